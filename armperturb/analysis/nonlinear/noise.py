"""The noise that a person and the instruments add to trials: its spectrum, white residuals, and new draws of it.

The noise is described as the hand force that would move the handle like the residual, through a linear arm near the
person. As in `fit.likelihood`, the spectrum of that force is smooth: it is averaged over trials and neighbouring
frequencies. Records begin at rest and fade out.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import fft

from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.fit.frequency_bands import Smoother, excited_bands
from armperturb.analysis.fit.likelihood import TAPER, whitened, whitening
from armperturb.analysis.fit.whittle import ROUND_OFF
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.subject import Subject

TOP = 20.0
"""Highest frequency that is fitted [Hz]: the thesis's perturbations reach it."""

HIGHEST = 50.0
"""Highest frequency of draws [Hz]. From `TOP` on they have the spectrum of the torque there, as noise of instruments
hides the person's in the records. It hardly moves the handle, but the joints, and a muscle that they move is softer."""

LEAST_SURE = 0.5
"""Least value of `Noise.sure` [-]."""

MOST_CHANGE = 3.0
"""Largest factor by which `matched_strength` departs from 1 [-]."""


class NoiseDraws(NamedTuple):
    """What determines draws of the noise.

    Attributes:
      roots: of the spectrum of each set's noise, (frequency, axis, axis) each.
      strengths: factor on the amplitude of each set's draws, (frequency,) each.
      n_pairs: how many pairs of opposite sign.
      seed: of the random numbers.
      attempts: how often a trial's noise was drawn anew, (pair, trial); None for never.
    """

    roots: tuple[ComplexArray, ...]
    strengths: tuple[Array, ...]
    n_pairs: int
    seed: int
    attempts: Array | None = None

    def standard(self, shape: tuple[int, int, int]) -> Iterator[Array]:
        """Independent standard normal numbers of each pair, (trial, time, axis)."""
        rng = np.random.default_rng(self.seed)
        for pair, attempts in enumerate(self.attempted(shape[0])):
            numbers = rng.standard_normal(shape)
            for trial in np.flatnonzero(attempts).tolist():
                again = np.random.default_rng([self.seed, pair, trial, int(attempts[trial])])
                numbers[trial] = again.standard_normal(shape[1:])
            yield numbers

    def attempted(self, n_trials: int) -> Array:
        """`attempts`, zeros if there were none."""
        return np.zeros((self.n_pairs, n_trials)) if self.attempts is None else self.attempts[: self.n_pairs]


