"""Which trials of the recordings that were given a command analyses."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.convert.checks import check_recordings
from armperturb.convert.importer import import_recording, require_each_once
from armperturb.convert.reading import TEXT, emg_file
from armperturb.convert.sidecar import Sidecar
from armperturb.copied_trials import without_copies
from armperturb.environment import Environment


def manipulator(environment: Environment) -> str:
    """What the hand held, for people to read."""
    return f"manipulator {environment.m_env:.4g} kg, {environment.b_env:.3g} Ns/m, {environment.k_env:.4g} N/m"


LARGEST_MEMORY = 4 * 2**30
"""Memory that an analysis may take [byte]."""

AT_LEAST = 400_000_000
"""Memory that it takes in any case [byte]."""


class MemoryPerSample(NamedTuple):
    """Memory that an analysis takes at most, measured.

    Attributes:
      longest: for each sample of the longest trial [byte].
      all: for each sample of any trial [byte].
    """

    longest: int
    all: int

    def require(self, recordings: Sequence[xr.Dataset]) -> None:
        """Refuse trials that would take too much, before any of it is allocated.

        Raises:
          ValueError: they would.
        """
        longest = max(recordings, key=lambda recording: int(recording.sizes["time"]))
        n_trials = sum(recording.sizes["trial"] for recording in recordings)
        n_samples = sum(recording.sizes["trial"] * recording.sizes["time"] for recording in recordings)
        needed = AT_LEAST + self.longest * longest.sizes["time"] + self.all * n_samples
        if needed > LARGEST_MEMORY:
            rate = float(longest.attrs["rate"])
            raise ValueError(
                f"{n_trials} trial{'' if n_trials == 1 else 's'} of up to {longest.sizes['time'] / rate:.6g} s at "
                f"{rate:g} Hz take some {needed / 2**30:.3g} GiB of memory; expected at most "
                f"{LARGEST_MEMORY / 2**30:g} GiB (a lower rate of the recording, as convert --rate gives it, a single "
                "--condition, or shorter trials)"
            )


def select_trials(
    files: Sequence[Path],
    sidecar: Path | None,
    subject: str | None,
    condition: str | None,
    *,
    single_condition: bool,
    optional: Collection[str] = (),
) -> tuple[list[xr.Dataset], list[str]]:
    """The trials of one subject, in one condition or in all, and what happened when they were read.

    Args:
      files: to read, see `import_recording`.
      sidecar: of all files that need one; None for that beside each.
      subject: name of the subject; None if there is only one.
      condition: name of the condition; None for all, or if there is only one.
      single_condition: whether all trials must be of one condition.
      optional: signals to read beside those that every recording has.

    Returns:
      The recordings that have such trials, without their others and copies; and notes, a sentence each.

    Raises:
      ValueError: as `import_recording`; no trial has the name, or one of several has to be chosen.
    """
    require_each_once(files)
    imported = [import_recording([path], sidecar=sidecar, optional=optional) for path in files]
    notes = _of_files(files, [of_file for _, of_file in imported])
    # Now, as notes count the trials of the files.
    source, selected = ", ".join(map(str, files)), [without_copies(recording).recording for recording, _ in imported]
    of_files = list(map(str, files))
    for label, wanted, single in (("subject", subject, True), ("condition", condition, single_condition)):
        names = list(dict.fromkeys(name for recording in selected for name in recording[label].values.tolist()))
        if wanted is None:
            if single and len(names) > 1:
                raise ValueError(f"{source}: {label}s {', '.join(names)}; expected only one (choose a --{label})")
            continue
        if wanted not in names:
            raise ValueError(f"{source}: no {label} {wanted!r}; expected one of {', '.join(names)}")
        selected = [recording.isel(trial=np.flatnonzero(recording[label].values == wanted)) for recording in selected]
        of_files = [file for file, recording in zip(of_files, selected, strict=True) if recording.sizes["trial"]]
        selected = [recording for recording in selected if recording.sizes["trial"]]
    check_recordings(selected, of_files)
    return selected, notes


def _of_files(files: Sequence[Path], notes: Sequence[Sequence[str]]) -> list[str]:
    """Notes of several files, each once: those that are not of all of them name theirs.

    Args:
      files: that were read.
      notes: of each of them.
    """
    of_note: dict[str, list[str]] = {}
    for path, of_file in zip(map(str, files), notes, strict=True):
        for note in of_file:
            of_note.setdefault(note, []).append(path)
    return [
        note if len(paths) == len(files) or note.startswith(paths[0]) else f"{', '.join(paths)}: {note}"
        for note, paths in of_note.items()
    ]


def with_emg_files(files: Sequence[Path], sidecar: Path | None) -> list[Path]:
    """Files that were read, each followed by the text file of its EMG, if it has one.

    Args:
      files: that were read.
      sidecar: of all files that need one; None for that beside each.
    """
    read: list[Path] = []
    for path in files:
        beside = None
        if path.suffix.lower() in TEXT:
            beside = emg_file(path, Sidecar.load(path.with_suffix(".json") if sidecar is None else sidecar))
        read += [path] if beside is None else [path, beside]
    return read
