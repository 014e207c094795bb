"""From a laboratory's files to a recording: units, signs and axes as the sidecar says, faults found, physics held."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import xarray as xr
from scipy import signal

from armperturb.arrays import Array
from armperturb.convert.balance import check_balance, require_signs
from armperturb.convert.c3d import read_c3d
from armperturb.convert.faults import (
    Fault,
    Repair,
    Timed,
    equal_lengths,
    even_times,
    find_gaps,
    find_stuck,
    without_padding,
)
from armperturb.convert.hdf5 import require_whole_hdf5
from armperturb.convert.matlab import read_matlab
from armperturb.convert.raw import RawTrial
from armperturb.convert.sidecar import FIRST, Sidecar, Signal
from armperturb.convert.text import read_text
from armperturb.convert.units import UNITS
from armperturb.recording import (
    SIGNALS,
    TRIAL_COORDINATES,
    join_recordings,
    load_recording,
    make_recording,
)
from armperturb.validation import require_number

TEXT, MATLAB, C3D, OURS = (".csv", ".tsv", ".txt"), (".mat",), (".c3d",), (".nc",)
"""Endings of the formats."""

LARGEST_NUMBER = 1e16
"""In a file, whatever its unit: microseconds since 1970 are less [-]."""

LARGEST_FORCE = 2000.0
"""That people and manipulators bear [N]; refuses millinewtons."""

REACH = 1.0
"""Of the handle from its start, in arm lengths [-]; refuses millimetres."""

AWAY = 0.01
"""Distance from its start at which no path stays throughout, unless it moves by more [m]; refuses places in a room."""

MOST_RESAMPLING = 20_000
"""Largest number in the ratio of two sampling rates [-]."""


class Imported(NamedTuple):
    """A recording and what happened on the way.

    Attributes:
      recording: the trials.
      notes: what was repaired, left out, or could not be checked, a sentence each.
    """

    recording: xr.Dataset
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trial:
    """A trial in SI and our axes."""

    where: str
    signals: Mapping[str, Array]
    rates: Mapping[str, float]
    labels: Mapping[str, Any]


def import_recording(
    paths: Sequence[str | Path],
    *,
    sidecar: str | Path | None = None,
    repair: Collection[Repair] = (),
    rate: float | None = None,
) -> Imported:
    """Read the trials of one or more files of a laboratory, or recordings of our own.

    Args:
      paths: CSV (.csv, .tsv, .txt), MATLAB (.mat) or C3D files, or netCDF of our own (.nc) alone.
      sidecar: JSON file that says what the channels mean, see docs/recordings.md; by default that beside each file, of
        the same name but for its ending.
      repair: which faults to repair, see `faults`; all others are refused.
      rate: sampling rate of the recording [Hz]; by default that of the files.

    Returns:
      The trials of all files in their order.

    Raises:
      TypeError: a field of the sidecar has the wrong type.
      ValueError: a file or sidecar is refused, or has a fault that is not to be repaired; the message names file,
        trial, channel and time. Or perturbation, force and displacement do not obey physics.
      RuntimeError: C3D is to be read without ezc3d.
      OSError: a file cannot be read.
    """
    files = [Path(path) for path in paths]
    if not files:
        raise ValueError("recordings is empty; expected at least one file")
    for one in repair:
        if one not in get_args(Repair):
            raise ValueError(f"repair = {one!r}; expected some of {', '.join(get_args(Repair))}")
    if rate is not None:
        require_number("convert", "rate", rate, at_least=1.0, at_most=1e6)
    for place, path in enumerate(files):
        if path.suffix.lower() not in (*TEXT, *MATLAB, *C3D, *OURS):
            raise ValueError(
                f"{path}: unknown ending {path.suffix!r}; expected {', '.join((*TEXT, *MATLAB, *C3D, *OURS))}"
            )
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file, or a folder; expected a recording")
        if path.resolve() in [one.resolve() for one in files[:place]]:
            raise ValueError(f"{path} comes twice; expected each recording once")
    ours = [path for path in files if path.suffix.lower() in OURS]
    if ours:
        return _ours(files, ours, sidecar, repair, rate)
    notes: list[str] = []
    trials: list[_Trial] = []
    masses = set()
    for path in files:
        meaning = Sidecar.load(path.with_suffix(".json") if sidecar is None else sidecar)
        masses.add(meaning.mass)
        for raw in _read(path, meaning):
            trial = _trial(path, raw, meaning, repair, rate, notes)
            if trial is not None:
                trials.append(trial)
    named = ", ".join(map(str, files))
    if not trials:
        raise ValueError(f"{named}: all trials are left out; expected one without faults ({notes[0]})")
    recording = _assembled(trials, repair, notes)
    recording.attrs["source"] = ", ".join(path.name for path in files)
    if notes:
        recording.attrs["repairs"] = "\n".join(notes)
    if len(masses) > 1:
        raise ValueError(f"{named}: environment.m_env differs between sidecars; expected one manipulator")
    try:
        notes += check_balance(
            recording, masses.pop(), [trial.where.removeprefix(named).removeprefix(": ") for trial in trials]
        )
    except ValueError as error:
        raise ValueError(f"{named}: {error}") from None
    return Imported(recording, tuple(notes))


def _ours(
    files: Sequence[Path],
    ours: Sequence[Path],
    sidecar: str | Path | None,
    repair: Collection[Repair],
    rate: float | None,
) -> Imported:
    if len(ours) < len(files):
        raise ValueError(f"{ours[0]} beside files of other formats; expected netCDF alone or none (convert them first)")
    for name, value in (("sidecar", sidecar), ("repair", repair), ("rate", rate)):
        if value:
            raise ValueError(f"{ours[0]}: {name} = {value!r}; expected none with netCDF, which says it all itself")
    for path in ours:
        require_whole_hdf5(path)
    recordings = [load_recording(path) for path in ours]
    for path, recording in zip(ours, recordings, strict=True):
        try:
            require_signs(recording)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    joined = recordings[0] if len(ours) == 1 else join_recordings(recordings, ", ".join(map(str, ours)))
    return Imported(joined, ())


def _read(path: Path, meaning: Sidecar) -> Sequence[RawTrial]:
    names = {channel for one in meaning.signals.values() if one.file is None for channel in one.channels.values()}
    emg = meaning.signals.get("emg")
    if emg is not None and emg.file is not None and path.suffix.lower() not in TEXT:
        raise ValueError(f"{meaning.path}: signals.emg.file = {emg.file!r}; expected none but with text")
    if meaning.time is not None:
        names.add(meaning.time[0])
    if path.suffix.lower() in C3D:
        for name, value in (("trial", meaning.trial), ("time", meaning.time)):
            if value is not None:
                raise ValueError(
                    f"{meaning.path}: {name} = {value!r}; expected none for C3D, a trial at a rate of its own"
                )
        return read_c3d(path, sorted(names))
    if meaning.trial is not None:
        names.add(meaning.trial)
    if path.suffix.lower() in MATLAB:
        return read_matlab(path, sorted(names), meaning.trial)
    if emg is not None and emg.rate is not None and emg.file is None:
        raise ValueError(f"{meaning.path}: signals.emg.rate without signals.emg.file; expected both with text, or none")
    trials = read_text(path, sorted(names), meaning.trial, meaning.dialect)
    return trials if emg is None or emg.file is None else _with_emg(path, trials, meaning, emg, emg.file)


def _with_emg(path: Path, trials: Sequence[RawTrial], meaning: Sidecar, emg: Signal, name: str) -> Sequence[RawTrial]:
    """The trials of a text file, with the EMG that another holds."""
    beside = meaning.path.with_name(name)
    if not beside.is_file():
        raise FileNotFoundError(f"{beside}: no such file, or a folder; expected signals.emg.file of {meaning.path}")
    names = [*emg.channels.values(), *([] if meaning.trial is None else [meaning.trial])]
    found = read_text(beside, names, meaning.trial, meaning.dialect)
    if meaning.trial is None:
        found = [replace(found[0], name=path.name)]
    expected, there = ([one.name for one in group] for group in (trials, found))
    if there != expected:
        raise ValueError(
            f"{beside}: trials {', '.join(there)[:60]}; expected {', '.join(expected)[:60]} as {path.name} has"
        )
    return [replace(one, channels={**one.channels, **other.channels}) for one, other in zip(trials, found, strict=True)]


def _trial(
    path: Path, raw: RawTrial, meaning: Sidecar, repair: Collection[Repair], rate: float | None, notes: list[str]
) -> _Trial | None:
    """A trial in SI, repaired as asked; None if it is left out."""
    where = f"{path}: trial {raw.name!r}" if raw.name != path.name else str(path)
    labels = meaning.labels_of(raw.name)
    timed, faults = _timed(where, raw, meaning)
    timed = without_padding(timed)
    timed, gaps = find_gaps(timed)
    timed, lengths = equal_lengths(timed, [name for name in timed.signals if name != "emg"])
    faults += gaps + lengths
    if all(np.isfinite(values).all() for values in timed.signals.values()):
        faults += find_stuck(timed)
    left = [fault for fault in faults if not (fault.can and fault.repair in repair and fault.repair != "trials")]
    if left:
        more = f" (and {len(left) - 1} more faults)" if len(left) > 1 else ""
        if "trials" not in repair:
            raise ValueError(f"{where}: {left[0].text}{more}; {_advice(left[0])}")
        notes.append(f"{where} is left out: {left[0].text}{more}")
        return None
    notes += [f"{where}: {fault.text}: repaired" for fault in faults]
    signals, rates = dict(timed.signals), dict(timed.rates)
    signals = {name: _in_si(values, meaning.signals[name]) for name, values in signals.items()}
    signals, rates = _resampled(where, signals, rates, rate)
    _require_plausible(where, signals, rates, labels)
    return _Trial(where=where, signals=signals, rates=rates, labels=labels)


def _advice(fault: Fault) -> str:
    if fault.repair == "trials" or not fault.can:
        why = "" if fault.repair == "trials" else ", which cannot be repaired"
        return f"expected a trial without{why} (--repair trials leaves it out)"
    return f"expected none (--repair {fault.repair} puts it right)"


def _timed(where: str, raw: RawTrial, meaning: Sidecar) -> tuple[Timed, list[Fault]]:
    """Channels as signals on even times."""
    signals: dict[str, Array] = {}
    rates: dict[str, float] = {}
    components = {}
    for name, one in meaning.signals.items():
        channels = [raw.channels[channel] for channel in one.channels.values()]
        sizes = {len(channel) for channel in channels}
        if len(sizes) > 1:
            raise ValueError(
                f"{where}: {name} has {' and '.join(map(str, sorted(sizes)))} samples; expected one length"
            )
        if sizes.pop() < 2:
            raise ValueError(f"{where}: {name} has {len(channels[0])} samples; expected at least 2")
        signals[name], components[name] = np.stack(channels, axis=1), tuple(one.channels.values())
        _require_numbers(where, name, signals[name])
        told = {raw.rates[channel] for channel in one.channels.values() if channel in raw.rates}
        if one.rate is not None:
            told.add(one.rate)
        if name == "displacement" and told and meaning.rate is not None:
            told.add(meaning.rate)
        if len(told) > 1:
            raise ValueError(f"{where}: {name} at {' and '.join(f'{r:g}' for r in sorted(told))} Hz; expected one rate")
        for channel in one.channels.values():
            _require_unit(where, name, channel, one.unit, raw.units.get(channel))
        if told:
            rates[name] = told.pop()
    free = [name for name in signals if name not in rates]
    if meaning.time is None:
        for name in free:
            if meaning.rate is None:
                raise ValueError(
                    f"{meaning.path}: rate and time are missing; expected the sampling rate in Hz, a channel, or both"
                )
            rates[name] = meaning.rate
        return Timed(signals=signals, rates=rates, components=components), []
    channel, factor = meaning.time
    _require_numbers(where, channel, raw.channels[channel][:, None])
    time = raw.channels[channel] * factor
    there = np.isfinite(time)
    n_time = len(time) - int(np.argmax(there[::-1])) if there.any() else len(time)
    if n_time < 2:
        raise ValueError(f"{where}: {channel} has {n_time} samples; expected at least 2 times")
    for name in free:
        if len(signals[name]) != len(time):
            raise ValueError(
                f"{where}: {name} has {len(signals[name])} samples and {channel} {len(time)}; expected as many"
            )
    try:
        timed, faults = even_times(
            {name: signals[name][:n_time] for name in free}, components, time[:n_time], meaning.rate
        )
    except ValueError as error:
        raise ValueError(f"{where}: {channel}: {error}") from None
    return replace(timed, signals={**signals, **timed.signals}, rates={**rates, **timed.rates}), faults


def _require_numbers(where: str, name: str, values: Array) -> None:
    """Refuse what is beyond any unit, and would overflow."""
    beyond = (np.abs(values) > LARGEST_NUMBER).any(axis=1)
    if beyond.any():
        at = int(np.argmax(beyond))
        raise ValueError(f"{where}: {name} is {values[at].max():.6g} at sample {at}; expected numbers of a signal")


def _require_unit(where: str, name: str, channel: str, stated: str, told: str | None) -> None:
    """Refuse a unit that the file contradicts."""
    known = UNITS[SIGNALS[name][1]]
    if told is not None and known.get(told) != known[stated]:
        raise ValueError(
            f"{where}: {channel} is in {told!r}; expected {stated!r}, as signals.{name}.unit of the sidecar says"
        )


def _in_si(values: Array, meaning: Signal) -> Array:
    start = values[0] if meaning.start == FIRST else np.array(meaning.start)
    return np.asarray((values - start) @ meaning.matrix)


def _resampled(
    where: str, signals: Mapping[str, Array], rates: Mapping[str, float], rate: float | None
) -> tuple[dict[str, Array], dict[str, float]]:
    """All signals but the EMG at one rate."""
    found = {rates[name] for name in signals if name != "emg"}
    if rate is None and len(found) > 1:
        several = ", ".join(f"{name} at {rates[name]:g} Hz" for name in signals if name != "emg")
        raise ValueError(f"{where}: {several}; expected one rate (choose it with --rate)")
    target = found.pop() if rate is None else rate
    out, at = dict(signals), dict(rates)
    for name in signals:
        if name == "emg" or rates[name] == target:
            continue
        values, ratio = signals[name], Fraction(target / rates[name]).limit_denominator(MOST_RESAMPLING)
        off = abs(float(ratio) / (target / rates[name]) - 1.0) * len(values)
        if ratio.numerator > MOST_RESAMPLING or off > 0.01:
            raise ValueError(
                f"{where}: rate = {target:g} Hz from {rates[name]:g} Hz; expected a ratio of whole numbers"
            )
        out[name] = signal.resample_poly(values, ratio.numerator, ratio.denominator, axis=0, padtype="line")
        at[name] = target
    n_time = min(len(out[name]) for name in out if name != "emg")
    return {name: values if name == "emg" else values[:n_time] for name, values in out.items()}, at


def _require_plausible(
    where: str, signals: Mapping[str, Array], rates: Mapping[str, float], labels: Mapping[str, Any]
) -> None:
    """Refuse what no arm and manipulator do, as a wrong unit makes them do."""
    reach = REACH * (labels["l_h"] + labels["l_f"])
    limits = {"perturbation": LARGEST_FORCE, "force": LARGEST_FORCE, "displacement": reach, "shoulder_marker": reach}
    limits |= {"joint_angle": 2 * np.pi, "emg": 100.0}
    for name, values in signals.items():
        size = np.abs(values).max(axis=1)
        if size.max() > limits[name]:
            at = int(np.argmax(size > limits[name]))
            raise ValueError(
                f"{where}: {name} is {size[at]:.4g} {SIGNALS[name][1]} at {at / rates[name]:.6g} s; expected at most "
                f"{limits[name]:.4g} (a wrong unit, or displacement not from its start?)"
            )
    path = signals["displacement"]
    for axis, low, high in zip("xy", path.min(axis=0), path.max(axis=0), strict=True):
        away = max(low, -high)
        if away > max(AWAY, high - low):
            raise ValueError(
                f"{where}: displacement {axis} is {low:.4g} to {high:.4g} m throughout; expected the path from the "
                'start of the trial (for places in a room "start": "first" or the place of the start)'
            )
    duration = len(path) / rates["displacement"]
    for name in ("pulse_onset", "limit_time"):
        if labels.get(name, 0.0) > duration:
            raise ValueError(
                f"{where}: {name} = {labels[name]:g} s; expected within the trial, which lasts {duration:g} s"
            )


def _assembled(trials: Sequence[_Trial], repair: Collection[Repair], notes: list[str]) -> xr.Dataset:
    """One recording of trials."""
    first = trials[0]
    for trial in trials[1:]:
        for name in {*first.signals, *trial.signals}:
            if name not in first.signals or name not in trial.signals:
                raise ValueError(f"{trial.where}: {name} is not in all trials; expected the same signals in all")
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
            text = f"{odd.where}: {name} lasts {least / rate:.6g} s, in other trials {max(lengths) / rate:.6g} s"
            if "lengths" not in repair:
                raise ValueError(f"{text}; expected equal lengths (--repair lengths cuts all to the shortest)")
            notes.append(f"{text}: all are cut to the shortest")
        signals[name] = np.stack([trial.signals[name][:least] for trial in trials])
    if signals["displacement"].shape[1] < 2:
        raise ValueError(f"{first.where}: one sample is left; expected at least 2")
    return make_recording(
        signals,
        _coordinates([trial.labels for trial in trials]),
        first.rates["displacement"],
        emg_rate=first.rates.get("emg"),
    )


def _coordinates(labels: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Labels of all trials, with what was left out."""
    seen: dict[tuple[Any, ...], int] = {}
    rows = []
    for given in labels:
        row = {name: float("nan") for name in ("pulse_direction", "pulse_onset", "limit_time")}
        row |= {"pulse_level": 0.0, "condition": given["task"], **given}
        key = (row["subject"], row["condition"], row["pulse_level"], str(row["pulse_direction"]))
        seen[key] = seen.get(key, -1) + 1
        rows.append({"repetition": seen[key], **row})
    names = [name for name in TRIAL_COORDINATES if all(name in row for row in rows)]
    return {name: [row[name] for row in rows] for name in names}
