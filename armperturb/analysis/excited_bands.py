"""Spectra of a recording in the bands that its perturbation excites, where a force balance can be judged."""

from typing import NamedTuple

import numpy as np
from scipy import fft, signal

from armperturb.arrays import Array, ComplexArray

EXCITED = 1e-3
"""Power of the perturbation, relative to the largest, from which on a frequency counts [-]."""

WIDTH = 0.1
"""Width of the bands over which spectra are averaged [Hz]: a delay hardly turns the phase within one."""

ROUND_OFF = 1e-7
"""Least noise, relative to the signal [-]: differences of products hold round-off of nearly 1e-8 of it."""


class Spectra(NamedTuple):
    """Products of d, f, acceleration, velocity and displacement in the bands that d excites, x and y of each.

    Attributes:
      frequency: mean of each band [Hz], (band,).
      products: mean over lines and trials, SI, (band, 10, 10).
      counts: lines and trials of each band, (band,).
      shorter: factor by which tapering makes the record seem shorter [-].
      least: standard deviations of round-off of force and displacement [N, m].
      noise: density of the noise in the balance, from which fits start, (band,).
    """

    frequency: Array
    products: ComplexArray
    counts: Array
    shorter: float
    least: tuple[float, float]
    noise: Array


def excited_spectra(signals: tuple[Array, Array, Array], rate: float, edge: int, band: tuple[float, float]) -> Spectra:
    """Spectra of a recording where the perturbation excites it.

    Args:
      signals: d, f and x [N, N, m], (trial, time, axis) each.
      rate: of the samples [Hz].
      edge: samples at either end on which the edges of filters lie.
      band: lowest and highest frequency [Hz].
    """
    n_samples = signals[0].shape[1]
    n_padded = fft.next_fast_len(n_samples + 4 * edge, real=True)
    s = 2j * np.pi * fft.rfftfreq(n_padded, 1.0 / rate)
    smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip((1.4 - np.abs(s) / (2 * np.pi * band[1])) / 0.3, 0.0, 1.0))
    n_inner = n_samples - 2 * edge
    taper = signal.windows.hann(n_inner, sym=False)
    taper /= np.linalg.norm(taper)
    frequency = fft.rfftfreq(n_inner, 1.0 / rate)
    used = (frequency > band[0]) & (frequency < band[1])
    frequency = frequency[used]

    def tapered(spectrum: ComplexArray) -> list[ComplexArray]:
        inner = fft.irfft(spectrum * smooth[:, None], n_padded, axis=1)[:, edge : edge + n_inner]
        lines = fft.rfft(signal.detrend(inner, axis=1) * taper[:, None], axis=1)[:, used]  # of sensors with offsets
        return [lines[..., 0], lines[..., 1]]

    d, f, x = (fft.rfft(values, n_padded, axis=1) for values in signals)
    columns = [*tapered(d), *tapered(f), *(line for power in (2, 1, 0) for line in tapered(x * (s**power)[:, None]))]
    first = np.flatnonzero(np.diff(np.floor(frequency / WIDTH), prepend=-1.0))
    lines = np.diff(first, append=len(frequency))
    pushed = np.add.reduceat(sum(np.sum(np.abs(part) ** 2, axis=0) for part in columns[:2]), first) / lines
    excited = (pushed > EXCITED * pushed.max()) & (pushed > 0.0)
    counts = lines[excited] * float(len(signals[0]))
    products = np.empty((len(counts), 10, 10), dtype=complex)
    for i, left in enumerate(columns):
        for j, right in enumerate(columns[: i + 1]):
            sums = np.add.reduceat(np.sum(left * right.conj(), axis=0), first)[excited] / counts
            products[:, i, j], products[:, j, i] = sums, sums.conj()
    round_off = [ROUND_OFF * float(np.sqrt(np.mean(values**2))) for values in (signals[0] - signals[1], signals[2])]
    middle = np.add.reduceat(frequency, first)[excited] / lines[excited]
    shorter = n_inner * float(np.sum(taper**4))
    return Spectra(middle, products, counts, shorter, (round_off[0], round_off[1]), np.ones(len(middle)))
