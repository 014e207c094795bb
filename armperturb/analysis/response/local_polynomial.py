"""The response to a known disturbance near one frequency, with transients removed (local polynomial method).

A person, the handle and its environment answer the disturbance d with z = (f, x). Over any finite record of a linear
loop, the discrete Fourier transforms obey

    Z(k) = T(k) D(k) + L(k) + V(k),

where the leakage L belongs to what came before the record and goes on after it. It is a rational function with the
loop's own poles, like T, and so both are smooth in frequency; D of an aperiodic or random signal is not. Around a
frequency, T and L are polynomials of the frequency's offset, and a least-squares fit separates them. What is left is
noise, and its sample covariance gives that of T (Pintelon & Schoukens, System Identification, 2nd ed., chapter 7).

Feedback does no harm, because all is referred to d (joint input-output approach). With T = (T_f; T_x),

    arm          H = T_x T_f^-1          error: (dT_x - H dT_f) T_f^-1
    environment  E = T_x (1 - T_f)^-1    error: (dT_x + E dT_f) (1 - T_f)^-1
    total        P = T_x                 error: dT_x

to first order. Assumed: d is known without noise and no person or instrument adds anything that correlates with it;
noise is stationary, and its spectrum about the same all over the window.

A person who differs from trial to trial moves all lines of a trial together, which residuals of single lines do not
tell. Where there are three trials or more, the variance is therefore raised to that of the sums which each trial adds
to the estimate (Liang & Zeger 1986, Biometrika 73, 13-22), as far as these exceed noise over an octave to either side.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.analysis.response.frequency_response import FrequencyResponse, System
from armperturb.analysis.response.joint_records import admittance_of, error_of, variance_of
from armperturb.analysis.trials import TrialRecord
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment

N_INPUTS = 2
LARGEST_CONDITION = 1e6
"""Condition number above which the effects of two disturbances are not separately identifiable [-]."""

REACH = 1.0
"""Octaves to either side over which it is told whether trials differ."""

STILL = 0.2, 1.0
"""No disturbance acts for so long before and after what does not leak [s], and for the last quarter of a record."""


class Window(NamedTuple):
    """Lines of one record near a frequency.

    Attributes:
      frequency: [Hz], (line,).
      perturbation: D, over the square root of the number of samples, (line, axis).
      answer: F and X, likewise, (line, 4); of one axis, (line, 1) or (line, 2).
      excited: whether D is there, (line,).
      leaks: whether an answer goes on after the record, or came before it.
    """

    frequency: Array
    perturbation: ComplexArray
    answer: ComplexArray
    excited: NDArray[np.bool_]
    leaks: bool = True

    def within(self, low: float, high: float) -> "Window":
        """The lines from low to high [Hz]."""
        return self.only((self.frequency >= low) & (self.frequency <= high))

    def only(self, chosen: NDArray[np.bool_]) -> "Window":
        """Some of the lines."""
        return self._replace(
            frequency=self.frequency[chosen],
            perturbation=self.perturbation[chosen],
            answer=self.answer[chosen],
            excited=self.excited[chosen],
        )


def whole_window(record: TrialRecord) -> Window:
    """DFT of a whole record, without the mean."""
    n = len(record.perturbation)
    d, z = (np.fft.rfft(values, axis=0)[1:] / np.sqrt(n) for values in (record.perturbation, record.response))
    frequency = np.asarray(np.fft.rfftfreq(n, 1.0 / record.rate)[1:], dtype=float)
    before, after = (round(seconds * record.rate) for seconds in STILL)
    still = np.concatenate([record.perturbation[:before], record.perturbation[-max(after, n // 4) :]])
    return Window(frequency, d, z, np.ones(len(d), dtype=bool), leaks=bool(np.ptp(still, axis=0).any()))


class LocalFit(NamedTuple):
    """Response from d to f and x at one frequency.

    Attributes:
      frequency: [Hz].
      answer: T, mean over the records, (4, input).
      factor: covariance of the elements of a row of T over the variance of that output's noise, (input, input).
      noise: sample covariance of what is left, (4, 4).
      dof: complex degrees of freedom behind `noise`.
      excited_noise: the same from excited lines alone, which also hold what a nonlinear arm adds there, (4, 4).
      excited_dof: complex degrees of freedom behind that.
      by_trial: what the residual of each record adds to T, (record, 4, input).
    """

    frequency: float
    answer: ComplexArray
    factor: ComplexArray
    noise: ComplexArray
    dof: float
    excited_noise: ComplexArray
    excited_dof: float
    by_trial: ComplexArray


def n_unknowns(
    n_records: int, order: int, leakage_order: int, own_levels: bool = False, n_inputs: int = N_INPUTS
) -> int:
    """Unknowns of `fit_locally` for each output."""
    n_levels = n_records if own_levels else 1
    return n_inputs * (n_levels + order) + n_records * (leakage_order + 1)


class DependentDisturbancesError(ValueError):
    """The disturbances along x and y are not independent at some frequency.

    Attributes:
      frequency: that one [Hz].
    """

    def __init__(self, frequency: float, are_proportional: bool, *, has_more_lines: bool = True) -> None:
        more_lines = ", more lines per average of multisines" if has_more_lines else ""
        others = "" if are_proportional else f"{more_lines}, or the method arx"
        super().__init__(
            f"the disturbances along x and y are not independent at {frequency:.3f} Hz; expected independent "
            "disturbances (other realisations, one trial for each direction, or the sign of y turned in half of the "
            f"trials{others})"
        )
        self.frequency = frequency


def fit_locally(
    windows: Sequence[Window], centre: float, *, order: int, leakage_order: int, own_levels: bool = False
) -> LocalFit:
    """Fit the response of all records together.

    Args:
      windows: of each record; they may differ in resolution and number of lines.
      centre: where the response is wanted [Hz].
      order: of the polynomial that the response is; its coefficients are the same in all records.
      leakage_order: of that of the leakage, each record having its own; -1 for none.
      own_levels: whether each record has its own constant term of the response: a person changes between trials.

    Raises:
      ValueError: there are no more equations than unknowns.
      DependentDisturbancesError: the disturbances along x and y are not independent.
    """
    offset = [window.frequency - centre for window in windows]
    scale = max(float(np.abs(values).max()) for values in offset) or 1.0
    n_rows = [len(values) for values in offset]
    n_levels = len(windows) if own_levels else 1
    n_inputs = windows[0].perturbation.shape[1]
    n_level, n_slope = n_inputs * n_levels, n_inputs * order
    n = n_unknowns(len(windows), order, leakage_order, own_levels, n_inputs)
    if sum(n_rows) <= n:
        raise ValueError(
            f"{sum(n_rows)} lines near {centre:.3f} Hz for {n} unknowns; expected more (more or longer trials, more "
            "lines per average, or a lower order)"
        )
    matrix = np.zeros((sum(n_rows), n), dtype=complex)
    first = 0
    for i, (window, values) in enumerate(zip(windows, offset, strict=True)):
        rows = matrix[first : first + len(values)]
        level = n_inputs * i if own_levels else 0
        rows[:, level : level + n_inputs] = window.perturbation
        powers = (values[:, None] / scale) ** np.arange(max(order, leakage_order) + 1)
        for power in range(order):
            column = n_level + n_inputs * power
            rows[:, column : column + n_inputs] = powers[:, power + 1, None] * window.perturbation
        column = n_level + n_slope + i * (leakage_order + 1)
        rows[:, column : column + leakage_order + 1] = powers[:, : leakage_order + 1]
        first += len(values)
    lengths = np.linalg.norm(matrix, axis=0)
    lengths[lengths == 0.0] = 1.0
    orthonormal, triangle = np.linalg.qr(matrix / lengths)
    if np.linalg.cond(triangle) > LARGEST_CONDITION:
        pushes = np.concatenate([window.perturbation for window in windows])
        raise DependentDisturbancesError(centre, bool(np.linalg.cond(pushes) > LARGEST_CONDITION))
    answer = np.concatenate([window.answer for window in windows])
    projected = orthonormal.conj().T @ answer
    back = np.linalg.inv(triangle)
    levels = ((back @ projected) / lengths[:, None])[:n_level].reshape(n_levels, n_inputs, -1)
    # The mean over records of the constant terms is a sum of rows of the inverse.
    rows = (back / lengths[:, None])[:n_level].reshape(n_levels, n_inputs, -1).mean(axis=0)
    left = answer - orthonormal @ projected
    free = 1.0 - np.sum(np.abs(orthonormal) ** 2, axis=1)
    excited = np.concatenate([window.excited for window in windows])

    def covariance(chosen: NDArray[np.bool_]) -> tuple[ComplexArray, float]:
        dof = float(free[chosen].sum())
        products = np.einsum("ra,rb->ab", left[chosen], left[chosen].conj())
        return np.asarray(products / max(dof, 1e-12), dtype=complex), dof

    factor = np.asarray(rows @ rows.conj().T)
    mean = levels.mean(axis=0)
    if own_levels:
        by_trial = (levels - mean) / n_levels
    else:
        added = (rows @ orthonormal.conj().T)[:, :, None] * left
        by_trial = np.stack([part.sum(axis=1) for part in np.split(added, np.cumsum(n_rows)[:-1], axis=1)])
    of_all, of_excited = covariance(np.ones(len(left), dtype=bool)), covariance(excited)
    return LocalFit(centre, mean.T, factor, *of_all, *of_excited, by_trial.swapaxes(1, 2))


def without(
    windows: Sequence[Window], leakage_order: int, weights: Sequence[Array] | None = None
) -> tuple[ComplexArray, float]:
    """Covariance of the noise of records that hold no response, (answer, answer), and its complex degrees of freedom.

    Leakage of each record is removed as in `fit_locally`; the weights of lines, 1 unless given, are those in the mean.
    """
    n = windows[0].answer.shape[1]
    total, dof = np.zeros((n, n), dtype=complex), 0.0
    for i, window in enumerate(windows):
        if len(window.frequency) <= leakage_order + 1:
            continue
        weight = np.ones(len(window.frequency)) if weights is None else weights[i]
        offset = window.frequency - window.frequency.mean()
        powers = (offset[:, None] / (np.abs(offset).max() or 1.0)) ** np.arange(leakage_order + 1)
        basis, _ = np.linalg.qr(powers)
        left = window.answer - basis @ (basis.T @ window.answer)
        total += np.einsum("r,ra,rb->ab", weight, left, left.conj())
        dof += float(weight @ (1.0 - np.sum(basis**2, axis=1)))
    return np.asarray(total / max(dof, 1e-12), dtype=complex), dof


def frequency_response(
    fits: Sequence[LocalFit],
    what: System,
    noises: Sequence[tuple[ComplexArray, float]],
    environment: Environment | None = None,
) -> FrequencyResponse:
    """One system at all frequencies, with the variance that noise and differences between trials make at each.

    Args:
      fits: at each frequency.
      what: "arm", "environment" or "total".
      noises: covariance of the noise at each frequency, (4, 4), and its complex degrees of freedom.
      environment: see `FrequencyResponse`.
    """
    frequency = np.array([fit.frequency for fit in fits])
    joint, factor = np.array([fit.answer for fit in fits]), np.array([fit.factor for fit in fits])
    variance = variance_of(what, joint, np.array([noise for noise, _ in noises]), factor)
    errors = [error_of(what, part[None], fit.by_trial) for part, fit in zip(joint, fits, strict=True)]
    covariance, dof = with_differences(frequency, variance, np.array([dof for _, dof in noises]), errors)
    return FrequencyResponse(
        frequency=frequency,
        response=admittance_of(what, joint),
        covariance=covariance,
        what=what,
        dof=dof,
        environment=environment,
    )


def with_differences(
    frequency: Array, variance: Array, dof: Array, errors: Sequence[ComplexArray]
) -> tuple[Array, Array]:
    """Variance of a response, and its complex degrees of freedom, with what differs between trials.

    Differences of few parameters move a response along few directions: their variance has half the degrees of freedom
    of one that is complex.

    Args:
      frequency: [Hz], (frequency,).
      variance: that noise makes, (frequency, output, input).
      dof: behind that, (frequency,).
      errors: what each trial adds to the response, (trial, output, input) at each frequency.
    """
    n_trials = np.array([len(each) for each in errors])
    if n_trials.min() < FEWEST_TRIALS:
        return variance, dof
    scatter = np.stack([np.sum(np.abs(each) ** 2, axis=0) for each in errors])
    excess = scatter * (n_trials / (n_trials - 1.0))[:, None, None] / np.maximum(variance, np.finfo(float).tiny)
    near = np.abs(np.log2(frequency[:, None] / frequency)) <= REACH
    smooth = np.einsum("fg,goi->foi", near / near.sum(axis=1, keepdims=True), excess)
    wider = np.maximum(smooth, 1.0)
    widest = wider.max(axis=(1, 2))
    of_trials = 0.5 * (n_trials - 1.0)
    return variance * wider, widest**2 / (1.0 / dof + (widest - 1.0) ** 2 / of_trials)


def where_independent(wanted: Array, fit: Callable[[float], LocalFit]) -> dict[float, LocalFit]:
    """Of the wanted frequencies [Hz], those at which the disturbances along x and y are independent, and their fits.

    Below the frequency at which a sweep starts, each axis's spectrum is as smooth as what leaks from the edges.

    Raises:
      DependentDisturbancesError: they are at less than half of the frequencies.
    """
    fits, refusal = {}, None
    for centre in wanted.tolist():
        try:
            fits[centre] = fit(centre)
        except DependentDisturbancesError as error:
            refusal = error
    if refusal is not None and 2 * len(fits) < len(wanted):
        raise refusal
    return fits
