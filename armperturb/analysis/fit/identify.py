"""From a recording to the arm: admittance, environment, arm model and how well it predicts (thesis 2.6, 2.7)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import xarray as xr

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.defaults import LINES_PER_AVERAGE, WINDOW_START
from armperturb.analysis.fit.maximum_likelihood import Estimate, Group, Interval, estimate
from armperturb.analysis.fit.structures import STRUCTURES, Structure
from armperturb.analysis.fit.thesis import ThesisEstimate, Wanted, fit_wanted
from armperturb.analysis.measures.vaf import prediction_vaf
from armperturb.analysis.response.spectra import SpectralEstimate, averaged_spectra
from armperturb.analysis.trials import ConditionTrials, Trials, prepared, trials_by_condition
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject
from armperturb.validation import require_one_of

Estimator = Literal["thesis", "frequency", "record"]
"""The thesis's (each trial alone, averaged), or greatest likelihood over mean periods, or over whole records."""

NORMAL_95 = 1.96
"""Half a 95 % confidence interval over the standard error [-]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmFit:
    """The arm of one person in one condition, as an estimator gives it.

    Attributes:
      estimator: which.
      structure: name of the model structure.
      arm: the estimated arm, fixed parameters included.
      values: estimate of each free parameter, SI.
      standard_error: of each, SI; infinite where the data say nothing. For "thesis", the mean over trials of the SEM
        (eq. 2.22).
      at_bound: free parameters that sit on a bound; for "thesis", in any trial.
      status: how the search ended, in words.
      converged: whether it ended at an optimum.
      stable: whether arm and environment are stable together.
      largest_real_pole: of arm and environment [1/s].
      criterion: V of eq. 2.19, without penalty, of the arm against the averaged spectra.
      remarks: what a reader must know before trusting the values, a sentence each.
      detail: the estimator's own result.
    """

    estimator: Estimator
    structure: str
    arm: Subject
    values: Mapping[str, float]
    standard_error: Mapping[str, float]
    at_bound: tuple[str, ...]
    status: str
    converged: bool
    stable: bool
    largest_real_pole: float
    criterion: float
    remarks: tuple[str, ...]
    detail: Estimate | ThesisEstimate

    def interval(self, name: str) -> Interval:
        """95 % confidence interval of a free parameter, SI; for "thesis" as if its SEM were a standard error."""
        half = NORMAL_95 * self.standard_error[name]
        return Interval(self.values[name] - half, self.values[name] + half)


@dataclass(frozen=True, kw_only=True, eq=False)
class Identification:
    """What one condition of a recording yields.

    Attributes:
      spectra: estimated admittances and coherence.
      environment: mass, spring and damper that the manipulator really showed.
      fit: the arm model.
      vaf: variance of the displacement that the fitted model accounts for, x and y, mean over trials [%], (axis,).
    """

    spectra: SpectralEstimate
    environment: Environment
    fit: ArmFit
    vaf: Array


def identify(
    trials: Trials,
    model: Structure | str,
    *,
    estimator: Estimator = "record",
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> Identification:
    """Admittance, environment, arm model and its VAF from the trials of one subject in one condition.

    Args:
      trials: each from rest at its first sample; of a larger recording, `recording.sel` or `.isel` picks them.
      model: structure or its name, see `structures.STRUCTURES`.
      estimator: "thesis", "frequency" or "record".
      window_start: start of the window of whole periods, after the transient has died away [s].
      period: of the disturbance [s]; None to find it.
      lines_per_average: of the spectra, see `estimate_spectra`; maximum likelihood estimates use every line.

    Raises:
      ValueError: the recording is refused, holds several subjects, conditions or postures, or gives no spectra.
    """
    ready = prepared(trials)
    ready.body  # noqa: B018  (refuses several conditions)
    return identify_conditions(
        {ready.label: ready},
        model,
        estimator=estimator,
        window_start=window_start,
        period=period,
        lines_per_average=lines_per_average,
    )[ready.label]


def identify_conditions(
    trials: Mapping[str, ConditionTrials] | xr.Dataset,
    model: Structure | str,
    *,
    estimator: Estimator = "record",
    share: Sequence[str] = (),
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
) -> dict[str, Identification]:
    """Admittance, environment, arm model and its VAF of one subject in every condition.

    Args:
      trials: condition to trials of one subject, or their recording; a condition's have the same posture.
      model: structure or its name, see `structures.STRUCTURES`.
      estimator: "thesis", "frequency" or "record".
      share: parameters that are the same in all conditions, see `maximum_likelihood.estimate`.
      window_start: start of the window of whole periods, after the transient has died away [s].
      period: of the disturbance [s]; None to find it, in each condition.
      lines_per_average: of the spectra, see `estimate_spectra`; maximum likelihood estimates use every line.

    Returns:
      Condition to what it yields, in the order of the recording; those in which nothing perturbs the window, as where
      there are pulses alone, are left out if there are others.

    Raises:
      ValueError: as `identify`; or the thesis's estimator is to share parameters, but fits each trial alone.
    """
    require_one_of("identify", "estimator", estimator, get_args(Estimator))
    if isinstance(model, str):
        require_one_of("identify", "model", model, list(STRUCTURES))
        model = STRUCTURES[model]
    if estimator == "thesis" and share:
        raise ValueError(
            f"identify: share = {', '.join(share)}; expected nothing with estimator = 'thesis', which fits each trial "
            "alone (--estimator record shares)"
        )
    conditions = trials_by_condition(trials) if isinstance(trials, xr.Dataset) else trials
    perturbed = {label: part for label, part in conditions.items() if part.is_perturbed(window_start)}
    conditions = perturbed or conditions
    for part in conditions.values():
        part.check_period(window_start, period)
    spectra = {
        label: averaged_spectra(part, window_start=window_start, period=period, lines_per_average=lines_per_average)
        for label, part in conditions.items()
    }
    if estimator == "thesis":
        wanted = [Wanted(part, model) for part in conditions.values()]
        fitted = fit_wanted(wanted, window_start=window_start, period=period)
        fits = {
            label: _thesis_fit(estimate_of_trials, part.body, model, spectra[label])
            for (label, part), estimate_of_trials in zip(conditions.items(), fitted, strict=True)
        }
    else:
        groups = [Group.prepare(part, model, window_start=window_start, period=period) for part in conditions.values()]
        joint = estimate(groups, estimator, share=share)
        fits = {group.label: _likely_fit(joint, group, spectra[group.label]) for group in groups}
    return {
        label: Identification(
            spectra=spectra[label],
            environment=environment,
            fit=fit,
            vaf=prediction_vaf(conditions[label], fit.arm, environment).mean(axis=0),
        )
        for label, (fit, environment) in fits.items()
    }


def _thesis_fit(
    found: ThesisEstimate, body: Subject, structure: Structure, spectra: SpectralEstimate
) -> tuple[ArmFit, Environment]:
    """Means over trials, as published."""
    names, n_trials = found.parameters, len(found.fits)
    values, errors = found.values.mean(axis=0), found.sem.mean(axis=0)
    arm = structure.arm(body, values)
    pole = largest_real_pole(arm, found.environment)
    remarks = [f"{name} sits on a bound in {count} of {n_trials} trials" for name, count in found.at_bound.items()]
    if found.n_stable < n_trials:
        remarks.append(f"{n_trials - found.n_stable} of {n_trials} trials give an unstable arm")
    fit = ArmFit(
        estimator="thesis",
        structure=found.structure,
        arm=arm,
        values=dict(zip(names, values.tolist(), strict=True)),
        standard_error=dict(zip(names, errors.tolist(), strict=True)),
        at_bound=tuple(found.at_bound),
        status=", ".join(f"{count} of {n_trials} trials {word}" for word, count in found.status.items()),
        converged=all(one.converged for one in found.fits),
        stable=pole < 0.0,
        largest_real_pole=pole,
        criterion=_criterion(arm, spectra),
        remarks=tuple(remarks),
        detail=found,
    )
    return fit, found.environment


def _likely_fit(found: Estimate, group: Group, spectra: SpectralEstimate) -> tuple[ArmFit, Environment]:
    """One condition's part of an estimate over several."""
    label = {name: name if name in found.values else f"{name} [{group.label}]" for name in group.structure.free}
    arm = found.arms[group.label]
    pole = largest_real_pole(arm, group.environment)
    fit = ArmFit(
        estimator=found.method,
        structure=group.structure.name,
        arm=arm,
        values={name: found.values[label[name]] for name in label},
        standard_error={name: found.standard_error[label[name]] for name in label},
        at_bound=tuple(name for name in label if label[name] in found.at_bound),
        status=found.status,
        converged=found.converged,
        stable=pole < 0.0,
        largest_real_pole=pole,
        criterion=_criterion(arm, spectra),
        remarks=found.remarks(),
        detail=found,
    )
    return fit, group.environment


def _criterion(arm: Subject, spectra: SpectralEstimate) -> float:
    error = np.abs(np.log(spectra.arm / arm_admittance(arm, spectra.frequency))) ** 2
    return float(np.mean(spectra.coherence[:, :, None] * error)) if np.isfinite(error).all() else math.inf
