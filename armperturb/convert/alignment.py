"""From channels to signals on even times, in SI and our axes, and from trials of all files to one recording."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import xarray as xr
from scipy import signal

from armperturb.arrays import Array
from armperturb.convert.checks import require_signal
from armperturb.convert.faults import LARGEST_RATIO, Fault, Timed, even_times, other_rate
from armperturb.convert.raw import RawTrial
from armperturb.convert.sidecar import FIRST, Sidecar, Signal
from armperturb.convert.tables import Repair
from armperturb.recording import ARM_LABELS, SIGNALS, TRIAL_COORDINATES, make_recording

MOST_TIMES = 50
"""Most samples in the place of one."""

MOST_RESAMPLING = 20_000
"""Largest number in the ratio of two sampling rates [-]."""


def timed_signals(where: str, raw: RawTrial, meaning: Sidecar) -> tuple[Timed, list[Fault]]:
    """Channels as signals on even times, still in the file's units and axes.

    Args:
      where: file and trial, for messages.
      raw: the trial as the file has it.
      meaning: its sidecar.

    Returns:
      The signals, and what was wrong with their times.

    Raises:
      ValueError: lengths or rates contradict one another, or values are no signal.
    """
    labels = meaning.labels_of(raw.name)
    signals: dict[str, Array] = {}
    rates: dict[str, float] = {}
    components = {}
    faults: list[Fault] = []
    for name, of_signal in meaning.signals.items():
        components[name] = tuple(of_signal.channels.values())
        channels = [raw.channels[channel] for channel in components[name]]
        sizes = sorted({len(channel) for channel in channels})
        if len(sizes) > 1 or sizes[0] < 2:
            expected = "one length" if len(sizes) > 1 else "at least 2"
            raise ValueError(f"{where}: {name} has {' and '.join(map(str, sizes))} samples; expected {expected}")
        signals[name] = np.stack(channels, axis=1)
        require_signal(where, name, signals[name])
        stated = {raw.rates[channel] for channel in components[name] if channel in raw.rates}
        if of_signal.rate is not None:
            stated.add(of_signal.rate)
        if name == "displacement" and stated and meaning.rate is not None:
            stated.add(meaning.rate)
        if len(stated) > 1:
            several = " and ".join(f"{rate:g}" for rate in sorted(stated))
            raise ValueError(f"{where}: {name} at {several} Hz; expected one rate")
        if stated:
            rates[name] = stated.pop()
    without_rate = [name for name in signals if name not in rates]
    if meaning.time is None:
        if without_rate and meaning.rate is None:
            raise ValueError(
                f"{meaning.path}: rate and time are missing; expected the sampling rate in Hz, a channel, or both"
            )
        rates |= {name: meaning.rate for name in without_rate if meaning.rate is not None}
    else:
        channel, factor = meaning.time
        require_signal(where, channel, raw.channels[channel][:, None])
        time = raw.channels[channel] * factor
        for name in without_rate:
            few, many = sorted(((len(signals[name]), name), (len(time), channel)))
            if few[0] != many[0]:
                ratio = many[0] / max(few[0], 1)
                why = f": {other_rate(few[1], many[1], ratio)}" if ratio > LARGEST_RATIO else ""
                raise ValueError(
                    f"{where}: {name} has {len(signals[name])} samples and {channel} {len(time)}{why}; expected as many"
                )
        finite = np.isfinite(time)
        n_time = len(time) - int(np.argmax(finite[::-1])) if finite.any() else len(time)
        if n_time < 2:
            raise ValueError(f"{where}: {channel} has {n_time} samples; expected at least 2 times")
        sampled = {name: signals[name][:n_time] for name in without_rate}
        even, rate, faults = even_times(f"{where}: {channel}", sampled, time[:n_time], meaning.rate)
        signals |= even
        rates |= dict.fromkeys(even, rate)
    emg = meaning.signals.get("emg")
    units = {name: of_signal.ours for name, of_signal in meaning.signals.items()}
    timed = Timed(
        where=where,
        labels=labels,
        signals=signals,
        rates=rates,
        components=components,
        muscles=emg.muscles if emg else None,
        emg_lead=emg.lead if emg else 0.0,
        emg_highpass=emg.highpass if emg else None,
        units=units,
        servo=meaning.servo,
    )
    return timed, faults


def _amplified(trial: Timed) -> tuple[Any, ...]:
    """What is said of the EMG of a trial, beside its rate."""
    return trial.muscles, trial.emg_lead, trial.emg_highpass


def in_si(values: Array, meaning: Signal) -> Array:
    """Values of a signal in SI and our axes, from its start, (time, component)."""
    start = values[0] if meaning.start == FIRST else np.array(meaning.start)
    return np.asarray((values - start) @ meaning.matrix)


def resampled(trial: Timed, rate: float | None) -> Timed:
    """A trial with all signals but EMG at one rate.

    Args:
      trial: with signals at any rates.
      rate: that is wanted [Hz]; None for that of the file.

    Raises:
      ValueError: rates differ and none is wanted, or the ratio is too large or not one of whole numbers.
    """
    rates = {name: trial.rates[name] for name in trial.signals if name != "emg"}
    present = {*rates.values()}
    if rate is None and len(present) > 1:
        several = ", ".join(f"{name} at {of_signal:g} Hz" for name, of_signal in rates.items())
        raise ValueError(f"{trial.where}: {several}; expected one rate (convert --rate chooses it)")
    target = present.pop() if rate is None else rate
    signals = {name: _at_rate(trial.where, trial.signals[name], rates[name], target, 0) for name in rates}
    n_time = min(map(len, signals.values()))
    cut = {name: values[:n_time] for name, values in signals.items()}
    return replace(trial, signals={**trial.signals, **cut}, rates={**trial.rates, **dict.fromkeys(rates, target)})


def resampled_recording(recording: xr.Dataset, rate: float, source: str) -> tuple[xr.Dataset, list[str]]:
    """A recording with all signals but EMG at another rate.

    Args:
      recording: checked.
      rate: that is wanted [Hz].
      source: where it comes from, for messages.

    Returns:
      The recording, with labels and attributes as they were, and what happened to it, a sentence each.

    Raises:
      ValueError: the ratio of the rates is too large or not one of whole numbers.
    """
    before = float(recording.attrs["rate"])
    if rate == before:
        return recording, []
    signals = {
        name: (variable.dims, _at_rate(source, variable.values, before, rate, 1), variable.attrs)
        for name, variable in recording.data_vars.items()
        if name in SIGNALS and "time" in variable.dims
    }
    n_time = signals["displacement"][1].shape[1]
    if n_time < 2:
        raise ValueError(f"{source}: one sample is left at rate = {rate:g} Hz; expected at least 2")
    time = ("time", np.arange(n_time) / rate, recording["time"].attrs)
    changed = recording.drop_dims("time").assign(signals).assign_coords(time=time).assign_attrs(rate=rate)
    notes = [f"{source}: resampled from {before:g} to {rate:g} Hz"]
    if lost := [str(name) for name in recording.variables if name not in changed.variables]:
        notes.append(f"{source}: not resampled, so left out: {', '.join(lost)}")
    return changed, notes


def _at_rate(where: str, values: Array, of_signal: float, target: float, axis: int) -> Array:
    """Values along an axis of time at another rate [Hz]; raises as `resampled`."""
    if of_signal == target:
        return values
    if target > MOST_TIMES * of_signal:
        raise ValueError(
            f"{where}: rate = {target:g} Hz from {of_signal:g} Hz; expected at most {MOST_TIMES} times as many "
            "samples, which tell no more"
        )
    ratio = Fraction(target / of_signal).limit_denominator(MOST_RESAMPLING)
    off = abs(float(ratio) / (target / of_signal) - 1.0) * values.shape[axis]
    if ratio.numerator > MOST_RESAMPLING or off > 0.01:
        raise ValueError(f"{where}: rate = {target:g} Hz from {of_signal:g} Hz; expected a ratio of whole numbers")
    return np.asarray(signal.resample_poly(values, ratio.numerator, ratio.denominator, axis=axis, padtype="line"))


def joined(
    trials: Sequence[Timed], repair: Collection[Repair], notes: list[str], joint: str | None = None
) -> xr.Dataset:
    """One recording of trials.

    Args:
      trials: at least one.
      joint: of a recording of one axis; None if unknown.
      repair: "lengths" cuts trials of unequal length to the shortest.
      notes: to which such a cut is added, and each pulse that a cut left out.

    Raises:
      ValueError: trials differ in signals, rates or length.
    """
    first = trials[0]
    for trial in trials[1:]:
        if (trial.servo, trial.units["force"]) != (first.servo, first.units["force"]):
            raise ValueError(f"{trial.where}: another servo or unit than {first.where}; expected one kind of recording")
        for name in {*first.signals, *trial.signals}:
            if name not in first.signals or name not in trial.signals:
                raise ValueError(f"{trial.where}: {name} is not in all trials; expected the same signals in all")
            if name == "emg" and _amplified(trial) != _amplified(first):
                raise ValueError(
                    f"{trial.where}: emg of other muscles, lead or highpass; expected the same in all trials"
                )
            if trial.rates[name] != first.rates[name]:
                raise ValueError(
                    f"{trial.where}: {name} at {trial.rates[name]:g} Hz and in others at {first.rates[name]:g} Hz; "
                    "expected one rate (choose it with --rate)"
                )
    signals = {}
    for name in first.signals:
        lengths = [len(trial.signals[name]) for trial in trials]
        least, rate = min(lengths), first.rates[name]
        if max(lengths) > least:
            odd = trials[int(np.argmin(lengths))]
            text = f"{odd.where}: {name} lasts {least / rate:.6g} s, other trials up to {max(lengths) / rate:.6g} s"
            if "lengths" not in repair:
                raise ValueError(f"{text}; expected equal lengths (convert --repair lengths cuts all)")
            notes.append(f"{text}: all are cut to the shortest")
        signals[name] = np.stack([trial.signals[name][:least] for trial in trials])
    if signals["displacement"].shape[1] < 2:
        raise ValueError(f"{first.where}: one sample is left; expected at least 2")
    duration = signals["displacement"].shape[1] / first.rates["displacement"]
    labels = _coordinates([_labels_within(trial, duration, notes) for trial in trials])
    return make_recording(
        signals,
        labels,
        first.rates["displacement"],
        emg_rate=first.rates.get("emg"),
        emg_lead=first.emg_lead,
        emg_highpass=first.emg_highpass,
        muscles=first.muscles,
        servo=first.servo,
        joint=joint,
        angular=first.units["displacement"] == "rad",
    )


def _labels_within(trial: Timed, duration: float, notes: list[str]) -> dict[str, Any]:
    """Labels of a trial that may have been cut: without those of a pulse, or of a limit, that was cut off."""
    labels = dict(trial.labels)
    if labels.get("limit_time", 0.0) > duration:
        del labels["limit_time"]
    onset = labels.get("pulse_onset", math.nan)
    if onset < 0.0 or onset > duration:
        notes.append(
            f"{trial.where}: the pulse, at {onset:.6g} s of the {duration:.6g} s that are kept, is cut off: "
            "pulse_onset, pulse_level and pulse_direction are left out"
        )
        labels = {name: value for name, value in labels.items() if not name.startswith("pulse_")}
    return labels


def _coordinates(labels: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Labels of all trials, with defaults of those that were left out."""
    counts: dict[tuple[Any, ...], int] = {}
    rows = []
    for given in labels:
        row = {name: float("nan") for name in (*ARM_LABELS, "pulse_direction", "pulse_onset", "limit_time")}
        row |= {"pulse_level": 0.0, "condition": given["task"], **given}
        key = (row["subject"], row["condition"], row["pulse_level"], str(row["pulse_direction"]))
        counts[key] = counts.get(key, -1) + 1
        rows.append({"repetition": counts[key], **row})
    names = [name for name in TRIAL_COORDINATES if all(name in row for row in rows)]
    return {name: [row[name] for row in rows] for name in names}
