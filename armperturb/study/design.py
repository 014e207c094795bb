"""Plan an experiment: how well each parameter will be known, and the line powers that make it best known.

The person is synthetic and so is the noise (`HUMAN_NOISE`, `Instruments`); what the design promises is what they make
of it. The thesis's multisine, as strong as the same limits allow, stands beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from armperturb.analysis.arm_model import require_stable, total_admittance
from armperturb.analysis.design import Experiment, Limits, Noise, optimise
from armperturb.analysis.displacement import NoiseLevels
from armperturb.analysis.structures import GRIP_UNITS, STRUCTURES, Structure, unit
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.experiment import MAX_DURATION
from armperturb.envs.instruments import Instruments
from armperturb.perturbations import CLUSTERS, Multisine, Sampled
from armperturb.perturbations.line_spectrum import draw_multisine
from armperturb.perturbations.multisine import DESIGN_RATE, PERIOD, PERIOD_SAMPLES
from armperturb.study.protocol import LARGEST_RMS_DISPLACEMENT, trial_seed
from armperturb.study.validate import at_truth, true_values
from armperturb.subject import Subject
from armperturb.validation import require_number

Array = NDArray[np.float64]
Row = dict[str, Any]

Goal = Literal["reflex", "intrinsic", "grip", "mass", "all"]
"""Parameters whose standard errors are to be small."""

_QUANTITIES: Mapping[str, tuple[str, ...]] = {
    "reflex": ("kv", "kp", "ka", "kf", "Td", "fact"),
    "intrinsic": ("b", "k"),
    "mass": ("m",),
}
_GAINS = tuple(f"{quantity}_{joint}" for quantity in ("kv", "kp", "ka", "kf") for joint in ("s", "se", "e"))

SPREAD = 0.2
"""Share of each axis's power that is spread evenly over the band [-]. The optimum alone sits on a handful of
frequencies: whether the structure is right could not be told from it, nor admittances between them, and a person who
is not as assumed would be badly served. A fifth costs little (docs/design.md has the figures)."""

GAP, RATIO = 7, 1.06
"""From a cluster to the next: at least so many lines (three empty ones between), and such a ratio of frequencies."""

TIMESTEP = 1e-3
"""Of the simulation, whose noise is meant [s]."""


def cluster_starts() -> NDArray[np.int64]:
    """First lines of the clusters that may be used, in cycles per period, over the thesis's band, (cluster,)."""
    starts = [int(CLUSTERS[0, 0])]
    while (following := max(starts[-1] + GAP, round(RATIO * starts[-1]))) <= CLUSTERS[-1, 0]:
        starts.append(following)
    return np.array(starts)


@dataclass(frozen=True, kw_only=True)
class DesignSettings:
    """What is to be planned.

    Attributes:
      subject: who will be perturbed, as far as is known.
      goal: whose standard errors are to be small, see `Goal`.
      limits: RMS force per axis [N], RMS displacement of the handle per axis that the perturbation causes [m], and
        duration of a trial [s].
      model: structure that will be fitted, see `analysis.structures`; what it fixes is known. By default 3b, or 1 for a
        person without reflexes.
      trials: that will be identified together, each with phases of its own.
      peak: largest force there may ever be on an axis [N]; None for no such limit.
      spread: share of each axis's power that is spread evenly over the band, 0 to 1 [-].
      seed: of the phases.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range, the model has no such parameters, or the person is unstable.
    """

    subject: Subject
    goal: Goal
    limits: tuple[float, float, float]
    model: str | None = None
    trials: int = 8
    peak: float | None = None
    spread: float = SPREAD
    seed: int = 0

    def __post_init__(self) -> None:
        if self.goal not in get_args(Goal):
            raise ValueError(f"design: goal = {self.goal!r}; expected one of {', '.join(get_args(Goal))}")
        if len(self.limits) != 3:
            raise ValueError(
                f"design: limits = {self.limits!r}; expected three numbers: RMS force [N], RMS displacement [m], "
                "duration [s]"
            )
        force, displacement, duration = self.limits
        require_number("design", "limit of the force [N]", force, above=0.0)
        name = "limit of the displacement [m]"
        require_number("design", name, displacement, above=0.0, at_most=LARGEST_RMS_DISPLACEMENT)
        # A period that is not whole tells no lines apart.
        require_number("design", "duration [s]", duration, at_least=PERIOD, at_most=MAX_DURATION)
        if self.model is not None and self.model not in STRUCTURES:
            raise ValueError(f"design: model = {self.model!r}; expected one of {', '.join(STRUCTURES)}")
        for field, least in (("trials", 1), ("seed", 0)):
            require_number("design", field, getattr(self, field), at_least=least)
            if not isinstance(getattr(self, field), int):
                raise TypeError(f"design: {field} = {getattr(self, field)!r}; expected a whole number")
        if self.peak is not None:
            require_number("design", "peak", self.peak, above=0.0)
        require_number("design", "spread", self.spread, at_least=0.0, at_most=1.0)
        require_stable(self.subject, Environment())
        if not self.wanted():
            lacking = "" if any(self._gains()) else f", and {self.subject.name!r} no reflexes"
            raise ValueError(
                f"design: goal = {self.goal!r}; expected another, as model {self.model_name()} leaves none of these "
                f"parameters free{lacking}"
            )

    def _gains(self) -> list[float]:
        return [getattr(self.subject, name) for name in _GAINS]

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
            return tuple(name for name in free if name in GRIP_UNITS)
        quantities = _QUANTITIES[self.goal]
        return tuple(name for name in free if name not in GRIP_UNITS and name.partition("_")[0] in quantities)


