"""Trials that a recording holds twice: copies tell nothing new, and count once."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from armperturb.recording import CLOCKS, REQUIRED_SIGNALS, SIGNALS

COPIED = 1e-4
"""RMS by which the signals of copies differ at most, over that of their changes [-]: by rounding. No two trials of a
person, and of hardly any instrument, agree so well."""

STILL = 1e-9
"""Extent up to which a signal counts as still [m, rad or V]: trials of rest, or without signals, are no copies."""

ALIKE = ("subject", "condition", "pulse_level", "pulse_direction", "pulse_onset")
"""Labels that copies share."""

N_LOOKED_AT = 64
"""Samples of a trial that are compared with those of all others; few trials agree there, and are compared in full."""


Lines: TypeAlias = Mapping[str, tuple[str, ...]]
"""Condition to lines on trials of it."""


class _Trial(NamedTuple):
    rate: float
    signals: dict[str, NDArray[np.floating]]
    moves: str

    def glance(self, n: int) -> NDArray[np.float64]:
        """How far what moves is from zero, at some of the first samples, (sample,)."""
        places = np.linspace(0, n - 1, N_LOOKED_AT).astype(np.intp)
        return np.asarray(np.linalg.norm(np.asarray(self.signals[self.moves][places], dtype=float), axis=1))


class WithoutCopies(NamedTuple):
    """A recording of which each trial counts once.

    Attributes:
      recording: its trials but for the copies.
      numbers: which trials these are, (trial,).
      copies: condition to a line on each trial that is left out.
    """

    recording: xr.Dataset
    numbers: NDArray[np.intp]
    copies: Lines

    @property
    def remarks(self) -> tuple[str, ...]:
        """A line on each trial that is left out."""
        return tuple(line for lines in self.copies.values() for line in lines)


def joined_lines(several: Iterable[Lines]) -> Lines:
    """The lines of each condition, each once."""
    pairs = dict.fromkeys((label, line) for lines in several for label, each in lines.items() for line in each)
    return {label: tuple(line for of, line in pairs if of == label) for label, _ in pairs}


def without_copies(recording: xr.Dataset, names: Sequence[str] = REQUIRED_SIGNALS) -> WithoutCopies:
    """The trials of a recording without those that repeat another of the same person, condition and pulse.

    Args:
      recording: a checked recording.
      names: signals that copies share; the last is that which moves.
    """
    (inside,), copies = each_once([recording], [range(recording.sizes["trial"])], names)
    return WithoutCopies(recording.isel(trial=inside) if copies else recording, np.array(inside, np.intp), copies)


def each_once(
    recordings: Sequence[xr.Dataset], numbers: Sequence[Iterable[int]], names: Sequence[str] = REQUIRED_SIGNALS
) -> tuple[list[list[int]], Lines]:
    """The places of the trials of each recording that repeat no earlier one, and a line on each of the others.

    Args:
      recordings: checked recordings.
      numbers: of the trials of each, for the lines.
      names: as in `without_copies`.
    """
    copies = copies_of(recordings, names)
    of_which = [f" of recording {place}" if len(recordings) > 1 else "" for place in range(len(recordings))]
    trials = [f"trial {number}{which}" for which, each in zip(of_which, numbers, strict=True) for number in each]
    labels = [str(label) for recording in recordings for label in recording["condition"].values]
    lines = [
        {labels[copy]: (f"{trials[copy]} repeats {trials[first]} and is left out",)} for copy, first in copies.items()
    ]
    inside, start = list[list[int]](), 0
    for recording in recordings:
        n = recording.sizes["trial"]
        inside.append([trial for trial in range(n) if start + trial not in copies])
        start += n
    return inside, joined_lines(lines)


def copies_of(
    recordings: Sequence[xr.Dataset], names: Sequence[str] = REQUIRED_SIGNALS, *, alike: bool = True
) -> dict[int, int]:
    """Place of each trial that is a copy to that of the first of its like, trials of all recordings in their order.

    Copies have the same signals but for rounding, and for an end that one may lack. Trials under the same perturbation
    differ by their noise.

    Args:
      recordings: checked recordings.
      names: signals that are compared; the last is that which moves.
      alike: whether trials that differ in a label of `ALIKE` are no copies, whatever their signals.
    """
    trials = list(_trials(recordings, names))
    if len(trials) < 2:
        return {}
    labels = [
        label for each in recordings for label in zip(*(each[name].values.astype(str) for name in ALIKE), strict=True)
    ]
    kind = np.unique(np.array(labels), axis=0, return_inverse=True)[1].ravel() if alike else np.zeros(len(trials))
    shortest = min(len(trial.signals[trial.moves]) for trial in trials)
    glances = np.stack([trial.glance(shortest) for trial in trials])
    # Far more than rounding, as the samples may be quieter than others, and far less than trials differ.
    size = COPIED * N_LOOKED_AT**0.5 * np.linalg.norm(glances - glances.mean(axis=1, keepdims=True), axis=1)
    copies: dict[int, int] = {}
    for place in range(1, len(trials)):
        near = np.linalg.norm(glances[:place] - glances[place], axis=1) <= np.maximum(size[:place], size[place])
        for first in np.flatnonzero(near & (kind[:place] == kind[place])).tolist():
            if first not in copies and _is_copy(trials[place], trials[first]):
                copies[place] = first
                break
    return copies


def _trials(recordings: Sequence[xr.Dataset], names: Sequence[str]) -> Iterator[_Trial]:
    clock = CLOCKS[SIGNALS[names[-1]][0][0]]
    for recording in recordings:
        signals = {name: recording[name].values for name in names if name in recording.data_vars}
        for trial in range(recording.sizes["trial"]):
            of_trial = {name: values[trial] for name, values in signals.items()}
            yield _Trial(float(recording.attrs[clock]), of_trial, names[-1])


def _is_copy(trial: _Trial, other: _Trial) -> bool:
    ours, theirs = trial.signals, other.signals
    n, longest = sorted((len(ours[trial.moves]), len(theirs[other.moves])))
    if 2 * n < longest or trial.rate != other.rate or ours.keys() != theirs.keys():
        return False
    for name in reversed(ours):
        here, there = (np.asarray(each[name][:n], dtype=float) for each in (ours, theirs))
        if here.shape != there.shape or (name == trial.moves and np.ptp(here, axis=0).max() <= STILL):
            return False
        if np.linalg.norm(here - there) > COPIED * np.linalg.norm(here - here.mean(axis=0)):
            return False
    return True
