"""Monte-Carlo judgement of the estimators, on synthetic people whose truth is known.

Groups of trials are simulated and identified again and again. What an estimator gives is compared with the truth, its
error with the Cramer-Rao bound (of all that the trials hold), and its intervals with how often they hold the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.defaults import Estimator
from armperturb.analysis.fit.group import Group, Method
from armperturb.analysis.fit.joint_likelihood import errors_by_manipulator
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.structures import Structure, unit
from armperturb.analysis.fit.thesis import fit_trials
from armperturb.analysis.fit.trial_effects import inverse
from armperturb.analysis.fit.truth import true_values
from armperturb.analysis.results import Description, Result
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.progress import Progress
from armperturb.seeds import trial_seed
from armperturb.study.validation.settings import ValidateSettings
from armperturb.subject import Subject
from armperturb.validation import require_type
from armperturb.workers import completed, cpu_count, require_workers, workers_for

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RMS_FORCE = {"PT": 5.4, "RT": 0.9}
"""Published RMS force per axis in PT7.5 and RT7.5 [N] (table 2.1)."""

DURATION = 32.0
"""Of a trial [s], as the multisine of section 2.4."""

SAME_OPTIMUM = 0.5
"""Twice the log likelihood by which a fit may miss the one that starts at the truth [-]; a datum tells about one."""

SAME_CRITERION = 0.01
"""Share by which the thesis's criterion may exceed its least value and the minimum still count as found [-]."""

BIASED = 2.0
"""From how many standard errors on the mean error of a parameter makes a run a biased one [-]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """One estimator on one group of trials.

    Attributes:
      values: estimates, (parameter,), SI.
      error: standard errors, (parameter,), SI.
      covered: whether the 95 % intervals hold the truth, (parameter,).
      converged: share of the fits that ended at an optimum [-]: of one, or for "thesis" of those of all trials.
      stable: share of them that give a stable arm [-].
      is_global: share of them than which no better optimum is known [-]: none that is found from the truth; for
        "thesis" none from several starts carried to their minima, for the first trial alone.
      suspicious: whether the estimator itself says that the structure is wrong; None if it cannot.
    """

    values: Array
    error: Array
    covered: NDArray[np.bool_]
    converged: float
    stable: float
    is_global: float
    suspicious: bool | None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Validation(Result):
    """What came out.

    Attributes:
      settings: what was done.
      names: of the free parameters.
      truth: their true values, (parameter,), SI.
      bound: Cramer-Rao bound of their standard deviation from the whole records, (parameter,), SI.
      judged: estimator to one entry per group.
    """

    settings: ValidateSettings
    names: tuple[str, ...]
    truth: Array
    bound: Array
    judged: dict[Estimator, tuple[Judged, ...]]

    def describe(self) -> Description:
        """Errors of each estimator beside the Cramer-Rao bound, and how the fits went."""
        from armperturb.study.validation.report import describe

        return describe(self)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the RMS error over the Cramer-Rao bound per parameter, estimators side by side.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, a single one.
        """
        from armperturb.study.validation.report import plot_validation

        return plot_validation(self, figure)

    def to_xarray(self) -> xr.Dataset:
        """What every group yields, as numbers (a truth is 1), and what its estimates are compared with.

        Variables `estimate`, `standard_error` and `covered` (estimator, group, parameter); `converged`, `stable`,
        `global` and `flagged` (estimator, group), see `Judged`; `true` and `bound`, that of Cramer and Rao (parameter).
        """
        of_parameter = {"estimate": "values", "standard_error": "error", "covered": "covered"}
        of_group = {"converged": "converged", "stable": "stable", "global": "is_global", "flagged": "suspicious"}
        variables: dict[str, Any] = {"true": ("parameter", self.truth), "bound": ("parameter", self.bound)}
        for name, field in (of_parameter | of_group).items():
            values = [[getattr(judgement, field) for judgement in judged] for judged in self.judged.values()]
            dims = ("estimator", "group", "parameter")[: 3 if name in of_parameter else 2]
            variables[name] = dims, np.array(values, dtype=float)
        return xr.Dataset(variables, coords={"estimator": list(self.judged), "parameter": list(self.names)})

    def to_frame(self) -> pd.DataFrame:
        """Bias, error, bound and coverage per estimator and parameter.

        Low and high are a 95 % interval of the RMS error over its bound, from the number of groups (chi2 distribution).
        """
        data, n = self.to_xarray(), self.settings.groups
        low, high = np.sqrt(n / stats.chi2.ppf([0.975, 0.025], n))
        deviation, mean = data["estimate"] - data["true"], data.mean("group", skipna=False)
        rms = (deviation**2).mean("group", skipna=False) ** 0.5
        ratio = rms / data["bound"]
        columns = {
            "true": data["true"],
            "bias": deviation.mean("group", skipna=False),
            "rms_error": rms,
            "rms_error_percent": 100.0 * rms / abs(data["true"]).where(data["true"] != 0.0),
            "bound": data["bound"],
            "rms_error_over_bound": ratio,
            "rms_error_over_bound_low": ratio * low,
            "rms_error_over_bound_high": ratio * high,
            "mean_standard_error": mean["standard_error"],
            "coverage_percent": 100.0 * mean["covered"],
        }
        frame = xr.Dataset(columns).to_dataframe(dim_order=["estimator", "parameter"]).reset_index()
        frame.insert(2, "unit", frame["parameter"].map(unit))
        return frame

    def estimators_frame(self) -> pd.DataFrame:
        """How the fits went, per estimator.

        A run counts as biased if the mean error of some parameter, over all groups, is above `BIASED` of the standard
        errors that the run itself gives.
        """
        data = self.to_xarray()
        deviation, mean = data["estimate"] - data["true"], data.mean("group", skipna=False)
        biased = (abs(deviation.mean("group", skipna=False)) > BIASED * data["standard_error"]).any("parameter")
        error = (deviation**2).mean("group", skipna=False) ** 0.5 / data["bound"]
        columns = {
            "groups": xr.full_like(mean["stable"], data.sizes["group"], dtype=int),
            **{f"{name}_percent": 100.0 * mean[name] for name in ("converged", "stable", "global")},
            "coverage_percent": 100.0 * mean["covered"].mean("parameter"),
            "median_error_over_bound": error.median("parameter", skipna=False),
            "flagged_percent": 100.0 * mean["flagged"],
            "biased_percent": 100.0 * biased.mean("group"),
            "flagged_of_biased_percent": 100.0 * data["flagged"].where(biased).mean("group"),
        }
        return xr.Dataset(columns).to_dataframe().reset_index()


