"""Plan an experiment: how well each parameter will be known, and the line powers that make it best known.

The person is synthetic and so is the noise (`HUMAN_NOISE`, `Instruments`); what the design promises is what they make
of it. The thesis's multisine, as strong as the same limits allow, stands beside it. That people are quieter when they
are pushed less is known of the synthetic ones alone. So by default the noise is held at what it is under the thesis's
multisine, and no joint is loaded more than by that one; what quieter people would add is told beside it.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.fft import irfft, rfft

from armperturb.analysis.arm.linear_arm import total_admittance
from armperturb.analysis.fit.joint_likelihood import SHARES
from armperturb.analysis.fit.structures import unit
from armperturb.analysis.fit.truth import true_values
from armperturb.analysis.results import Description, Result
from armperturb.arrays import Array, ComplexArray
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.perturbations import CLUSTERS, Multisine, Sampled
from armperturb.perturbations.line_spectrum import draw_multisine
from armperturb.perturbations.multisine import DESIGN_RATE, PERIOD, PERIOD_SAMPLES
from armperturb.seeds import trial_seed
from armperturb.study.planning.information import Limits, optimise
from armperturb.study.planning.settings import DesignSettings, NoiseLaw
from armperturb.study.planning.signals import Signal, experiment_at, multisine_signal, proposed_signal
from armperturb.validation import require_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PEAK_ROUNDS = 5
"""How often the optimum is sought where the largest force is limited: the ratio to RMS force hardly changes then."""

GAP, RATIO = 7, 1.06
"""From a cluster to the next: at least so many lines (three empty ones between), and such a ratio of frequencies."""


def cluster_starts(period: float = PERIOD) -> NDArray[np.int64]:
    """First lines of the clusters that may be used, in cycles per period, over the thesis's band, (cluster,).

    Args:
      period: [s].
    """
    # Above the thesis's lowest line, and at least two periods in the window.
    starts = [max(2, int(np.ceil(CLUSTERS[0, 0] * period / PERIOD)))]
    highest = CLUSTERS[-1, -1] * period / PERIOD - (CLUSTERS.shape[1] - 1)
    while (following := max(starts[-1] + GAP, round(RATIO * starts[-1]))) <= highest:
        starts.append(following)
    return np.array(starts)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Design(Result):
    """What came out.

    Attributes:
      settings: what was planned.
      names: of the free parameters.
      truth: their values, SI, (parameter,).
      thesis: its multisine, as strong as the limits allow.
      optimised: the best multisine within the limits.
      proposed: the proposed perturbation, played in every trial, if there is one.
      perturbations: realisations of the optimised one, one per trial.
      excess: bound of how far the optimum is from the best, see `information.Optimum` [-]; None if the limit of the
        largest force binds, for which there is no bound.
    """

    settings: DesignSettings
    names: tuple[str, ...]
    truth: Array
    thesis: Signal
    optimised: Signal
    proposed: Signal | None
    perturbations: tuple[Sampled, ...]
    excess: float | None

    @property
    def factor(self) -> float:
        """Geometric mean of the goal's standard errors, optimised over thesis's, by the law of the settings [-]."""
        return self.factors[self.settings.noise]

    @cached_property
    def factors(self) -> dict[NoiseLaw, float]:
        """Law of the noise to that factor."""
        columns = [self.names.index(name) for name in self.settings.wanted()]
        best, usual = self.optimised.standard_error, self.thesis.standard_error
        return {law: float(np.exp(np.mean(np.log((best[law] / usual[law])[columns])))) for law in get_args(NoiseLaw)}

    @cached_property
    def between_trials(self) -> Array:
        """What adds to each standard error (as squares) as synthetic people differ from trial to trial, SI.

        That is the SD over trials of a parameter's mean over the joints that it stands for, over the root of the
        number of trials, (parameter,).
        """
        human = HUMAN_NOISE[self.settings.subject.task]
        spread = {name: getattr(human, f"spread_{name.partition('_')[0]}", 0.0) for name in self.names}
        shares = np.array([0.0 if name in SHARES["grip"] else spread[name] for name in self.names])
        return np.abs(self.truth) * shares / np.sqrt(self.settings.trials)

    def describe(self) -> Description:
        """Predicted standard errors, and what the signals demand."""
        from armperturb.study.planning.report import describe

        return describe(self)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw standard errors against duration and number of trials, and the spectra of the signals.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (2, 2).
        """
        from armperturb.study.planning.report import plot_design

        return plot_design(self, figure)

    def to_frame(self) -> pd.DataFrame:
        """Predicted standard errors per parameter, SI."""
        wanted, law = self.settings.wanted(), self.settings.noise
        thesis, optimised = self.thesis.standard_error[law], self.optimised.standard_error
        frame = pd.DataFrame(
            {
                "parameter": self.names,
                "unit": [unit(name) for name in self.names],
                "value": self.truth,
                "goal": [int(name in wanted) for name in self.names],
                "sem_thesis": thesis,
                "sem_optimised": optimised[law],
                "ratio": optimised[law] / thesis,
                "sem_noise_held": optimised["held"],
                "sem_noise_follows": optimised["follows"],
                "between_trials": self.between_trials,
            }
        )
        return frame if self.proposed is None else frame.assign(sem_proposed=self.proposed.standard_error[law])

    def to_xarray(self) -> xr.Dataset:
        """What each signal has and yields, along a dimension `signal`.

        Variables `power` [N^2] of each line (frequency, axis), NaN at frequencies that are no lines of a signal;
        `standard_error` (noise, parameter), in the unit of the parameter; `displacement`, its RMS [m] (axis).
        """
        signals = {"thesis": self.thesis, "optimised": self.optimised, "proposed": self.proposed}
        there = {name: signal for name, signal in signals.items() if signal is not None}
        parts = []
        for signal in there.values():
            variables = {
                "power": (("frequency", "axis"), signal.power, {"units": "N2"}),
                "standard_error": (("noise", "parameter"), np.array([*signal.standard_error.values()])),
                "displacement": ("axis", signal.displacement, {"units": "m"}),
            }
            coords = {"axis": ["x", "y"], "noise": list(signal.standard_error), "parameter": list(self.names)}
            frequency = ("frequency", signal.frequency, {"units": "Hz"})
            parts.append(xr.Dataset(variables, coords={"frequency": frequency, **coords}))
        return xr.concat(parts, dim=xr.DataArray(list(there), dims="signal", name="signal"), join="outer")

    def spectrum_frame(self) -> pd.DataFrame:
        """RMS force of each line."""
        parts = {}
        for name, signal in (("thesis", self.thesis), ("optimised", self.optimised)):
            frequency = pd.Index(signal.frequency, name="frequency_hz")
            parts[name] = pd.DataFrame(np.sqrt(signal.power), frequency, ["force_x_N", "force_y_N"])
        return pd.concat(parts, names=["signal"]).reset_index()

    def signal_frame(self) -> pd.DataFrame:
        """RMS and largest force, and RMS displacement of the handle, of each realisation and axis."""
        n_period = period_samples(self.settings)
        rows: list[tuple[Any, ...]] = []
        for number, signal in enumerate(self.perturbations, start=1):
            moved = displacements(self.settings, signal)
            for axis, force, displacement in zip("xy", signal.force.T, moved, strict=True):
                rms = np.sqrt(np.mean(force[:n_period] ** 2))
                rows.append((number, axis, rms, np.abs(force).max(), displacement))
        return pd.DataFrame(rows, columns=["trial", "axis", "rms_force_N", "peak_force_N", "rms_displacement_m"])


