"""Nonlinear identification of one person in one task, and what all models predict of pulses that no fit has seen.

Two kinds of fit: to what comes before the pulses, and, for each direction of pulses, also to those of the other
directions. Pulses that were left out of a fit are what it is judged by.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.nonlinear.model import stem
from armperturb.analysis.nonlinear.trials import cut_remarks, fitted_conditions, training_sets
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.planar_arm.skeletal import simulate_skeletal
from armperturb.study.protocol import Condition
from armperturb.study.results.cases import Case
from armperturb.subject import Subject

MODELS = ("linear", "skeletal", "nonlinear")
"""Linear arm, the same arm with the geometry of its movement, and the arm with a muscle law."""

PATHS = {"PT": ("PT7.5", 2.0), "RT": ("RT7.5", 1.0)}
"""Task to condition and pulse level whose paths the thesis draws (figures 3.17, 3.18)."""


def drawn_pulse(conditions: Iterable[Condition], task: str) -> tuple[str, float] | None:
    """Condition and pulse level whose paths are drawn; None without pulses after a multisine.

    The thesis's; where it is not among these, the largest level of the first condition that has both.

    Args:
      conditions: of the protocol.
      task: "PT" or "RT".
    """
    pulses = [
        (condition.name, level)
        for condition in conditions
        if condition.task == task and condition.has_multisine
        for level in sorted(condition.pulse_levels, reverse=True)
    ]
    return PATHS[task] if PATHS[task] in pulses else next(iter(pulses), None)


class LeftOutPulse(NamedTuple):
    """A pulse that the fit has not seen.

    Attributes:
      condition: of the trial.
      level: of the pulse, multiple of the unit pulse.
      direction_deg: of the pulse, from the x axis.
      peak: model to predicted over recorded peak displacement [%] (eq. 2.25); without models that predict nothing.
      vaf: model to the share of the path's variance that it accounts for [%], x and y together.
      paths: "recorded" and models to the displacement from the onset on [m], (time, axis); only of `drawn_pulse`.
    """

    condition: str
    level: float
    direction_deg: float
    peak: Mapping[str, float]
    vaf: Mapping[str, float]
    paths: Mapping[str, Array]


class NonlinearFit(NamedTuple):
    """A nonlinear fit to one person in one task, or why there is none.

    Attributes:
      name: of the person.
      task: "PT" or "RT".
      fitted_deg: directions of the pulses that were fitted beside what comes before pulses; empty for none of them.
      directions_deg: all directions of the person's pulses.
      reference: condition whose level of co-contraction is 1.
      values: parameter, as `nonlinear.model` calls it, to its estimate.
      lower: parameter to the lower end of its 95 % interval.
      upper: likewise, the upper end.
      at_bound: parameters that sit on a bound.
      converged: whether the search ended at a maximum.
      status: how it ended.
      remarks: what to know before trusting the values, one sentence each.
      pulses: those that were left out.
      failed: why there is no fit; empty if there is one.
    """

    name: str
    task: str
    fitted_deg: tuple[float, ...]
    directions_deg: tuple[float, ...] = ()
    reference: str = ""
    values: Mapping[str, float] = {}
    lower: Mapping[str, float] = {}
    upper: Mapping[str, float] = {}
    at_bound: tuple[str, ...] = ()
    converged: bool = False
    status: str = ""
    remarks: tuple[str, ...] = ()
    pulses: tuple[LeftOutPulse, ...] = ()
    failed: str = ""

    @property
    def label(self) -> str:
        """Which fit it is, in words."""
        pulses = " and ".join(f"{deg:g}\u00b0" for deg in self.fitted_deg)
        return f"{self.task}, pulses at {pulses} fitted too" if pulses else f"{self.task}, no pulses fitted"

    @property
    def others_deg(self) -> tuple[tuple[float, ...], ...]:
        """For each direction all others: pulses to fit so that those of that direction can be predicted."""
        if self.failed or len(self.directions_deg) < 2:
            return ()
        return tuple(tuple(deg for deg in self.directions_deg if deg != left_out) for left_out in self.directions_deg)

    @property
    def start(self) -> dict[str, float]:
        """Where a fit to more trials of the person may start; their levels may be relative to another condition."""
        return {
            name: value for name, value in self.values.items() if stem(name) != "level" and name not in self.at_bound
        }


def fit_nonlinear(
    recording: xr.Dataset,
    task: str,
    cases: Sequence[Case],
    fitted_deg: Iterable[float] = (),
    start: Mapping[str, float] | None = None,
    checkpoint: Path | None = None,
) -> NonlinearFit:
    """Fit the full muscle law to a person's trials of one task, and predict the pulses that were left out.

    The linear and the skeletal model predict them as the thesis has it, each trial by its own fit, if it is stable.

    Args:
      recording: the person's trials.
      task: "PT" or "RT".
      cases: the person in conditions with a multisine, of either task.
      fitted_deg: directions of the pulses that are fitted.
      start: parameter to the value from which the search starts.
      checkpoint: file in which the search is kept after each step; one that was stopped there goes on.

    Raises:
      OSError: the checkpoint cannot be written.
    """
    # Here, as compiling loads slowly, and few reports have anything to fit.
    from armperturb.analysis.nonlinear.estimate import fit

    name = str(recording["subject"].values[0])
    nothing = NonlinearFit(name, task, tuple(fitted_deg))
    identified = {case.condition.name: case for case in cases if case.condition.task == task and case.identification}
    try:
        if not identified:
            raise ValueError(f"no linear arm was identified in {task}, where the fit would start")
        mine = _usable(recording, task)
        sets = fitted_conditions(mine)
        fitted, _ = training_sets(sets, fitted_deg)
        arms = {label: case.identified.fit.arm for label, case in identified.items()}
        estimate = fit(fitted, arms, initial=start, checkpoint=checkpoint)
        subjects = {label: estimate.subject(task, label) for label in sets}
        drawn = drawn_pulse((case.condition for case in cases), task)
        estimates = {label: case.thesis_estimate for label, case in identified.items()}
        pulses = _left_out(mine, sets, subjects, estimates, fitted_deg, drawn)
    except ValueError as error:  # must not cost the other people their results
        return nothing._replace(failed=str(error))
    intervals = {parameter: estimate.interval(parameter) for parameter in estimate.values}
    directions = np.concatenate([trials.direction_deg for trials in sets.values()])
    return nothing._replace(
        directions_deg=tuple(np.unique(directions[np.isfinite(directions)]).tolist()),
        reference=next(trials.label for trials in fitted if f"level.{trials.label}" not in estimate.values),
        values=dict(estimate.values),
        lower={parameter: lower for parameter, (lower, _) in intervals.items()},
        upper={parameter: upper for parameter, (_, upper) in intervals.items()},
        at_bound=estimate.at_bound,
        converged=estimate.converged,
        status=estimate.message,
        remarks=(*cut_remarks(sets, fitted), *estimate.remarks),
        pulses=tuple(pulses),
    )


def _usable(recording: xr.Dataset, task: str) -> xr.Dataset:
    """Trials of a task that stay inside the workspace until the pulse, as `ConditionTrials.multisine` has them."""
    usable = []
    labels = np.where(recording["task"].values == task, recording["condition"].values, "")
    for label in dict.fromkeys(labels[labels != ""].tolist()):
        places = np.flatnonzero(labels == label)
        usable += places[
            ConditionTrials.prepare(recording.isel(trial=places), is_checked=True).multisine.numbers
        ].tolist()
    return recording.isel(trial=usable)


def _left_out(
    recording: xr.Dataset,
    sets: Mapping[str, ConditionTrials],
    subjects: Mapping[str, Subject],
    estimates: Mapping[str, ThesisEstimate | None],
    fitted_deg: Iterable[float],
    drawn: tuple[str, float] | None,
) -> list[LeftOutPulse]:
    """What the models predict of pulses whose direction was not fitted; with paths of those that are drawn."""
    from armperturb.analysis.nonlinear.prediction import predict_pulses

    fitted = list(fitted_deg)
    pulses: list[LeftOutPulse] = []
    for label, prepared in sets.items():
        mine = recording.isel(trial=np.flatnonzero(recording["condition"].values == label))
        estimate = estimates.get(label)
        for trial, direction in enumerate(prepared.direction_deg):
            if np.isnan(direction) or np.isclose(direction, fitted or [np.nan]).any():
                continue
            for pulse in predict_pulses(prepared.take([trial]), subjects[label]):
                predicted = {"nonlinear": pulse}
                if estimate is not None and estimate.fits[trial].stable:
                    arm, environment = estimate.fits[trial].arm, estimate.environment
                    driven = mine["perturbation"].values[trial, : prepared.onset[trial] + len(pulse.time)]
                    onset = int(prepared.onset[trial])
                    for model, path in predicted_paths(arm, environment, driven, prepared.rate, onset).items():
                        predicted[model] = replace(pulse, predicted=path)
                finite = {model: its for model, its in predicted.items() if np.isfinite(its.predicted).all()}
                level = abs(float(mine["pulse_level"].values[trial]))
                paths: dict[str, Array] = {}
                if finite and (label, level) == drawn:
                    paths = {"recorded": pulse.recorded, **{model: its.predicted for model, its in finite.items()}}
                peak, vaf = ({model: getattr(its, of) for model, its in finite.items()} for of in ("peak", "vaf"))
                pulses.append(LeftOutPulse(label, level, float(direction), peak, vaf, paths))
    return pulses


def predicted_paths(arm: Subject, environment: Environment, force: Array, rate: float, onset: int) -> dict[str, Array]:
    """Displacement of the handle from the onset of a pulse on, as the linear and the skeletal model have it [m].

    Args:
      arm: a trial's own fit.
      environment: what the hand holds.
      force: the disturbance from the start of the trial [N], (time, axis).
      rate: of the force [Hz].
      onset: sample at which the pulse begins.
    """
    linear = simulate_linear(arm, environment, force, rate).displacement[onset:]
    return {"linear": linear, "skeletal": simulate_skeletal(arm, environment, force, rate, onset)}
