"""The displacement of a handle that is most likely given both encoders and strain gauge.

The best path of a record makes

    sum (x_encoder - x)^2 / s_x^2 + sum (d - f - E^-1 x)^2 / s_f^2

least: a smoother for an interval with free ends. Away from the ends it is x + G n, with n what the recorded signals
leave of the balance and G = s_x^2 conj(E^-1) / (s_x^2 |E^-1|^2 + s_f^2). What the record does not hold before its
start and after its end is missing in that. The missing part satisfies s_x^2 |E^-1|^2 x + s_f^2 x = 0 inside the record:
it is a sum of the two modes of this equation that decay from each end inwards, and least squares tell how much of each.
"""

from typing import NamedTuple

import numpy as np
from scipy import fft

from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment

BEYOND = 1.0
"""How far signals are continued beyond either end of a record before they are transformed [s]."""

FADED = 1e-9
"""Part of a mode that is nothing [-]."""


ROUND_OFF = 1e-12
"""No instrument is known to be less noisy than this share of its RMS signal [-]."""


class NoiseLevels(NamedTuple):
    """White noise of the instruments.

    Attributes:
      force: standard deviation of a sample of the force [N].
      displacement: standard deviation of a sample of the displacement [m].
    """

    force: float
    displacement: float


def gauge_gain(impedance: ComplexArray, levels: NoiseLevels) -> ComplexArray:
    """What the best displacement has of what is left of the balance, G [m/N], (frequency,).

    Args:
      impedance: E^-1 of the manipulator [N/m], (frequency,).
      levels: of the instruments' noise.
    """
    variance = levels.displacement**2
    return np.asarray(variance * impedance.conj() / (variance * np.abs(impedance) ** 2 + levels.force**2))


def smoothed(displacement: Array, load: Array, rate: float, environment: Environment, levels: NoiseLevels) -> Array:
    """Best displacement [m], (trial, time, axis).

    Args:
      displacement: of the encoders [m], (trial, time, axis).
      load: d - f [N], likewise.
      rate: of the samples [Hz].
      environment: the manipulator.
      levels: of the instruments' noise.
    """
    if levels.displacement == 0.0:
        return displacement.copy()
    levels = levels._replace(force=max(levels.force, ROUND_OFF * float(np.sqrt(np.mean(load**2)))))
    n = displacement.shape[1]
    beyond = min(round(BEYOND * rate), n - 1)
    n_padded = fft.next_fast_len(n + 2 * beyond, real=True)
    s = 2j * np.pi * fft.rfftfreq(n_padded, 1.0 / rate)
    impedance = np.asarray(environment.m_env * s**2 + environment.b_env * s + environment.k_env)
    gain = gauge_gain(impedance, levels)[:, None]
    of_path = levels.force**2 / (levels.displacement**2 * np.abs(impedance) ** 2 + levels.force**2)[:, None]
    path, forces = (fft.rfft(_continued(values, beyond), n_padded, axis=1) for values in (displacement, load))
    inside = slice(beyond, beyond + n)
    better = fft.irfft(of_path * path + gain * forces, n_padded, axis=1)[:, inside]
    left = fft.irfft(of_path * (forces - impedance[:, None] * path), n_padded, axis=1)[:, inside]
    # Each residual over its noise; only the ratio counts.
    ratio = levels.displacement / levels.force
    off, better = np.stack([displacement - better, ratio * left]), better.copy()
    start, end = (_modes(n, rate, environment, levels, backwards=backwards) for backwards in (False, True))
    n_modes = start.shape[1]
    if 2 * n_modes <= n:
        parts = [(slice(0, n_modes), start), (slice(n - n_modes, n), end)]
    else:  # some reach the other end
        nothing = np.zeros((2, n - n_modes, 2))
        from_start, from_end = np.concatenate([start, nothing], axis=1), np.concatenate([nothing, end], axis=1)
        parts = [(slice(0, n), np.concatenate([from_start, from_end], axis=2))]
    for part, (modes, of_force) in parts:
        target = np.moveaxis(off[:, :, part], 2, 1).reshape(2 * len(modes), -1)
        amounts = np.linalg.lstsq(np.concatenate([modes, ratio * of_force]), target, rcond=1e-9)[0]
        better[:, part] += (modes @ amounts).reshape(len(modes), len(better), -1).swapaxes(0, 1)
    return better


def _continued(values: Array, beyond: int) -> Array:
    """Signals turned about their first and last samples, which fade to zero, (trial, beyond + time + beyond, axis).

    A jump at an end would hold frequencies that no mode has.
    """
    fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(beyond) + 0.5) / beyond)[:, None]
    first, last = values[:, :1], values[:, -1:]
    before = fade * (2.0 * first - values[:, beyond:0:-1])
    after = fade[::-1] * (2.0 * last - values[:, -2 : -beyond - 2 : -1])
    return np.concatenate([before, values, after], axis=1)


def _modes(n_most: int, rate: float, environment: Environment, levels: NoiseLevels, *, backwards: bool) -> Array:
    """Two modes that decay from an end of a record inwards, and the force that each takes [N/m], (2, time, mode).

    Args:
      n_most: most samples.
      rate: of the samples [Hz].
      environment: the manipulator.
      levels: of the instruments' noise.
      backwards: whether from the end, so that the last sample is the largest.
    """
    m, b, k = environment.m_env, environment.b_env, environment.k_env
    # (m s^2 + b s + k) (m s^2 - b s + k) + (s_f / s_x)^2 = 0 is quadratic in s^2.
    squares = np.roots([m**2, 2.0 * m * k - b**2, k**2 + (levels.force / levels.displacement) ** 2]).astype(complex)
    poles = -np.sqrt(squares)  # the roots in the left half of the plane
    slowest = max(-float(poles.real.max()), 1e-9)
    time = np.arange(max(1, min(n_most, int(-np.log(FADED) / slowest * rate) + 1))) / rate
    waves = np.exp(np.multiply.outer(time, poles))
    sign = -1.0 if backwards else 1.0
    forces = (m * poles**2 + sign * b * poles + k) * waves
    if poles[0].imag != 0.0:  # a conjugate pair: both parts of one of them
        waves, forces = (np.stack([each[:, 0].real, each[:, 0].imag], axis=1) for each in (waves, forces))
    both = np.stack([waves.real, forces.real])
    return both[:, ::-1] if backwards else both
