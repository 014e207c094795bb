"""The best linear approximation of a nonlinear arm, and how much of its response is noise and how much distortion.

Under random-phase multisines of one power spectrum, a nonlinear arm answers as the linear one that comes closest on
average (its best linear approximation), and adds a stochastic distortion: as periodic as the disturbance, but different
for every realisation. Noise is not periodic. So

- what differs from one period to the next is noise;
- what a smooth response leaves on the excited lines of mean periods is noise and distortion.

(Pintelon & Schoukens, System Identification, 2nd ed., chapters 3 and 4: robust method, in closed loop by projection on
d.) Two inputs act at once: as their phases are independent, each cluster of lines of each realisation gives as many
equations as it has lines for the two responses, and no trials with one direction alone are needed.

Differences between periods are orthonormal contrasts, each of a period (the last may be short) with the mean of those
before, and their spectrum around a cluster is that of the noise; leakage is removed from both as
`local_polynomial` does. All is said of w = x - H f, the part of the displacement that the arm adds to its linear
response.

Assumed, beside what `local_polynomial` assumes: realisations are independent, of the same power spectrum and of random
phases; noise one period apart is independent; the arm has forgotten its start, and is the same in all periods of a
trial. Between trials it may differ: each has a constant term of its own, and none of that counts as distortion. What
the polynomial of a cluster cannot follow does count: with noise far below that of people (a hundredth of the response),
linear arms look nonlinear in two or three trials, for want of a term of second order.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from armperturb.analysis.closed_loop import Periodic, Recordings, periodic_trials
from armperturb.analysis.frequency_response import FrequencyResponse
from armperturb.analysis.local_polynomial import (
    Response,
    Window,
    frequency_response,
    linearised,
    without,
)

Array = NDArray[np.float64]

NOISE_BAND = 0.25
"""Band on either side of a cluster from which the noise is taken [Hz]."""

NOISE_LEAKAGE = 1
"""Order of the leakage's polynomial in that band, which holds few lines."""