class Lines(NamedTuple):
    """A multisine but for its phases.

    Attributes:
      lines: in cycles per period, (line,).
      power: mean square force [N^2], (line, axis).
      standard_error: predicted, of each free parameter, from all trials, SI, (parameter,).
      equally_noisy: the same, were the person as noisy as under the thesis's multisine, SI, (parameter,).
      displacement: RMS displacement of the handle that it causes, on average over phases [m], (axis,).
    """

    lines: NDArray[np.int64]
    power: Array
    standard_error: Array
    equally_noisy: Array
    displacement: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Design:
    """What came out.

    Attributes:
      settings: what was planned.
      names: of the free parameters.
      truth: their values, SI, (parameter,).
      thesis: its multisine, as strong as the limits allow.
      optimised: the best multisine within the limits.
      perturbations: realisations of the latter, one per trial.
      excess: bound of how far the optimum is from the best, see `analysis.design.Optimum` [-].
    """

    settings: DesignSettings
    names: tuple[str, ...]
    truth: Array
    thesis: Lines
    optimised: Lines
    perturbations: tuple[Sampled, ...]
    excess: float

    @cached_property
    def factor(self) -> float:
        """Geometric mean of the goal's standard errors, optimised over thesis's [-]."""
        return self._factor(self.optimised.standard_error)

    @cached_property
    def factor_equally_noisy(self) -> float:
        """The same, were the person under the optimised multisine as noisy as under the thesis's [-]."""
        return self._factor(self.optimised.equally_noisy)

    def _factor(self, error: Array) -> float:
        columns = [self.names.index(name) for name in self.settings.wanted()]
        return float(np.exp(np.mean(np.log((error / self.thesis.standard_error)[columns]))))

    def rows(self) -> list[Row]:
        """Predicted standard errors per parameter, SI."""
        wanted = self.settings.wanted()
        return [
            {
                "parameter": name,
                "unit": unit(name),
                "value": float(value),
                "goal": int(name in wanted),
                "sem_thesis": float(thesis),
                "sem_optimised": float(optimised),
                "ratio": float(optimised / thesis),
            }
            for name, value, thesis, optimised in zip(
                self.names, self.truth, self.thesis.standard_error, self.optimised.standard_error, strict=True
            )
        ]

    def spectrum_rows(self) -> list[Row]:
        """RMS force of each line."""
        return [
            {
                "signal": name,
                "frequency_hz": float(line / PERIOD),
                "force_x_N": float(np.sqrt(x)),
                "force_y_N": float(np.sqrt(y)),
            }
            for name, signal in (("thesis", self.thesis), ("optimised", self.optimised))
            for line, (x, y) in zip(signal.lines.tolist(), signal.power, strict=True)
        ]

    def signal_rows(self) -> list[Row]:
        """RMS and largest force, and RMS displacement of the handle, of each realisation."""
        moved = [displacements(self.settings.subject, signal) for signal in self.perturbations]
        return [
            {
                "trial": number,
                "axis": axis,
                "rms_force_N": float(np.sqrt(np.mean(signal.force[:PERIOD_SAMPLES, column] ** 2))),
                "peak_force_N": float(np.abs(signal.force[:, column]).max()),
                "rms_displacement_m": float(moved[number - 1][column]),
            }
            for number, signal in enumerate(self.perturbations, start=1)
            for column, axis in enumerate(("x", "y"))
        ]


