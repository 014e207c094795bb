"""Where trials of a recording are cut: at the pulse, at the workspace limit, by condition."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import xarray as xr

from armperturb.arrays import Array, Indices
from armperturb.recording import ARM_LABELS, is_one_axis

CHOSEN_BY = {"subject": "--subject", "task": "--condition", "condition": "--condition"}
"""Coordinate to the option that picks the trials of one of its values."""

ONE_VALUED = (*CHOSEN_BY, *ARM_LABELS)
"""Coordinates that all trials of a person in a condition share."""


def require_two_axes(recording: xr.Dataset) -> None:
    """Refuse a recording of one axis where an arm is wanted.

    Raises:
      ValueError: it is one.
    """
    if is_one_axis(recording):
        raise ValueError(
            "recording: one axis, of a joint or a single direction; expected the two of an arm (identify_joint and "
            "response take one axis, and so do the commands identify and response)"
        )


def onset_samples(recording: xr.Dataset) -> Indices:
    """First sample of each trial's pulse, or the number of samples of a trial without one, (trial,)."""
    n_samples, rate = recording.sizes["time"], float(recording.attrs["rate"])
    onset = recording["pulse_onset"].values.astype(float) * rate
    return np.minimum(np.round(np.where(np.isnan(onset), n_samples, onset)), n_samples).astype(np.intp)


def limit_samples(recording: xr.Dataset) -> Array:
    """When each trial met the workspace limit [samples], (trial,); infinite if it did not."""
    limit = recording["limit_time"].values.astype(float) * float(recording.attrs["rate"])
    return np.where(np.isnan(limit), np.inf, limit)


def before_limit(recording: xr.Dataset) -> tuple[list[int], int]:
    """Trials that never met the workspace limit, and all samples; or all trials, and the samples before any met it."""
    limit, n_time = limit_samples(recording), recording.sizes["time"]
    inside = np.flatnonzero(limit >= n_time).tolist()
    return (inside, n_time) if inside else (list(range(len(limit))), int(limit.min()))


class Numbered(Protocol):
    """A recording of which trials may have been left out, and the numbers of those that are there."""

    @property
    def recording(self) -> xr.Dataset:
        """What is there."""
        ...

    @property
    def numbers(self) -> Indices:
        """Which trials these are, (trial,)."""
        ...


def inside_limit(several: Sequence[Numbered]) -> tuple[list[xr.Dataset], tuple[str, ...]]:
    """Trials that never met the workspace limit; or, if all did, the samples of each recording before any met it.

    Returns:
      Recordings that have such trials, whose coordinate `trial` has their numbers, and a remark on what was left out;
      none where nothing was.

    Raises:
      ValueError: all trials met the limit, and one did so from the start.
    """
    recordings = [each.recording.assign_coords(trial=each.numbers) for each in several]
    parts = [before_limit(recording) for recording in recordings]
    n_trials = sum(recording.sizes["trial"] for recording in recordings)
    pairs = list(zip(recordings, parts, strict=True))
    inside = [(recording, trials) for recording, (trials, n) in pairs if n == recording.sizes["time"]]
    n_left_out = n_trials - sum(len(trials) for _, trials in inside)
    if not n_left_out:
        return recordings, ()
    met = "met the workspace limit (limit_time)"
    if inside:
        said = f"{n_left_out} of {n_trials} trials {met} and are left out"
        return [recording.isel(trial=trials) for recording, trials in inside], (said,)
    until = [n / float(recording.attrs["rate"]) for recording, (_, n) in pairs]
    if min(n for _, n in parts) < 2:
        raise ValueError(
            f"recording: limit_time = {min(until):g} s; expected trials that start inside the workspace (leave them "
            "out, or labels.limit_time of the sidecar)"
        )
    ends = ", ".join(dict.fromkeys(f"{end:.4g}" for end in until))
    before = [recording.isel(time=slice(0, n)) for recording, (_, n) in pairs]
    return before, (f"all trials {met}, and are used up to the first time that one did: {ends} s",)


def of_condition(recording: xr.Dataset, condition: str) -> xr.Dataset:
    """Trials of the condition of that name; no copy where all are."""
    of = recording["condition"].values == condition
    return recording if of.all() else recording.isel(trial=np.flatnonzero(of))


def one_condition(recordings: Iterable[xr.Dataset]) -> dict[str, Any]:
    """The values of `ONE_VALUED` that all trials share; NaN where they are unknown.

    Args:
      recordings: checked recordings of one person in one condition.

    Raises:
      ValueError: trials differ in subject, task, condition or posture.
    """
    several, shared = list(recordings), {}
    for name in ONE_VALUED:
        # What is unknown in some trials does not differ from the others; NaN equals nothing.
        values = [value for recording in several for value in recording[name].values.tolist() if value == value]
        distinct = list(dict.fromkeys(values))
        if len(distinct) > 1:
            option, first = CHOSEN_BY.get(name), distinct[0]
            choose = f" (choose a {option}; in Python, recording.isel(trial=recording.{name}.values == {first!r}))"
            raise ValueError(
                f"recording: {name} has several values ({', '.join(map(str, distinct))}); expected the trials of one "
                f"person in one condition and posture{choose if option else ''}"
            )
        shared[name] = distinct[0] if distinct else math.nan
    return shared
