"""What is to be planned: who is perturbed, what should be estimated well, and within which limits."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from armperturb.analysis.arm.state_space import require_stable
from armperturb.analysis.defaults import SETTLING, WINDOW_START
from armperturb.analysis.fit.joint_likelihood import SHARES
from armperturb.analysis.fit.structures import STRUCTURES, Structure
from armperturb.analysis.fit.truth import at_truth
from armperturb.analysis.smoother import NoiseLevels
from armperturb.environment import Environment
from armperturb.envs.lab.instruments import Instruments
from armperturb.perturbations import Perturbation
from armperturb.perturbations.multisine import PERIOD
from armperturb.perturbations.perturbation import LARGEST_RMS_DISPLACEMENT, MAX_DURATION
from armperturb.subject import Subject
from armperturb.validation import require_number, require_one_of, require_ranges

Goal = Literal["reflex", "intrinsic", "grip", "mass", "all"]
"""Parameters whose standard errors are to be small."""

NoiseLaw = Literal["held", "follows"]
"""How noisy the person is: as under the thesis's multisine, and more only where a joint is loaded more; or as the
synthetic people, whose noise rises and falls with the load."""

_QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "reflex": ("kv", "kp", "ka", "kf", "Td", "fact"),
    "intrinsic": ("b", "k"),
    "mass": ("m",),
}
_GAINS = tuple(f"{quantity}_{joint}" for quantity in ("kv", "kp", "ka", "kf") for joint in ("s", "se", "e"))

SPREAD = 0.2
"""Share of each axis's power that is spread evenly over the band [-]. The optimum alone has power at a handful of
frequencies: it could neither show whether the structure is right nor give admittances between them, and it would suit
a person who differs from the assumed one badly. A fifth costs little (docs/design.md has the figures)."""

SHORTEST_PERIOD = PERIOD / 4
"""Of a multisine [s]; its clusters are 0.8 Hz wide."""

DECIMALS = 9
"""Of durations [s]: sums of decimal numbers are a little off, and a message shows the number that is meant."""

LEAST_FORCE, MOST_FORCE = 1e-3, 1e3
"""Of a limit [N]: gauges resolve no less, manipulators exert no more."""


@dataclass(frozen=True, kw_only=True)
class DesignSettings:
    """What is to be planned.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range, the model has no such parameters, or the person is unstable.
    """

    subject: Subject
    """TOML file of the person who will be perturbed, as far as known."""
    goal: Goal
    """Parameters whose standard errors are minimised."""
    force: float
    """Largest RMS force per axis [N]."""
    displacement: float
    """Largest RMS displacement of the handle per axis [m]."""
    duration: float
    """Duration of a trial [s]."""
    model: Literal["1", "2", "3", "4", "5", "6", "3a", "3b"] | None = None
    """Model structure that will be fitted; what it fixes is taken as known. By default 3b, or 1 for a person without
    reflexes."""
    trials: int = 8
    """Number of trials that will be identified together, each with phases of its own."""
    peak: float | None = None
    """Largest force that may occur on an axis at any time [N]; by default any."""
    spread: float = SPREAD
    """Share of each axis's power that is spread evenly over the band, 0 to 1, so that structure and admittances can be
    judged from the same trials."""
    noise: NoiseLaw = "held"
    """Noise of the person: held at its level under the thesis's multisine, also under less load; or following the load,
    as the noise of the synthetic people does."""
    perturbation: Perturbation | None = None
    """CSV file (see simulate) of another perturbation, whose standard errors are given for comparison: it is played
    once, by a person at rest before it; it need not keep the limits."""
    manipulator: tuple[float, float, float] = (Environment.m_env, Environment.b_env, Environment.k_env)
    """Mass [kg], damping [Ns/m] and stiffness [N/m] of the manipulator, as identify prints them; by default the
    thesis's."""
    seed: int = 0
    """Seed of the phases."""

    def __post_init__(self) -> None:
        require_one_of("design", "goal", self.goal, get_args(Goal))
        require_one_of("design", "noise", self.noise, get_args(NoiseLaw))
        require_number("design", "force [N]", self.force, at_least=LEAST_FORCE, at_most=MOST_FORCE)
        require_number("design", "displacement [m]", self.displacement, above=0.0, at_most=LARGEST_RMS_DISPLACEMENT)
        # Displacements below the encoders' steps are lost in their noise.
        least = noise_levels(Instruments()).displacement
        if self.displacement < least:
            raise ValueError(
                f"design: displacement [m] = {self.displacement:g}; expected at least the noise of the encoders, "
                f"{least:.2g} m"
            )
        # Lines are resolved only over whole periods.
        shortest = round(SHORTEST_PERIOD + SETTLING, DECIMALS)
        require_number("design", "duration [s]", self.duration, at_least=shortest, at_most=MAX_DURATION)
        require_one_of("design", "model", self.model, (*STRUCTURES, None))
        require_ranges("design", self)
        require_number("design", "peak [N]", self.peak, at_least=LEAST_FORCE, optional=True)
        if self.perturbation is not None:
            name = "duration of the perturbation [s]"
            require_number("design", name, self.perturbation.duration, at_least=shortest, at_most=MAX_DURATION)
        if len(self.manipulator) != 3:
            raise ValueError(f"design: manipulator = {self.manipulator}; expected mass, damping and stiffness")
        require_stable(self.subject, self.environment)
        if not self.wanted():
            lacking = "" if any(self._gains()) else f", and {self.subject.name!r} no reflexes"
            raise ValueError(
                f"design: goal = {self.goal!r}; expected another, as model {self.model_name()} leaves none of these "
                f"parameters free{lacking}"
            )

    def _gains(self) -> list[float]:
        return [getattr(self.subject, name) for name in _GAINS]

    @property
    def environment(self) -> Environment:
        """What the hand will hold."""
        m_env, b_env, k_env = self.manipulator
        return Environment(m_env=m_env, b_env=b_env, k_env=k_env)

    @property
    def period(self) -> float:
        """Of the multisine [s]: the thesis's, or its half or quarter where the duration is too short for that."""
        period = PERIOD
        while round(period + SETTLING, DECIMALS) > self.duration:
            period /= 2.0
        return period

    @property
    def start(self) -> float:
        """Of the window of whole periods in which `identify` estimates spectra [s]."""
        return min(WINDOW_START, self.duration - self.period)

    def model_name(self) -> str:
        """Name of the structure that will be fitted."""
        return self.model or ("3b" if any(self._gains()) else "1")

    def structure(self) -> Structure:
        """What will be fitted, what it fixes being known."""
        structure = STRUCTURES[self.model_name()]
        return at_truth(structure, self.subject).named(structure.name)

    def wanted(self) -> tuple[str, ...]:
        """Free parameters that the goal names."""
        free = self.structure().free
        if self.goal == "all":
            return free
        if self.goal == "grip":
            return tuple(name for name in free if name in SHARES["grip"])
        quantities = _QUANTITIES[self.goal]
        return tuple(name for name in free if name not in SHARES["grip"] and name.partition("_")[0] in quantities)


def noise_levels(instruments: Instruments) -> NoiseLevels:
    """Noise of gauge and encoders per sample, the latter from rounding to counts where the handle starts."""
    step = 2.0 * np.pi / 2**instruments.encoder_bits
    # Of the handle per rad of each joint: its distance from that joint.
    levers = np.hypot(*instruments.base), instruments.link_lengths[1]
    return NoiseLevels(instruments.force_noise, float(step / np.sqrt(12.0) * np.hypot(*levers) / np.sqrt(2.0)))
