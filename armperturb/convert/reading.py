"""The channels of a file that its sidecar names, whatever the format."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armperturb.convert.arrays import read_arrays
from armperturb.convert.raw import RawTrial, missing_channel
from armperturb.convert.sidecar import Sidecar, Signal
from armperturb.convert.text import read_text
from armperturb.foreign import read_foreign

TEXT, ARRAYS, C3D = (".csv", ".tsv", ".txt"), (".mat", ".npz"), (".c3d",)
"""Endings of the formats that need a sidecar: columns of text, arrays of MATLAB or NumPy, motion capture."""


def read_trials(path: Path, meaning: Sidecar) -> Sequence[RawTrial]:
    """Trials of a file, with the channels that the sidecar names.

    Raises:
      ValueError: the file is refused, lacks a channel, or the sidecar does not suit the format.
      ModuleNotFoundError: C3D is to be read, and ezc3d is not installed.
      OSError: the file cannot be read.
    """
    names = {name for signal in meaning.signals.values() if signal.file is None for name in signal.channels.values()}
    emg = meaning.signals.get("emg")
    if emg is not None and emg.file is not None and path.suffix.lower() not in TEXT:
        raise ValueError(f"{meaning.path}: signals.emg.file = {emg.file!r}; expected it only beside text files")
    if meaning.time is not None:
        names.add(meaning.time[0])
    if path.suffix.lower() in C3D:
        for name, value in (("trial", meaning.trial), ("time", meaning.time)):
            if value is not None:
                raise ValueError(
                    f"{meaning.path}: {name} = {value!r}; expected no such field for C3D, which is one trial at the "
                    "rates that it states itself"
                )
        return [_c3d_trial(path, sorted(names))]
    if meaning.trial is not None:
        names.add(meaning.trial)
    if path.suffix.lower() in ARRAYS:
        return read_arrays(path, sorted(names), meaning.trial)
    if emg is not None and emg.dialect is not None and emg.file is None:
        raise ValueError(f"{meaning.path}: signals.emg.csv without signals.emg.file; expected that, or csv of all")
    if emg is not None and emg.rate is not None and emg.file is None:
        raise ValueError(f"{meaning.path}: signals.emg.rate without signals.emg.file; expected both with text, or none")
    trials = read_text(path, sorted(names), meaning.trial, meaning.dialect)
    beside = emg_file(path, meaning)
    return trials if emg is None or beside is None else _with_emg(path, trials, meaning, emg, beside)


def _c3d_trial(path: Path, names: Sequence[str]) -> RawTrial:
    """A marker's coordinate is the channel `LABEL.X`, `LABEL.Y` or `LABEL.Z`; an analogue channel has its label."""
    content = read_foreign(path, names)
    for name in names:
        if name not in content:
            raise missing_channel(path, name, list(content))
        rate = content[name]["rate"]
        if not (np.isfinite(rate) and rate > 0.0):
            raise ValueError(f"{path}: rate of {name} = {rate!r}; expected a number of Hz above 0")
    return RawTrial(
        name=path.name,
        channels={name: np.asarray(content[name]["values"], dtype=float) for name in names},
        rates={name: content[name]["rate"] for name in names},
        units={name: content[name]["unit"] for name in names if content[name]["unit"]},
    )


def emg_file(path: Path, meaning: Sidecar) -> Path | None:
    """The second text file that holds the EMG of a file; None if none does."""
    emg = meaning.signals.get("emg")
    if emg is None or emg.file is None:
        return None
    return (path if "*" in emg.file else meaning.path).with_name(emg.file.replace("*", path.stem))


def _with_emg(
    path: Path, trials: Sequence[RawTrial], meaning: Sidecar, emg: Signal, beside: Path
) -> Sequence[RawTrial]:
    """The trials of a text file, with the EMG that another text file holds."""
    if not beside.is_file():
        raise FileNotFoundError(f"{beside}: no such file, or a folder; expected signals.emg.file of {meaning.path}")
    names = [*emg.channels.values(), *([] if meaning.trial is None else [meaning.trial])]
    emg_trials = read_text(beside, names, meaning.trial, emg.dialect or meaning.dialect)
    if meaning.trial is None:
        emg_trials = [replace(emg_trials[0], name=path.name)]
    expected, there = ([trial.name for trial in group] for group in (trials, emg_trials))
    if there != expected:
        raise ValueError(
            f"{beside}: trials {', '.join(there)[:60]}; expected {', '.join(expected)[:60]} as {path.name} has"
        )
    return [
        replace(trial, channels={**trial.channels, **of_emg.channels})
        for trial, of_emg in zip(trials, emg_trials, strict=True)
    ]