class Noise:
    """Noise of the trials of one condition.

    Attributes:
      root: of the spectrum of its hand force, as last estimated, (frequency, axis, axis).
      sure: by how much each number of `white` tells less, as the noise is estimated from the same trials (see
        `fit.whittle`) [-], (number,).

    Args:
      arm: linear, near the person in this condition.
      environment: what the hand held.
      n: samples that are fitted.
      n_trials: over which the spectrum is averaged.
      rate: of the samples [Hz].
    """

    def __init__(self, arm: Subject, environment: Environment, n: int, n_trials: int, rate: float) -> None:
        self._n, self._rate = n, rate
        n_taper = round(TAPER * rate)
        self._taper = np.ones(n)
        self._taper[-n_taper:] = 0.5 + 0.5 * np.cos(np.pi * (np.arange(n_taper) + 0.5) / n_taper)
        frequency = fft.rfftfreq(n, 1.0 / rate)
        self._used = slice(1, int(np.searchsorted(frequency, min(TOP, 0.45 * rate))))
        self._frequency = frequency[self._used]
        linear, values = LinearArm(arm, self._frequency), parameter_vector(arm)
        total = linear.total_admittance(values, environment)
        (a, b), (c, d) = np.moveaxis(total * whitening(self._frequency, rate)[:, None, None], 0, -1)
        self._to_force = np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)
        self._to_torque = linear.equivalent_torque(values)
        self._smoother = Smoother(len(self._frequency), n_trials)
        self.root = np.zeros((len(self._frequency), 2, 2), dtype=complex)
        self._white = self._to_force
        averaged = self._smoother.count * n_trials
        self.sure = np.tile(np.maximum(1.0 - 2.0 / averaged, LEAST_SURE), 4)

    def _spectrum(self, mixing: ComplexArray, residual: Array) -> ComplexArray:
        """DFT of residuals (trial, time, axis), mixed by (axis, axis, frequency), (trial, axis, frequency)."""
        faded = whitened(residual[:, : self._n], self._rate) * self._taper[:, None]
        spectrum = fft.rfft(faded, axis=1)[:, self._used].transpose(0, 2, 1)
        return np.einsum("abf,tbf->taf", mixing, spectrum)

    def _power(self, residual: Array) -> ComplexArray:
        force = self._spectrum(self._to_force, residual)
        power = np.einsum("taf,tbf->fab", force, force.conj()) / len(force)
        return np.asarray(self._smoother(power.reshape(-1, 4)).reshape(-1, 2, 2), dtype=complex)

    def weigh(self, residual: Array) -> None:
        """Estimate the spectrum from residuals [m], (trial, time, axis); it weights `white` until the next call."""
        smooth = self._power(residual)
        floor = ROUND_OFF * np.trace(smooth, axis1=1, axis2=2).real + np.finfo(float).tiny
        self.root = np.linalg.cholesky(smooth + floor[:, None, None] * np.eye(2))
        # Real and imaginary part of the residual have half its power each.
        white = np.sqrt(2.0) * np.linalg.solve(self.root, np.moveaxis(self._to_force, -1, 0))
        self._white = np.moveaxis(white, 0, -1)

    @property
    def log_determinant(self) -> float:
        """Twice the logarithm of the density's Jacobian in one trial: minus 2 log-likelihood less sum of squares."""
        (a, b), (c, d) = self._white
        return 4.0 * float(np.sum(np.log(np.abs(a * d - b * c))))

    def white(self, residual: Array) -> Array:
        """Residuals [m], (trial, time, axis), as numbers of unit variance if they are noise, (trial, number)."""
        white = self._spectrum(self._white, residual).reshape(len(residual), -1)
        return np.concatenate([white.real, white.imag], axis=1)

    def lack_of_fit(self, white: Array, perturbation: Array) -> tuple[Array, int]:
        """Sum of squares of the linear response to the disturbance that residuals hold in the bands that it excites.

        As in `fit.likelihood.Likelihood.lack_of_fit`, with the spectrum as last estimated.

        Args:
          white: from `white`, of the trials; any number of such records, (..., trial, number).
          perturbation: d of the trials [N], (trial, time, axis).

        Returns:
          The sums, (...,), and how many real numbers are in such responses.
        """
        real, imaginary = np.split(white.reshape(*white.shape[:-1], 2, 2, -1), 2, axis=-3)
        spectrum = np.moveaxis((real + 1j * imaginary)[..., 0, :, :], -3, 0)
        force = fft.rfft(perturbation[:, : self._n] * self._taper[:, None], axis=1)[:, self._used].transpose(0, 2, 1)
        changes = np.einsum("aof,tif->tafoi", self._white * whitening(self._frequency, self._rate), force)
        chi2, n_bands = np.zeros(white.shape[:-2]), 0
        for band in excited_bands(self._frequency, force):
            basis, _ = np.linalg.qr(changes[:, :, band].reshape(-1, 4))
            in_band = np.moveaxis(spectrum[..., band], 0, -3).reshape(*chi2.shape, -1)
            chi2 += np.sum(np.abs(in_band @ basis.conj()) ** 2, axis=-1)
            n_bands += 1
        return chi2, 8 * n_bands

    def torque(self, root: ComplexArray, strength: Array, standard: Array) -> Array:
        """A draw of the joint torque that moves the handle like the noise [Nm], (time, joint).

        Args:
          root: of the hand force's spectrum, (frequency, axis, axis), as `root` once was.
          strength: factor on its amplitude, (frequency,).
          standard: independent standard normal numbers, (time, axis).
        """
        n = len(standard)
        frequency = fft.rfftfreq(n, 1.0 / self._rate)
        shaped = (self._to_torque @ root * strength[:, None, None]).reshape(len(root), 4)
        # np.interp holds the last value.
        fine = np.stack(
            [
                np.interp(frequency, self._frequency, of.real) + 1j * np.interp(frequency, self._frequency, of.imag)
                for of in shaped.T
            ],
            axis=1,
        ).reshape(-1, 2, 2)
        fine[frequency > HIGHEST] = 0.0
        fine[0] = 0.0
        spectrum = np.einsum("fab,fb->fa", fine, fft.rfft(standard, axis=0) / np.sqrt(n))
        return np.asarray(fft.irfft(spectrum * np.sqrt(n / np.sum(self._taper**2)), n, axis=0))

    def matched_strength(self, white: Array, simulated: Array) -> Array:
        """Factor on the amplitude of draws with which they leave residuals as large as the trials', (frequency,).

        Args:
          white: residuals of the trials, from `white`, (trial, number).
          simulated: residuals of draws of strength 1, (draw and trial, number).
        """
        wanted, drawn = (
            self._smoother(np.mean(np.sum(values.reshape(len(values), 4, -1) ** 2, axis=1), axis=0))
            for values in (white, simulated)
        )
        ratio = np.sqrt(wanted / np.maximum(drawn, np.finfo(float).tiny))
        return np.clip(ratio, 1.0 / MOST_CHANGE, MOST_CHANGE)
