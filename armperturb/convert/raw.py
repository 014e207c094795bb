"""What every reader of a format gives: channels by name, trial by trial, as the file has them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armperturb.arrays import Array

LARGEST = 2**30
"""Of what a file may hold or unpack to [byte]: an hour of eight channels at 2 kHz takes less than half of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RawTrial:
    """A trial as a file has it.

    Attributes:
      name: what the file calls it: its number, or the name of the file if it holds no other.
      channels: name to values, (time,); NaN where there is none.
      rates: name to sampling rate [Hz], of the channels of which the file tells it.
      units: name to unit, of the channels of which the file tells it.
    """

    name: str
    channels: Mapping[str, Array]
    rates: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)


def require_modest(path: Path, size: int, what: str) -> None:
    """Refuse what would take too much memory, before it is read.

    Raises:
      ValueError: size [byte] is beyond `LARGEST`.
    """
    if size > LARGEST:
        raise ValueError(f"{path}: {what} = {size} bytes; expected at most {LARGEST} (1 GiB)")


def missing_channel(path: Path, name: str, found: Collection[str]) -> ValueError:
    """The error of a channel that is not in the file."""
    shown = [repr(one)[:40] for one in list(found)[:12]]
    more = f" and {len(found) - 12} more" if len(found) > 12 else ""
    return ValueError(
        f"{path}: no channel {name!r:.60}; expected one of {', '.join(shown) or 'none, as there are none'}{more}"
    )


def trial_name(number: float) -> str:
    """How a trial with a number is called in the sidecar: 3, not 3.0."""
    return f"{number:.12g}"


def split_trials(path: Path, channels: Mapping[str, Array], number: str | None) -> Sequence[RawTrial]:
    """One table as its trials.

    Args:
      path: of the file.
      channels: of equal length.
      number: channel that numbers the trials; None if there is one trial, which is then called as the file.

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
    bounds = [0, *cuts.tolist(), len(numbers)]
    return [
        RawTrial(name=name, channels={one: values[first:last] for one, values in channels.items() if one != number})
        for name, first, last in zip(names, bounds[:-1], bounds[1:], strict=True)
    ]
