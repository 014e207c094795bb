"""Multivariable ARX models of trials, with the order that tells the wanted frequency response best.

With y = (f, x) and u = d (`joint_records`), at each sample of each trial

    y(k) = c + D u(k) + sum_i [A_i y(k - i) + B_i u(k - i)] + e(k),    i = 1 .. order,

with a constant c per trial. Least squares is consistent as the order grows with the data, whatever the colour of the
noise (Ljung & Wahlberg 1992, Adv. Appl. Prob. 24), and its order need not be that of the system: lags that reach over
the reflex delay take that in. A model starts anywhere, so that transients are data, and trials may have any lengths.

Regressors stand in the order of their lags. One triangular factor of all data then holds the models of every order.

**Covariance.** With response G = A^-1 B, noise covariance L of e, and Psi the response of the regressors to u,

    dG = A^-1 dtheta^T Psi,    cov(dG_ab, dG_cd) = (A^-1 L A^-H)_ac (Psi^T (Phi^T Phi)^-1 Psi*)_bd.

**Order.** What predicts best is a question of the instruments' noise; what is asked is a frequency response. The order
is therefore the one whose estimated error of the wanted response is least (a focused criterion: Claeskens & Hjort 2003,
JASA 98): variance as above, and the square of the bias from the distance to the highest order,

    |R_n - R_N|^2 - (V_N - V_n),

as the difference of nested least squares varies by the difference of the variances. The variance of an order that was
chosen so tells too little: it knows neither the bias nor that there was a choice. An order is chosen because its
estimated error is no greater than that of the highest, which is V_N. So V_N is what a chosen model gives for its own.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from armperturb.analysis.response.frequency_response import System
from armperturb.analysis.response.joint_records import JointRecords, admittance_of, variance_of
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_number

HIGHEST_ORDER = 40
"""Lags of the highest order among which is chosen: 0.2 s at 200 Hz, several times the reflex delay."""

NOISE_FLOOR = 1e-4
"""No signal is taken to be less noisy than this share of its standard deviation: without noise, and where nothing is
excited, the regressors depend on each other."""

ROWS_PER_COEFFICIENT = 3
"""Samples there must be for each coefficient of a channel."""


class Arx(NamedTuple):
    """An ARX model of one order.

    Attributes:
      order: number of lags.
      past_response: A_i, (lag, output, output).
      past_input: B_i, (lag, output, input).
      direct: D, (output, input).
      noise: covariance L of e, (output, output).
      factor: triangular R with R^T R = Phi^T Phi, of regressors and responses in their own scale.
      input_scale: of u in the factor, (input,).
      response_scale: of y in the factor, (output,).
      rate: of the samples [Hz].
      highest: model of the highest order among which this one was chosen, whose covariance it gives for its own; None
        for an order that was given.
    """

    order: int
    past_response: Array
    past_input: Array
    direct: Array
    noise: Array
    factor: Array
    input_scale: Array
    response_scale: Array
    rate: float
    highest: "Arx | None" = None

    @property
    def largest_pole(self) -> float:
        """Modulus of the largest pole; below 1 if the model is stable."""
        n_outputs = len(self.direct)
        companion = np.eye(self.order * n_outputs, k=-n_outputs)
        companion[:n_outputs] = np.concatenate(list(self.past_response), axis=1)
        return float(np.abs(np.linalg.eigvals(companion)).max())

    def response(self, frequency: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """G from d to (f, x), (frequency, 4, 2), with noise and spread as `variance_of` takes them."""
        joint, noise, spread = self.own_response(frequency)
        return joint, *((noise, spread) if self.highest is None else self.highest.own_response(frequency)[1:])

    def own_response(self, frequency: Array) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """The same with the covariance of this order, which holds no bias."""
        lag = np.exp(-2j * np.pi * np.outer(frequency / self.rate, np.arange(1, self.order + 1)))
        left = np.linalg.inv(np.eye(len(self.direct)) - np.einsum("fl,lac->fac", lag, self.past_response))
        joint = np.asarray(left @ (self.direct + np.einsum("fl,lab->fab", lag, self.past_input)), dtype=complex)
        noise = np.asarray(left @ self.noise @ left.conj().swapaxes(1, 2), dtype=complex)
        # ComplexArray of the regressors, in the scale of the factor; inputs come first, then each lag's y and u.
        to_u = np.broadcast_to(np.diag(1.0 / self.input_scale), (len(frequency), *2 * (len(self.input_scale),)))
        of_lag = np.concatenate([joint / self.response_scale[:, None], to_u], axis=1)
        lagged = (lag[:, :, None, None] * of_lag[:, None]).reshape(len(frequency), -1, self.direct.shape[1])
        regressors = np.concatenate([to_u, lagged], axis=1)
        columns = np.moveaxis(regressors, 0, -1).reshape(len(self.factor), -1)
        solved = linalg.solve_triangular(self.factor, columns, trans="T")
        solved = solved.reshape(len(self.factor), -1, len(frequency))
        return joint, noise, np.asarray(np.einsum("wbf,wdf->fbd", solved, solved.conj()), dtype=complex)


class Regression:
    """Triangular factor of regressors and responses of all trials, for all orders up to the highest.

    Args:
      records: trials; one that is not longer than the highest order says nothing.
      highest: order.

    Raises:
      TypeError: highest is not a whole number.
      ValueError: highest is below 1, or the records are too short for it.
    """

    def __init__(self, records: JointRecords, highest: int) -> None:
        require_order("highest order", highest)
        self.highest, self.rate = highest, records.rate
        self.n_inputs, self.n_outputs = records.perturbation[0].shape[1], records.response[0].shape[1]
        self.input_scale = _deviation(records.perturbation)
        self.response_scale = _deviation(records.response)
        width = self.width(highest)
        trials = [
            (u / self.input_scale, y / self.response_scale)
            for u, y in zip(records.perturbation, records.response, strict=True)
            if len(u) > highest + 1
        ]
        self.n_rows = sum(len(u) - highest for u, _ in trials)
        self.n_trials = len(trials)
        if self.n_rows < ROWS_PER_COEFFICIENT * width:
            raise ValueError(
                f"order {highest} has {width} coefficients for each channel, and {records.n_samples} samples at "
                f"{records.rate:g} Hz leave {self.n_rows} equations; expected at least {ROWS_PER_COEFFICIENT * width} "
                "(longer records, more trials, or a lower order)"
            )
        factor = np.sqrt(self.n_rows) * NOISE_FLOOR * np.eye(width, width + self.n_outputs)
        for u, y in trials:
            both = np.concatenate([y, u], axis=1)
            lagged = [both[highest - lag : len(u) - lag] for lag in range(1, highest + 1)]
            rows = np.concatenate([u[highest:], *lagged, y[highest:]], axis=1)
            stacked = np.concatenate([factor, rows - rows.mean(axis=0)])
            factor = linalg.qr(stacked, mode="r", overwrite_a=True, check_finite=False)[0][: stacked.shape[1]]
        self.factor = factor
        """Columns: u, then y and u of each lag, then y; in units of their scales."""

    def width(self, order: int) -> int:
        """Regressors of an order."""
        return self.n_inputs + order * (self.n_inputs + self.n_outputs)

    def coefficients(self, order: int) -> Array:
        """In units of the scales, (regressor, output)."""
        width, answers = self.width(order), self.width(self.highest)
        return np.asarray(linalg.solve_triangular(self.factor[:width, :width], self.factor[:width, answers:]))

    def model(self, order: int) -> Arx:
        """The model of an order up to the highest."""
        width, answers = self.width(order), self.width(self.highest)
        left_over = self.factor[width:, answers:]
        noise = left_over.T @ left_over / (self.n_rows - self.n_trials - width)
        scaled = self.coefficients(order).T * self.response_scale[:, None]
        of_lag = scaled[:, self.n_inputs :].reshape(self.n_outputs, order, -1).swapaxes(0, 1)
        return Arx(
            order=order,
            past_response=of_lag[:, :, : self.n_outputs] / self.response_scale,
            past_input=of_lag[:, :, self.n_outputs :] / self.input_scale,
            direct=scaled[:, : self.n_inputs] / self.input_scale,
            noise=noise * np.outer(self.response_scale, self.response_scale),
            factor=self.factor[:width, :width],
            input_scale=self.input_scale,
            response_scale=self.response_scale,
            rate=self.rate,
        )


def fit_arx(
    records: JointRecords,
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
      highest_order: among which is chosen.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: an order is below 1, or the records are too short for it.
    """
    if order is not None:
        require_order("order", order)
        return Regression(records, order).model(order)
    regression = Regression(records, highest_order)
    models = [regression.model(n) for n in range(1, highest_order + 1)]
    joints = [model.own_response(frequency) for model in models]
    found = [admittance_of(what, joint) for joint, _, _ in joints]
    variances = [variance_of(what, *joint) for joint in joints]
    errors = [
        error_over_size(response, variance, found[-1], variances[-1])
        for response, variance in zip(found, variances, strict=True)
    ]
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
    own, all_of_it = variance.sum(axis=(1, 2)), most.sum(axis=(1, 2))
    bias = np.maximum(distance - np.maximum(all_of_it - own, 0.0), 0.0)
    return float(np.mean((bias + own) / size))


def require_order(name: str, order: int) -> None:
    """Refuse an order that is no whole number of at least 1.

    Raises:
      TypeError: it is no whole number.
      ValueError: it is below 1.
    """
    require_number("ARX and subspace models", name, order, at_least=1)
    if not isinstance(order, int | np.integer):
        raise TypeError(f"ARX and subspace models: {name} = {order!r}; expected a whole number")


def _deviation(trials: tuple[Array, ...]) -> Array:
    n_samples = sum(map(len, trials))
    return np.sqrt(sum(np.sum((one - one.mean(axis=0)) ** 2, axis=0) for one in trials) / n_samples)