def design(settings: DesignSettings) -> Design:
    """Plan.

    Raises:
      ValueError: no multisine tells about some of the model's parameters; the message names them.
    """
    force, displacement, duration = settings.limits
    structure, starts = settings.structure(), cluster_starts()
    lines = (starts[:, None] + np.arange(CLUSTERS.shape[1])).ravel()
    best = experiment_at(settings, lines)
    optimum = optimise(best, len(starts), settings.wanted(), Limits(force, displacement), settings.spread)
    seeds = [trial_seed(settings.seed, "design", number) for number in range(settings.trials)]
    drawn = [draw_multisine(lines, optimum.power, seed=seed, duration=duration) for seed in seeds]
    # How x and y add up depends on the phases: the worst trial must be within the limits.
    scale = min(1.0, displacement / max(float(displacements(settings.subject, one).max()) for one in drawn))

    usual = experiment_at(settings, CLUSTERS.ravel())
    multisine = Multisine(rms=force, phases=np.zeros((2, CLUSTERS.size)))
    thesis = np.repeat(multisine.amplitudes[:, None] ** 2 / 2.0, 2, axis=1)
    thesis /= max(1.0, float(usual.displacement(thesis).max()) / displacement**2)
    if settings.peak is not None:
        scale = min(scale, settings.peak / max(float(np.abs(one.force).max()) for one in drawn))
        multisines = [Multisine.draw(seed=seed, rms=float(np.sqrt(thesis[:, 0].sum()))) for seed in seeds]
        largest = max(float(np.abs(one.sample(DESIGN_RATE, PERIOD_SAMPLES)).max()) for one in multisines)
        thesis *= min(1.0, settings.peak / largest) ** 2

    def signal(of: Experiment, at: NDArray[np.int64], powers: Array) -> Lines:
        error, equally_noisy = (
            of.standard_error(powers, duration, settings.trials, demand=demand)
            for demand in (None, usual.demand(thesis))
        )
        return Lines(at, powers, error, equally_noisy, np.sqrt(of.displacement(powers)))

    return Design(
        settings=settings,
        names=structure.free,
        truth=true_values(settings.subject, structure),
        thesis=signal(usual, CLUSTERS.ravel(), thesis),
        optimised=signal(best, lines, scale**2 * optimum.power),
        perturbations=tuple(Sampled(force=scale * one.force, rate=one.rate) for one in drawn),
        excess=optimum.excess,
    )


def experiment_at(settings: DesignSettings, lines: NDArray[np.int64]) -> Experiment:
    """The planned experiment with a multisine of these lines."""
    frequency = lines / PERIOD
    human, instruments = HUMAN_NOISE[settings.subject.task], Instruments()
    floor, louder = (human.torque_spectrum([rms, rms], TIMESTEP, frequency)[:, 0] for rms in (0.0, 1.0))
    noise = Noise(floor, louder - floor, noise_levels(instruments), DESIGN_RATE)
    return Experiment(settings.subject, settings.structure(), Environment(), frequency, noise)


def displacements(subject: Subject, perturbation: Sampled) -> Array:
    """RMS displacement of the handle that a periodic perturbation causes once its start is forgotten [m], (axis,)."""
    spectrum = rfft(perturbation.force[:PERIOD_SAMPLES], axis=0)[1:] / PERIOD_SAMPLES
    total = total_admittance(subject, Environment(), np.arange(1, len(spectrum) + 1) / PERIOD)
    return np.asarray(np.sqrt(2.0 * np.sum(np.abs(np.einsum("fij,fj->fi", total, spectrum)) ** 2, axis=0)))


def noise_levels(instruments: Instruments) -> NoiseLevels:
    """Noise of gauge and encoders per sample, the latter from rounding to counts where the handle starts."""
    step = 2.0 * np.pi / 2**instruments.encoder_bits
    # Of the handle per rad of each joint: its distance from that joint.
    levers = np.hypot(*instruments.base), instruments.link_lengths[1]
    return NoiseLevels(instruments.force_noise, float(step / np.sqrt(12.0) * np.hypot(*levers) / np.sqrt(2.0)))
