"""The manipulator and the displacement of its handle as encoders and strain gauge together tell them.

The force balance of the environment, d - f = E^-1 x, holds whatever the arm does. What is left of it is noise,

    n = d - f - E^-1 x,    Phi_nn = s_f^2 + |E^-1|^2 s_x^2,    E^-1 = m s^2 + b s + k,

with the white noise s_f of the gauge and s_x of the encoders. Whatever moves the handle, the person included, so tells
what the environment is (errors in variables: sum |n|^2 / Phi_nn is least), and then how noisy both instruments are.

The recorded force thus holds a second measurement of the displacement, E (d - f). Encoders are better at low
frequencies, where the handle moves far; the gauge is better at high ones, where inertia turns small movements into large
forces (with the thesis's instruments above some 6 Hz, and 50 times better at 40 Hz). The best displacement is the mean of
both, weighted inversely with their variances: x + G n with G = s_x^2 conj(E^-1) / (s_x^2 |E^-1|^2 + s_f^2).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize, signal

from armperturb.environment import Environment

Array = NDArray[np.float64]

EDGE = 0.5
"""Length at either end of a record on which the edges of the filters lie [s]."""

BAND = (0.2, 0.25)
"""Frequencies that are used: lowest [Hz], and highest over the sampling rate [-]."""

ROUNDS = 4
"""How often environment and noise levels are estimated in turn: the former hardly depends on the latter."""


class NoiseLevels(NamedTuple):
    """White noise of the instruments.

    Attributes:
      force: standard deviation of a sample of the force [N].
      displacement: standard deviation of a sample of the displacement [m].
    """

    force: float
    displacement: float


class Balance:
    """The force balance of the environment in a recording.

    Args:
      perturbation: d [N], (trial, time, axis).
      force: hand reaction force f [N], (trial, time, axis).
      displacement: of the handle [m], (trial, time, axis).
      rate: of the samples [Hz].

    Raises:
      ValueError: the record is too short.
    """

    def __init__(self, perturbation: Array, force: Array, displacement: Array, rate: float) -> None:
        self._displacement, self._rate = displacement, rate
        self._n_samples, self._n_edge = displacement.shape[1], round(EDGE * rate)
        if self._n_samples < 10 * self._n_edge:
            raise ValueError(f"the recording lasts {self._n_samples / rate:g} s; expected at least {10 * EDGE:g} s")
        self._n_padded = fft.next_fast_len(self._n_samples + 4 * self._n_edge, real=True)
        s = 2j * np.pi * fft.rfftfreq(self._n_padded, 1.0 / rate)
        self._powers = np.stack([s**2, s, np.ones_like(s)])
        self._load = fft.rfft(perturbation - force, self._n_padded, axis=1)
        self._path = fft.rfft(displacement, self._n_padded, axis=1)
        self._band_powers, self._roots = self._in_band()

    def _in_band(self) -> tuple[NDArray[np.complex128], Array]:
        """s^2, s and 1 at the frequencies used, and per frequency a root of the power of what the balance is made of.

        That is load, acceleration, velocity and displacement, each tapered: the power of any sum of them with weights v
        is |root v|^2. Roots are (frequency, 4, 4).
        """
        top = BAND[1] * self._rate
        frequency = np.abs(self._powers[1]) / (2 * np.pi)
        # Beyond the band the encoders' noise is so large in the balance that its side lobes would cover the rest.
        smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip((1.4 * top - frequency) / (0.3 * top), 0.0, 1.0))
        n_inner = self._n_samples - 2 * self._n_edge
        taper = signal.windows.hann(n_inner, sym=False)
        taper /= np.linalg.norm(taper)
        coarse = fft.rfftfreq(n_inner, 1.0 / self._rate)
        used = (coarse > BAND[0]) & (coarse < top)

        def tapered(spectrum: NDArray[np.complex128]) -> NDArray[np.complex128]:
            values = fft.irfft(spectrum * smooth[:, None], self._n_padded, axis=1)
            inner = values[:, self._n_edge : self._n_edge + n_inner] * taper[:, None]
            return fft.rfft(inner, axis=1)[:, used]

        terms = np.stack([tapered(self._load), *(-tapered(self._path * power[:, None]) for power in self._powers)])
        # Of each frequency: all trials and axes, real and imaginary parts, below one another.
        rows = np.moveaxis(terms, 2, 0).reshape(used.sum(), 4, -1).swapaxes(1, 2)
        rows = np.concatenate([rows.real, rows.imag], axis=1) / np.sqrt(rows.shape[1])
        s = 2j * np.pi * coarse[used]
        return np.stack([s**2, s, np.ones_like(s)]), np.linalg.qr(rows, mode="r")

    def fit(self) -> tuple[Environment, NoiseLevels]:
        """Mass, damping and stiffness that the manipulator really showed (as C.1-C.3), and the noise of the instruments.

        Raises:
          ValueError: no positive mass comes out, as happens when the sign of the force is wrong.
        """
        # Low frequencies first, where noise hardly matters.
        slow = self._roots[: max(20, len(self._roots) // 5)].reshape(-1, 4)
        values = np.linalg.lstsq(slow[:, 1:], -slow[:, 0], rcond=None)[0]
        levels = self._levels(values)
        for _ in range(ROUNDS):
            values = self._most_likely(values, levels)
            levels = self._levels(values)
        mass, damping, stiffness = map(float, values)
        if not mass > 0.0:
            raise ValueError(
                f"the environment's mass comes out at {mass:.3g} kg; expected a positive mass (force must be the "
                "reaction force that the handle exerts on the hand, so that the environment sees perturbation - force)"
            )
        return Environment(m_env=mass, b_env=max(damping, 0.0), k_env=max(stiffness, 0.0)), levels

    def _noise(self, values: Array) -> Array:
        """What is left of the balance, (frequency, 4): its power is the sum of squares."""
        return np.asarray(self._roots @ np.concatenate([[1.0], values]))

    def _density(self, values: Array, levels: NoiseLevels) -> Array:
        stiff = np.abs(values @ self._band_powers) ** 2
        return np.asarray(levels.force**2 + stiff * levels.displacement**2)

    def _most_likely(self, values: Array, levels: NoiseLevels) -> Array:
        scale = np.abs(values) + 1e-3

        def residual(relative: Array) -> Array:
            now = relative * scale
            return np.ravel(self._noise(now) / np.sqrt(self._density(now, levels))[:, None])

        return np.asarray(optimize.least_squares(residual, values / scale, x_scale="jac").x * scale)

    def _levels(self, values: Array) -> NoiseLevels:
        """Levels that are most likely for the periodogram of the balance (Whittle)."""
        power = np.sum(self._noise(values) ** 2, axis=1)
        shapes = np.stack([np.ones_like(power), np.abs(values @ self._band_powers) ** 2], axis=1)

        def deviance(logarithms: Array) -> float:
            density = shapes @ np.exp(logarithms)
            return float(np.sum(np.log(density) + power / density))

        start = np.log([np.quantile(power, 0.1), np.median(power / shapes[:, 1])])
        force, displacement = np.exp(0.5 * optimize.minimize(deviance, start, method="Nelder-Mead").x)
        return NoiseLevels(float(force), float(displacement))

    def displacement(self, environment: Environment, levels: NoiseLevels) -> Array:
        """Best displacement from encoders and gauge [m], (trial, time, axis); its last `EDGE` s are not to be used."""
        impedance = np.array([environment.m_env, environment.b_env, environment.k_env]) @ self._powers
        gain = levels.displacement**2 * impedance.conj()
        gain /= levels.displacement**2 * np.abs(impedance) ** 2 + levels.force**2
        balance = self._load - impedance[:, None] * self._path
        better = fft.irfft(gain[:, None] * balance, self._n_padded, axis=1)[:, : self._n_samples]
        return np.asarray(self._displacement + better)
