"""Trials of one person, divided into those that are fitted and those whose pulses are left out."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import xarray as xr

from armperturb.analysis.trials import ConditionTrials, trials_by_condition

LEAST = 5.0
"""Shortest time before a pulse that is fitted [s]."""


def fitted_conditions(recording: xr.Dataset) -> dict[str, ConditionTrials]:
    """All trials of one person, by condition.

    Conditions that are perturbed by pulses alone move too little for identifying the manipulator: they take it from
    another condition, of the same task if there is one.

    Raises:
      ValueError: the recording is refused or of several people, or nothing but pulses perturbs.
    """
    conditions = trials_by_condition(recording)
    perturbed = {label: trials for label, trials in conditions.items() if trials.drive[:, : trials.first_onset].any()}
    if not perturbed:
        raise ValueError("no trial has a perturbation before its pulse; expected some with a multisine or noise")
    for label, trials in conditions.items():
        if label not in perturbed:
            same = [other for other in perturbed.values() if other.body.task == trials.body.task]
            source = (same or list(perturbed.values()))[0]
            conditions[label] = replace(trials, given=source.instruments)
    return conditions


def training_sets(
    conditions: Mapping[str, ConditionTrials], pulse_directions_deg: Iterable[float] = ()
) -> tuple[list[ConditionTrials], list[ConditionTrials]]:
    """Trials to fit, and trials whose pulses are left out.

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
            before = others.before(others.first_onset)
            if before.end >= LEAST * before.rate and before.drive[:, : before.end].any(axis=(1, 2)).all():
                fitted.append(before)
    return fitted, left_out