def design(settings: DesignSettings) -> Design:
    """Plan.

    Raises:
      TypeError: settings are no `DesignSettings`.
      ValueError: no multisine tells about some of the model's parameters; the message names them.
    """
    require_type("design: settings", settings, DesignSettings, "DesignSettings")
    force, displacement = settings.force, settings.displacement
    structure = settings.structure()

    usual = experiment_at(settings, CLUSTERS.ravel() / PERIOD)
    multisine = Multisine(rms=force, phases=np.zeros((2, CLUSTERS.size)))
    thesis = np.repeat(multisine.amplitudes[:, None] ** 2 / 2.0, 2, axis=1)
    thesis /= max(1.0, float(usual.displacement(thesis).max()) / displacement**2)
    if settings.peak is not None:
        multisines = [Multisine.draw(seed=seed, rms=float(np.sqrt(thesis[:, 0].sum()))) for seed in _seeds(settings)]
        largest = max(float(np.abs(each.sample(DESIGN_RATE, PERIOD_SAMPLES)).max()) for each in multisines)
        thesis *= min(1.0, settings.peak / largest) ** 2
    usual_demand = usual.demand(thesis)

    optimised, perturbations, excess = _best_multisine(settings, usual_demand)
    return Design(
        settings=settings,
        names=structure.free,
        truth=true_values(settings.subject, structure),
        thesis=multisine_signal(usual, thesis, usual_demand, settings),
        optimised=optimised,
        proposed=None if settings.perturbation is None else proposed_signal(settings, usual_demand),
        perturbations=perturbations,
        excess=excess,
    )