def validate(settings: ValidateSettings, *, workers: int | None = None, show_progress: bool = True) -> Validation:
    """Judge the estimators.

    Args:
      settings: what to do; they alone determine the result.
      workers: number of processes; by default one per core.
      show_progress: whether to draw a progress bar where there is a terminal.

    Raises:
      TypeError: settings are no `ValidateSettings`, or workers is not a number.
      ValueError: subject, structure or workers are refused, the person does not determine the structure's parameters,
        or the arm is unstable.
      OSError: the subject's file cannot be read.
    """
    require_type("validate: settings", settings, ValidateSettings, "ValidateSettings")
    settings.structure()
    require_workers("validate", workers)
    if workers is None:
        workers = cpu_count()
    units, do, results = range(settings.groups), partial(run_group, settings), []
    with (
        workers_for(min(workers, settings.groups), None) as pool,
        Progress("validation", total=len(units), unit="groups", show=show_progress) as bar,
    ):
        for result in map(do, units) if pool is None else completed(do, units, pool, bar.refresh):
            results.append(result)
            bar.update()
    return collect(settings, results)


def simulate_group(settings: ValidateSettings, number: int) -> xr.Dataset:
    """The recording of one group of trials, counted from 0.

    Raises:
      ValueError: the subject is refused, or the arm is unstable.
      OSError: the subject's file cannot be read.
    """
    # A muscle law makes another arm of the parameters that are the truth.
    truth, linear = replace(settings.truth(), muscle=None), not settings.multibody
    instruments = Instruments(marker_noise=None, emg=None)
    trials = [_trial(settings, truth, number, trial) for trial in range(settings.trials)]
    return run_experiment(trials, linear=linear, engine=settings.engine, instruments=instruments, n_threads=1)


