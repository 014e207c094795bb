"""Faults of recordings: found with the time at which they occur, and repaired if asked.

| fault | seen as | repaired as |
|---|---|---|
| `gaps` | values that are missing | by a cubic spline through the others: up to 0.025 s of forces, 0.1 s of paths |
| `drops` | times that skip samples and stay behind | the same, up to 0.025 s |
| `clock` | times that run at another rate than stated, or not evenly | by a cubic spline on even times |
| `stretch` | values that are missing for longer than that | by a cut to the longest stretch without |
| `lengths` | trials, or signals of one (by up to a tenth), that do not last equally long | by a cut to the shortest |
| `trials` | any fault that is not repaired otherwise | by leaving out the trial |

Channels that are stuck, clipped or hold their last value can only be left out with their trial, and so can a trial that
broke off: all others would be cut to the little that there is of it. Times that step back
are always refused.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from armperturb.analysis.plateaus import LEAST_RUN, clipped_stretches, held_stretches, runs
from armperturb.arrays import Array
from armperturb.convert.tables import Repair
from armperturb.recording import REQUIRED_SIGNALS, Action, HighPass

LONGEST_GAP = {"perturbation": 0.025, "force": 0.025}
"""Longest gap that is filled in a signal [s]: a quarter period of its highest frequency of substantial power."""

LONGEST_SLOW_GAP = 0.1
"""Longest gap that is filled in positions and angles [s]: the arm's resonance is at about 2.5 Hz."""

ROUNDED = 0.15
"""Largest deviation of a time from even times, relative to a step [-]: some files hold whole milliseconds."""

SKIPPED = 1.3
"""Steps that are all shorter than this, in usual ones, skip no sample [-]."""

AHEAD = 20
"""Samples that must stay late for one to be missing before them; a late time alone does not."""

FOLLOW = 0.2
"""How far the level of the times follows each of them [-]: some clocks wander, and loops may wait after each sample."""

OFF = 0.1
"""Largest relative deviation of a clock from the stated rate that is repaired [-]; beyond, rate or unit is wrong."""


LARGEST_RATIO = 1.1
"""Largest ratio of the lengths of signals that are cut to the shortest [-]; beyond, their rates differ."""


BROKEN_OFF = 0.5
"""Duration of a trial over the median of all below which the others are not cut to it [-]."""


class Fault(NamedTuple):
    """Something wrong in a trial.

    Attributes:
      repair: what would repair it; "trials" if nothing else does.
      text: what is wrong, where and when.
      can: whether that repair can do it.
      signal: that has the fault; empty of what concerns several.
    """

    repair: Repair
    text: str
    can: bool = True
    signal: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Timed:
    """A trial on even times.

    Attributes:
      where: file and trial, for messages.
      labels: coordinate along `trial` to value.
      signals: name to values, (time, component), in the file's units and axes until they are repaired, then in ours.
      rates: name to sampling rate [Hz].
      components: name to what its components are called in the file.
      muscles: of the EMG, and what each does; None for those that recordings have anyway.
      emg_lead: by how much the other signals are later than the EMG; negative where that is later [s].
      emg_highpass: of the EMG's amplifier; None if nobody knows it.
      units: name to its SI unit.
      servo: what the device of a recording of one axis does; None with two axes.
    """

    where: str
    labels: Mapping[str, Any]
    signals: Mapping[str, Array]
    rates: Mapping[str, float]
    components: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str]
    servo: str | None = None
    muscles: Mapping[str, Action] | None = None
    emg_lead: float = 0.0
    emg_highpass: HighPass | None = None


