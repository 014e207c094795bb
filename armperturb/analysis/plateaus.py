"""Stretches in which a channel stands still: at its largest or smallest value, or while what drives it goes on."""

import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array

LEAST_RUN = 3
"""Smallest number of equal samples that counts as clipping."""

STEEP = 0.3
"""Slope into and out of a plateau that counts as clipping, relative to the RMS step of the channel [-]."""

BEYOND = 3.0
"""Extrapolated height above a plateau that counts as clipping, in resolutions of the channel [-]."""

LEVELS = 20
"""Levels from which on a channel is one that was rounded, and no square wave."""

LEVEL = 0.05
"""Share of the samples that are not zero which one level of a square wave has at least [-]."""

AT_LEVELS = 0.8
"""Share of them that all its levels have together, at least [-]; a clipped signal is at its two limits for less."""

HELD, FEWEST = 0.1, 5
"""Shortest stretch that counts as held [s], and the fewest equal samples in it."""

CHANGES = 0.3
"""Range of the drive in such a stretch, relative to its standard deviation, from which on it goes on [-]."""

RARE = 0.02
"""Share of steps without change elsewhere below which a channel is fine enough to change all the time [-]."""

JUMP = 5.0
"""Step at the end of a stretch, relative to the RMS step of the channel, that counts as a jump [-]."""

SLOWLY = 0.5
"""Step at the end of a stretch, relative to the next, below which the channel starts from standstill [-]; by constant
acceleration it is at most a third."""


def clipped_stretches(values: Array, *, is_command: bool = False, may_rest: bool = False) -> list[tuple[int, int]]:
    """First sample and end of each stretch at the largest or smallest value that is entered and left steeply.

    Args:
      values: of one channel, (time,), not all equal.
      is_command: whether it is a perturbation, which may rest at zero, or be a square wave of two or more levels; it
        has none then.
      may_rest: whether another channel may rest at zero.
    """
    if is_command and _is_square(values):
        return []
    sides = [side for side in (values, -values) if side.max() != 0.0 or not (is_command or may_rest)]
    return [stretch for side in sides for stretch in _plateaus(side)]


def _is_square(values: Array) -> bool:
    counts = np.unique(values[values != 0.0], return_counts=True)[1]  # it may rest before and after
    return float(counts[counts >= LEVEL * counts.sum()].sum()) > AT_LEVELS * float(counts.sum())


def _plateaus(values: Array) -> list[tuple[int, int]]:
    top = float(values.max())
    steps = np.abs(np.diff(values))
    moving, still = steps[steps > 0.0], len(runs(steps == 0.0))
    # As often as a coarse channel stands still, it moves by a single level; two encoders make smaller steps as well.
    level, middle = np.quantile(moving, [still / (still + len(moving)), 0.5])
    usual = float(np.sqrt(np.mean(steps**2)))
    plateaus = []
    for first, last in runs(values == top):
        if last - first < LEAST_RUN or first < 2 or last > len(values) - 2:
            continue
        last_step, last_two = top - values[[first - 1, last]], top - values[[first - 2, last + 1]]
        # A fine channel rises less by its last step to a limit than by the step before, a coarse channel by a level.
        resolution = max(level, min(middle, (2.0 * last_step - last_two).max()))
        # Two samples tell no slope of a staircase whose stairs are longer.
        is_stair = last_two.min() <= BEYOND * level and np.ptp(values) > LEVELS * level
        reach = max(2, min((last - first) // 8, first, len(values) - last)) if is_stair else 2
        slope = min(top - values[first - reach], top - values[last + reach - 1]) / reach
        # A peak that is rounded to the resolution rises by less than that within its plateau.
        if slope > STEEP * usual and 0.25 * slope * (last - first) > BEYOND * resolution:
            plateaus.append((first, last))
    return plateaus


def held_stretches(values: Array, drive: Array, rate: float) -> list[tuple[int, int]]:
    """First sample and end of each stretch in which a channel stands still while what drives it changes.

    Coarse channels often stand still for some samples: of these only stretches count that end with a jump.

    Args:
      values: of one channel, (time,).
      drive: the perturbation, or the displacement that a device imposes, (time, axis).
      rate: of the samples [Hz].
    """
    steps = np.abs(np.diff(values))
    still = steps == 0.0
    if still.all():
        return []
    n_still = int(np.count_nonzero(still))
    jump = max(JUMP * float(np.sqrt(np.mean(steps**2))), BEYOND * float(steps[~still].min()))
    held, least_change = [], CHANGES * drive.std(axis=0)
    for first, end in runs(still):
        n = end - first
        if first == 0 or n + 1 < max(HELD * rate, FEWEST):
            continue
        early = drive[first : end + 1 - n // 4]  # what changes near the end may be seen after it only
        if not (np.ptp(early, axis=0) > least_change).any():
            continue
        after = steps[end : end + 2]
        starts_slowly = len(after) == 2 and after[0] < SLOWLY * after[1]  # as from a rest that friction held
        is_fine = n_still - n < RARE * (len(steps) - n)
        if (is_fine and not starts_slowly) or (after[:1] > jump).any():
            held.append((first, end + 1))
    return held


def runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First sample and end of each run of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]
