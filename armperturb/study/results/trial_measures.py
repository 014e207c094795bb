"""What the thesis reports of one person, from the person's recordings: cells of tables, admittance, pulses, fits."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.measures.pulse import cut_peaks, peak_norm, predicted_peaks, pulse_peaks, pulse_span
from armperturb.analysis.measures.vaf import variance_accounted_for
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.planar_arm.skeletal import simulate_skeletal
from armperturb.study.published import tables as published
from armperturb.study.results.cases import Case
from armperturb.study.results.quantities import Cell, level_name, measure
from armperturb.subject import Subject

N_LOW = 2
"""How many of the lowest frequency points tell the low-frequency gain (thesis 3.1)."""


class TrialMeasures(NamedTuple):
    """What one trial tells, and what its own fit predicts of it.

    Numbers are NaN where there is none: no pulse, no stable fit, or a skeletal model that reached the workspace limit.

    Attributes:
      condition: of the protocol.
      repetition: of the condition, from 0.
      pulse_level: as recorded, multiple of the unit pulse; 0 without pulse.
      pulse_direction_deg: of its force, from the x axis.
      displacement: peak after the pulse [m].
      force: peak hand reaction force after the pulse [N].
      predicted_linear: peak displacement as the linear model has it [m].
      predicted_skeletal: likewise, the nonlinear skeletal model.
      vaf_linear: variance of the displacement before the pulse that the linear model accounts for, x and y [%].
      vaf_skeletal: likewise, the nonlinear skeletal model.
    """

    condition: str
    repetition: int
    pulse_level: float
    pulse_direction_deg: float
    displacement: float
    force: float
    predicted_linear: float = math.nan
    predicted_skeletal: float = math.nan
    vaf_linear: tuple[float, float] = (math.nan, math.nan)
    vaf_skeletal: tuple[float, float] = (math.nan, math.nan)

    @property
    def admittance(self) -> float:
        """Pulse admittance [m/N]. Source: eq. 2.24."""
        return self.displacement / self.force


class PulseMeans(NamedTuple):
    """A person's responses to the pulses of a condition and level, as means over trials.

    Attributes:
      displacement: peak [m], mean over the trials of each direction, then over directions.
      admittance: pulse admittance [m/N], likewise.
      prediction: predicted over recorded peak displacement, of the linear model [%]; NaN if there is no model.
      excess: recorded over predicted peak displacement, of the linear model [-]; likewise.
      prediction_skeletal: predicted over recorded peak displacement, of the nonlinear skeletal model [%]; likewise.
      by_direction: direction, in whole degrees from the x axis as text, to displacement [m] and admittance [m/N] in it.
    """

    displacement: float
    admittance: float
    prediction: float
    excess: float
    prediction_skeletal: float
    by_direction: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True, eq=False)
class PersonMeasures:
    """What a person's recordings tell.

    Attributes:
      name: of the person.
      conditions: that were recorded.
      cells: of tables 2.1 and F.2 to F.6 to the person's values, SI, and of conditions that the thesis does not have;
        joints from the handle's path.
      true_cells: those of tables F.2 to F.6, with the joints as the simulation has them; none of people.
      low_gain: condition to the gain of the diagonal of the admittance at the lowest frequencies [m/N], (frequency,
        axis).
      trials: what each recorded trial tells, those of published conditions first.
      estimates: condition to the fits of its trials that predict them.
      left_out: why trials, or parts of them, tell nothing; one line each.
    """

    name: str
    conditions: tuple[str, ...]
    cells: Mapping[Cell, float]
    true_cells: Mapping[Cell, float]
    low_gain: Mapping[str, Array]
    trials: tuple[TrialMeasures, ...]
    estimates: Mapping[str, ThesisEstimate]
    left_out: tuple[str, ...]

    @cached_property
    def pulses(self) -> dict[tuple[str, str], PulseMeans]:
        """Condition and `level_name` to the means over the trials whose pulse tells something, small pulses first."""
        of_condition: dict[str, dict[float, list[TrialMeasures]]] = {}
        for trial in self.trials:
            if math.isfinite(trial.displacement):
                of_level = of_condition.setdefault(trial.condition, {})
                of_level.setdefault(abs(trial.pulse_level), []).append(trial)
        return {
            (condition, level_name(condition, level)): _pulse_means(its)
            for condition, of_level in of_condition.items()
            for level, its in sorted(of_level.items())
        }


def measure_person(
    recording: xr.Dataset, conditions: Mapping[str, ConditionTrials], cases: Sequence[Case]
) -> PersonMeasures:
    """All of it.

    Args:
      recording: the person's trials.
      conditions: condition to these trials.
      cases: what was identified from them; each trial is predicted by its own fit, of the thesis's estimator.

    Raises:
      ValueError: the recording is refused, or holds several people.
    """
    cells, reasons = measure(recording)
    name = str(recording["subject"].values[0])
    left_out = [f"{name}: {line}" for line in reasons]
    left_out += [f"{name} in {line}" for line in cut_peaks(recording)]
    by_condition = {case.condition.name: case for case in cases}
    low_gain: dict[str, Array] = {}
    trials: list[TrialMeasures] = []
    estimates: dict[str, ThesisEstimate] = {}
    for condition in sorted(conditions, key=_printed_place):
        mine, multisine = conditions[condition].recording, conditions[condition].multisine
        case = by_condition.get(condition)
        if case is not None and case.identification is not None:
            gain = np.abs(np.diagonal(case.identification.spectra.arm, axis1=1, axis2=2))
            low_gain[condition] = gain[:N_LOW]
        estimate = case.thesis_estimate if case is not None else None
        models: dict[int, tuple[Subject, Environment, list[float]]] = {}
        if estimate is not None:
            estimates[condition] = estimate
            left_out += diverged(f"{name}, {condition}, model {estimate.structure}", estimate)
            models = {
                trial: (fit.arm, estimate.environment, vaf)
                for trial, fit, vaf in zip(
                    multisine.numbers.tolist(), estimate.fits, estimate.vaf.tolist(), strict=True
                )
                if fit.stable
            }
        for trial, measures in enumerate(_recorded_trials(mine)):
            if trial in models:
                arm, environment, (x, y) = models[trial]
                alone = mine.isel(trial=[trial])
                predicted = float(predicted_peaks(alone, arm, environment)[0])
                measures = measures._replace(predicted_linear=predicted, vaf_linear=(x, y))
                before = slice(0, multisine.n_samples)
                measures, lost = _with_skeletal(measures, alone, before, arm, environment)
                left_out += [f"{name} in {line}" for line in lost]
            trials.append(measures)
    true_cells = measure(recording, simulated_joints=True).cells if "joint_angle" in recording else {}
    return PersonMeasures(
        name=name,
        conditions=tuple(conditions),
        cells=cells,
        true_cells={cell: value for cell, value in true_cells.items() if cell.table.startswith("F")},
        low_gain=low_gain,
        trials=tuple(trials),
        estimates=estimates,
        left_out=tuple(left_out),
    )


def _printed_place(condition: str) -> int:
    """Place in table 2.1; conditions that it does not have come after those that it has."""
    printed = published.conditions()
    return printed.index(condition) if condition in printed else len(printed)


def diverged(name: str, estimate: ThesisEstimate) -> list[str]:
    """How many of the fits of that name ended unstable, in a line; none if no fit did."""
    n = len(estimate.fits) - estimate.n_stable
    line = f"{name}: {n} of {len(estimate.fits)} fits diverged (unstable on the manipulator in spite of the penalty)"
    return [f"{line} and are left out"] if n else []


def stable_mean(estimate: ThesisEstimate, name: str, *, sem: bool = False) -> float:
    """A person's mean over stable trials of a parameter, or of its SEM; NaN without any."""
    per_trial = (estimate.sem if sem else estimate.values)[estimate.stable, estimate.parameters.index(name)]
    return float(per_trial.mean()) if len(per_trial) else math.nan


