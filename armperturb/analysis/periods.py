"""From when on the perturbation of trials repeats, and after how long."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from armperturb.analysis.defaults import SETTLED
from armperturb.analysis.numerics.periodicity import find_period, samples_of_period
from armperturb.analysis.trials import ConditionTrials, TrialRecord, records_of

APERIODIC = 1e-2
"""Share of its power by which a disturbance may differ from one period to the next [-]."""

FADE_OUT = 1.0
"""Longest time over which a disturbance fades before a pulse or the end of a trial [s]."""


def settled_start(trials: Sequence[ConditionTrials], window_start: float) -> float:
    """Start of the window; where nothing perturbs all trials yet, `SETTLED` after something does [s].

    Args:
      trials: of one or several recordings.
      window_start: of the window, as it is wanted [s].
    """
    begin = max(part.begin for part in trials)
    return window_start if window_start >= begin else begin + SETTLED


def common_period(trials: Sequence[ConditionTrials], window_start: float) -> float:
    """Period of the perturbation of all trials together [s], found in what was recorded of it before the pulses.

    Args:
      trials: of one or several recordings; some may be shorter than a period.
      window_start: from when on the analysis uses the trials [s]. The perturbation counts from `SETTLED` after its
        beginning on, or from `window_start` if it repeats only then; it may fade out over `FADE_OUT`.

    Raises:
      ValueError: as `ConditionTrials.records` and `find_period`.
    """
    used = settled_start(trials, window_start)
    starts = [min(window_start, SETTLED), used]
    if begin := max(part.begin for part in trials):
        starts.insert(1, min(begin + SETTLED, used))
    refusal: ValueError | None = None
    for start in dict.fromkeys(starts):
        try:
            return _found(trials, start, may_fade=start == used)
        except ValueError as error:
            refusal = refusal or error
    assert refusal is not None
    raise refusal


def _found(trials: Sequence[ConditionTrials], start: float, *, may_fade: bool) -> float:
    """The period from a time on, stored with the trials of a single recording."""
    key = ("period", start)
    if len(trials) > 1 or key not in trials[0].results:
        records, rate = [record.perturbation for record in records_of(trials, start)], trials[0].rate
        try:
            period = find_period(records, rate, start)
        except ValueError:
            n_fade, period = round(FADE_OUT * rate), None
            if may_fade and min(map(len, records)) > 2 * n_fade:
                with suppress(ValueError):
                    period = find_period([d[:-n_fade] for d in records], rate, start)
            if period is None:
                raise
        trials[0].results[key] = period
    return float(trials[0].results[key])


def without_fade(record: TrialRecord, n_period: int) -> TrialRecord:
    """A record up to where its perturbation no more repeats, if that is within `FADE_OUT` of the end.

    Args:
      record: of a perturbation that repeats.
      n_period: after how many samples.
    """
    d = record.perturbation
    last = len(d) - round(FADE_OUT * record.rate)
    if last <= n_period:
        return record
    change = np.sum((d[last:] - d[last - n_period : -n_period]) ** 2, axis=1)
    differs = np.flatnonzero(change > APERIODIC * np.mean(np.sum(d**2, axis=1)))
    if not len(differs):
        return record
    return record._replace(perturbation=d[: last + differs[0]], response=record.response[: last + differs[0]])


def check_period(trials: ConditionTrials, window_start: float, period: float | None) -> None:
    """Refuse a stated period after which the perturbation does not repeat.

    Args:
      trials: of one recording.
      window_start: start of the window of whole periods [s]. What is before it counts from half that time on.
      period: as stated [s]; None if it is to be found.

    Raises:
      ValueError: the perturbation does not repeat, or a period is not a whole number of samples.
    """
    if period is None:
        return
    n_period = samples_of_period(period, trials.rate)
    first = max(round(window_start * trials.rate) // 2, round(trials.begin * trials.rate))
    for trial, end in enumerate(trials.onset.tolist()):
        d = trials.perturbation[trial, first:end]
        earlier, later = d[:-n_period], d[n_period:]
        if np.sum((later - earlier) ** 2) > APERIODIC * np.sum(later**2):
            raise ValueError(
                f"period = {period:g} s; expected the perturbation's own: that of trial {trial} does not repeat after "
                f"it from {first / trials.rate:g} s on (without --period it is found; a later --window-start leaves "
                "out what comes before)"
            )
