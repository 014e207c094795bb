"""Phases that give a sum of sinusoids a small peak (crest-factor optimisation)."""

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft

from armperturb.files import packaged_table


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """One norm to be minimised.

    Attributes:
      keep: how many candidates enter, those with the lowest norm so far.
      doublings: m for a norm of order p = 2 + 2^(m+1).
      n_samples: samples per period, more than twice the highest line.
      weight: what the odd samples count for, the even ones 1.
    """

    keep: int
    doublings: int
    n_samples: int
    weight: float = 1.0


_STAGES = tuple(_Stage(**stage) for stage in packaged_table(__package__, "crest.toml")["stages"])
"""Low orders tell early which starts will end well (the norm of order 18 correlates by 0.95 with the final peak);
high orders lower single peaks. Those look in between the 4096 samples of the thesis as well, where the peak would
move to otherwise; the weight makes it 0.015 lower on these samples, and 0.008 higher in between."""

N_STARTS = _STAGES[0].keep
"""How many starts `reduce_crest` picks from."""

_STEPS = 50
"""Steps per stage; more buy less than they cost."""


@np.errstate(under="ignore")  # high powers of what is far below the peak are zero
def reduce_crest(lines: np.ndarray, amplitudes: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Lower the peaks of signals sum_k amplitudes_k cos(2 pi lines_k t + phases_k), t in periods.

    Minimises L_p norms of rising order p from the given starts, as Guillaume et al. (1991) do, but with BFGS on the
    logarithm of the norm, as its gradient costs only two Fourier transforms, and drops the worse candidates from order
    to order. Candidates step together, of all signals once few of each are left: most of the time of a single one is
    overhead. No signal depends on the others. Nothing in here calls BLAS (hence neither `@` nor SciPy's `minimize`):
    its threads cost more than such small arrays do, and may change the last digit.

    Args:
      lines: cycles per period, distinct whole numbers between 1 and 1023, (line,).
      amplitudes: amplitudes > 0, any unit, (line,).
      starts: phases to start from [rad], (signal, start, line); `N_STARTS` of each signal, or fewer for a worse result.

    Returns:
      Phases [rad], (signal, line).
    """
    # An amplitude squared says how much the norm feels the phase; each norm's curvature is a good guess of the next's.
    scale = np.sum(amplitudes**2) / (2.0 * amplitudes**2)
    n_signals, n_starts, n_lines = starts.shape
    phases = starts.copy()
    inverse_hessian = np.broadcast_to(np.diag(scale), (n_signals, n_starts, n_lines, n_lines))
    values = np.zeros((n_signals, n_starts))
    for stage in _STAGES:
        best = np.argsort(values, axis=1, kind="stable")[:, : stage.keep]
        phases = np.take_along_axis(phases, best[..., None], axis=1)
        inverse_hessian = np.take_along_axis(inverse_hessian, best[..., None, None], axis=1)
        values = np.empty(best.shape)
        together = max(1, N_STARTS // best.shape[1])
        for first in range(0, n_signals, together):
            some = slice(first, first + together)
            candidates = phases[some].reshape(-1, n_lines)
            curvature = inverse_hessian[some].reshape(-1, n_lines, n_lines)
            candidates, value = _minimise(candidates, curvature, lines, amplitudes, stage)
            phases[some], values[some] = candidates.reshape(phases[some].shape), value.reshape(values[some].shape)
    return phases[:, 0]


def _minimise(
    phases: np.ndarray, inverse_hessian: np.ndarray, lines: np.ndarray, amplitudes: np.ndarray, stage: _Stage
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise `_log_norm` by BFGS for all candidates at once.

    Args:
      phases: where to start [rad], (candidate, line).
      inverse_hessian: first guess, (candidate, line, line); overwritten by what is found.
      lines: see `reduce_crest`.
      amplitudes: see `reduce_crest`.
      stage: the norm.

    Returns:
      Phases (candidate, line) and value (candidate,).
    """
    update = np.empty_like(inverse_hessian)
    value, gradient = _log_norm(phases, lines, amplitudes, stage)
    direction, slope, length = _descend(inverse_hessian, gradient)
    for _ in range(_STEPS):
        step = length[:, np.newaxis] * direction
        new_value, new_gradient = _log_norm(phases + step, lines, amplitudes, stage)
        lower = new_value <= value + 1e-4 * length * slope
        # Where it is not lower: the minimum of the parabola through both values and the slope, within bounds.
        excess = np.maximum(new_value - value - slope * length, 1e-300)
        shorter = length * np.clip(-0.5 * slope * length / excess, 0.1, 0.5)

        change = new_gradient - gradient
        curvature = _dot(step, change)
        # Without positive curvature along the step the update would not stay positive definite.
        useful = lower & (curvature > 1e-12 * np.sqrt(_dot(step, step) * _dot(change, change)))
        accepted = lower[:, np.newaxis]
        phases = np.where(accepted, phases + step, phases)
        value, gradient = np.where(lower, new_value, value), np.where(accepted, new_gradient, gradient)

        step, change = (np.where(useful[:, np.newaxis], it, 0.0) for it in (step, change))
        curvature = np.where(useful, curvature, 1.0)[:, np.newaxis]
        image = np.einsum("cij,cj->ci", inverse_hessian, change)
        left = (step * (1.0 + _dot(change, image)[:, np.newaxis] / curvature) - image) / curvature
        inverse_hessian += np.multiply(left[:, :, np.newaxis], step[:, np.newaxis], out=update)
        inverse_hessian -= np.multiply(step[:, :, np.newaxis], (image / curvature)[:, np.newaxis], out=update)
        direction, slope, full = _descend(inverse_hessian, gradient)
        length = np.where(lower, full, shorter)
    return phases, value


def _descend(inverse_hessian: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quasi-Newton direction (candidate, line), slope along it and how far to go (candidate,): at most 1 rad."""
    direction = -np.einsum("cij,cj->ci", inverse_hessian, gradient)
    return direction, _dot(direction, gradient), 1.0 / np.maximum(1.0, np.abs(direction).max(axis=1))


def _dot(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.einsum("ci,ci->c", left, right)


def _log_norm(
    phases: np.ndarray, lines: np.ndarray, amplitudes: np.ndarray, stage: _Stage
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of the signals' norm of order p (candidate,), and its gradient over the phases (candidate, line)."""
    phasors = amplitudes * (np.cos(phases) + 1j * np.sin(phases))
    spectrum = np.zeros((len(phases), stage.n_samples // 2 + 1), complex)
    spectrum[:, lines] = phasors / 2.0
    signal = irfft(spectrum, stage.n_samples, norm="forward")
    if stage.weight != 1.0:
        signal[:, 1::2] *= stage.weight
    peak = np.maximum(signal.max(axis=1), -signal.min(axis=1))
    signal /= peak[:, np.newaxis]
    slope = signal * signal
    for _ in range(stage.doublings):
        slope *= slope
    slope *= signal  # signal^(p-1), up to the factor p
    total = _dot(slope, signal)
    if stage.weight != 1.0:
        slope[:, 1::2] *= stage.weight
    gradient = (np.conj(phasors) * rfft(slope)[:, lines]).imag / (total * peak)[:, np.newaxis]
    return np.log(peak) + np.log(total / stage.n_samples) / (2 + 2 ** (stage.doublings + 1)), gradient
