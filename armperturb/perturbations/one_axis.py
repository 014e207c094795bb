"""Perturbations of a single axis, as numbers at the rate of a recording."""

import numpy as np
from scipy import signal

from armperturb.arrays import Array
from armperturb.seeds import generator_of
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
    rng = generator_of("random_steps", seed)
    n_samples = round(duration * rate)
    n_levels = int(np.ceil(duration / (0.6 * hold))) + 1
    lengths = np.maximum(1, np.rint(rate * hold * rng.uniform(0.6, 1.4, n_levels))).astype(int)
    levels = size * (rng.random(n_levels) - 0.5)
    return _smoothed(np.repeat(levels, lengths)[:n_samples], rate, cutoff)


def random_noise(
    *, seed: int, duration: float, rate: float = 1000.0, rms: float = 1.0, cutoff: float = 15.0, order: int = 2
) -> Array:
    """Gaussian noise with a Butterworth low-pass, (time,).

    Args:
      seed: of the noise.
      duration: of the series [s], > 0.
      rate: of the samples [Hz], > 0.
      rms: of the series [rad or Nm], > 0.
      cutoff: of the low-pass, half its power [Hz], below half the rate.
      order: of the low-pass, 1 to 8.

    Raises:
      TypeError: the order or seed is not a whole number.
      ValueError: a number is out of its range.
    """
    for name, value in (("duration", duration), ("rate", rate), ("rms", rms)):
        require_number("random_noise", name, value, above=0.0)
    require_number("random_noise", "cutoff", cutoff, above=0.0, below=0.5 * rate)
    require_number("random_noise", "order", order, at_least=1, at_most=8, whole=True)
    white = generator_of("random_noise", seed).standard_normal(round(duration * rate))
    noise = np.asarray(signal.sosfilt(signal.butter(order, cutoff, fs=rate, output="sos"), white))
    return rms * noise / noise.std()


LOWEST, HIGHEST = 1.0, 15.0
"""Bandwidths of an imposed movement [Hz], whatever the joint: a servo must follow it."""

WIDTH = float(np.sqrt(2.0))
"""Bandwidth of an imposed movement over the joint's natural frequency [-]; beyond, inertia needs more torque than the
stiffness alone takes of a slow movement."""

RECORDED_SPEED = 0.34
"""RMS velocity of the recorded ankles of docs/real_people.md, below 50 Hz [rad/s]."""


def imposed_movement(
    *, seed: int, duration: float, natural_frequency: float, rate: float = 1000.0, speed: float = RECORDED_SPEED
) -> Array:
    """Gaussian movement of a position servo as wide as the joint, (time,) [rad].

    What is not known of a joint is in proportion to the torque that moves it. Stiffness K and inertia I take together
    |K - I w^2|, no more than K up to the root of two of the natural frequency, while reflexes answer to velocity: the
    angle is flat up to there, and falls steeply beyond (Butterworth, order 4; docs/laboratory.md#one-joint).

    Args:
      seed: of the movement.
      duration: of the series [s], > 0.
      natural_frequency: of the joint [Hz]; the bandwidth is the root of two of it, 1 Hz at least, 15 Hz at most.
      rate: of the samples [Hz], above twice the bandwidth.
      speed: RMS velocity [rad/s], > 0; by default that of recorded ankles.

    Raises:
      ValueError: a number is out of its range.
    """
    require_number("imposed_movement", "natural_frequency", natural_frequency, at_least=0.0)
    require_number("imposed_movement", "speed", speed, above=0.0)
    cutoff = min(max(WIDTH * natural_frequency, LOWEST), HIGHEST)
    angle = random_noise(seed=seed, duration=duration, rate=rate, cutoff=cutoff, order=4)
    return speed / float(np.std(rate * np.gradient(angle))) * angle


def _smoothed(series: Array, rate: float, cutoff: float) -> Array:
    pole = np.exp(-2.0 * np.pi * cutoff / rate)
    return np.asarray(signal.lfilter([(1.0 - pole) ** 2], [1.0, -2.0 * pole, pole**2], series))
