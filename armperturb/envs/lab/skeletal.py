"""The nonlinear skeletal model: the arm of the linear model, with true geometry and inertia (thesis 2.7, eq. 2.17).

It is MuJoCo's arm with the linear muscle, driven by what was recorded and free of noise, instruments and muscle law. So
what it predicts beside the linear model is the effect of geometry, centripetal and Coriolis forces alone. Its state at
the onset of a pulse is the linear model's (figure 2.9): joint angles and their velocities, displacement and velocity of
the handle, and what spindles have sent on its way. In the linear model the hand is then where J q has it, in this one
where the joints put it: what the two differ by deflects the grip from the onset on.

A recorded disturbance runs straight between its samples, as in `analysis.arm_model.simulate_linear`. Delays are exact
here and third-order Pade approximations there, which for the low-pass of muscle activation is the same.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from mujoco import MjData, mj_initCtrlHistory
from mujoco.batch import Batch
from scipy import signal

from armperturb.analysis.arm.state_space import fastest_pole, linear_states, require_stable
from armperturb.arrays import Array
from armperturb.controllers.reflex import ReflexGains, activate, reflex_gains, spindle_excitation
from armperturb.environment import Environment
from armperturb.envs.lab.simulation import DIVERGED, silent_simulator
from armperturb.models import JOINTS, REFLEXES, SLIDES, build_model, history_length
from armperturb.subject import Subject
from armperturb.validation import require_number

STEP = 2.5e-3
"""Longest step of the simulation [s]; docs/method.md has the error that it makes."""

STEP_LIMIT = 1.0
"""Largest product of the fastest pole's modulus and the step [-]; a faster arm takes smaller steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """What one arm is asked to predict.

    Attributes:
      arm: the model; a muscle law takes no part in how it moves.
      environment: what the hand holds.
      perturbation: disturbance as recorded d [N], (time, axis).
      onset: sample at which the skeletal model takes over from the linear one, which has run from rest; at 0 it starts
        from rest itself.

    Raises:
      TypeError: onset is no whole number.
      ValueError: the perturbation has the wrong shape or is not finite, onset is not one of its samples, the arm has
        force or acceleration feedback, which the model of eq. 2.17 has not, or is unstable on the environment.
    """

    arm: Subject
    environment: Environment
    perturbation: Array
    onset: int = 0

    def __post_init__(self) -> None:
        shape = np.shape(self.perturbation)
        if len(shape) != 2 or shape[0] < 2 or shape[1] != 2:
            raise ValueError(f"Prediction: perturbation of shape {shape}; expected (n, 2) with at least 2 samples")
        if not np.isfinite(self.perturbation).all():
            raise ValueError("Prediction: perturbation is not finite; expected finite forces")
        if isinstance(self.onset, bool) or not isinstance(self.onset, int | np.integer):
            raise TypeError(f"Prediction: onset = {self.onset!r}; expected a whole number")
        require_number("Prediction", "onset", int(self.onset), at_least=0, at_most=shape[0] - 1)
        if any(self.arm.joint_triple("ka") + self.arm.joint_triple("kf")):
            raise ValueError(
                f"Prediction: subject {self.arm.name!r} has acceleration or force feedback; expected velocity and "
                "position feedback only"
            )
        require_stable(self.arm, self.environment)


class _Start(NamedTuple):
    """State of an arm at the onset.

    Attributes:
      linear: states of the linear model, (state,); first q', q, x', x.
      filters: of the activation, (2, joint).
      active: torque that reflexes have sent in the steps before, oldest first [Nm], (step, joint).
    """

    linear: Array
    filters: Array
    active: Array


def simulate_skeletal(predictions: Sequence[Prediction], rate: float) -> list[Array]:
    """Displacement of the handle from the onset on, as the nonlinear skeletal model has it [m], (time, axis) each.

    All arms with the same step are simulated side by side on one core, and none knows of the others. From the sample on
    at which a handle reaches the workspace limit, or an arm cannot be integrated, its displacement is NaN.

    Args:
      predictions: what to simulate.
      rate: of the recordings [Hz].

    Raises:
      TypeError: rate is no number.
      ValueError: rate is not positive, or an arm's delay is shorter than its step.
    """
    require_number("simulate_skeletal", "rate", rate, above=0.0)
    n_steps = [_steps_per_sample(one, rate) for one in predictions]
    results: list[Array] = [np.empty((0, 2))] * len(predictions)
    for decimation in sorted(set(n_steps)):
        places = [place for place, own in enumerate(n_steps) if own == decimation]
        simulated = _simulate([predictions[place] for place in places], rate, decimation)
        for place, displacement in zip(places, simulated, strict=True):
            results[place] = displacement
    return results


def _steps_per_sample(one: Prediction, rate: float) -> int:
    pole = max(fastest_pole(one.arm, one.environment) / STEP_LIMIT, 1.0 / STEP)
    return math.ceil(round(pole / rate, 9))


def _simulate(predictions: Sequence[Prediction], rate: float, decimation: int) -> list[Array]:
    """`simulate_skeletal` with the same number of steps in each sample of all arms."""
    timestep = 1.0 / (rate * decimation)
    arms = [one.arm for one in predictions]
    n_history = max(history_length(arm, timestep) for arm in arms)
    models = [
        build_model(one.arm, one.environment, timestep=timestep, n_history=n_history, visual=False)
        for one in predictions
    ]
    gains = _gains(arms, timestep)
    starts = _starts(predictions, gains, timestep, decimation, n_history)

    n_samples = [len(one.perturbation) - one.onset for one in predictions]
    longest = max(n_samples)
    held = np.zeros(((longest - 1) * decimation, len(arms), 2))
    for trial, one in enumerate(predictions):
        own = _held(one.perturbation[one.onset :], decimation)
        held[: len(own), trial] = own

    batch = Batch(models[0], len(arms), 1)
    batch.set_models(models)
    batch.reset()
    hinge, slide = (
        slice(models[0].joint(names[0]).qposadr[0], models[0].joint(names[1]).qposadr[0] + 1)
        for names in (JOINTS, SLIDES)
    )
    motor = slice(models[0].actuator(REFLEXES[0]).id, models[0].actuator(REFLEXES[1]).id + 1)
    qpos, qvel, ctrl, history = (batch.bind(name) for name in ("qpos", "qvel", "ctrl", "history"))
    applied = batch.bind("qfrc_applied")
    angle, velocity, handle = qpos[:, hinge], qvel[:, hinge], qpos[:, slide]
    linear = np.array([start.linear for start in starts])
    velocity[:], angle[:] = linear[:, 0:2], gains.posture + linear[:, 2:4]
    qvel[:, slide], handle[:] = linear[:, 4:6], linear[:, 6:8]
    for trial, (model, start) in enumerate(zip(models, starts, strict=True)):
        data = MjData(model)
        for joint, name in enumerate(REFLEXES):
            mj_initCtrlHistory(model, data, model.actuator(name).id, None, -start.active[:, joint])
        history[trial] = data.history

    workspace = np.array([[one.environment.workspace] for one in predictions])
    activation = np.stack([start.filters for start in starts], axis=1)
    displacement = np.full((len(arms), longest, 2), np.nan)
    inside = np.ones(len(arms), dtype=bool)
    with silent_simulator():
        for sample in range(longest):
            inside &= (np.abs(handle) < workspace).all(axis=1) & ~(batch.warning[:, DIVERGED, 1] > 0).any(axis=1)
            displacement[inside, sample] = handle[inside]
            for step in range(sample * decimation, min((sample + 1) * decimation, len(held))):
                active, activation = activate(gains, activation, spindle_excitation(gains, angle, velocity))
                np.negative(active, out=ctrl[:, motor])
                applied[:, slide] = held[step]
                batch.step()
    return [one[:n] for one, n in zip(displacement, n_samples, strict=True)]


def _between(force: Array, decimation: int) -> Array:
    """A force that runs straight between samples, at every step [N], (step, axis)."""
    sample = np.arange((len(force) - 1) * decimation + 1) / decimation
    return np.stack([np.interp(sample, np.arange(len(force)), of_axis) for of_axis in force.T], axis=1)


def _held(force: Array, decimation: int) -> Array:
    """What to hold over each step for a handle to feel a force that runs straight between samples [N], (step, axis).

    The mean over a step brings the handle to the right velocity, but too far by its rise times step^2 / (12 m_env); the
    second difference takes that back.
    """
    fine = _between(force, decimation)
    mean = (fine[1:] + fine[:-1]) / 2
    # Before the start is no rise: what came until then is in the state.
    return mean - np.diff(np.concatenate([mean[:1], mean, mean[-1:]]), n=2, axis=0) / 12.0


def _gains(arms: Sequence[Subject], timestep: float) -> ReflexGains:
    """`reflex_gains` whose filters make up for straight lines between steps.

    Running straight between steps, as the filter's input and the delayed torque do, a signal loses (omega step)^2 / 12.
    """
    gains = reflex_gains(arms, timestep)
    numerator = np.empty_like(gains.numerator)
    for trial, arm in enumerate(arms):
        for joint, cutoff in enumerate((arm.fact_s, arm.fact_e)):
            omega = 2 * np.pi * cutoff
            continuous = ([-((omega * timestep) ** 2) / 6, 0.0, omega**2], [1.0, 2 * arm.zeta_act * omega, omega**2])
            numerator[:, trial, joint] = np.ravel(signal.cont2discrete(continuous, timestep, method="foh")[0])
    return replace(gains, numerator=numerator)


def _starts(
    predictions: Sequence[Prediction], gains: ReflexGains, timestep: float, decimation: int, n_history: int
) -> list[_Start]:
    """Where the linear models are at the onsets, and what their spindles have sent in the `n_history` steps before."""
    starts = []
    for trial, one in enumerate(predictions):
        force = _between(one.perturbation[: one.onset + 1], decimation)
        states = linear_states(one.arm, one.environment, force, 1.0 / timestep)
        past = states[:-1]
        excitation = past[:, 0:2] @ gains.velocity[trial].T + past[:, 2:4] @ gains.position[trial].T
        active, filters = np.zeros((n_history, 2)), np.zeros((2, 2))
        for joint in range(2):
            coefficients = gains.numerator[:, trial, joint], gains.denominator[:, trial, joint]
            sent, filters[:, joint] = signal.lfilter(*coefficients, excitation[:, joint], zi=np.zeros(2))
            kept = sent[-n_history:]
            active[n_history - len(kept) :, joint] = kept
        starts.append(_Start(states[-1], filters, active))
    return starts