def run_group(settings: ValidateSettings, number: int) -> tuple[int, dict[Estimator, Judged], Array]:
    """Simulate and identify one group of trials.

    Args:
      settings: what to do.
      number: of the group, from 0; it and the settings determine everything.

    Returns:
      The number, estimator to what it made of the group, and the Fisher information at the truth, less what is lost
      because the manipulator is not known.

    Raises:
      ValueError: as `ValidateSettings.structure`, or the arm is unstable.
      OSError: the subject's file cannot be read.
    """
    truth, structure, recording = settings.truth(), settings.structure(), simulate_group(settings, number)
    trials = ConditionTrials.prepare(recording, is_checked=True)
    group = Group.prepare(trials, structure)
    values = true_values(truth, structure)
    arm = parameter_vector(truth)
    group.records[0].weigh(arm)
    known = group.records[0].normal(arm, structure.mixing).information
    # The manipulator is identified from the same trials, which matters where people are quiet.
    slope = errors_by_manipulator(group.records[0], group.of_records[0], arm, structure.mixing)
    information = known @ inverse(known + slope @ slope.T) @ known
    judged = {
        name: _by_thesis(trials, structure, values) if name == "thesis" else _by_likelihood(group, name, values)
        for name in settings.estimators
    }
    return number, judged, information


def collect(settings: ValidateSettings, results: Sequence[tuple[int, dict[Estimator, Judged], Array]]) -> Validation:
    """What `run_group` gave of every group, together."""
    ordered = sorted(results, key=lambda result: result[0])
    structure = settings.structure()
    information = np.mean([matrix for _, _, matrix in ordered], axis=0)
    return Validation(
        settings=settings,
        names=structure.free,
        truth=true_values(settings.truth(), structure),
        bound=np.sqrt(np.diag(inverse(information))),
        judged={name: tuple(judged[name] for _, judged, _ in ordered) for name in settings.estimators},
    )


def _trial(settings: ValidateSettings, truth: Subject, group: int, number: int) -> Trial:
    force = RMS_FORCE[truth.task] if settings.force is None else settings.force
    noise = HUMAN_NOISE[truth.task].scaled(settings.noise)
    rng = np.random.default_rng(trial_seed(settings.seed, "validate multisine", group, number))
    return Trial(
        subject=truth,
        perturbation=replace(Multisine.draw(seed=rng, rms=force, crested=False), duration=DURATION),
        condition=f"{truth.task}7.5",
        repetition=number,
        seed=trial_seed(settings.seed, "validate trial", group, number),
        # The person is the same in all trials: else there is no one truth.
        noise=replace(noise, spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0),
    )


def _by_likelihood(group: Group, method: Method, truth: Array) -> Judged:
    fitted = estimate([group], method)
    names = group.structure.free
    from_truth = estimate([group], method, initial=dict(zip(names, truth.tolist(), strict=True)))
    lower, upper = np.array([fitted.interval(name) for name in names]).T
    return Judged(
        values=np.array([*fitted.values.values()]),
        error=np.array([*fitted.standard_error.values()]),
        covered=(lower <= truth) & (truth <= upper),
        converged=float(fitted.converged),
        stable=float(fitted.stable),
        is_global=float(fitted.objective <= from_truth.objective + SAME_OPTIMUM),
        suspicious=fitted.is_suspicious,
    )


def _by_thesis(trials: ConditionTrials, structure: Structure, truth: Array) -> Judged:
    """Each trial alone, averaged as published; intervals from the mean of the standard errors of eq. 2.22."""
    fitted = fit_trials(trials, structure)
    least = fit_trials(trials.take([0]), structure, as_published=False)
    values, error = fitted.values.mean(axis=0), fitted.sem.mean(axis=0)
    return Judged(
        values=values,
        error=error,
        covered=np.abs(values - truth) <= stats.norm.ppf(0.975) * error,
        converged=float(np.mean([fit.converged for fit in fitted.fits])),
        stable=float(fitted.stable.mean()),
        is_global=float(fitted.criterion[0] <= (1.0 + SAME_CRITERION) * least.criterion[0]),
        suspicious=None,
    )
