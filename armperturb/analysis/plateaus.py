"""Stretches of a channel in which it stands still at its largest or smallest value, as clipped signals do."""

import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array

LEAST_RUN = 3
"""Smallest number of equal samples that counts as clipping."""

STEEP = 0.3
"""Slope into and out of a plateau that counts as clipping, relative to the RMS step of the channel [-]."""

BEYOND = 3.0
"""Extrapolated height above a plateau that counts as clipping, in resolutions of the channel [-]."""

LEVEL = 0.05
"""Share of the samples that are not zero which one level of a square wave has at least [-]."""

AT_LEVELS = 0.8
"""Share of them that all its levels have together, at least [-]; a clipped signal is at its two limits for less."""


def clipped_stretches(values: Array, *, is_command: bool = False) -> list[tuple[int, int]]:
    """First sample and end of each stretch at the largest or smallest value that is entered and left steeply.

    Args:
      values: of one channel, (time,), not all equal.
      is_command: whether it is a perturbation, which may be a square wave of two or more levels; it has none then.
    """
    if is_command and _is_square(values):
        return []
    return [*_plateaus(values), *_plateaus(-values)]


def _is_square(values: Array) -> bool:
    counts = np.unique(values[values != 0.0], return_counts=True)[1]  # it may rest before and after
    return float(counts[counts >= LEVEL * counts.sum()].sum()) > AT_LEVELS * float(counts.sum())


def _plateaus(values: Array) -> list[tuple[int, int]]:
    top = float(values.max())
    if top == 0.0:  # where a disturbance rests
        return []
    steps = np.abs(np.diff(values))
    moving = steps[steps > 0.0]
    resolution, usual = float(moving.min()), float(np.sqrt(np.mean(steps**2)))
    plateaus = []
    for first, last in runs(values == top):
        if last - first < LEAST_RUN or first < 2 or last > len(values) - 2:
            continue
        slope = min(top - values[first - 2], top - values[last + 1]) / 2.0
        # A peak that is rounded to the resolution rises by less than that within its plateau.
        if slope > STEEP * usual and 0.25 * slope * (last - first) > BEYOND * resolution:
            plateaus.append((first, last))
    return plateaus


def runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First sample and end of each run of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]
