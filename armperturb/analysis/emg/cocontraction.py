"""How much antagonists co-contract: the mean over time of the lesser of their amplitudes.

With the amplitudes f and e of flexors and extensors, and d = f - e, the lesser one is (f + e - |d|) / 2. Averages that
are long enough to be free of noise let reflexes pass from one antagonist to the other, which makes the index too large;
those that are short enough are noisy, and the mean of |d| grows with the variance v of their noise. So power is
averaged over a short time, and what noise adds is taken off again: where d is normal with mean m and variance s^2,

    E |d + noise| - E |d| = F(m, s^2 + v) - F(m, s^2),    F(m, s^2) = E |N(m, s^2)|,

with m and s^2 + v from each second of a trial. The noise is known: power P = x + N of a muscle (x) and its silent
channel (N), averaged over k independent numbers, has the variance 2 P^2 / k, so that an amplitude x^(1/2) has

    v = P^2 / (2 k x) = (x + 2 N + N^2 / x) / (2 k)    and is too small by the share    (P / x)^2 / (4 k).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.reference import mean_known
from armperturb.arrays import Array

NUMBERS = 8.0
"""Independent numbers that are averaged at least far above the noise, and k (x / P)^2 near it [-]: those of 10 ms of a
contraction at 2 kHz."""

LONGEST = 0.1
"""Time over which power is averaged at most [s]."""

LARGEST_SHARE = 0.5
"""By which amplitudes are taken to be too small at most [-]: nearer to the noise, that is no small correction."""

WINDOW = 1.0
"""Time in which the difference of antagonists is taken to be normal [s]."""


class _Side(NamedTuple):
    """Muscles of one side of a joint: their mean amplitude, and the variance of its noise, (time,) both."""

    amplitude: Array
    variance: Array


def cocontraction(
    envelopes: Envelopes, trial: int, part: slice, is_there: Array, flexors: list[int], extensors: list[int]
) -> tuple[float, float]:
    """Co-contraction of the muscles of a joint in a part of a trial.

    Args:
      envelopes: of a person.
      trial: which one.
      part: samples of it.
      is_there: whether each muscle is above its noise at all, (muscle,).
      flexors: muscles of one side.
      extensors: muscles of the other side.

    Returns:
      Index, the mean over time of the lesser amplitude [-], and its ratio to the mean of both; NaN where both are
      silent.
    """
    used = flexors + extensors
    power, silent = envelopes.power[trial, part][:, used], envelopes.noise[used]
    mean, per_second = mean_known(power), envelopes.samples_per_second[trial, used]
    above = np.where(is_there[used], mean - silent, np.nan)
    of_noise = (mean / above) ** 2
    wanted = NUMBERS * np.nan_to_num(of_noise / per_second).max()
    n = max(round(min(wanted, LONGEST) * envelopes.rate) - 1, 1)  # each sample is a mean over two
    power = power[: len(power) // n * n].reshape(-1, n, power.shape[1]).mean(axis=1)
    numbers = per_second * n * envelopes.averaging / (2.0 - 1.0 / n)
    too_small = np.minimum(of_noise / (4.0 * numbers), LARGEST_SHARE)
    of_muscle = np.maximum(power - silent, 0.0)
    amplitude = np.nan_to_num(1.0 / (1.0 - too_small)) * np.sqrt(of_muscle)
    squared = of_muscle + 2.0 * silent + silent**2 / above
    variance = np.where(is_there[used], squared / (2.0 * numbers), 0.0 * power)  # unknown where a channel is dead
    one_side, other_side = (
        _Side(
            mean_known(amplitude[:, side].T),
            mean_known(variance[:, side].T) / np.maximum(np.isfinite(power[:, side]).sum(axis=1), 1),
        )
        for side in (slice(len(flexors)), slice(len(flexors), None))
    )
    lesser = _mean_of_lesser(one_side, other_side, round(WINDOW * envelopes.rate / n))
    both = float(mean_known(one_side.amplitude + other_side.amplitude)) / 2.0
    return lesser, lesser / both if both > 0.0 else math.nan


def _mean_of_lesser(flexors: _Side, extensors: _Side, window: int) -> float:
    """Mean over time of the lesser of two amplitudes, were there no noise; windows have so many samples."""
    n_windows = max(len(flexors.amplitude) // max(window, 2), 1)
    length = len(flexors.amplitude) // n_windows

    def in_windows(values: Array) -> Array:
        return values[: n_windows * length].reshape(n_windows, length).T

    sums, difference = (
        in_windows(flexors.amplitude + extensors.amplitude),
        in_windows(flexors.amplitude - extensors.amplitude),
    )
    variance = in_windows(flexors.variance + extensors.variance)
    mean = mean_known(difference)
    spread = mean_known((difference - mean) ** 2) * length / (length - 1)
    true = np.maximum(spread - mean_known(variance), 0.0)
    # Noise counts where the lesser antagonist changes, and is less there than where one of them is strong.
    tiny = np.finfo(float).tiny
    at_change = np.exp(-(difference**2) / np.maximum(2.0 * variance, tiny))
    noise = mean_known(at_change * variance) / np.maximum(mean_known(at_change), tiny)
    added = _folded(mean, true + noise) - _folded(mean, true)
    return float(mean_known(mean_known(sums) - mean_known(np.abs(difference)) + added)) / 2.0


def _folded(mean: Array, variance: Array) -> Array:
    """Mean of the modulus of normal numbers (Leone, Nelson & Nottingham 1961, Technometrics 3)."""
    deviation = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    along = mean / (np.sqrt(2.0) * deviation)
    return np.asarray(deviation * np.sqrt(2.0 / np.pi) * np.exp(-(along**2)) + mean * special.erf(along))