def even_times(
    where: str, signals: Mapping[str, Array], time: Array, stated: float | None
) -> tuple[Mapping[str, Array], float, list[Fault]]:
    """Signals on even times, and what was wrong with the times.

    Args:
      where: file, trial and channel of the times, for messages.
      signals: name to values, (time, component), NaN where there is none.
      time: of the samples [s], (time,).
      stated: sampling rate that the sidecar states [Hz]; None to take it from the times.

    Returns:
      The signals, unchanged if the times are even and otherwise repaired as far as possible, their rate [Hz], and the
      faults.

    Raises:
      ValueError: times are missing or do not increase.
    """
    if not np.isfinite(time).all():
        at = int(np.argmin(np.isfinite(time)))
        raise ValueError(f"{where}: the time of sample {at} is missing; expected a number")
    time = time - time[0]
    steps = np.diff(time)
    if (steps <= 0.0).any():
        at = int(np.argmax(steps <= 0.0))
        if steps[at] == 0.0:
            raise ValueError(
                f"{where}: time stands still at {time[at]:.6g} s, samples {at} and {at + 1}; expected increasing times "
                "(where they are rounded, leave the channel 'time' out and state the rate)"
            )
        raise ValueError(
            f"{where}: time steps back from {time[at]:.6g} s to {time[at + 1]:.6g} s at sample {at + 1}; expected "
            "increasing times (two recordings in one file need a channel 'trial' that numbers them)"
        )
    usual = float(np.median(steps))
    usual = float(steps[np.abs(steps - usual) < 0.6 * usual].mean())
    missing = _missing(steps / usual)
    index = np.concatenate([[0], np.cumsum(missing + 1)])
    step, first = _line(index, time)
    rate = stated if stated is not None else _rate_of(step, len(time))
    faults = []
    for at in np.flatnonzero(missing).tolist():
        what = (
            f"{missing[at]} samples are dropped at {time[at]:.6g} s (time steps by {1e3 * steps[at]:.4g} ms, usually "
            f"by {1e3 * usual:.4g} ms)"
        )
        can = bool(missing[at] * usual <= min(LONGEST_GAP.values()) + 0.1 * usual)  # all signals miss them
        faults.append(Fault("drops", what, can))
    off = np.abs(time - first - index / rate)
    if off.max() > ROUNDED / rate:
        at = int(np.argmax(off > ROUNDED / rate))
        of_times = 1.0 / step
        drifts = abs(of_times / rate - 1.0) * len(time) > ROUNDED
        what = f"time runs at {of_times:.6g} Hz" if drifts else "time does not run evenly"
        near = abs(of_times / rate - 1.0) < OFF
        unit = "" if near else " (a wrong unit of the times?)"
        what += f": sample {index[at]} is at {time[at]:.6g} s, and off by up to {1e3 * off.max():.4g} ms"
        faults.append(Fault("clock", f"{what}; expected even steps at rate = {rate:.6g} Hz{unit}", near))
    if faults and all(fault.can for fault in faults):  # others may claim any length
        there, grid = index.astype(float), np.arange(index[-1] + 1, dtype=float)
        if off.max() > ROUNDED / rate:
            # Of the line, so that trials whose last times are early or late have one length.
            n_even = math.floor(float(step * index[-1] * rate) + ROUNDED) + 1
            there, grid = time, first + np.arange(n_even) / rate
        signals = {name: _between(there, values, grid) for name, values in signals.items()}
    return signals, rate, faults


