"""The thesis's estimator as appendices C, D and E have it: trial by trial, with or without penalty, averaged.

Each trial gives one admittance (lines averaged in fours), to which a structure is fitted by the criterion of eq. 2.19
and judged by eqs 2.22 (SEM) and 2.23 (VAF). The thesis averages results over the trials of a subject, then over
subjects. Its tables print the criterion as a sum: 60 to 120 would as a mean over the N = 4 n_f errors of eq. 2.19 be an
average error of a factor e^9. `ThesisEstimate.criterion` is that sum.

Which optimisation is used matters (`as_published`). That of the thesis stops where a step changes the criterion by less
than a share of 1e-5; along directions of which one trial says little that is on the way, so that estimates depend on
the start. With `as_published=False` all starts of appendix E end in the same minimum in most trials; a few trials have
two (`benchmarks.thesis_sem`).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from armperturb.analysis.arm.linear_arm import Delay
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.fit.admittance_fit import AdmittanceFit, fit_admittance
from armperturb.analysis.fit.admittance_problem import Target
from armperturb.analysis.fit.structures import MODEL_3_WIDE, STRUCTURES, Structure, published_starts, unit
from armperturb.analysis.measures.vaf import trial_vaf
from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.response.spectra import LINES_PER_AVERAGE, single_trial_spectra
from armperturb.analysis.results import Description, Result, Table, plain, quantile
from armperturb.analysis.trials import ConditionTrials, Trials, prepared
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.recording import LABELS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ThesisEstimate(Result):
    """A structure fitted to every trial of a condition, and the averages that the thesis prints.

    Attributes:
      structure: name of the structure.
      subjects: whose trial each is, (trial,).
      environment: mass, spring and damper that the manipulator really showed.
      fits: of each trial; statuses, bounds and stability stand there.
      vaf: variance of the displacement accounted for [%], (trial, axis); minus infinity for an unstable model.
    """

    structure: str
    subjects: tuple[str, ...]
    environment: Environment
    fits: tuple[AdmittanceFit, ...]
    vaf: Array

    def describe(self) -> Description:
        """Means over subjects, SDs over them, and how the fits ended."""
        n, people = len(self.fits), list(dict.fromkeys(self.subjects))
        who = people[0] if len(people) == 1 else f"{len(people)} people"
        vaf, _ = self.mean_vaf()
        columns = {"value": "mean", "value_sd": "SD over people", "sem": "SEM"}
        if len(people) == 1:
            del columns["value_sd"]
        return Description(
            title=f"The thesis's estimator, model {self.structure}: {n} trial{'' if n == 1 else 's'} of {who}",
            facts=(
                f"{self.n_stable} stable; {self.n_positive} with a positive VAF, mean x {vaf[0]:.1f}, y {vaf[1]:.1f} %",
                ", ".join(f"{count} of {n} {words}" for words, count in self.status.items()),
            ),
            table=Table(
                ("parameter", *columns.values(), "unit"),
                tuple(
                    (row["parameter"], *(plain(row[name]) for name in columns), row["unit"])
                    for row in self.to_frame().to_dict("records")
                ),
            ),
            remarks=tuple(f"{name} sits on a bound in {count} of {n} trials" for name, count in self.at_bound.items()),
        )

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the estimated parameters."""
        return tuple(self.fits[0].values)

    @property
    def values(self) -> Array:
        """Estimates, SI, (trial, parameter)."""
        return np.array([list(fit.values.values()) for fit in self.fits])

    @property
    def sem(self) -> Array:
        """Standard errors of the mean as eq. 2.22 has them, SI, (trial, parameter)."""
        return np.array([list(fit.sem.values()) for fit in self.fits])

    @property
    def criterion(self) -> Array:
        """Sum of the squared errors, penalty included, as the tables print it, (trial,)."""
        return np.array([fit.criterion * fit.n_errors for fit in self.fits])

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Whether arm and environment are stable together, (trial,)."""
        return np.array([fit.stable for fit in self.fits])

    @property
    def at_bound(self) -> dict[str, int]:
        """In how many trials each parameter that ever did so sits on a bound."""
        hits = [name for fit in self.fits for name in fit.at_bound]
        return {name: hits.count(name) for name in self.parameters if name in hits}

    @property
    def status(self) -> dict[str, int]:
        """Why fits stopped, in words, and how many did so."""
        words = [fit.status for fit in self.fits]
        return {word: words.count(word) for word in dict.fromkeys(words)}

    @property
    def n_stable(self) -> int:
        """Trials whose model is stable (N_stab of tables C.5 and C.15)."""
        return int(self.stable.sum())

    @property
    def positive(self) -> NDArray[np.bool_]:
        """Whether the VAF of both axes is positive, (trial,)."""
        return np.asarray((self.vaf > 0).all(axis=1))

    @property
    def n_positive(self) -> int:
        """Trials with a positive VAF (N_pos of the tables)."""
        return int(self.positive.sum())

    def over_subjects(self, per_trial: Array) -> tuple[Array, Array]:
        """Mean and SD over subjects of their means over trials, as tables C.3 to E.4 print; SD is NaN for one subject.

        Args:
          per_trial: e.g. `values` or `sem`, (trial, ...).
        """
        subjects = np.array(self.subjects)
        return _mean_and_sd(
            np.array([per_trial[subjects == name].mean(axis=0) for name in dict.fromkeys(self.subjects)])
        )

    def mean_vaf(self) -> tuple[Array, Array]:
        """Mean and SD over trials with a positive VAF [%], (axis,) each; NaN without any (tables C.5 to E.5)."""
        return _mean_and_sd(self.vaf[self.positive])

    def means(self) -> dict[str, float]:
        """Group means, from which another fit may start (step 2 of appendix C)."""
        return dict(zip(self.parameters, map(float, self.over_subjects(self.values)[0]), strict=True))

    def to_frame(self) -> "pd.DataFrame":
        """One row per parameter, as in tables E.3 and E.4: means and SDs over subjects of estimate and SEM, SI."""
        import pandas as pd

        (mean, sd), (sem, sem_sd) = self.over_subjects(self.values), self.over_subjects(self.sem)
        return pd.DataFrame(
            {
                "parameter": self.parameters,
                "unit": [unit(name) for name in self.parameters],
                "value": mean,
                "value_sd": sd,
                "sem": sem,
                "sem_sd": sem_sd,
                "sem_over_value": np.divide(np.abs(sem), np.abs(mean), out=np.full_like(sem, np.inf), where=mean != 0),
            }
        )

    def to_xarray(self) -> xr.Dataset:
        """`value` and `sem`, SI, (trial, parameter), `stable`, (trial,), and `vaf` [%], (trial, axis)."""
        of_trial = ("trial", "parameter")
        return xr.Dataset(
            {
                "value": (of_trial, self.values),
                "sem": (of_trial, self.sem),
                "stable": ("trial", self.stable),
                "vaf": (("trial", "axis"), self.vaf, {"units": "%"}),
            },
            {
                "parameter": list(self.parameters),
                "unit": ("parameter", [unit(name) for name in self.parameters]),
                "axis": list(LABELS["axis"]),
                "subject": ("trial", list(self.subjects)),
            },
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw each person's mean over trials, with 95 % intervals of its SEM (eq. 2.22), one panel per unit.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (unit,).
        """
        from armperturb.plots.parameters import plot_parameters

        frames, subjects = {}, np.array(self.subjects)
        for name in dict.fromkeys(self.subjects):
            which = np.flatnonzero(subjects == name)
            fits = tuple(self.fits[trial] for trial in which)
            mine = replace(self, subjects=(name,) * len(which), fits=fits, vaf=self.vaf[which])
            frame = mine.to_frame()
            half = quantile(0.95) * frame["sem"]
            limits = {"lower_95": frame["value"] - half, "upper_95": frame["value"] + half}
            frames[name] = frame.assign(**limits, at_bound=frame["parameter"].isin(list(mine.at_bound)))
        return plot_parameters(frames, figure)


