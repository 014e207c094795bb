"""Trials of one person, divided into those that are fitted and those whose pulses are left out."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import xarray as xr

from armperturb.analysis.pulses_alone import fitted_whole
from armperturb.analysis.trials import OTHERS, ConditionTrials, trials_by_condition
from armperturb.arrays import Indices

LEAST = 5.0
"""Shortest time before a pulse that is fitted [s]."""

CUT = 1.0
"""Time that is left out before a pulse from which on it is told [s]."""


def fitted_conditions(recording: xr.Dataset) -> dict[str, ConditionTrials]:
    """All trials of one person, by condition.

    Conditions that are perturbed by pulses alone move too little for identifying the manipulator: they take it from
    another condition, of the same task if there is one. Where all are, trials are used whole, as if without pulses.

    Raises:
      ValueError: the recording is refused or of several people, nothing perturbs any trial, or as `fitted_whole`.
    """
    conditions = trials_by_condition(recording)
    perturbed = {label: trials for label, trials in conditions.items() if trials.drive[:, : trials.first_onset].any()}
    if not perturbed:
        return {label: _whole(trials) for label, trials in conditions.items()}
    for label, trials in conditions.items():
        if label not in perturbed:
            same = [other for other in perturbed.values() if other.body.task == trials.body.task]
            source = (same or list(perturbed.values()))[0]
            conditions[label] = replace(trials, given=source.instruments)
    return conditions


def _whole(trials: ConditionTrials) -> ConditionTrials:
    (whole,) = fitted_whole([trials])
    if whole is trials:
        raise ValueError(
            f"nothing perturbs a trial of {trials.label} before its pulse, and not all have one; expected a multisine "
            f"or noise, or a pulse in every trial ({OTHERS})"
        )
    recording = whole.recording.assign_coords(pulse_direction=("trial", np.full(whole.n_trials, np.nan)))
    return replace(ConditionTrials.prepare(recording, is_checked=True), copies=whole.copies)


def training_sets(
    conditions: Mapping[str, ConditionTrials], pulse_directions_deg: Iterable[float] = ()
) -> tuple[list[ConditionTrials], list[ConditionTrials]]:
    """Trials to fit, and trials whose pulses are left out.

    Trials of a condition are fitted up to the same time. Where pulses begin at different times, it is the one that
    keeps most: trials whose pulse begins before it are not fitted, see `cut_remarks`.

    Args:
      conditions: all trials by condition.
      pulse_directions_deg: directions of the pulses that are fitted; of other trials, what comes before the pulse is.

    Returns:
      What to fit, without trials that nothing perturbs, and the whole trials whose pulses are left out.
    """
    wanted = list(pulse_directions_deg)
    fitted: list[ConditionTrials] = []
    left_out: list[ConditionTrials] = []
    for condition in conditions.values():
        trials = condition.before(condition.end)  # the same length in all parts of a condition
        with_pulse = np.array([np.isnan(deg) or bool(np.isclose(deg, wanted).any()) for deg in trials.direction_deg])
        moved = with_pulse & trials.drive.any(axis=(1, 2))  # not those of a maximal contraction, or of rest
        if moved.any():
            fitted.append(trials.take(np.flatnonzero(moved)))
        if not with_pulse.all():
            others = trials.take(np.flatnonzero(~with_pulse))
            left_out.append(others)
            ends = _ends(others)
            end = max(ends, key=lambda end: (end * (ends >= end).sum(), end))
            if end >= LEAST * others.rate:
                fitted.append(others.take(np.flatnonzero(ends >= end)).before(int(end)))
    return fitted, left_out


def cut_remarks(conditions: Mapping[str, ConditionTrials], fitted: Iterable[ConditionTrials]) -> list[str]:
    """Which perturbed trials are not fitted because their pulse comes early, and which are cut, a line each.

    Args:
      conditions: all trials by condition.
      fitted: what `training_sets` takes of them.
    """
    sets, remarks = list(fitted), []
    for label, condition in conditions.items():
        ends = _ends(condition)
        end_of = {int(number): trials.end for trials in sets if trials.label == label for number in trials.numbers}
        missing = [k for k, number in enumerate(condition.numbers) if ends[k] and int(number) not in end_of]
        if missing:
            latest = ends[missing].max() / condition.rate
            begin = f"begins at {latest:.3g} s" if len(missing) == 1 else f"begin at {latest:.3g} s or earlier"
            pulses = "its pulse" if len(missing) == 1 else "their pulses"
            verb = "is" if len(missing) == 1 else "are"
            remarks.append(
                f"{label}: {len(missing)} of {condition.n_trials} trials {verb} not fitted, as {pulses} {begin}"
            )
        cut = [
            (ends[k] - end_of[int(number)]) / condition.rate
            for k, number in enumerate(condition.numbers)
            if int(number) in end_of
        ]
        if cut and max(cut) > CUT:
            remarks.append(
                f"{label}: {sum(each > CUT for each in cut)} of {condition.n_trials} trials are fitted up to "
                f"{min(end_of.values()) / condition.rate:.3g} s only, where the first pulse of the others begins"
            )
    return remarks


def _ends(trials: ConditionTrials) -> Indices:
    """First sample of each trial's pulse, or its end, where something perturbs it before that; 0 where nothing does."""
    ends = np.minimum(trials.onset, trials.end)
    return np.array([end if drive[:end].any() else 0 for end, drive in zip(ends, trials.drive, strict=True)], np.intp)