SHORTEST = 4.0
"""Pieces of a period that are shorter than this tell nothing of the noise [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BestLinear:
    """Best linear approximation, with the levels of noise and distortion.

    Powers are mean squares of the displacement's sine wave at one excited line of one period [m^2], means over the
    lines of a cluster and over trials.

    Attributes:
      response: of the arm, at the middle of each cluster; its covariance holds noise and distortion.
      linear: power of the linear response H f, (frequency, output).
      noise: power of the noise in a single period, (frequency, output).
      distortion: power of the distortion; unbiased, so that it may come out negative, (frequency, output).
      distortion_error: standard error that it has if the arm is linear, (frequency, output).
      statistic: distortion over its standard error, of all frequencies and outputs together, each weighed by its noise
        [-]; of linear arms standard normal.
      n_periods: periods per trial, with parts, (trial,).
    """

    response: FrequencyResponse
    linear: Array
    noise: Array
    distortion: Array
    distortion_error: Array
    statistic: float
    n_periods: Array

    @property
    def p_value(self) -> float:
        """Chance of so large a statistic if the arm is linear [-]."""
        return float(stats.norm.sf(self.statistic))

    @property
    def share(self) -> Array:
        """Power of the distortion over that of linear response and distortion, all frequencies together, (output,)."""
        distortion = self.distortion.sum(axis=0)
        return np.asarray(distortion / (self.linear.sum(axis=0) + distortion))

    @property
    def share_error(self) -> Array:
        """Standard error that `share` has if the arm is linear, (output,)."""
        error = np.sqrt(np.sum(self.distortion_error**2, axis=0))
        return np.asarray(error / (self.linear + self.distortion).sum(axis=0))


def estimate_best_linear(
    recordings: Recordings, *, period: float = 20.48, start: float = 2.0, lines_per_average: int = 4
) -> BestLinear:
    """Best linear approximation of the arm, from multisines.

    Args:
      recordings: trials of one subject in one condition, two or more, with different multisines of one power spectrum,
        each longer than a period by a fifth or more.
      period: of the disturbance [s].
      start: of what is used [s].
      lines_per_average: as in `estimate_multisine`; 3 or more.

    Raises:
      ValueError: as `estimate_multisine`; or trials, lines of a cluster or periods are too few.
    """
    trials = periodic_trials(recordings, period=period, start=start, lines_per_average=lines_per_average)
    if len(trials.trials) < 2:
        raise ValueError(f"{len(trials.trials)} trial; expected two or more, with different multisines")
    shortest = min(map(len, trials.groups))
    if shortest < 3:
        raise ValueError(f"a group has {shortest} excited lines; expected at least 3 (more lines per average)")
    n_periods = np.array([1.0 + sum(map(len, trial.contrasts)) / (period * trials.rate) for trial in trials.trials])
    contrasts = _contrasts(trials)
    if not contrasts:
        raise ValueError(
            f"trials hold {n_periods.max():.2f} periods from {start:g} s on; expected at least "
            f"{1 + SHORTEST / period:.2f}"
        )
    fits = trials.fit(2 if len(trials.trials) >= 4 else 1, own_levels=True)
    share = float(np.mean([trial.share for trial in trials.trials]))
    scale = 2.0 / (period * trials.rate)  # from |Z|^2 over the number of samples to the mean square of a sine wave
    n_shared = _windows_per_quiet_line(trials)
    linear, noise, distortion, error, excess, precision = [], [], [], [], [], []
    for group, fit in zip(trials.groups, fits, strict=True):
        left = linearised(fit.answer, "arm").left
        noise_z, noise_dof = _noise(contrasts, group / period)
        of_noise = left @ noise_z @ left.conj().T
        on_lines = _Excess(left @ fit.excited_noise @ left.conj().T, fit.excited_dof, of_noise, noise_dof)
        # Distortion falls between the excited lines as well, and there it shows best.
        quiet_dof = fit.dof - fit.excited_dof
        quiet = left @ (fit.dof * fit.noise - fit.excited_dof * fit.excited_noise) @ left.conj().T
        counted = fit.excited_dof + quiet_dof / n_shared
        total = (fit.excited_dof * on_lines.total + quiet / n_shared) / counted
        everywhere = _Excess(total, counted, of_noise, noise_dof)
        force = [np.abs(trial.answer[group, :2] @ left[:, :2].T) ** 2 for trial in trials.trials]
        linear.append(scale * share * np.mean(force, axis=(0, 1)))
        noise.append(scale * np.diagonal(of_noise).real)
        distortion.append(scale * share * np.diagonal(on_lines.total - of_noise).real)
        error.append(scale * share * np.sqrt(on_lines.variance) * np.diagonal(on_lines.pooled).real)
        excess.append(everywhere.relative)
        precision.append(1.0 / everywhere.relative_variance)
    return BestLinear(
        response=frequency_response(fits, "arm", [(fit.excited_noise, fit.excited_dof) for fit in fits]),
        linear=np.array(linear),
        noise=np.array(noise),
        distortion=np.array(distortion),
        distortion_error=np.array(error),
        statistic=float(np.dot(precision, excess) / np.sqrt(np.sum(precision))),
        n_periods=n_periods,
    )


class _Excess(NamedTuple):
    """Covariance of noise and distortion beside that of noise, (2, 2) each, with their degrees of freedom.

    Without distortion, total over pooled is independent of pooled and has a (matrix) beta distribution: its moments are
    exact, however few the degrees of freedom.
    """

    total: Response
    total_dof: float
    noise: Response
    noise_dof: float

    @property
    def pooled(self) -> Response:
        both = self.total_dof * self.total + self.noise_dof * self.noise
        return np.asarray(both / (self.total_dof + self.noise_dof))

    @property
    def variance(self) -> float:
        """Of (total - noise) over pooled, of one output."""
        dof = self.total_dof + self.noise_dof
        return dof**2 / (self.total_dof * self.noise_dof * (dof + 1))

    @property
    def relative(self) -> float:
        """Total less noise over pooled, mean over outputs; its mean is zero without distortion."""
        return 0.5 * float(np.trace(np.linalg.solve(self.pooled, self.total - self.noise)).real)

    @property
    def relative_variance(self) -> float:
        return 0.5 * self.variance * (1 - 1 / (self.total_dof + self.noise_dof - 1))


def _windows_per_quiet_line(trials: Periodic) -> float:
    """How many clusters a quiet line is counted for, on average."""
    quiet = [window.frequency[~window.excited] for window in (trials.windows(group)[0] for group in trials.groups)]
    every = np.concatenate(quiet)
    return max(len(every), 1) / max(len(np.unique(every)), 1)


def _contrasts(trials: Periodic) -> list[Window]:
    """Spectra of what differs between periods."""
    pieces = []
    for trial in trials.trials:
        for values in trial.contrasts:
            n = len(values)
            if n >= SHORTEST * trials.rate:
                spectrum = np.fft.rfft(values, axis=0)[1:] / np.sqrt(n)
                frequency = np.asarray(np.fft.rfftfreq(n, 1.0 / trials.rate)[1:], dtype=float)
                pieces.append(Window(frequency, spectrum[:, :0], spectrum, np.zeros(len(frequency), dtype=bool)))
    return pieces


def _noise(contrasts: list[Window], frequency: Array) -> tuple[Response, float]:
    """Covariance of the noise of f and x around a cluster, (4, 4), and its degrees of freedom."""
    half = NOISE_BAND
    while True:
        low, high = frequency[0] - half, frequency[-1] + half
        near = [piece.within(low, high) for piece in contrasts]
        noise, dof = without(near, NOISE_LEAKAGE)
        if dof >= 6.0:
            return noise, dof
        half *= 1.3
