"""The manipulator and the displacement of its handle as encoders and strain gauge together tell them.

The force balance of the environment, d - f = E^-1 x, holds whatever the arm does. What is left of it is noise,

    n = d - f - E^-1 x,    Phi_nn = s_f^2 + |E^-1|^2 s_x^2,    E^-1 = m s^2 + b s + k,

with the white noise s_f of the gauge and s_x of the encoders. Whatever moves the handle, the person included, so tells
what the environment is (errors in variables: sum |n|^2 / Phi_nn is least), and then how noisy both instruments are.

The recorded force thus holds a second measurement of the displacement, E (d - f). Encoders are better at low
frequencies, where the handle moves far; the gauge is better at high ones, where inertia turns small movements into
large forces (with the thesis's instruments above some 6 Hz, and 50 times better at 40 Hz). The best displacement is the
mean of both, weighted inversely with their variances, see `smoother`.

All this takes the clocks of force and displacement to agree: a skew turns inertia into damping, by m w^2 per second. It
is seen in the balance as well, as a delay that no m, b and k explain. So is whatever else is wrong with a signal or the
manipulator, see `imbalance`.
"""

import itertools
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import fft, optimize, signal

from armperturb.analysis.excited_bands import excited_spectra
from armperturb.analysis.imbalance import Imbalance, find_imbalance
from armperturb.analysis.smoother import ROUND_OFF, NoiseLevels, smoothed
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment

EDGE = 0.5
"""Length at either end of a record on which the edges of the filters lie [s]."""

BAND = (0.2, 0.25)
"""Frequencies that are used: lowest [Hz], and highest over the sampling rate [-]."""

ROUNDS = 3
"""How often environment and noise levels are estimated in turn: the former hardly depends on the latter."""

EMPTY, LEAST_FULL = 0.3, 30.0
"""Share of what one half of a band makes one expect of the other at whose end it is empty [-], and the frequency from
which on that is looked for [Hz]: people and perturbations leave more than white noise below."""

LEFT_OVER = 0.2
"""Share of the load's power at low frequencies from which on there is no balance [-], beside the instruments' noise."""

LEAST_SLOW, CLEAR = 20, 10.0
"""Least number of frequencies that are low, and power of the acceleration over that of the encoders' noise in it up to
which they are [-]."""

LONGEST_STORED = 2**18
"""Samples of a record up to which its balance is stored with it."""


