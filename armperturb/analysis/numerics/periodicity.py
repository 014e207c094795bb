"""The period of a disturbance, from what was recorded of it, and whether disturbances are the same one.

A signal of period P differs from itself P later by noise alone. The mean square of that difference over the power of
both parts, as far as they overlap, is computed for every lag (by FFT), of all trials together: they may be different
realisations of one period, and need not hold a whole number of periods.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy import fft, signal

from armperturb.arrays import Array
from armperturb.validation import require_number

OVERLAP = 0.1
"""Share of a lag that a record has to go on beyond it, for that lag to be judged [-]."""

APERIODIC = 5e-3
"""Difference from which on a disturbance does not repeat [-]."""

DIFFERENT = 0.1
"""Difference that has to come before a repetition: what moves slowly resembles itself a moment later [-]."""

QUIET = 0.05
"""Share of the power of whole records below which the parts that a lag compares tell nothing [-]: of a pulse, they are
what comes before it and after it."""

ROUND_OFF = 1e-6
"""Differences below are none [-]."""

ALIKE = 0.9
"""Correlation, at the best lag, from which on two signals are the same one [-]."""

OFF_SAMPLE = 0.1
"""Distance of a period from a whole number of samples from which on it is none [sample]."""


def find_period(perturbation: Sequence[Array], rate: float, start: float = 0.0) -> float:
    """Period of a periodic disturbance [s], the shortest if several fit.

    Args:
      perturbation: d of each trial [N], (time, axis).
      rate: of the samples [Hz].
      start: of what is judged, for messages [s].

    Raises:
      ValueError: the disturbance does not repeat, or not after a whole number of samples.
    """
    difference = _differences(perturbation)
    longest = max(map(len, perturbation)) / rate
    refusal = (
        f"the perturbation does not repeat within the {longest:.4g} s from {start:g} s on; expected a periodic one "
        f"that is recorded for at least {1 + OVERLAP:g} periods (for noise and pulses there is --method noise; of a "
        "shorter record state the period: --period; what comes before it repeats is left out by a later "
        "--window-start)"
    )
    apart = np.flatnonzero(difference > DIFFERENT)
    if not len(apart):
        raise ValueError(refusal)
    first = int(apart[0])
    inner = difference[first + 1 : -1]
    dips = first + 1 + np.flatnonzero((inner <= difference[first:-2]) & (inner <= difference[first + 2 :]))
    if not len(dips):
        raise ValueError(refusal)
    before, at, after = difference[dips - 1], difference[dips], difference[dips + 1]
    # Near a period the difference grows with the square of the distance.
    bend = np.maximum(before - 2 * at + after, 1e-300)
    offset = 0.5 * (before - after) / bend
    bottom = np.maximum(at - 0.5 * bend * offset**2, 0.0)
    fits = at <= max(10 * at.min(), ROUND_OFF)
    if at.min() < APERIODIC:
        best = int(np.flatnonzero(fits)[0])
        if abs(offset[best]) < OFF_SAMPLE or at[best] - bottom[best] < max(0.5 * bottom[best], ROUND_OFF):
            return float(dips[best] / rate)
    else:
        best = int(np.argmin(bottom))
        if bottom[best] > APERIODIC or abs(offset[best]) < OFF_SAMPLE:
            raise ValueError(refusal)
    samples = dips[best] + offset[best]
    raise ValueError(
        f"rate = {rate:g} Hz; expected one at which the perturbation's period of {samples / rate:.5g} s is a whole "
        f"number of samples (it is {samples:.2f}; convert --rate resamples)"
    )


def _differences(perturbation: Sequence[Array]) -> Array:
    """Of each lag from 0 on, with the last for which any trial is long enough; 1 is that of unrelated signals."""
    n_lags = int(max(map(len, perturbation)) / (1 + OVERLAP))
    products, power, whole = np.zeros((3, n_lags))
    for d in (each - each.mean(axis=0) for each in perturbation):  # a constant force repeats at every lag
        n = min(n_lags, int(len(d) / (1 + OVERLAP)))
        squares = np.concatenate([[0.0], np.cumsum(np.sum(d**2, axis=1))])
        lag = np.arange(n)
        power[:n] += squares[len(d) - lag] + squares[-1] - squares[lag]
        whole[:n] += 2 * squares[-1]
        for axis in d.T:
            products[:n] += signal.correlate(axis, axis, mode="full", method="fft")[len(d) - 1 :][:n]
    difference = np.maximum(1.0 - 2 * products / np.maximum(power, 1e-300), 0.0)
    return np.where(power < QUIET * whole, 1.0, difference)


def samples_of_period(period: float, rate: float) -> int:
    """Number of samples of a period.

    Args:
      period: [s].
      rate: of the samples [Hz].

    Raises:
      ValueError: it is no whole number, or the period is not above 0.
    """
    require_number("analysis", "period", period, above=0.0)
    samples = period * rate
    if abs(samples - round(samples)) > 1e-6 * samples:
        raise ValueError(
            f"rate = {rate:g} Hz; expected one at which the period of {period:g} s is a whole number of samples "
            f"(it is {samples:.6g}; convert --rate resamples)"
        )
    return round(samples)


def are_independent(signals: Sequence[Array]) -> bool:
    """Whether all signals, (time, axis) each, hold something, and none is another one scaled, reversed or shifted."""
    sizes = [float(np.linalg.norm(each)) for each in signals]
    n = fft.next_fast_len(2 * max(map(len, signals)), real=True)
    spectra = [fft.rfft(each, n, axis=0) for each in signals]
    return all(sizes) and not any(
        np.abs(fft.irfft(np.sum(spectra[i].conj() * spectra[j], axis=1), n)).max() > ALIKE * sizes[i] * sizes[j]
        for i, j in combinations(range(len(signals)), 2)
    )
