"""What every reader of a format gives: channels by name, trial by trial, as the file has them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armperturb.arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class RawTrial:
    """A trial as a file has it.

    Attributes:
      name: the number that the file gives it, or the name of a file that holds no other trial.
      channels: name to values, (time,); NaN where there is none.
      rates: channel to sampling rate [Hz], where the file states it.
      units: channel to unit, where the file states it.
    """

    name: str
    channels: Mapping[str, Array]
    rates: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


def missing_channel(path: Path, name: str, channels: Collection[str]) -> ValueError:
    """The error of a channel that is not in the file."""
    shown = [repr(channel)[:40] for channel in list(channels)[:12]]
    more = f" and {len(channels) - 12} more" if len(channels) > 12 else ""
    return ValueError(
        f"{path}: no channel {name!r:.60}; expected one of {', '.join(shown) or 'none, as there are none'}{more}"
    )


def trial_name(number: float) -> str:
    """What the sidecar calls a trial with a number: 3, not 3.0."""
    return f"{number:.12g}"


def split_trials(path: Path, channels: Mapping[str, Array], number: str | None) -> Sequence[RawTrial]:
    """One table as its trials.

    Args:
      path: of the file.
      channels: of equal length.
      number: channel that numbers the trials; None for a single trial, which is then called as the file.

    Raises:
      ValueError: a trial has no number, or starts again after another.
    """
    if number is None:
        return [RawTrial(name=path.name, channels=channels)]
    numbers = channels[number]
    if not np.isfinite(numbers).all():
        row = int(np.argmin(np.isfinite(numbers)))
        raise ValueError(f"{path}: {number} of sample {row} is {numbers[row]}; expected the number of a trial")
    cuts = np.flatnonzero(np.diff(numbers)) + 1
    names = [trial_name(part[0]) for part in np.split(numbers, cuts)]
    for place, name in enumerate(names):
        if name in names[:place]:
            raise ValueError(
                f"{path}: {number} = {name} again at sample {int(cuts[place - 1])}; expected each trial in one piece"
            )
    parts = {key: np.split(values, cuts) for key, values in channels.items() if key != number}
    return [
        RawTrial(name=name, channels={key: of_trials[place] for key, of_trials in parts.items()})
        for place, name in enumerate(names)
    ]