class Skew(NamedTuple):
    """How much later the force was recorded than the displacement.

    Attributes:
      time: by which it is late [s].
      standard_error: of that [s].
    """

    time: float
    standard_error: float


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
        self._signals, self._rate = (perturbation, force, displacement), rate
        self._n_samples, self._n_edge = displacement.shape[1], round(EDGE * rate)
        if self._n_samples < 10 * self._n_edge:
            raise ValueError(f"the recording lasts {self._n_samples / rate:g} s; expected at least {10 * EDGE:g} s")
        self._n_padded = fft.next_fast_len(self._n_samples + 4 * self._n_edge, real=True)
        self._powers = _powers(fft.rfftfreq(self._n_padded, 1.0 / rate))
        load = perturbation - force
        self._load = fft.rfft(load, self._n_padded, axis=1)
        self._path = fft.rfft(displacement, self._n_padded, axis=1)
        self._n_averages = displacement.shape[0] * displacement.shape[2]
        # Fourth differences are hardly anything but noise, and have 70 times its variance.
        self._white = NoiseLevels(
            *(float(np.sqrt(np.mean(np.diff(each, 4, axis=1) ** 2) / 70.0)) for each in (force, displacement))
        )
        self._least = ROUND_OFF * np.sqrt([np.mean(load**2), np.mean(displacement**2)])
        taper = signal.windows.hann(self._n_samples - 2 * self._n_edge, sym=False)
        self._taper = taper / np.linalg.norm(taper)
        frequency = fft.rfftfreq(len(taper), 1.0 / rate)
        self._used = (frequency > BAND[0]) & (frequency < BAND[1] * rate)
        self._omega = 2 * np.pi * frequency[self._used]
        self._band_powers = _powers(frequency[self._used])

    @classmethod
    def stored(cls, results: dict[object, Any], signals: tuple[Array, Array, Array], rate: float) -> Self:
        """The balance of d, f and x that is stored among results; of long records it is large, and made anew."""
        made: Self = results.get(cls) or cls(*signals, rate)
        if made._n_samples <= LONGEST_STORED:
            results[cls] = made
        return made

    @cached_property
    def _roots(self) -> Array:
        """Per frequency a root of the power of what the balance is made of, (frequency, at most 5, 5).

        That is load, acceleration, velocity, displacement (these three negative) and the load's derivative, each
        tapered: the power of any sum of them with weights v is |root v|^2.
        """
        top = BAND[1] * self._rate
        frequency = self._powers[1].imag / (2 * np.pi)
        # Beyond the band the encoders' noise is so large in the balance that its side lobes would cover the rest.
        smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip((1.4 * top - frequency) / (0.3 * top), 0.0, 1.0))

        def tapered(spectrum: ComplexArray) -> ComplexArray:
            values = fft.irfft(spectrum * smooth[:, None], self._n_padded, axis=1)
            # In short records the taper would spread the offset, or drift, of a sensor over the lowest frequencies.
            inner = signal.detrend(values[:, self._n_edge : self._n_edge + len(self._taper)], axis=1)
            return np.asarray(fft.rfft(inner * self._taper[:, None], axis=1)[:, self._used])

        path = [-tapered(self._path * power[:, None]) for power in self._powers]
        terms = np.stack([tapered(self._load), *path, tapered(self._load * self._powers[1][:, None])])
        # Of each frequency: all trials and axes, real and imaginary parts, below one another.
        rows = np.moveaxis(terms, 2, 0).reshape(len(self._omega), 5, -1).swapaxes(1, 2)
        rows = np.concatenate([rows.real, rows.imag], axis=1) / np.sqrt(self._n_averages)
        return np.asarray(np.linalg.qr(rows, mode="r"))

    def fit(self) -> tuple[Environment, NoiseLevels]:
        """Mass, damping and stiffness that the manipulator really showed, and the noise of the instruments.

        Raises:
          ValueError: no positive mass comes out, or none that balances, as when the sign of the force is wrong.

        Source: errors in variables, as above; the thesis's values are eqs C.1-C.3.
        """
        # Low frequencies first.
        slow = self._roots[: self._n_slow, :, :4].reshape(-1, 4)
        values = np.asarray(np.linalg.lstsq(slow[:, 1:], -slow[:, 0], rcond=None)[0], dtype=float)
        n = self._n_full(values)
        levels = self._levels(values, n)
        for _ in range(ROUNDS):
            values = self._most_likely(values, levels, n)
            levels = self._levels(values, n)
        mass, damping, stiffness = map(float, values)
        sign = "force must be the reaction force that the handle exerts on the hand: the environment sees d - f"
        if not mass > 0.0:
            raise ValueError(f"the environment's mass comes out at {mass:.3g} kg; expected a positive mass ({sign})")
        left = self._left(values, levels)
        if left > LEFT_OVER:
            raise ValueError(
                f"mass, damping and stiffness leave {left:.0%} of the load on the environment unexplained; expected "
                f"less than {LEFT_OVER:.0%} ({sign})"
            )
        return Environment(m_env=mass, b_env=max(damping, 0.0), k_env=max(stiffness, 0.0)), levels

    @property
    def _n_slow(self) -> int:
        """Number of low frequencies, where noise hardly matters."""
        moving = int(np.searchsorted(self._omega, 2 * np.pi * LEAST_FULL))
        most = max(LEAST_SLOW, min(len(self._roots) // 5, moving))
        acceleration = np.cumsum(np.sum(self._roots[:most, :, 1] ** 2, axis=1))
        noise = np.cumsum((self._omega[:most] ** 2 * self._white.displacement) ** 2)
        return max(LEAST_SLOW, int(np.count_nonzero(acceleration > CLEAR * noise)))

    def unexplained(self, environment: Environment) -> float:
        """Share of the load's power at low frequencies that mass, damping and stiffness leave [-]."""
        return self._left(np.array([environment.m_env, environment.b_env, environment.k_env]), self._white)

    def _left(self, values: Array, levels: NoiseLevels) -> float:
        """The same, but for what instruments explain that have the noise of given levels, or what is white if less."""
        slow, least = slice(self._n_slow), NoiseLevels(*np.minimum(levels, self._white).tolist())
        left = np.sum(self._noise(values)[slow] ** 2) - np.sum(self._density(values, least)[slow])
        return float(max(left, 0.0) / np.sum(self._roots[slow, :, 0] ** 2))

    def _noise(self, values: Array) -> Array:
        """What is left of the balance, (frequency, 4): its power is the sum of squares."""
        return np.asarray(self._roots[..., :4] @ np.concatenate([[1.0], values]))

    def _density(self, values: Array, levels: NoiseLevels) -> Array:
        stiff = np.abs(values @ self._band_powers) ** 2
        return np.asarray(levels.force**2 + stiff * levels.displacement**2)

    def _n_full(self, values: Array) -> int:
        """Number of frequencies below those that a low-pass, or resampling to a higher rate, has emptied.

        White noise of the instruments fills all of them, and would be found far too small with empty ones.
        """
        sizes = [len(self._omega)]
        while self._omega[sizes[0] // 2] > 2 * np.pi * LEAST_FULL:
            sizes.insert(0, sizes[0] // 2)
        power = np.sum(self._noise(values) ** 2, axis=1)
        for n, wider in itertools.pairwise(sizes):
            density = self._density(values, self._levels(values, n))
            last = slice(3 * wider // 4, wider)
            if np.mean(power[last] / density[last]) < EMPTY:
                return n
        return sizes[-1]

    def _most_likely(self, values: Array, levels: NoiseLevels, n: int) -> Array:
        scale = np.abs(values) + 1e-3

        def residual(relative: Array) -> Array:
            now = relative * scale
            return np.ravel(self._noise(now)[:n] / np.sqrt(self._density(now, levels)[:n, None]))

        return np.asarray(optimize.least_squares(residual, values / scale, x_scale="jac").x * scale)

    def _levels(self, values: Array, n: int) -> NoiseLevels:
        """Levels that are most likely for the periodogram of the balance (Whittle) at the first n frequencies."""
        power = np.sum(self._noise(values)[:n] ** 2, axis=1)
        shapes = np.stack([np.ones_like(power), np.abs(values @ self._band_powers[:, :n]) ** 2], axis=1)

        def deviance(logarithms: Array) -> tuple[float, Array]:
            parts = shapes * np.exp(logarithms)
            density = parts.sum(axis=1)
            return float(np.sum(np.log(density) + power / density)), (1.0 / density - power / density**2) @ parts

        first, second = np.maximum([np.quantile(power, 0.1), np.median(power / shapes[:, 1])], self._least**2)
        bounds = [(np.log(least**2), None) for least in self._least]
        solution = optimize.minimize(deviance, np.log([first, second]), jac=True, bounds=bounds, method="L-BFGS-B")
        force, displacement = np.exp(0.5 * solution.x)
        return NoiseLevels(float(force), float(displacement))

    @cached_property
    def imbalance(self) -> Imbalance | None:
        """What is wrong with a signal or the manipulator, where more than noise is left; None where nothing is."""
        band = BAND[0], BAND[1] * self._rate
        return find_imbalance(excited_spectra(self._signals, self._rate, self._n_edge, band))

    def skew(self, environment: Environment, levels: NoiseLevels) -> Skew:
        """How much later force was recorded than displacement.

        Where `imbalance` finds a delay, it is that of the signal that is late: none if it is the perturbation. Where
        something else is wrong, it is not known, and its standard error infinite. Else it is the delay of d and f
        together after x, from a Gauss-Newton step that starts at no skew. Noise would attenuate that if its regressor
        were the derivative of the noisy load. As a delay leaves the noise's power as it is, only the power that load
        and path share counts.
        """
        wrong = self.imbalance
        if wrong is not None:
            after = {"force": wrong.delay, "displacement": -wrong.delay}
            return Skew(after.get(wrong.kind, 0.0), wrong.standard_error)
        values = np.array([environment.m_env, environment.b_env, environment.k_env])
        products = np.einsum("fki,fkj->fij", self._roots, self._roots) / self._density(values, levels)[:, None, None]
        information = products.sum(axis=0)[1:, 1:]
        information[3, 3] = -float(np.sum(self._omega**2 * (products[:, 0, 1:4] @ values)))
        variance = float(np.linalg.inv(information)[3, 3])
        slope = float(np.sum(products[:, 4, :4] @ np.concatenate([[1.0], values])))
        return Skew(-variance * slope, float(np.sqrt(variance * self._shorter / (2 * self._n_averages))))

    @property
    def _shorter(self) -> float:
        """Tapering makes neighbouring frequencies depend on each other, as a record shorter by this factor would."""
        return len(self._taper) * float(np.sum(self._taper**4))

    def covariance(self, environment: Environment, levels: NoiseLevels) -> Array:
        """Covariance of the errors of mass, damping and stiffness as `fit` estimates them, in SI units, (3, 3).

        The encoders' noise is no movement: its expected power is taken out of what the path tells, unless little else
        is in it.
        """
        values = np.array([environment.m_env, environment.b_env, environment.k_env])
        density = self._density(values, levels)[:, None, None]
        path = self._roots[:, :, 1:4]
        noise = levels.displacement**2 * np.einsum("if,jf->fij", self._band_powers.conj(), self._band_powers).real
        seen = np.sum(np.einsum("fki,fkj->fij", path, path) / density, axis=0)
        moved = seen - np.sum(noise / density, axis=0)
        information = moved if np.linalg.eigvalsh(moved)[0] > 0.0 else seen
        return np.asarray(np.linalg.inv(information) * self._shorter / (2 * self._n_averages))

    def displacement(self, environment: Environment, levels: NoiseLevels) -> Array:
        """Best displacement from encoders and gauge [m], (trial, time, axis)."""
        d, f, x = self._signals
        return smoothed(x, d - f, self._rate, environment, levels)


def _powers(frequency: Array) -> ComplexArray:
    """s^2, s and 1, (3, frequency)."""
    s = 2j * np.pi * frequency
    return np.stack([s**2, s, np.ones_like(s)])
