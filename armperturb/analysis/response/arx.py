"""Multivariable ARX models of trials, with the order that gives the wanted frequency response best.

With y = (f, x) and u = d (`joint_records`), at each sample of each trial

    y(k) = c + D u(k) + sum_i [A_i y(k - i) + B_i u(k - i)] + e(k),    i = 1 .. order,

with a constant c per trial. Least squares is consistent as the order grows with the data, whatever the colour of the
noise (Ljung & Wahlberg 1992, Adv. Appl. Prob. 24), and its order need not be that of the system: lags that reach over
the reflex delay take that in. Any sample may be the first, so that transients are data and trials may differ in length.

Regressors are ordered by lag, so that one triangular factor of all data holds the models of every order.

**Covariance.** With response G = A^-1 B, noise covariance L of e, and Psi the response of the regressors to u,

    dG = A^-1 dtheta^T Psi,    cov(dG_ab, dG_cd) = (A^-1 L A^-H)_ac (Psi^T (Phi^T Phi)^-1 Psi*)_bd.

**Order.** The order that predicts best depends on the noise of the instruments; here a frequency response is wanted.
The order is therefore the one with the least estimated error of that response (a focused criterion: Claeskens & Hjort
2003, JASA 98): variance as above, and the square of the bias from the distance to the highest order,

    |R_n - R_N|^2 - (V_N - V_n),

as the difference of nested least squares varies by the difference of the variances. The variance of the chosen order
alone is too small: it knows neither the bias nor that there was a choice. As the estimated error of the chosen order is
no larger than that of the highest, V_N, a chosen model states V_N as its own.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from armperturb.analysis.response.frequency_response import System
from armperturb.analysis.response.joint_records import admittance_of, variance_of
from armperturb.analysis.response.local_polynomial import N_INPUTS
from armperturb.analysis.trials import TrialRecord
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_whole

HIGHEST_ORDER = 40
"""Lags of the highest order that is tried: 0.2 s at 200 Hz, several times the reflex delay."""

NOISE_FLOOR = 1e-4
"""Least noise of a signal over its standard deviation: without noise, and where nothing is excited, the regressors
depend on each other."""

ROWS_PER_COEFFICIENT = 3
"""Least number of samples for each coefficient of a channel."""


MOST_ROWS = 2**14
"""Equations that are factored at once, for the sake of memory."""


class Arx(NamedTuple):
    """An ARX model of one order.

    Attributes:
      order: number of lags.
      weights: D, then A_i and B_i of each lag, transposed, (regressor, output).
      noise: covariance L of e, (output, output).
      factor: triangular R with R^T R = Phi^T Phi, (regressor, regressor).
      rate: of the samples [Hz].
      highest: model of the highest order that was tried, whose covariance this one states; None for a given order.
    """

    order: int
    weights: Array
    noise: Array
    factor: Array
    rate: float
    highest: "Arx | None" = None

    @property
    def direct(self) -> Array:
        """D, (output, input)."""
        return self.weights[:N_INPUTS].T

    @property
    def past(self) -> Array:
        """A_i and B_i beside one another, (lag, output, output and input)."""
        return self.weights[N_INPUTS:].reshape(self.order, -1, len(self.noise)).swapaxes(1, 2)

    @property
    def largest_pole(self) -> float:
        """Modulus of the largest pole; below 1 if the model is stable."""
        n = len(self.noise)
        companion = np.eye(self.order * n, k=-n)
        companion[:n] = np.concatenate(list(self.past[:, :, :n]), axis=1)
        return float(np.abs(np.linalg.eigvals(companion)).max())

    def response(self, frequency: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """G from d to (f, x), (frequency, 4, 2), with noise and spread as `variance_of` takes them."""
        joint, noise, spread = self.own_response(frequency)
        return joint, *((noise, spread) if self.highest is None else self.highest.own_response(frequency)[1:])

    def own_response(self, frequency: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """The response with the covariance of this order, which holds no bias."""
        n = len(self.noise)
        lag = np.exp(-2j * np.pi * np.outer(frequency / self.rate, np.arange(1, self.order + 1)))
        past = np.einsum("fl,lab->fab", lag, self.past)
        left = np.linalg.inv(np.eye(n) - past[:, :, :n])
        joint = np.asarray(left @ (self.direct + past[:, :, n:]), dtype=complex)
        noise = np.asarray(left @ self.noise @ left.conj().swapaxes(1, 2), dtype=complex)
        to_u = np.broadcast_to(np.eye(N_INPUTS), (len(frequency), N_INPUTS, N_INPUTS))
        lagged = lag[:, :, None, None] * np.concatenate([joint, to_u], axis=1)[:, None]
        regressors = np.concatenate([to_u, lagged.reshape(len(frequency), -1, N_INPUTS)], axis=1)
        columns = np.moveaxis(regressors, 0, -1).reshape(len(self.factor), -1)
        solved = linalg.solve_triangular(self.factor, columns, trans="T").reshape(len(self.factor), N_INPUTS, -1)
        return joint, noise, np.asarray(np.einsum("wbf,wdf->fbd", solved, solved.conj()), dtype=complex)


class Regression:
    """Triangular factor of regressors and responses of all trials, for all orders up to the highest.

    Args:
      records: trials; one that is not longer than the highest order holds no equation.
      highest: order.

    Raises:
      TypeError: highest is not a whole number.
      ValueError: highest is below 1, or the records are too short for it.
    """

    def __init__(self, records: Sequence[TrialRecord], highest: int) -> None:
        require_whole("ARX and subspace models", "highest order", highest, at_least=1)
        self.highest, self.rate = highest, records[0].rate
        trials = [np.concatenate([record.response, record.perturbation], axis=1) for record in records]
        n_samples = sum(map(len, trials))
        self.scale = np.sqrt(sum(np.sum((part - part.mean(axis=0)) ** 2, axis=0) for part in trials) / n_samples)
        """Of the columns of y, then of u."""
        self.n_outputs = len(self.scale) - N_INPUTS
        width = self.width(highest)
        trials = [part / self.scale for part in trials if len(part) > highest + 1]
        self.dof = sum(len(part) - highest - 1 for part in trials)
        """Equations less the constants of the trials."""
        self.n_rows = self.dof + len(trials)
        if self.n_rows < ROWS_PER_COEFFICIENT * width:
            raise ValueError(
                f"order {highest} has {width} coefficients for each channel, and {n_samples} samples at "
                f"{self.rate:g} Hz leave {self.n_rows} equations; expected at least {ROWS_PER_COEFFICIENT * width} "
                "(longer records, more trials, or a lower order)"
            )
        factor = np.sqrt(self.n_rows) * NOISE_FLOOR * np.eye(width, width + self.n_outputs)
        for part in trials:
            mean = np.concatenate([values.mean(axis=0) for values in self._lagged(part, 0, len(part))])
            for start in range(highest, len(part), MOST_ROWS):
                rows = np.concatenate(self._lagged(part, start - highest, start + MOST_ROWS), axis=1)
                stacked = np.concatenate([factor, rows - mean])
                factor = linalg.qr(stacked, mode="r", overwrite_a=True, check_finite=False)[0][: stacked.shape[1]]
        self.factor = factor
        """Columns: u, then y and u of each lag, then y; in units of their scales."""

    def _lagged(self, part: Array, first: int, last: int) -> list[Array]:
        """Columns of equations whose samples are from `first` to before `last`: u, y and u of each lag, y."""
        samples = part[first:last]
        n, now = len(samples), samples[self.highest :]
        lagged = (samples[self.highest - lag : n - lag] for lag in range(1, self.highest + 1))
        return [now[:, self.n_outputs :], *lagged, now[:, : self.n_outputs]]

    def width(self, order: int) -> int:
        """Regressors of an order."""
        return N_INPUTS + order * len(self.scale)

    def coefficients(self, order: int) -> Array:
        """In units of the scales, (regressor, output)."""
        width, outputs = self.width(order), self.width(self.highest)
        return np.asarray(linalg.solve_triangular(self.factor[:width, :width], self.factor[:width, outputs:]))

    def model(self, order: int) -> Arx:
        """The model of an order up to the highest."""
        width = self.width(order)
        of_response = self.scale[: self.n_outputs]
        of_regressor = np.concatenate([self.scale[self.n_outputs :], np.tile(self.scale, order)])
        residual = self.factor[width:, self.width(self.highest) :] * of_response
        return Arx(
            order=order,
            weights=self.coefficients(order) * of_response / of_regressor[:, None],
            noise=residual.T @ residual / (self.dof - width),
            factor=self.factor[:width, :width] * of_regressor,
            rate=self.rate,
        )


def fit_arx(
    records: Sequence[TrialRecord],
    frequency: Array,
    *,
    what: System = "arm",
    order: int | None = None,
    highest_order: int = HIGHEST_ORDER,
) -> Arx:
    """ARX model by least squares.

    Args:
      records: trials of one system.
      frequency: at which the response is wanted [Hz], (frequency,); the order is chosen for it.
      what: response that is wanted.
      order: number of lags; None chooses.
      highest_order: the highest order that is tried.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: an order is below 1, or the records are too short for it.
    """
    if order is not None:
        require_whole("ARX and subspace models", "order", order, at_least=1)
        return Regression(records, order).model(order)
    regression = Regression(records, highest_order)
    models = [regression.model(n) for n in range(1, highest_order + 1)]
    joints = [model.own_response(frequency) for model in models]
    pairs = [(admittance_of(what, joint[0]), variance_of(what, *joint)) for joint in joints]
    errors = [error_over_size(*pair, *pairs[-1]) for pair in pairs]
    return models[int(np.argmin(errors))]._replace(highest=models[-1])


def error_over_size(response: ComplexArray, variance: Array, best: ComplexArray, most: Array) -> float:
    """Estimated mean square of the error over the size of a response [-].

    Args:
      response: that is judged, (frequency, output, input).
      variance: of its elements.
      best: of the highest order, which has no bias.
      most: variance of that one.
    """
    size, distance = (np.sum(np.abs(values) ** 2, axis=(1, 2)) for values in (best, response - best))
    of_this, of_best = variance.sum(axis=(1, 2)), most.sum(axis=(1, 2))
    bias = np.maximum(distance - np.maximum(of_best - of_this, 0.0), 0.0)
    return float(np.mean((bias + of_this) / size))
