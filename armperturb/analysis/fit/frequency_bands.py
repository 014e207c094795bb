"""Frequencies that are taken together: over which noise is averaged, and over which a lack of fit is looked for."""

import itertools
from typing import NamedTuple

import numpy as np
from scipy import sparse

from armperturb.arrays import Array, ComplexArray

N_SMOOTH = 40
"""Trials times frequencies over which the spectrum of the noise is averaged at least."""

RELATIVE_WIDTH = 0.05
"""Half the band over which the spectrum of the noise is averaged at least, over its frequency [-]."""

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


def smoother(n: int, n_trials: int) -> sparse.csr_array:
    """Matrix that averages over nearby frequencies, the same of each of n_trials trials, (frequency, frequency)."""
    index = np.arange(n)
    half = np.maximum(int(np.ceil(N_SMOOTH / n_trials / 2)), (RELATIVE_WIDTH * index).astype(int))
    first = np.maximum(index - half, 0)
    count = np.minimum(index + half, n - 1) - first + 1
    ends = np.cumsum(count)
    near = np.arange(ends[-1]) - np.repeat(ends - count - first, count)
    return sparse.csr_array((np.repeat(1.0 / count, count), near, np.append(0, ends)), shape=(n, n))


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