def muscle_parameter(name: str, of_joints: Callable[[str], float]) -> float:
    """A parameter of a muscle group, from those of joints: k_s* = k_s - k_se, k_e* = k_e - k_se (eq. 2.10).

    Args:
      name: with a star for muscles of one joint.
      of_joints: name of a joint's parameter to its value.
    """
    joint, star, _ = name.partition("*")
    return of_joints(joint) - of_joints(f"{joint.split('_')[0]}_se") if star else of_joints(joint)


def _recorded_trials(recording: xr.Dataset) -> list[TrialMeasures]:
    """What the trials of a recording tell without any model."""
    peaks = pulse_peaks(recording)
    return [
        TrialMeasures(
            condition=str(recording["condition"].values[trial]),
            repetition=int(recording["repetition"].values[trial]),
            pulse_level=float(recording["pulse_level"].values[trial]),
            pulse_direction_deg=float(recording["pulse_direction"].values[trial]),
            displacement=float(peaks.displacement[trial]),
            force=float(peaks.force[trial]),
        )
        for trial in range(recording.sizes["trial"])
    ]


def _with_skeletal(
    measures: TrialMeasures, trial: xr.Dataset, multisine: slice, arm: Subject, environment: Environment
) -> tuple[TrialMeasures, list[str]]:
    """What the nonlinear skeletal model predicts of a trial added, and what it could not predict, one line each.

    Args:
      measures: what else the trial tells; its pulse is predicted if the linear model's is.
      trial: alone.
      multisine: samples that the VAF is of.
      arm: the trial's own fit.
      environment: what the hand held.
    """
    rate, left_out = float(trial.attrs["rate"]), []
    spans = {"multisine": multisine}
    if math.isfinite(measures.predicted_linear):
        spans["pulse"] = pulse_span(trial, 0)
    for part, span in spans.items():
        path = simulate_skeletal(arm, environment, trial["perturbation"].values[0, : span.stop], rate, span.start)
        lost = np.flatnonzero(np.isnan(path[:, 0]))
        if len(lost):
            left_out.append(
                f"{measures.condition}, repetition {measures.repetition}: the skeletal model left the workspace "
                f"{lost[0] / rate:.3f} s after the {part} began; it predicts nothing of it"
            )
        elif part == "pulse":
            measures = measures._replace(predicted_skeletal=peak_norm(path))
        else:
            x, y = variance_accounted_for(trial["displacement"].values[0, span], path, rate).tolist()
            measures = measures._replace(vaf_skeletal=(x, y))
    return measures, left_out