def _seeds(settings: DesignSettings) -> list[int]:
    return [trial_seed(settings.seed, "design", number) for number in range(settings.trials)]


def _best_multisine(settings: DesignSettings, usual_demand: Array) -> tuple[Signal, tuple[Sampled, ...], float | None]:
    """The best multisine within the limits, its realisations, and the bound of how far from the best it is.

    The largest force depends on the phases, so that its limit is none of the optimisation's. It becomes a limit of the
    RMS force of each axis by the ratio that the realisations have, for which the optimum is sought anew.
    """
    starts, n_period = cluster_starts(settings.period), period_samples(settings)
    lines = (starts[:, None] + np.arange(CLUSTERS.shape[1])).ravel()
    best = experiment_at(settings, lines / settings.period)
    held = usual_demand if settings.noise == "held" else None
    peak = np.inf if settings.peak is None else settings.peak
    force = np.full(2, settings.force)
    candidates: list[tuple[Signal, tuple[Sampled, ...]]] = []
    for number in range(PEAK_ROUNDS):
        limits = Limits(force, settings.displacement)
        optimum = optimise(best, len(starts), settings.wanted(), limits, settings.spread, held)
        drawn = [
            balanced(
                settings,
                draw_multisine(lines, optimum.power, seed=seed, duration=settings.duration, n_period=n_period),
            )
            for seed in _seeds(settings)
        ]
        largest = np.max([np.abs(each.force).max(axis=0) for each in drawn], axis=0)
        weaker = np.minimum(1.0, peak / largest)
        drawn = [Sampled(force=weaker * each.force, rate=each.rate) for each in drawn]
        # How x and y add up depends on the phases: the worst trial must be within the limits.
        moved = max(float(displacements(settings, each).max()) for each in drawn)
        scale = min(1.0, settings.displacement / moved)
        signal = multisine_signal(best, (scale * weaker) ** 2 * optimum.power, usual_demand, settings)
        candidates.append((signal, tuple(Sampled(force=scale * each.force, rate=each.rate) for each in drawn)))
        if number == 0 and (largest <= peak).all():
            return *candidates[0], optimum.excess
        force = np.minimum(settings.force, np.sqrt(optimum.power.sum(axis=0)) * peak / largest)
    columns = [best.names.index(name) for name in settings.wanted()]
    return *min(candidates, key=lambda each: np.sum(np.log(each[0].standard_error[settings.noise][columns]))), None


def period_samples(settings: DesignSettings) -> int:
    """Samples of a period of the optimised multisine."""
    return round(settings.period * DESIGN_RATE)


def balanced(settings: DesignSettings, perturbation: Sampled) -> Sampled:
    """The perturbation with y later by so much that x and y together move the handle as they do on average over phases.

    On its few lines an optimum may else move it by a third more or less. Neither spectra nor peaks change.

    Args:
      settings: who is perturbed, what the hand holds, and the period.
      perturbation: of that period.
    """
    n_period = period_samples(settings)
    spectrum = rfft(perturbation.force[:n_period], axis=0)
    total = _total(settings, len(spectrum) - 1)
    by_axis = total * spectrum[1:, None]
    alone = np.sum(np.abs(by_axis) ** 2, axis=(0, 2))
    # Of both together, for each delay of y in samples.
    common = np.concatenate([np.zeros((1, 2)), by_axis[:, :, 0] * by_axis[:, :, 1].conj()])
    together = n_period * irfft(common, n_period, axis=0)
    delay = int(np.argmin(np.max(np.abs(together) / alone, axis=1)))
    period = np.stack([perturbation.force[:n_period, 0], np.roll(perturbation.force[:n_period, 1], delay)], axis=1)
    return Sampled(force=np.resize(period, perturbation.force.shape), rate=perturbation.rate)


def displacements(settings: DesignSettings, perturbation: Sampled) -> Array:
    """RMS displacement of the handle that a periodic perturbation causes once its start is forgotten [m], (axis,).

    Args:
      settings: who is perturbed, what the hand holds, and the period.
      perturbation: of at least a period.
    """
    n_period = period_samples(settings)
    spectrum = rfft(perturbation.force[:n_period], axis=0)[1:] / n_period
    total = _total(settings, len(spectrum))
    return np.asarray(np.sqrt(2.0 * np.sum(np.abs(np.einsum("fij,fj->fi", total, spectrum)) ** 2, axis=0)))


def _total(settings: DesignSettings, n_lines: int) -> ComplexArray:
    """Admittance of arm and manipulator at the first lines of the period [m/N], (line, output, input)."""
    return total_admittance(settings.subject, settings.environment, np.arange(1, n_lines + 1) / settings.period)