def _missing(steps: Array) -> NDArray[np.int64]:
    """Number of samples that are missing in each step, from times that may be early or late by half a step.

    Args:
      steps: between the times, in usual ones, (step,).
    """
    missing = np.zeros(len(steps), dtype=np.int64)
    if steps.max() < SKIPPED:
        return missing
    late = np.cumsum(np.minimum(steps, 1e15) - 1.0)
    level = latest = 0.0
    for at, value in enumerate(late.tolist()):
        off = value - level
        if off > 0.5:
            ahead = np.sort(late[at + 1 : at + 1 + AHEAD]) - level
            # Nothing follows the last time, which may just be as late as others.
            stays = float(ahead[len(ahead) // 4]) if len(ahead) else off - latest
            missing[at] = max(round(min(off, stays)), 0)
            off -= missing[at]
            level += missing[at]
        latest = max(latest, off)
        level += FOLLOW * min(max(off, -0.5), 0.5)
    return missing


def _line(index: NDArray[np.int64], time: Array) -> tuple[float, float]:
    """Step and start of the straight line through the times, by least squares [s, s]."""
    centred = index - index.mean()
    step = float(centred @ time / (centred @ centred))
    return step, float(time.mean() - step * index.mean())


def _rate_of(step: float, n_time: int) -> float:
    """Sampling rate that fits the times [Hz]: a whole number if one does."""
    whole = float(max(round(1.0 / step), 1))
    return whole if abs(whole * step - 1.0) * n_time < ROUNDED else 1.0 / step


def _between(at: Array, values: Array, grid: Array) -> Array:
    """Cubic spline through the finite samples; NaN where a gap was, so that it is found afterwards."""
    out = np.full((len(grid), values.shape[1]), np.nan)
    for column, of_one in enumerate(values.T):
        there = np.isfinite(of_one)
        if there.sum() >= 4:
            spline = interpolate.CubicSpline(at[there], of_one[there], extrapolate=False)
            out[:, column] = spline(np.clip(grid, at[0], at[-1]))
            near = np.searchsorted(grid, at[~there] - 0.5 * (grid[1] - grid[0]))
            out[np.clip(near, 0, len(grid) - 1), column] = np.nan
    return out


def longest_stretch(timed: Timed) -> tuple[Timed, str]:
    """The longest stretch of a trial without gaps that are too long to be filled, and where it lies.

    Gaps of the EMG do not count. A trial that reached the limit of the workspace counts up to there.

    Raises:
      ValueError: there is no such stretch.
    """
    counted = [name for name in timed.signals if name != "emg"]
    end = min(len(timed.signals[name]) / timed.rates[name] for name in counted)
    limit = float(timed.labels.get("limit_time", math.nan))
    end = min(end, limit) if math.isfinite(limit) else end
    missing = []
    for name in counted:
        values, rate = timed.signals[name], timed.rates[name]
        longest = LONGEST_GAP.get(name, LONGEST_SLOW_GAP)
        for first, last in (gap for column in values.T for gap in runs(~np.isfinite(column))):
            if first == 0 or last == len(values) or (last - first) / rate > longest + 1e-9:
                missing.append((first / rate, last / rate))
    parts, free_from = [], 0.0
    for start, stop in [*sorted(missing), (end, end)]:
        parts.append((min(start, end) - free_from, free_from, min(start, end)))
        free_from = max(free_from, stop)
    length, start, stop = max(parts)
    if length <= 0.0:
        raise ValueError(f"{timed.where}: values are missing everywhere; expected a stretch without gaps")
    if not missing:
        return timed, ""
    cut = {}
    for name, values in timed.signals.items():
        first = math.ceil(start * timed.rates[name] - 1e-6)
        cut[name] = values[first : first + math.floor(length * timed.rates[name] + 1e-6)]
    labels = {**timed.labels, **{name: math.nan for name in ("limit_time",) if name in timed.labels}}
    onset = float(labels.get("pulse_onset", math.nan))
    if math.isfinite(onset):
        labels["pulse_onset"] = onset - start
    return replace(timed, signals=cut, labels=labels), f"{start:.6g} to {stop:.6g} s"


def find_gaps(timed: Timed) -> tuple[Timed, list[Fault]]:
    """Signals with short gaps filled, and all gaps."""
    faults, mended = [], {}
    for name, values in timed.signals.items():
        rate, longest = timed.rates[name], LONGEST_GAP.get(name, LONGEST_SLOW_GAP)
        values = values.copy()
        for column, channel in enumerate(timed.components[name]):
            there = np.isfinite(values[:, column])
            if there.all():
                continue
            n_there = int(there.sum())
            for first, last in runs(~there):
                length = (last - first) / rate
                can = first > 0 and last < len(values) and length <= longest + 1e-9 and n_there >= 4
                place = f"at {first / rate:.6g} s" if n_there else "everywhere"
                faults.append(Fault("gaps", f"{channel} ({name}) has a gap of {length:.4g} s {place}", can, name))
            if n_there >= 4:
                index = np.arange(len(values), dtype=float)
                spline = interpolate.CubicSpline(index[there], values[there, column], extrapolate=False)
                values[~there, column] = spline(index[~there])
        mended[name] = values
    return replace(timed, signals=mended), faults


def without_padding(timed: Timed) -> Timed:
    """Signals without missing values at their end, which a table of trials of unequal length has."""
    signals = {}
    for name, values in timed.signals.items():
        there = np.flatnonzero(np.isfinite(values).any(axis=1))
        signals[name] = values[: there[-1] + 1] if len(there) else values
    return replace(timed, signals=signals)


def find_stuck(timed: Timed) -> list[Fault]:
    """Channels that are constant, clipped or hold their last value, in signals without gaps."""
    faults = []
    is_still = "perturbation" in timed.signals and not timed.signals["perturbation"].any()
    for name in _required(timed):
        values, rate = timed.signals[name], timed.rates[name]
        for column, channel in enumerate(timed.components[name]):
            samples = values[:, column]
            if np.ptp(samples) == 0.0:
                # A disturbance may leave an axis, or a trial, alone, in which a person may push without moving.
                may_rest = (name == "perturbation" and samples[0] == 0.0) or (name == "displacement" and is_still)
                if not may_rest:
                    faults.append(Fault("trials", f"{channel} ({name}) is constant at {samples[0]:.6g}"))
                continue
            if name == "displacement" and timed.servo == "position":  # which may hold its position
                continue
            # Where nothing perturbs, people push and rest.
            plateaus = clipped_stretches(samples, is_command=name == "perturbation", may_rest=is_still)
            if plateaus:
                first, last = min(plateaus)
                is_lost = name == "displacement" and samples[first] == 0.0
                lost = " (lost markers? left empty, they count as gaps)" if is_lost else ""
                clipped = f"clipped at {samples[first]:.6g} for {(last - first) / rate:.4g} s at {first / rate:.6g} s"
                faults.append(Fault("trials", f"{channel} ({name}) is {clipped}, {len(plateaus)} times in all{lost}"))
    return [*faults, *_held(timed)]


def _required(timed: Timed) -> list[str]:
    return [name for name in REQUIRED_SIGNALS if name in timed.signals]


def _held(timed: Timed) -> list[Fault]:
    """Stretches in which no signal changes although the disturbance does before and after: the recorder stopped.

    And those in which force or displacement alone does not change although what drives it does: a sensor stopped.
    """
    names = _required(timed)
    parts = [timed.signals[name] for name in names]
    if len({len(part) for part in parts}) > 1 or len({timed.rates[name] for name in names}) > 1:
        return []
    same = (np.diff(np.concatenate(parts, axis=1), axis=0) == 0.0).all(axis=1)
    changes = (np.diff(parts[0], axis=0) != 0.0).any(axis=1)
    rate = timed.rates[names[0]]
    stretches = [
        ("all channels hold their", first, last)
        for first, last in runs(same)
        if last - first >= LEAST_RUN - 1 and first > 0 and last < len(same) and changes[first - 1] and changes[last]
    ]
    drive = "displacement" if timed.servo == "position" else "perturbation"
    stretches += [
        (f"{channel} ({name}) holds its", first, last)
        for name in ("displacement", "force")
        for channel, samples in zip(timed.components[name], timed.signals[name].T, strict=True)
        if name != drive
        for first, last in held_stretches(samples, timed.signals[drive], rate)
    ]
    return [
        Fault("trials", f"{what} value for {(last - first) / rate:.4g} s at {first / rate:.6g} s")
        for what, first, last in stretches
    ]


def equal_lengths(timed: Timed, names: Collection[str]) -> tuple[Timed, list[Fault]]:
    """Signals of a trial cut to the shortest, and the fault that their lengths differed."""
    lengths = {name: len(timed.signals[name]) / timed.rates[name] for name in names}
    shortest, longest = min(names, key=lengths.__getitem__), max(names, key=lengths.__getitem__)
    rates, end = {timed.rates[name] for name in names}, lengths[shortest]
    if lengths[longest] - end <= (1.0 / min(rates) if len(rates) > 1 else 0.0) + 1e-9:
        return timed, []
    text = f"{longest} lasts {lengths[longest]:.6g} s and {shortest} {end:.6g} s"
    rates_differ = lengths[longest] > LARGEST_RATIO * end
    why = f": {other_rate(shortest, longest, lengths[longest] / end)}" if rates_differ else "; expected equal lengths"
    cut = {name: timed.signals[name][: round(end * timed.rates[name])] for name in names}
    fault = Fault("lengths", text + why, not rates_differ)
    return replace(timed, signals={**timed.signals, **cut}), [fault]


def lasting(trials: Sequence[Timed], repair: Collection[Repair], notes: list[str]) -> list[int]:
    """Numbers of the trials that did not break off long before the others ended.

    Args:
      trials: at least one.
      repair: "trials" leaves out those that broke off.
      notes: to which each that is left out is added.

    Raises:
      ValueError: a trial broke off and is not to be left out.
    """
    durations = [min(len(trial.signals[name]) / trial.rates[name] for name in trial.signals) for trial in trials]
    usual = float(np.median(durations))
    left = []
    for number, (trial, duration) in enumerate(zip(trials, durations, strict=True)):
        if duration >= BROKEN_OFF * usual:
            left.append(number)
            continue
        text = f"it lasts {duration:.6g} s, and half of the trials {usual:.6g} s or longer"
        if "trials" not in repair:
            raise ValueError(
                f"{trial.where}: {text}; expected trials of about one length (convert --repair trials leaves it out; "
                "trials that are meant to be shorter, as MVC, go into a recording of their own, beside the others)"
            )
        notes.append(f"{trial.where} is left out: {text}")
    return left


def other_rate(few: str, many: str, ratio: float) -> str:
    """What is wrong where a signal has fewer samples than another by such a ratio, and what to do."""
    return f"their rates seem to differ by a factor of {ratio:.4g} (resample {few} to the times of {many} in the file)"
