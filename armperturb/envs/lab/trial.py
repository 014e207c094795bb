"""One trial: a person under a perturbation, what is random about it, and what it puts into the simulation."""

from dataclasses import dataclass
from types import NoneType

import numpy as np

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.state_space import fastest_pole, largest_real_pole
from armperturb.arrays import Array
from armperturb.controllers.remnant import HumanNoise
from armperturb.environment import Environment, Strap
from armperturb.perturbations import Perturbation, Pulse
from armperturb.subject import Subject
from armperturb.validation import require_name, require_number, require_type, require_whole

HUMAN, MARKER, EMG = 1, 2, 3
"""What a trial's seed is extended by for each source of chance; the strain gauge takes the seed as it is."""

MARGIN_KEPT = 0.5
"""Share of a person's distance from instability (largest real part of a pole) that every trial keeps [-]: closer to it,
an arm rings on the remnant in a way that people do not."""

RK4_LIMIT = 2.5
"""Largest product of a pole's modulus and the step [-]: Runge-Kutta 4 is stable up to 2.79 on the real axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One person under one perturbation, with the labels that the recording carries.

    Attributes:
      subject: the person.
      perturbation: what is applied.
      condition: name in the protocol, e.g. "PT7.5"; the subject's task if empty.
      repetition: of the condition, from 0.
      pulse_level: multiple of the unit pulse; 0 without pulse.
      order: place in the session, from 0.
      seed: of the person's and the instruments' noise; a whole number of at least 0.
      noise: how noisy the person is; None for a person without noise, the same in every trial.
      contraction: share of full activation to which all muscles contract against one another for a while, and are
        silent before and after, for EMG alone [-], 0 to 1; None for what posture and reflexes ask for.

    Raises:
      TypeError: seed, order or repetition is not a whole number, or another field is of another type.
      ValueError: seed, order or repetition is not finite or negative, condition cannot be printed on one line, or
        pulse_level or contraction is out of its range.
    """

    subject: Subject
    perturbation: Perturbation
    condition: str = ""
    repetition: int = 0
    pulse_level: float = 0.0
    order: int = 0
    seed: int = 0
    noise: HumanNoise | None = None
    contraction: float | None = None

    def __post_init__(self) -> None:
        require_type("Trial: subject", self.subject, Subject, "a Subject")
        require_type("Trial: perturbation", self.perturbation, Perturbation, "a perturbation, e.g. Multisine or Pulse")
        if self.condition != "":
            require_name("Trial", "condition", self.condition)
        require_number("Trial", "pulse_level", self.pulse_level)
        for field in ("repetition", "order", "seed"):
            require_number("Trial", field, getattr(self, field), at_least=0)
            require_whole("Trial", field, getattr(self, field), at_least=0)
        require_type("Trial: noise", self.noise, (HumanNoise, NoneType), "HumanNoise or None")
        require_number("Trial", "contraction", self.contraction, at_least=0.0, at_most=1.0, optional=True)

    def generator(self, source: int) -> np.random.Generator:
        """The trial's own stream of chance for one source (`HUMAN`, `MARKER`, `EMG`)."""
        return np.random.default_rng([self.seed, source])


def subject_in(trial: Trial, environment: Environment, strap: Strap | None = None) -> Subject:
    """The person as it is in this trial."""
    if trial.noise is None:
        return trial.subject
    bound = MARGIN_KEPT * largest_real_pole(trial.subject, environment, strap)
    stream = trial.generator(HUMAN).spawn(2)[0]
    return trial.noise.vary(trial.subject, stream, lambda drawn: largest_real_pole(drawn, environment, strap) <= bound)


def noise_torque(trial: Trial, timestep: float, n_steps: int) -> Array | None:
    """Torque of the person's noise [Nm], (step, joint); None if there is no noise."""
    if trial.noise is None:
        return None
    # The demand is the continuous perturbation's: the pulse is over before a person could answer with more effort.
    pulse = pulse_of(trial.perturbation)
    end = pulse.onset if pulse else trial.perturbation.duration
    force = trial.perturbation.sample(1.0 / timestep, round(end / timestep))
    x, y = hand_jacobian(trial.subject)
    load = force[:, :1] * x + force[:, 1:] * y  # not @: BLAS may add in another order on another number of threads
    demand = np.sqrt(np.mean(load**2, axis=0)) if len(load) else np.zeros(2)
    return trial.noise.torque(demand, timestep, n_steps, trial.generator(HUMAN).spawn(2)[1])


def pulse_of(perturbation: Perturbation) -> Pulse | None:
    """The pulse of a perturbation, if it has one."""
    return perturbation if isinstance(perturbation, Pulse) else getattr(perturbation, "pulse", None)


def require_integrable(subject: Subject, environment: Environment, strap: Strap | None, timestep: float) -> None:
    """Refuse an arm that is too fast for the simulation's step.

    Args:
      subject: as it is in the trial.
      environment: what the hand holds.
      strap: what lets the shoulder move; None holds it in place.
      timestep: of the simulation [s].

    Raises:
      ValueError: `RK4_LIMIT` is exceeded.
    """
    pole = fastest_pole(subject, environment, strap)
    if pole * timestep > RK4_LIMIT:
        parts, large = (
            ("arm and environment", "grip") if strap is None else ("arm, environment and strap", "grip, strap")
        )
        raise ValueError(
            f"subject {subject.name!r}: fastest pole of {parts} = {pole:.4g} 1/s; expected at most "
            f"{RK4_LIMIT / timestep:.4g} 1/s at a step of {timestep:g} s ({large} or damping too large for the masses)"
        )


def known_ahead(trial: Trial, timestep: float, n_steps: int, parts: int = 1) -> Array:
    """What the motors of `models.rig.KNOWN` do from one step before the first to `AHEAD` steps after the last one.

    Args:
      trial: whose perturbation and noise.
      timestep: at which the noise is drawn [s].
      n_steps: of the trial, of the simulation's step.
      parts: number of steps of the simulation in one of those; the noise is interpolated between them.

    Returns:
      Torque of the person's noise on the joints [Nm], and force on the handle [N], (n_steps + 4, motor).
    """
    from armperturb.models.rig import AHEAD, KNOWN  # here, as protocols are read without the simulator

    step = timestep / parts
    known = np.zeros((n_steps + AHEAD + 1, len(KNOWN)))
    known[:, 2:] = trial.perturbation.sample(1.0 / step, len(known), -step)
    coarse = -(-(n_steps + AHEAD - 1) // parts) + 1
    torque = noise_torque(trial, timestep, coarse)
    if torque is not None:
        if parts > 1:
            from scipy.interpolate import CubicSpline  # here, as hardly a trial needs it

            torque = CubicSpline(np.arange(coarse), torque)(np.arange(n_steps + AHEAD) / parts)
        known[1:, :2] = torque
    return known
