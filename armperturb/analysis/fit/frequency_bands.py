"""Frequencies that are taken together: over which noise is averaged, and over which a lack of fit is looked for."""

import itertools
from typing import NamedTuple

import numpy as np
from scipy import sparse

from armperturb.arrays import Array, ComplexArray, Indices

N_SMOOTH = 40
"""Trials times frequencies over which the spectrum of the noise is averaged at least."""

RELATIVE_WIDTH = 0.05
"""Half the band over which the spectrum of the noise is averaged at least, over its frequency [-]."""

LARGEST_MATRIX = 2**22
"""Entries up to which averages are taken by a matrix; it grows with the square of a trial's length."""

EXCITED_POWER = 1e-3
"""Share of the largest power above which a frequency counts as excited. It is larger than that of the lines of a
multisine (`spectra.EXCITED_LINE`), as whole records are tapered and leak power into neighbouring frequencies."""


class BandOfLack(NamedTuple):
    """What is left in the residual that the disturbance explains, in one band of excited frequencies.

    Attributes:
      low: lowest frequency [Hz].
      high: highest frequency [Hz].
      chi2: of a further, free linear response in the band, eight real numbers [-].
    """

    low: float
    high: float
    chi2: float


class Smoother:
    """Averages over nearby frequencies, the same of each trial.

    Args:
      n: how many frequencies there are.
      n_trials: that are averaged as well.
      wanted: indices of those at which the average is wanted; None for all.

    Attributes:
      count: frequencies that are averaged for each that is wanted, (wanted,).
    """

    def __init__(self, n: int, n_trials: int, wanted: Indices | None = None) -> None:
        index = np.arange(n) if wanted is None else wanted
        half = np.maximum(int(np.ceil(N_SMOOTH / n_trials / 2)), (RELATIVE_WIDTH * index).astype(int))
        self._first = np.maximum(index - half, 0)
        self.count = np.minimum(index + half, n - 1) - self._first + 1
        ends = np.cumsum(self.count)
        self._matrix: sparse.csr_array | None = None
        if ends[-1] <= LARGEST_MATRIX:
            near = np.arange(ends[-1]) - np.repeat(ends - self.count - self._first, self.count)
            weights = np.repeat(1.0 / self.count, self.count)
            self._matrix = sparse.csr_array((weights, near, np.append(0, ends)), shape=(len(index), n))

    def __call__(self, values: Array) -> Array:
        """Averages of values (frequency, ...) at the wanted frequencies."""
        if self._matrix is not None:
            return np.asarray(self._matrix @ values)
        # Each band is a sum of blocks whose lengths are powers of two. Differences of running sums would be quicker,
        # and lose what is weak beside what is strong.
        total = np.zeros((len(self._first), *values.shape[1:]), dtype=values.dtype)
        at, blocks, length = self._first.copy(), values, 1
        while True:
            odd = np.flatnonzero(self.count & length)
            total[odd] += blocks[at[odd]]
            at[odd] += length
            if 2 * length > self.count.max():
                break
            blocks, length = blocks[:-length] + blocks[length:], 2 * length
        return total / self.count.reshape(-1, *(1,) * (values.ndim - 1))


def excited_bands(frequency: Array, force: ComplexArray) -> list[slice]:
    """Runs of excited frequencies, split where they are wider than a third of an octave."""
    power = np.mean(np.abs(force) ** 2, axis=(0, 1))
    excited = np.flatnonzero(power > EXCITED_POWER * power.max())
    runs, first = [], excited[0]
    for before, now in itertools.pairwise(excited):
        if now - before > 2 or frequency[now] > 2 ** (1 / 3) * frequency[first] + 4 * frequency[0]:
            runs.append(slice(int(first), int(before) + 1))
            first = now
    runs.append(slice(int(first), int(excited[-1]) + 1))
    # Four complex numbers are estimated in each.
    return [run for run in runs if 2 * len(force) * (run.stop - run.start) >= 8]
