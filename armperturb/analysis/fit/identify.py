"""From a recording to the arm: admittance, environment, arm model and how well it predicts (thesis 2.6, 2.7)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, get_args

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import require_two_axes
from armperturb.analysis.defaults import LINES_PER_AVERAGE, WINDOW_START, Estimator
from armperturb.analysis.fit.arm_fit import ArmFit, facts_of_arm, remark_on_force
from armperturb.analysis.fit.group import Group, Method, parts_by_condition, remark_on_manipulators
from armperturb.analysis.fit.identification import Identification, Identifications
from armperturb.analysis.fit.ladder import Choice, choose_structure, nearest_to_linear
from armperturb.analysis.fit.left_out import cut_by_pulses, used_conditions
from armperturb.analysis.fit.maximum_likelihood import Estimate, estimate
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.fit.structures import Structure, is_published, structure_of
from armperturb.analysis.fit.thesis import ThesisEstimate, fit_trials
from armperturb.analysis.fit.use_emg import UseOfEmg, told_of_emg
from armperturb.analysis.manipulator import remarks_on_trials
from armperturb.analysis.measures.start_geometry import in_start_geometry
from armperturb.analysis.measures.vaf import prediction_vaf
from armperturb.analysis.periods import check_period
from armperturb.analysis.response.condition_spectra import condition_spectra
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.analysis.trials import ConditionTrials, SeveralTrials, prepared_condition
from armperturb.subject import Subject
from armperturb.validation import require_number, require_one_of, require_whole

Conditions = Mapping[str, Sequence[ConditionTrials]]


def identify(
    trials: SeveralTrials,
    model: Structure | str | None = None,
    *,
    estimator: Estimator = "record",
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
    emg: UseOfEmg | None = None,
) -> Identification:
    """Admittance, environment, arm model and its VAF from the trials of one subject in one condition.

    Args:
      trials: of any perturbation, from rest or amid the movement; or several recordings, which may differ in length. Of
        a larger recording, `recording.sel` or `.isel` picks them.
      model: structure, or its name (see `structures.STRUCTURES`); bounds that are the thesis's are kept with the
        thesis's estimator only, and are those of `Structure.widened` with others. A structure that is not a named one
        is fitted in the geometry of the start posture where the trials ask for it, see `ladder.nearest_to_linear`. None
        lets the trials of each condition choose, see `ladder.choose_structure`.
      estimator: "thesis", "frequency" or "record".
      window_start: start of the window of whole periods, after the transient has died away [s].
      period: of the disturbance [s]; None to find it.
      lines_per_average: of the spectra, see `estimate_spectra`; maximum likelihood estimates use every line.
      emg: EMG that tells of reflexes as well; with maximum likelihood only. The structure is chosen without it.

    Raises:
      TypeError: trials are no `Dataset`, or an option is no number.
      ValueError: the recording is refused, is of one axis, holds several subjects, conditions or postures, or gives no
        spectra; or an option is out of its range.
    """
    parts = tuple(prepared_condition(trials))
    for part in parts:
        require_two_axes(part.recording)
        part.body  # noqa: B018  (refuses an unknown posture)
    return identify_conditions(
        {parts[0].label: parts},
        model,
        estimator=estimator,
        window_start=window_start,
        period=period,
        lines_per_average=lines_per_average,
        emg=emg,
    )[parts[0].label]


def identify_conditions(
    trials: Mapping[str, Sequence[ConditionTrials]] | xr.Dataset | Sequence[xr.Dataset],
    model: Structure | str | None = None,
    *,
    estimator: Estimator = "record",
    share: Sequence[str] = (),
    window_start: float = WINDOW_START,
    period: float | None = None,
    lines_per_average: int = LINES_PER_AVERAGE,
    emg: UseOfEmg | None = None,
    progress: Callable[[str], object] = lambda _: None,
) -> Identifications:
    """Admittance, environment, arm model and its VAF of one subject in every condition.

    Args:
      trials: condition to trials of one subject, those of one length together, or their recordings; a condition's have
        the same posture.
      model: structure, or its name, see `identify`. None lets the trials of each condition choose.
      estimator: "thesis", "frequency" or "record".
      share: parameters that are the same in all conditions, which then are fitted together, see `maximum_likelihood`.
      window_start: start of the window of whole periods, after the transient has died away [s].
      period: of the disturbance [s]; None to find it, in each condition.
      lines_per_average: of the spectra, see `identify`.
      emg: EMG that tells of reflexes as well, see `identify`.
      progress: called with each condition once its arm is fitted.

    Returns:
      Condition to what it yields, in the order of the recording; those in which nothing perturbs the window, as where
      there are pulses alone, are left out if there are others; if there are none, trials are used with their pulses.
      Unless parameters are shared, a condition that cannot be identified is left out, too, and remarks tell why.

    Raises:
      TypeError: as `identify`.
      ValueError: as `identify`, of no condition or of those that share parameters; or the thesis's estimator is to
        share parameters, but fits each trial alone.
    """
    require_one_of("identify", "estimator", estimator, get_args(Estimator))
    require_number("identify", "window_start", window_start, at_least=0.0)
    require_whole("identify", "lines_per_average", lines_per_average, at_least=1)
    if model is None and (share or estimator == "thesis"):
        field = f"share = {', '.join(share)}" if share else "estimator = 'thesis'"
        raise ValueError(f"identify: {field} without a model; expected one, e.g. --model 3")
    structure = composed() if model is None else structure_of(model, wide=estimator != "thesis")
    if estimator == "thesis" and emg:
        raise ValueError("identify: EMG with estimator = 'thesis'; expected --estimator record or frequency")
    if estimator == "thesis" and share:
        raise ValueError(
            f"identify: share = {', '.join(share)}; expected nothing with estimator = 'thesis', which fits each trial "
            "alone (--estimator record shares)"
        )
    conditions, remarks = used_conditions(parts_by_condition(trials), window_start)
    fitter = _Fitter(
        structure=structure,
        chooses=model is None,
        estimator=estimator,
        share=tuple(share),
        window_start=window_start,
        period=period,
        lines_per_average=lines_per_average,
        emg=emg,
    )
    identified: dict[str, Identification] = {}
    refused: dict[str, str] = {}
    # What conditions do not share is found sooner alone, and judged by their own trials.
    for labels in [list(conditions)] if share else [[label] for label in conditions]:
        try:
            identified |= fitter.identified({label: conditions[label] for label in labels})
        except ValueError as error:
            if share:
                raise
            refused[labels[0]] = str(error).removeprefix(f"{labels[0]}: ")
        for label in labels:
            progress(label)
    if not identified:
        reasons = list(dict.fromkeys(refused.values()))
        raise ValueError(
            reasons[0] if len(reasons) == 1 else "; ".join(f"{label}: {text}" for label, text in refused.items())
        )
    remarks += [f"{label} is not identified: {text}" for label, text in refused.items()]
    return Identifications(
        {
            label: replace(result, fit=replace(result.fit, remarks=(*result.fit.remarks, *remarks)))
            for label, result in identified.items()
        }
    )


@dataclass(frozen=True, kw_only=True)
class _Fitter:
    """How conditions are fitted; see `identify_conditions`.

    Attributes:
      structure: that is fitted, or chosen from.
      chooses: whether the trials of each condition choose it.
      estimator: of the three.
      share: parameters that conditions share.
      window_start: of the window of whole periods [s].
      period: of the disturbance [s]; None to find it.
      lines_per_average: of the spectra.
      emg: that tells of reflexes as well.
    """

    structure: Structure
    chooses: bool
    estimator: Estimator
    share: tuple[str, ...]
    window_start: float
    period: float | None
    lines_per_average: int
    emg: UseOfEmg | None

    def identified(self, conditions: Conditions) -> dict[str, Identification]:
        """What conditions yield that are fitted together."""
        for parts in conditions.values():
            for part in parts:
                check_period(part, self.window_start, self.period)
        spectra = {
            label: condition_spectra(
                parts, window_start=self.window_start, period=self.period, lines_per_average=self.lines_per_average
            )
            for label, parts in conditions.items()
        }
        if self.estimator == "thesis":
            fits = {label: self._thesis_fit(parts, spectra[label]) for label, parts in conditions.items()}
        else:
            fits = self._likely_fits(conditions, spectra, self.estimator)
        is_cut = self.estimator != "record" or self.emg is not None
        said = {
            label: (
                *remarks_on_trials(parts),
                *(cut_by_pulses(parts) if is_cut else ()),
                *remark_on_manipulators(parts),
            )
            for label, parts in conditions.items()
        }
        return {
            label: Identification(
                n_trials=sum(part.n_trials for part in conditions[label]),
                spectra=spectra[label],
                environment=conditions[label][0].environment,
                fit=replace(fit, remarks=(*fit.remarks, *said[label])),
                vaf=np.concatenate(
                    [prediction_vaf(part, fit.arm, part.environment) for part in conditions[label]]
                ).mean(axis=0),
            )
            for label, fit in fits.items()
        }

    def _thesis_fit(self, parts: Sequence[ConditionTrials], spectra: SpectralEstimate) -> ArmFit:
        trials = _only(parts)
        of_trials = fit_trials(
            trials,
            self.structure,
            window_start=self.window_start,
            period=self.period,
            lines_per_average=self.lines_per_average,
        )
        return _mean_fit(of_trials, trials, self.structure, spectra)

    def _likely_fits(
        self, conditions: Conditions, spectra: Mapping[str, SpectralEstimate], method: Method
    ) -> dict[str, ArmFit]:
        """By maximum likelihood, with the structure that is given or that the trials choose."""
        structure, emg = self.structure, self.emg
        options: dict[str, Any] = {"window_start": self.window_start, "period": self.period}
        groups = [Group.prepare(parts, structure, **options) for parts in conditions.values()]
        moved = [partial(_in_start_geometry, group, options) for group in groups]

        def with_emg(group: Group) -> Group:
            return emg.added_to(group, conditions[group.label][0]) if emg else group

        if self.chooses:
            fits = {
                group.label: _chosen_fit(choose_structure(group, turned, method, with_emg=with_emg))
                for group, turned in zip(groups, moved, strict=True)
            }
        else:
            if not is_published(structure):
                groups = [nearest_to_linear(*each, method) for each in zip(groups, moved, strict=True)]
            joint = estimate([with_emg(group) for group in groups], method, share=self.share)
            fits = {
                group.label: _likely_fit(joint, group, spectra[group.label] if is_published(structure) else None)
                for group in groups
            }
        return {label: told_of_emg(fit, emg, conditions[label][0]) if emg else fit for label, fit in fits.items()}


def _only(parts: Sequence[ConditionTrials]) -> ConditionTrials:
    if len(parts) > 1:
        lengths = ", ".join(f"{part.n_samples / part.rate:g} s" for part in parts)
        raise ValueError(
            f"trials of {lengths}; expected one length with estimator = 'thesis' (--estimator record takes any)"
        )
    return parts[0]


def _mean_fit(
    result: ThesisEstimate, trials: ConditionTrials, structure: Structure, spectra: SpectralEstimate
) -> ArmFit:
    """Means over trials, as published."""
    names, n_trials = result.parameters, len(result.fits)
    values, errors = result.values.mean(axis=0), result.sem.mean(axis=0)
    remarks = [f"{name} sits on a bound in {count} of {n_trials} trials" for name, count in result.at_bound.items()]
    if result.n_stable < n_trials:
        remarks.append(f"{n_trials - result.n_stable} of {n_trials} trials give an unstable arm")
    if (wrong := trials.balance.imbalance) is not None:
        remarks.append(wrong.text)
    return ArmFit(
        estimator="thesis",
        values=dict(zip(names, values.tolist(), strict=True)),
        standard_error=dict(zip(names, errors.tolist(), strict=True)),
        at_bound=tuple(result.at_bound),
        correlation=np.where(np.eye(len(names), dtype=bool), 1.0, np.nan),
        message=", ".join(f"{count} of {n_trials} trials {word}" for word, count in result.status.items()),
        converged=all(part.converged for part in result.fits),
        remarks=tuple(remarks),
        detail=result,
        **facts_of_arm(structure.arm(trials.body, values), structure, [trials], spectra),
    )


def _in_start_geometry(group: Group, options: Mapping[str, Any], arm: Subject | None) -> Group | None:
    """The same trials as an arm of constant geometry would have given them; None where the arm cannot reach the handle.

    Args:
      group: the trials as they were recorded.
      options: of `Group.prepare`.
      arm: an estimate of the arm, see `in_start_geometry`.
    """
    try:
        return Group.prepare([in_start_geometry(part, arm) for part in group.parts], group.structure, **options)
    except ValueError:
        return None


def _chosen_fit(choice: Choice) -> ArmFit:
    """With the structure that the trials choose; what is said of the choice comes before other remarks."""
    group = choice.group.with_structure(choice.chosen.structure)
    fit = _likely_fit(choice.estimate, group)
    return replace(fit, choice=choice, remarks=(*choice.remarks(group.parts), *fit.remarks))


def _likely_fit(result: Estimate, group: Group, as_recorded: SpectralEstimate | None = None) -> ArmFit:
    """One condition's part of an estimate, of trials with such spectra as recorded, or else of those of the group."""
    condition, names = group.label, group.structure.free
    label = {name: name if name in result.values else f"{name} [{condition}]" for name in names}
    rows = [list(result.values).index(name) for name in label.values()]
    facts = facts_of_arm(result.arms[condition], group.structure, group.parts, as_recorded or group.spectra)
    errors = {name: result.standard_error[label[name]] for name in names}
    return ArmFit(
        estimator=result.method,
        values={name: result.values[label[name]] for name in names},
        standard_error=errors,
        at_bound=tuple(name for name in names if label[name] in result.at_bound),
        degrees_of_freedom={
            name: result.degrees_of_freedom[label[name]] for name in names if label[name] in result.degrees_of_freedom
        },
        correlation=result.correlation[np.ix_(rows, rows)],
        message=result.message,
        converged=result.converged,
        remarks=(*result.remarks, *remark_on_force(facts["arm"], facts["force"], errors)),
        detail=result,
        trials=() if as_recorded else group.parts,
        **facts,
    )
