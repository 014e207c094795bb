"""From a laboratory's files to a recording: read, aligned, repaired as asked, and checked against physics."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
import xarray as xr

from armperturb.analysis.joint_balance import check_joint
from armperturb.convert.alignment import in_si, joined, resampled, resampled_recording, timed_signals
from armperturb.convert.balance import check_balance, require_handle, require_signs
from armperturb.convert.checks import (
    check_different,
    check_recordings,
    other_units,
    require_instants,
    require_plausible,
    require_plausible_recording,
)
from armperturb.convert.faults import (
    Fault,
    Timed,
    equal_lengths,
    find_gaps,
    find_stuck,
    lasting,
    longest_stretch,
    without_padding,
)
from armperturb.convert.raw import RawTrial
from armperturb.convert.reading import ARRAYS, C3D, TEXT, read_trials
from armperturb.convert.sidecar import Sidecar
from armperturb.convert.tables import Repair
from armperturb.joined_recordings import join_recordings
from armperturb.recording import OPTIONAL_SIGNALS, is_one_axis
from armperturb.recording_files import load_recording, wanted_signals
from armperturb.validation import as_list, require_number, require_one_of, require_type

EXPECTED = "the path of a file, or several"
"""What is to be imported, for messages."""

OURS = (".nc",)
"""Endings of recordings, which need no sidecar."""


class Imported(NamedTuple):
    """A recording and what happened on the way.

    Attributes:
      recording: the trials.
      notes: what was repaired, left out, guessed, or could not be checked, a sentence each.
    """

    recording: xr.Dataset
    notes: tuple[str, ...]


def import_recording(
    paths: Sequence[str | Path] | str | Path,
    *,
    sidecar: str | Path | None = None,
    repair: Collection[Repair] | Repair = (),
    rate: float | None = None,
    optional: Collection[str] = OPTIONAL_SIGNALS,
) -> Imported:
    """Read the trials of one or more files of a laboratory, or recordings of our own.

    Args:
      paths: CSV (.csv, .tsv, .txt), MATLAB (.mat), NumPy (.npz) or C3D files, or only recordings (.nc); one or several.
      sidecar: JSON file that says what the channels mean, see docs/recordings.md; by default that beside each file, of
        the same name but for its ending. Recordings have none.
      repair: which faults to repair, see `faults`; all others are refused. Recordings are free of them.
      rate: sampling rate of the recording but for its EMG [Hz]; by default that of the files.
      optional: what to read beside `REQUIRED_SIGNALS`, where there is any; what is wrong with other signals does not
        matter.

    Returns:
      The trials of all files in their order.

    Raises:
      TypeError: an argument or a field of the sidecar has the wrong type.
      ValueError: a file or sidecar is refused, or has a fault that is not to be repaired; the message names file,
        trial, channel and time. Or perturbation, force and displacement do not obey physics.
      ModuleNotFoundError: C3D is to be read, and ezc3d is not installed.
      OSError: a file cannot be read.
    """
    files = [_path_of(path) for path in as_list("recordings", paths, (str, Path), EXPECTED)]
    repair = as_list("convert: repair", repair, str, f"some of {', '.join(get_args(Repair))}", or_none=True)
    for fault in repair:
        require_one_of("convert", "repair", fault, get_args(Repair))
    optional = wanted_signals(optional, "import_recording")
    require_number("convert", "rate", rate, at_least=1.0, at_most=1e6, optional=True)
    for path in files:
        require_one_of(str(path), "ending", path.suffix.lower(), (*TEXT, *ARRAYS, *C3D, *OURS))
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file, or a folder; expected a recording")
    require_each_once(files)
    ours = [path for path in files if path.suffix.lower() in OURS]
    if not ours:
        return import_trials(_read(files, sidecar, set(OPTIONAL_SIGNALS) - optional), repair, rate)
    if len(ours) < len(files):
        raise ValueError(f"{ours[0]} beside files of other formats; expected only netCDF or none (convert them first)")
    for name, value in (("sidecar", sidecar), ("repair", repair)):
        if value:
            raise ValueError(f"{ours[0]}: {name} = {value!r}; expected none with netCDF, which is complete itself")
    recordings = [load_recording(path, optional) for path in ours]
    physics: list[str] = []
    for path, recording in zip(ours, recordings, strict=True):
        require_plausible_recording(recording, str(path))
        if is_one_axis(recording):
            physics += [f"{path}: {note}" for note in check_joint(recording, source=str(path))]
        else:
            require_signs(recording, source=str(path))
            require_handle(recording, str(path))
    notes = [*check_recordings(recordings, list(map(str, ours))), *physics]
    if rate is not None:
        for at, path in enumerate(ours):
            recordings[at], remarks = resampled_recording(recordings[at], rate, str(path))
            notes += remarks
    if len(ours) == 1:
        return Imported(recordings[0], tuple(notes))
    together = join_recordings(recordings, ", ".join(map(str, ours)), OPTIONAL_SIGNALS)
    lost = [f"{name} ({why})" if why else name for name, why in together.lost.items()]
    lost = [f"not in all files alike, so left out: {', '.join(lost)}"] if lost else []
    return Imported(together.recording, (*notes, *lost))


def _path_of(path: str | Path) -> Path:
    require_type("recordings: path", path, (str, Path), EXPECTED)
    return Path(path)


def require_each_once(files: Sequence[Path]) -> None:
    """Refuse files of which one comes twice.

    Raises:
      ValueError: one does.
    """
    for place, path in enumerate(files):
        if path.resolve() in [other.resolve() for other in files[:place]]:
            raise ValueError(f"{path} comes twice; expected each recording once")


def _read(
    files: Sequence[Path], sidecar: str | Path | None, without: Collection[str]
) -> Iterable[tuple[Path, Sidecar, Sequence[RawTrial]]]:
    for path in files:
        meaning = Sidecar.load(path.with_suffix(".json") if sidecar is None else sidecar, without)
        yield path, meaning, read_trials(path, meaning)


def import_trials(
    files: Iterable[tuple[Path, Sidecar, Sequence[RawTrial]]],
    repair: Collection[Repair] = (),
    rate: float | None = None,
) -> Imported:
    """Make a recording of trials that were read.

    Args:
      files: path of each file, its sidecar, and its trials.
      repair: which faults to repair.
      rate: sampling rate of the recording [Hz]; by default that of the files.

    Raises:
      ValueError: as `import_recording`.
    """
    notes: list[str] = []
    trials: list[Timed] = []
    paths, guesses, repairs, masses, joints, of_files = [], [], list[str](), set(), set(), list[str]()
    for path, meaning, raw_trials in files:
        paths.append(path)
        remarks = [*meaning.notes, *other_units(raw_trials, meaning)]
        guesses += [note for note in remarks if note not in guesses]
        repairs += meaning.repairs
        masses.add(meaning.mass)
        joints.add(meaning.joint)
        aligned = (_aligned(path, raw, meaning, repair, rate, notes) for raw in raw_trials)
        trials += [trial for trial in aligned if trial is not None]
        of_files += [str(path)] * (len(trials) - len(of_files))
    named = ", ".join(map(str, paths))
    if not trials:
        raise ValueError(f"{named}: all trials are left out; expected one without faults ({notes[0]})")
    left = lasting(trials, repair, notes)
    trials, of_files = [trials[number] for number in left], [of_files[number] for number in left]
    if len(joints) > 1:
        several = " and ".join(map(str, sorted(joints, key=str)))
        raise ValueError(f"{named}: labels.joint = {several}; expected trials of one joint")
    recording = joined(trials, repair, notes, joints.pop())
    recording.attrs["source"] = ", ".join(path.name for path in paths)
    if of_all := dict.fromkeys((*repairs, *notes)):  # one sidecar may be that of several files
        recording.attrs["repairs"] = "\n".join(of_all)
    if len(masses) > 1:
        raise ValueError(f"{named}: environment.m_env differs between sidecars; expected one manipulator")
    notes += check_different([recording], [trial.where for trial in trials], of_files)
    names = [trial.where.removeprefix(named).removeprefix(": ") for trial in trials]
    mass = masses.pop()
    if is_one_axis(recording):
        physics = check_joint(recording, mass, named)
    else:
        physics = check_balance(recording, mass, names, named)
    return Imported(recording, (*notes, *physics, *guesses))


def _aligned(
    path: Path, raw: RawTrial, meaning: Sidecar, repair: Collection[Repair], rate: float | None, notes: list[str]
) -> Timed | None:
    """A trial in SI, repaired as asked; None if it is left out."""
    where = f"{path}: trial {raw.name!r}" if raw.name != path.name else str(path)
    timed, faults = timed_signals(where, raw, meaning)
    duration = max(len(values) / timed.rates[name] for name, values in timed.signals.items() if name != "emg")
    require_instants(where, timed.labels, duration)  # before anything is cut
    timed = without_padding(timed)
    if "stretch" in repair:
        timed, part = longest_stretch(timed)
        if part:
            notes.append(f"{where}: cut to {part}, its longest stretch without long gaps")
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
    in_ours = {name: in_si(values, meaning.signals[name]) for name, values in timed.signals.items()}
    trial = resampled(replace(timed, signals=in_ours), rate)
    require_plausible(trial)
    return trial


def _advice(fault: Fault) -> str:
    if fault.repair == "lengths" and not fault.can:
        return "expected one rate of all signals but EMG (convert --repair trials leaves the trial out)"
    if fault.repair == "trials" or not fault.can:
        why = "" if fault.repair == "trials" else ", which cannot be repaired"
        instead = ", stretch keeps the longest part without gaps" if fault.repair == "gaps" else ""
        if fault.signal == "emg":
            instead = "; signals.emg.channels without this channel, or no signals.emg, keeps all else"
        return f"expected a trial without{why} (convert --repair trials leaves it out{instead})"
    return f"expected none (convert --repair {fault.repair} puts it right)"
