"""From a recording to the arm: admittance, environment, arm model and how well it predicts (thesis 2.6, 2.7)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.cuts import require_two_axes
from armperturb.analysis.defaults import LINES_PER_AVERAGE, WINDOW_START, Estimator
from armperturb.analysis.fit.arm_fit import ArmFit, facts_of_arm, remark_on_force
from armperturb.analysis.fit.group import Group, parts_by_condition, remark_on_manipulators
from armperturb.analysis.fit.ladder import Choice, choose_structure, nearest_to_linear
from armperturb.analysis.fit.left_out import cut_by_pulses, used_conditions
from armperturb.analysis.fit.maximum_likelihood import Estimate, estimate
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.fit.structures import Structure, is_published, structure_of, unit
from armperturb.analysis.fit.thesis import ThesisEstimate, fit_trials
from armperturb.analysis.fit.use_emg import UseOfEmg, told_of_emg
from armperturb.analysis.manipulator import remarks_on_trials
from armperturb.analysis.measures.endpoint import EndpointImpedance
from armperturb.analysis.measures.start_geometry import in_start_geometry
from armperturb.analysis.measures.vaf import prediction_vaf
from armperturb.analysis.response.condition_spectra import condition_spectra
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.analysis.results import Description, Result, Table, parameter_table, plain
from armperturb.analysis.trials import ConditionTrials, SeveralTrials, prepared_condition
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject
from armperturb.validation import require_number, require_one_of, require_whole

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

ESTIMATOR_NAMES: Mapping[Estimator, str] = {
    "thesis": "the thesis's estimator, trial by trial",
    "frequency": "maximum likelihood of mean periods",
    "record": "maximum likelihood of whole records",
}
"""What each estimator is called where people read it."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Identification(Result):
    """What one condition of a recording yields.

    Attributes:
      n_trials: how many trials it comes from.
      spectra: estimated admittances and coherence.
      environment: mass, spring and damper that the manipulator really showed.
      fit: the arm model.
      vaf: variance of the displacement that the fitted model accounts for, x and y, mean over trials [%], (axis,).
    """

    n_trials: int
    spectra: SpectralEstimate
    environment: Environment
    fit: ArmFit
    vaf: Array

    def describe(self) -> Description:
        """Who and what was identified, how well the arm predicts, and its parameters."""
        fit, held = self.fit, self.environment
        trials = f"{self.n_trials} trial{'' if self.n_trials == 1 else 's'}"
        return Description(
            title=f"Arm of {fit.arm.name} in {fit.condition} ({fit.arm.task}), {trials}: model {fit.structure}, "
            f"{ESTIMATOR_NAMES[fit.estimator]}",
            facts=(
                f"VAF x {self.vaf[0]:.1f} %, y {self.vaf[1]:.1f} %; {fit.message}",
                f"environment {held.m_env:.4g} kg, {held.b_env:.3g} Ns/m, {held.k_env:.4g} N/m",
            ),
            table=parameter_table(self.to_frame()),
            remarks=fit.remarks,
            details=(
                f"criterion (eq. 2.19) {plain(fit.criterion)}; largest pole of arm and environment "
                f"{plain(fit.largest_real_pole, 3)} 1/s; least coherence {self.spectra.coherence.min():.3f}",
            ),
        )

    def endpoint(
        self, *, posture_deg: tuple[float, float] | None = None, force: ArrayLike | None = None
    ) -> EndpointImpedance:
        """Stiffness, damping and inertia at the hand, see `ArmFit.endpoint`."""
        return self.fit.endpoint(posture_deg=posture_deg, force=force)

    def to_frame(self) -> "pd.DataFrame":
        """One row per free parameter, with the columns of `results.PARAMETER_COLUMNS`."""
        return self.fit.to_frame()

    def to_xarray(self) -> xr.Dataset:
        """The spectral estimate (see `SpectralEstimate.to_xarray`), and `model`: the fitted arm's admittance."""
        model = arm_admittance(self.fit.arm, self.spectra.frequency)
        made = ("frequency", "output", "input"), model, {"units": "m/N", "long_name": "admittance of the model"}
        return self.spectra.to_xarray().assign(model=made).assign_attrs(**self.fit.labels, condition=self.fit.condition)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the estimated admittance and that of the fitted arm with its 95 % bands.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase of each element.
        """
        return Identifications({self.fit.condition: self}).plot(figure)


class Identifications(Result, Mapping[str, Identification]):
    """Condition to what it yields, in the order of the recording; reads as a dictionary."""

    def __init__(self, by_condition: Mapping[str, Identification]) -> None:
        self._by_condition = dict(by_condition)

    def __getitem__(self, condition: str) -> Identification:
        return self._by_condition[condition]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_condition)

    def __len__(self) -> int:
        return len(self._by_condition)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What fits say of themselves, each once, after the conditions that it is said of unless these are all."""
        whose: dict[str, dict[str, None]] = {}
        for condition, result in self.items():
            for remark in result.fit.remarks:
                whose.setdefault(remark, {})[condition] = None
        return tuple(said if len(of) == len(self) else f"{', '.join(of)}: {said}" for said, of in whose.items())

    def describe(self) -> Description:
        """Who was identified, how well each arm predicts, and the estimates of all conditions side by side."""
        first = next(iter(self.values())).fit
        names = dict.fromkeys(name for result in self.values() for name in result.fit.values)
        models = {condition: f"model {result.fit.structure}, " for condition, result in self.items()}
        shared = models[first.condition] if len(set(models.values())) == 1 else ""
        return Description(
            title=f"Arm of {first.arm.name} in {len(self)} condition{'' if len(self) == 1 else 's'}: "
            f"{shared}{ESTIMATOR_NAMES[first.estimator]}",
            facts=tuple(
                f"{condition}: {'' if shared else models[condition]}{result.n_trials} trial"
                f"{'' if result.n_trials == 1 else 's'}, "
                f"VAF x {result.vaf[0]:.1f} %, y {result.vaf[1]:.1f} %; {result.fit.message}"
                for condition, result in self.items()
            ),
            table=Table(
                ("parameter", "unit", *self),
                tuple((name, unit(name), *(_with_error(of.fit, name) for of in self.values())) for name in names),
            ),
            remarks=self.remarks,
            details=("Estimates +/- standard errors; to_frame() has 95 % intervals.",),
        )

    def to_frame(self) -> "pd.DataFrame":
        """One row per condition and free parameter, with the columns of `results.PARAMETER_COLUMNS`.

        A parameter that conditions share has one row, whose condition names them with + between.
        """
        import pandas as pd

        frame = pd.concat([result.to_frame() for result in self.values()], ignore_index=True)
        together = next(iter(self.values())).fit.detail
        if isinstance(together, Estimate) and len(together.arms) > 1:
            places = [together.place_of(name) for name in together.values]
            shared = {parameter: condition for parameter, condition in places if condition not in together.arms}
            frame["condition"] = [
                shared.get(parameter, condition)
                for parameter, condition in zip(frame["parameter"], frame["condition"], strict=True)
            ]
        return frame.drop_duplicates(["parameter", "condition"], ignore_index=True)

    def to_xarray(self) -> xr.Dataset:
        """`Identification.to_xarray` of all conditions, along a dimension of that name."""
        parts = [result.to_xarray() for result in self.values()]
        data = xr.concat(parts, xr.DataArray(list(self), dims="condition", name="condition"), join="outer")
        data.attrs = dict(next(iter(self.values())).fit.labels)
        return data

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the estimated admittance of each condition and that of the fitted arm with its 95 % bands.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (output, input, 2): gain and phase of each element.
        """
        from armperturb.plots.bands import Curve, plot_responses
        from armperturb.plots.style import colours_for

        curves = []
        for (condition, result), colour in zip(self.items(), colours_for(len(self)), strict=True):
            spectra = result.spectra
            dense = np.geomspace(spectra.frequency[0], spectra.frequency[-1], 200)
            points = {"color": colour, "marker": "o", "linestyle": "", "markersize": 3.5}
            model, bands = arm_admittance(result.fit.arm, dense), result.fit.admittance_bands(dense)
            curves += [
                Curve(f"{condition}, estimated", spectra.frequency, spectra.arm, None, points, (dense, model)),
                Curve(f"{condition}, model {result.fit.structure}", dense, model, bands, {"color": colour}),
            ]
        return plot_responses(curves, figure=figure)


def _with_error(fit: ArmFit, name: str) -> str:
    if name not in fit.values:
        return "-"
    error = fit.standard_error[name]
    mark = " (bound)" if name in fit.at_bound else ""
    if not np.isfinite(error):
        return f"{plain(fit.values[name])} +/- inf{mark}"
    return f"{plain(fit.values[name])} +/- {plain(error, 2)}{mark}"


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

    Raises:
      TypeError: as `identify`.
      ValueError: as `identify`; or the thesis's estimator is to share parameters, but fits each trial alone.
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
    for parts in conditions.values():
        for part in parts:
            part.check_period(window_start, period)
    options: dict[str, Any] = {"window_start": window_start, "period": period}
    spectral = {**options, "lines_per_average": lines_per_average}
    spectra = {label: condition_spectra(parts, **spectral) for label, parts in conditions.items()}
    fits: dict[str, ArmFit] = {}
    if estimator == "thesis":
        for label, parts in conditions.items():
            of_trials = fit_trials(_only(parts), structure, **spectral)
            fits[label] = _thesis_fit(of_trials, parts[0], structure, spectra[label])
            progress(label)
    else:
        groups = [Group.prepare(parts, structure, **options) for parts in conditions.values()]
        moved = [partial(_in_start_geometry, group, options) for group in groups]

        def with_emg(group: Group) -> Group:
            return emg.added_to(group, conditions[group.label][0]) if emg else group

        if model is None:
            for each in zip(groups, moved, strict=True):
                fits[each[0].label] = _chosen_fit(choose_structure(*each, estimator, with_emg=with_emg))
                progress(each[0].label)
        else:
            if not is_published(structure):
                groups = [nearest_to_linear(*each, estimator) for each in zip(groups, moved, strict=True)]
            # What conditions do not share is found sooner alone, and judged by their own trials.
            for together in [groups] if share else [[group] for group in groups]:
                joint = estimate([with_emg(group) for group in together], estimator, share=share)
                for group in together:
                    as_recorded = spectra[group.label] if is_published(structure) else None
                    fits[group.label] = _likely_fit(joint, group, as_recorded)
                    progress(group.label)
        if emg:
            fits = {label: told_of_emg(fit, emg, conditions[label][0]) for label, fit in fits.items()}
    is_cut = estimator != "record" or emg is not None
    said = {
        label: (*remarks_on_trials(parts), *(cut_by_pulses(parts) if is_cut else ()), *remark_on_manipulators(parts))
        for label, parts in conditions.items()
    }
    return Identifications(
        {
            label: Identification(
                n_trials=sum(part.n_trials for part in conditions[label]),
                spectra=spectra[label],
                environment=conditions[label][0].environment,
                fit=replace(fit, remarks=(*fit.remarks, *said[label], *remarks)),
                vaf=np.concatenate(
                    [prediction_vaf(part, fit.arm, part.environment) for part in conditions[label]]
                ).mean(axis=0),
            )
            for label, fit in fits.items()
        }
    )


def _only(parts: Sequence[ConditionTrials]) -> ConditionTrials:
    if len(parts) > 1:
        lengths = ", ".join(f"{part.n_samples / part.rate:g} s" for part in parts)
        raise ValueError(
            f"trials of {lengths}; expected one length with estimator = 'thesis' (--estimator record takes any)"
        )
    return parts[0]


def _thesis_fit(
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
