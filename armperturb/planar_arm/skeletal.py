"""The nonlinear skeletal model: the linear model's arm with true geometry and inertia (thesis 2.7, eq. 2.17).

It differs from the linear model only in the geometry of the moving arm and in centripetal and Coriolis forces. At the
onset of a pulse it takes over the linear model's state (figure 2.9): joint angles and their velocities, displacement
and velocity of the handle, and the reflex torque on its way. The linear model has the hand at J q, this one where the
joints put it; the difference deflects the grip from the onset on.

As in `simulate_linear`, a recorded disturbance runs straight between its samples. Delays are exact here, and
third-order Pade approximations there; after the low-pass filter of muscle activation, the two are indistinguishable.
"""

from dataclasses import replace

import numpy as np
from scipy import signal

from armperturb.analysis.arm.state_space import fastest_pole, linear_states, require_stable
from armperturb.arrays import Array
from armperturb.controllers.lanes import Table
from armperturb.environment import Environment
from armperturb.planar_arm.lanes import Start, at_rest, lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import Subject
from armperturb.validation import require_number, require_whole

STEP = 1.25e-3
"""Longest step of the simulation [s]; docs/method.md has the error that it makes."""

STEP_LIMIT = 1.0
"""Largest product of the fastest pole's modulus and the step [-]; a faster arm takes smaller steps."""


def simulate_skeletal(
    arm: Subject,
    environment: Environment,
    perturbation: Array,
    rate: float,
    onset: int = 0,
    *,
    longest_step: float = STEP,
) -> Array:
    """Displacement of the handle from the onset on, as the nonlinear skeletal model predicts it [m], (time, axis).

    It is NaN from the sample at which the handle reaches the workspace limit, or the arm diverges.

    Args:
      arm: the model; its muscle law takes no part.
      environment: what the hand holds.
      perturbation: disturbance as recorded d [N], (time, axis).
      rate: of the samples [Hz].
      onset: sample at which this model takes over from the linear one, which has run from rest; at 0 it starts from
        rest itself.
      longest_step: of the simulation [s].

    Raises:
      TypeError: the rate is no number, or the onset no whole number.
      ValueError: the rate is not positive, the perturbation has the wrong shape or is not finite, no sample follows the
        onset, the arm has force or acceleration feedback, which eq. 2.17 does not have, a delay is shorter than the
        step, or the arm is unstable on the environment.
      ModuleNotFoundError: numba is not installed.
    """
    require_number("simulate_skeletal", "rate", rate, above=0.0)
    force = np.asarray(perturbation, dtype=float)
    if force.ndim != 2 or len(force) < 2 or force.shape[1] != 2:
        raise ValueError(
            f"simulate_skeletal: perturbation of shape {force.shape}; expected (n, 2) with at least 2 samples"
        )
    if not np.isfinite(force).all():
        raise ValueError("simulate_skeletal: perturbation is not finite; expected finite forces")
    require_whole("simulate_skeletal", "onset", onset, at_least=0)
    require_number("simulate_skeletal", "onset", onset, at_most=len(force) - 2)
    if any(arm.joint_triple("ka") + arm.joint_triple("kf")):
        raise ValueError(
            f"simulate_skeletal: subject {arm.name!r} has acceleration or force feedback; expected velocity and "
            "position feedback only"
        )
    require_stable(arm, environment)
    step = min(longest_step, STEP_LIMIT / fastest_pole(arm, environment))
    disturbance = Disturbances(force[None, onset:], rate, longest_step=step, straight=True)
    lanes = lane_table([replace(arm, muscle=None)], [environment], disturbance.timestep)
    start = at_rest(lanes, disturbance.timestep)
    if onset:
        _take_over(start, lanes, arm, environment, force[: onset + 1], disturbance)
    [path] = disturbance.responses(lanes, np.zeros(1, dtype=np.intp), start=start)
    inside = np.logical_and.accumulate((np.abs(path) < environment.workspace).all(axis=1))
    return np.where(inside[:, None], path, np.nan)


def _take_over(
    start: Start, lanes: Table, arm: Subject, environment: Environment, force: Array, disturbance: Disturbances
) -> None:
    """Put the one lane where the linear model is after a force (time, axis), with what its spindles have sent."""
    step = np.arange((len(force) - 1) * disturbance.decimation + 1) / disturbance.decimation
    fine = np.stack([np.interp(step, np.arange(len(force)), of_axis) for of_axis in force.T], axis=1)
    states = linear_states(arm, environment, fine, 1.0 / disturbance.timestep)
    # Of the linear model: q', q, x', x.
    start.state[0] = states[-1, [2, 3, 6, 7, 0, 1, 4, 5]]
    past, memory = states[:-1], start.memory[0]
    excitation = past[:, 0:2] @ arm.joint_matrix("kv").T + past[:, 2:4] @ arm.joint_matrix("kp").T
    n_history = len(memory["sent"])
    for joint in range(2):
        coefficients = lanes["numerator"][0, :, joint], lanes["denominator"][0, :, joint]
        sent, memory["filters"][:, joint] = signal.lfilter(*coefficients, excitation[:, joint], zi=np.zeros(2))
        recent = sent[-n_history:]
        memory["sent"][n_history - len(recent) :, joint] = recent