def _mean_and_sd(values: Array) -> tuple[Array, Array]:
    """Over the first axis; NaN where there are too few for one."""
    unknown = np.full(values.shape[1:], np.nan)
    spread = values.std(axis=0, ddof=1) if len(values) > 1 else unknown
    return values.mean(axis=0) if len(values) else unknown, np.asarray(spread)


@per_trials
def _targets(
    trials: ConditionTrials, *, window_start: float, period: float | None, lines_per_average: int
) -> tuple[Target, ...]:
    """What a fit of each trial needs."""
    return tuple(
        Target(
            frequency=spectra.frequency,
            admittance=spectra.arm,
            body=trials.body,
            environment=trials.environment,
            coherence=spectra.coherence,
        )
        for spectra in single_trial_spectra(
            trials, window_start=window_start, period=period, lines_per_average=lines_per_average
        )
    )


def fit_trials(
    trials: Trials,
    structure: Structure | str,
    *,
    initial: Mapping[str, float] | None = None,
    use_penalty: bool = True,
    as_published: bool = True,
    delay: Delay = "pade",
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> ThesisEstimate:
    """Fit a structure to the admittance of each trial.

    Fits are kept with their trials: what was fitted before, with the same options, is not fitted again.

    Args:
      trials: of one person in one condition, or their recording.
      structure: model structure, or its name in `STRUCTURES`.
      initial: parameter vector to start from, SI; the structure's own where not given.
      use_penalty: whether to push fits away from instability (eq. 2.21).
      as_published: see the head of this module and `fit_admittance`.
      delay: "exact", or the thesis's "pade".
      window_start: start of the spectral window [s].
      period: of the disturbance [s]; None to find it.
      lines_per_average: of each trial's spectra, see `estimate_spectra`.

    Raises:
      ValueError: the recording is refused or gives no spectra, or structure or initial are refused.
    """
    ready = prepared(trials)
    options = (use_penalty, as_published, delay, window_start, period, lines_per_average)
    key = (fit_trials, structure, tuple((initial or {}).items()), *options)
    if key not in ready.results:
        fits = tuple(
            fit_admittance(
                **vars(target),
                structure=structure,
                initial=initial,
                use_penalty=use_penalty,
                delay=delay,
                as_published=as_published,
            )
            for target in _targets(ready, window_start=window_start, period=period, lines_per_average=lines_per_average)
        )
        ready.results[key] = ThesisEstimate(
            structure=fits[0].structure,
            subjects=(ready.body.name,) * ready.n_trials,
            environment=ready.environment,
            fits=fits,
            vaf=np.array([trial_vaf(ready, n, fit.arm, ready.environment) for n, fit in enumerate(fits)]),
        )
    estimate = ready.results[key]
    assert isinstance(estimate, ThesisEstimate)
    return estimate


def join_estimates(estimates: Sequence[ThesisEstimate]) -> ThesisEstimate:
    """The trials of several estimates of one structure in one, with the first's environment.

    Args:
      estimates: at least one.

    Raises:
      ValueError: structures differ.
    """
    structures = list(dict.fromkeys(estimate.structure for estimate in estimates))
    if len(structures) != 1:
        raise ValueError(f"estimates of structures {', '.join(structures) or 'none'}; expected one structure")
    return replace(
        estimates[0],
        subjects=tuple(name for estimate in estimates for name in estimate.subjects),
        fits=tuple(fit for estimate in estimates for fit in estimate.fits),
        vaf=np.concatenate([estimate.vaf for estimate in estimates]),
    )


THETA = published_starts("D", MODEL_3_WIDE)
"""Initial parameter vectors of appendix D, SI (table D.3, in italics)."""

VARTHETA = published_starts("E", STRUCTURES["3b"])
"""Initial parameter vectors of appendix E, SI (table E.3, in italics)."""

STARTS: Mapping[str, tuple[Structure | str, Mapping[str, float]]] = {
    **{name: (MODEL_3_WIDE, initial) for name, initial in THETA.items()},
    **{name: ("3a" if name == "vartheta_i1" else "3b", initial) for name, initial in VARTHETA.items()},
}
"""Start of appendix D or E to the structure that is fitted from it, and the start."""


def fit_starts(trials: Trials, starts: Iterable[str], **options: Any) -> dict[str, ThesisEstimate]:
    """Fits from the published starts, with penalty.

    From `THETA` that is model 3 with the bounds of table D.2 (appendix D, tables D.3 to D.5); from `VARTHETA` model 3a
    from the first start and model 3b from the others (appendix E, tables E.3 to E.5).

    Args:
      trials: of PT7.5, or their recording.
      starts: names in `STARTS`.
      **options: of `fit_trials`.

    Returns:
      Name of the start to its estimate.

    Raises:
      ValueError: the recording is refused, or as `fit_trials`.
    """
    ready = prepared(trials)
    wanted = {name: STARTS[name] for name in starts}
    return {
        name: fit_trials(ready, structure, initial=initial, **options) for name, (structure, initial) in wanted.items()
    }
