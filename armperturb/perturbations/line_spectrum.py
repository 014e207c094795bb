"""Multisines of any line powers, drawn as samples."""

import numpy as np
from scipy.fft import irfft

from armperturb.perturbations.crest import N_STARTS, reduce_crest
from armperturb.perturbations.multisine import DESIGN_RATE, PERIOD_SAMPLES
from armperturb.perturbations.sampled import Sampled
from armperturb.seeds import generator_of
from armperturb.validation import require_number

LEAST_POWER = 1e-9
"""Share of an axis's power below which a line is left out [-]."""


def draw_multisine(
    lines: np.ndarray,
    power: np.ndarray,
    *,
    seed: int | np.random.Generator,
    duration: float,
    n_period: int = PERIOD_SAMPLES,
) -> Sampled:
    """A random realisation of line powers at the thesis's rate of 200 Hz, independent on x and y, with low peaks.

    Args:
      lines: cycles per period, distinct whole numbers from 1 to below a quarter of n_period, (line,).
      power: mean square force of each line [N^2], >= 0, (line, axis).
      seed: what the phases are drawn from; the same seed gives the same multisine.
      duration: time that it is applied for [s], at least 0.01 s.
      n_period: samples per period, at most 4096.

    Raises:
      TypeError: duration is not a number, or seed neither a whole number nor a generator.
      ValueError: lines are not as described, a power is negative or not finite, an axis has none, or the duration is
        too short.
    """
    lines, power = np.asarray(lines), np.asarray(power, dtype=float)
    require_number("draw_multisine", "duration", duration, at_least=2.0 / DESIGN_RATE)
    if lines.ndim != 1 or lines.dtype.kind not in "iu" or len(np.unique(lines)) < len(lines):
        raise ValueError(f"draw_multisine: lines = {lines!r}; expected distinct whole numbers")
    if power.shape != (len(lines), 2) or not (np.isfinite(power).all() and (power >= 0.0).all()):
        expected = f"({len(lines)}, 2) numbers of at least 0"
        raise ValueError(f"draw_multisine: power of shape {power.shape}; expected {expected}")
    if not power.any(axis=0).all():
        raise ValueError("draw_multisine: power of an axis is zero at all lines; expected some")
    require_number("draw_multisine", "n_period", n_period, at_least=8, at_most=4096, whole=True)
    highest = n_period // 4 - 1
    if lines.min() < 1 or lines.max() > highest:
        raise ValueError(f"draw_multisine: lines from {lines.min()} to {lines.max()}; expected 1 to {highest}")
    starts = generator_of("draw_multisine", seed).uniform(-np.pi, np.pi, (2, N_STARTS, len(lines)))
    spectrum = np.zeros((2, n_period // 2 + 1), complex)
    for axis in range(2):
        used = power[:, axis] > LEAST_POWER * power[:, axis].sum()
        amplitudes = np.sqrt(2.0 * power[used, axis])
        # Phases must not depend on the scale, not even by rounding.
        relative = amplitudes / np.sqrt(power[used, axis].sum())
        (phases,) = reduce_crest(lines[used], relative, starts[axis : axis + 1][..., used])
        spectrum[axis, lines[used]] = amplitudes * np.exp(1j * phases)
    period = irfft(spectrum, n_period, norm="forward").T / 2.0
    return Sampled(force=np.resize(period, (round(duration * DESIGN_RATE), 2)), rate=DESIGN_RATE)
