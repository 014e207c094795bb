"""Perturbations of a single axis, as numbers at the rate of a recording."""

import numpy as np
from scipy import signal

from armperturb.arrays import Array
from armperturb.validation import require_number


def random_steps(
    *, seed: int, duration: float, rate: float = 1000.0, size: float = 0.03, hold: float = 0.25, cutoff: float = 25.0
) -> Array:
    """A pseudo-random series of steps between arbitrary levels, smoothed: (time,).

    Args:
      seed: of levels and times.
      duration: of the series [s], > 0.
      rate: of the samples [Hz], > 0.
      size: distance between the smallest and the largest level [rad or Nm], > 0.
      hold: mean time between steps [s], > 0; each is 0.6 to 1.4 of it.
      cutoff: of the critically damped second-order low-pass that smooths the steps [Hz], below half the rate.

    Raises:
      ValueError: a number is out of its range.
    """
    for name, value in (("duration", duration), ("rate", rate), ("size", size), ("hold", hold)):
        require_number("random_steps", name, value, above=0.0)
    require_number("random_steps", "cutoff", cutoff, above=0.0, below=0.5 * rate)
    rng = np.random.default_rng(seed)
    n_samples = round(duration * rate)
    n_levels = int(np.ceil(duration / (0.6 * hold))) + 1
    lengths = np.maximum(1, np.rint(rate * hold * rng.uniform(0.6, 1.4, n_levels))).astype(int)
    levels = size * (rng.random(n_levels) - 0.5)
    return _smoothed(np.repeat(levels, lengths)[:n_samples], rate, cutoff)


def random_noise(*, seed: int, duration: float, rate: float = 1000.0, rms: float = 1.0, cutoff: float = 15.0) -> Array:
    """Gaussian noise with a second-order low-pass, (time,).

    Args:
      seed: of the noise.
      duration: of the series [s], > 0.
      rate: of the samples [Hz], > 0.
      rms: of the series [rad or Nm], > 0.
      cutoff: of the critically damped low-pass [Hz], below half the rate.

    Raises:
      ValueError: a number is out of its range.
    """
    for name, value in (("duration", duration), ("rate", rate), ("rms", rms)):
        require_number("random_noise", name, value, above=0.0)
    require_number("random_noise", "cutoff", cutoff, above=0.0, below=0.5 * rate)
    noise = _smoothed(np.random.default_rng(seed).standard_normal(round(duration * rate)), rate, cutoff)
    return rms * noise / noise.std()


def _smoothed(series: Array, rate: float, cutoff: float) -> Array:
    pole = np.exp(-2.0 * np.pi * cutoff / rate)
    return np.asarray(signal.lfilter([(1.0 - pole) ** 2], [1.0, -2.0 * pole, pole**2], series))