def _pulse_means(trials: list[TrialMeasures]) -> PulseMeans:
    displacement = np.array([trial.displacement for trial in trials])

    def known(predicted: list[float]) -> Array:
        ratio = np.array(predicted) / displacement
        return ratio[np.isfinite(ratio)]

    linear = known([trial.predicted_linear for trial in trials])
    skeletal = known([trial.predicted_skeletal for trial in trials])
    measured = np.array([(trial.displacement, trial.admittance) for trial in trials])
    directions = np.array([f"{round(trial.pulse_direction_deg, 0) % 360.0:g}" for trial in trials])
    of_direction = {str(each): measured[directions == each] for each in dict.fromkeys(directions)}
    by_direction = {each: its.mean(axis=0) for each, its in of_direction.items()}
    # Of equally many trials the mean over all is the same, and does not depend on how they are grouped.
    is_even = len(set(map(len, of_direction.values()))) == 1
    peak, admittance = (measured if is_even else np.array(list(by_direction.values()))).T.mean(axis=1).tolist()
    return PulseMeans(
        displacement=peak,
        admittance=admittance,
        prediction=100.0 * float(linear.mean()) if len(linear) else math.nan,
        excess=float((1.0 / linear).mean()) if len(linear) else math.nan,
        prediction_skeletal=100.0 * float(skeletal.mean()) if len(skeletal) else math.nan,
        by_direction={direction: (float(peak), float(ratio)) for direction, (peak, ratio) in by_direction.items()},
    )
