"""Phases that give a sum of sinusoids a small peak (crest-factor optimisation)."""

import numpy as np
from scipy.fft import irfft, rfft

_STAGES = ((1, 4096), (2, 4096), (3, 4096), (5, 8192), (7, 8192))
"""Stages (m, samples per period) that minimise the norm of order 2 + 2^(m+1). The last ones, in which single peaks
decide, look twice as closely: otherwise the peak moves in between the samples."""

_ITERATIONS = 60
"""Most steps per stage; more buy less than 0.01 of crest factor."""


def reduce_crest(lines: np.ndarray, amplitudes: np.ndarray, phases: np.ndarray) -> np.ndarray:
    """Lower the peak of sum_k amplitudes_k cos(2 pi lines_k t + phases_k), t in periods.

    Minimises L_p norms of rising order p from the given start, as Guillaume et al. (1991) do, but with BFGS on the
    logarithm of the norm, as its gradient costs only two Fourier transforms. Nothing in here calls BLAS (hence neither
    `@` nor SciPy's `minimize`): its threads cost more than such small arrays do, and may change the last digit.

    Args:
      lines: cycles per period, distinct whole numbers between 1 and 2047, (line,).
      amplitudes: amplitudes > 0, any unit, (line,).
      phases: where to start [rad], (line,).

    Returns:
      Phases [rad], (line,).
    """
    inverse_hessian = None
    for doublings, n_samples in _STAGES:
        # The curvature of one norm is a good guess of the next one's.
        phases, inverse_hessian = _minimise(phases, inverse_hessian, lines, amplitudes, doublings, n_samples)
    return phases


def _minimise(
    phases: np.ndarray,
    inverse_hessian: np.ndarray | None,
    lines: np.ndarray,
    amplitudes: np.ndarray,
    doublings: int,
    n_samples: int,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Minimise `_log_norm` by BFGS; phases (line,) and inverse Hessian (line, line), None if not known yet."""
    value, gradient = _log_norm(phases, lines, amplitudes, doublings, n_samples)
    for _ in range(_ITERATIONS):
        direction = -gradient if inverse_hessian is None else -np.sum(inverse_hessian * gradient, axis=1)
        slope = np.sum(direction * gradient)
        if slope >= 0.0:
            inverse_hessian, direction = None, -gradient
            slope = np.sum(direction * gradient)
        largest = np.abs(direction).max()
        if largest == 0.0:
            break
        # No phase moves by more than 1 rad, or 0.3 rad as long as the scale is unknown.
        length = 0.3 / largest if inverse_hessian is None else min(1.0, 1.0 / largest)
        for _ in range(12):
            step = length * direction
            new_value, new_gradient = _log_norm(phases + step, lines, amplitudes, doublings, n_samples)
            if new_value <= value + 1e-4 * length * slope:
                break
            # The minimum of the parabola through both values and the slope, within bounds.
            length *= min(0.5, max(0.1, -0.5 * slope * length / (new_value - value - slope * length)))
        else:
            break  # nothing lower to be found: rounding
        change = new_gradient - gradient
        curvature = np.sum(step * change)
        # Without positive curvature along the step the update would not stay positive definite.
        if curvature > 1e-12 * np.sqrt(np.sum(step**2) * np.sum(change**2)):
            if inverse_hessian is None:
                inverse_hessian = np.eye(len(phases)) * (curvature / np.sum(change**2))
            image = np.sum(inverse_hessian * change, axis=1)
            left = (step * (1.0 + np.sum(change * image) / curvature) - image) / curvature
            inverse_hessian = inverse_hessian + np.multiply.outer(left, step)
            inverse_hessian -= np.multiply.outer(step, image / curvature)
        phases, value, gradient = phases + step, new_value, new_gradient
    return phases, inverse_hessian


def _log_norm(
    phases: np.ndarray, lines: np.ndarray, amplitudes: np.ndarray, doublings: int, n_samples: int
) -> tuple[float, np.ndarray]:
    """Logarithm of the signal's norm of order p = 2 + 2^(doublings+1), and its gradient over the phases (line,)."""
    phasors = amplitudes * np.exp(1j * phases)
    spectrum = np.zeros(n_samples // 2 + 1, complex)
    spectrum[lines] = phasors * (n_samples / 2)
    signal = irfft(spectrum, n_samples)
    peak = np.abs(signal).max()
    signal /= peak
    power = signal * signal
    for _ in range(doublings):
        power *= power
    slope = power * signal  # signal^(p-1), up to the factor p
    total = np.sum(slope * signal)
    gradient = -np.imag(phasors * np.conj(rfft(slope)[lines])) / (total * peak)
    return np.log(peak) + np.log(total / n_samples) / (2 + 2 ** (doublings + 1)), gradient
