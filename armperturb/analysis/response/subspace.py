"""Subspace models of trials: optimised predictor-based subspace identification.

Of the joint system from u = d to y = (f, x) (`joint_records`) in innovation form

    s(k+1) = A s(k) + B u(k) + K e(k),    y(k) = C s(k) + D u(k) + e(k),

the state is, but for what came before the past window, a sum over past data: s(k) = M z(k), with z(k) the y and u of
the last p samples. The ARX model of the same data with p lags (`arx`) gives the product Gamma M of the extended
observability matrix and M; its singular values, weighted with the spread of z, tell which states matter. With states
known, A, B, C, D and K are least squares (Chiuso 2007, Automatica 43: PBSIDopt). The method bears feedback from y to
later u; here, from the disturbance on, there is none.

The states of the next sample are those of z(k+1), which is z(k) less its oldest lag, with u(k) and y(k). So all is
linear in what the regression's triangular factor holds, and data are visited once.

**Order.** As for ARX models, the one whose estimated error of the wanted response is least, among those that are
stable. The ARX model of p lags is taken to have no bias; its 4p states vary as its covariance says, and n of them by
the share n / 4p of that. This serves to choose only: the method has no covariance that is as simple as that of ARX.
"""

import warnings
from typing import NamedTuple

import numpy as np

from armperturb.analysis.response.arx import Regression, error_over_size, require_order
from armperturb.analysis.response.frequency_response import System
from armperturb.analysis.response.joint_records import JointRecords, admittance_of, variance_of
from armperturb.arrays import Array, ComplexArray

PAST = 24
"""Lags of the past window, and samples of the future one: 0.12 s at 200 Hz, four times the reflex delay."""

MOST_STATES = 60
"""Largest order among which is chosen."""


class Subspace(NamedTuple):
    """A state-space model in innovation form.

    Attributes:
      a: (state, state).
      b: (state, input).
      c: (output, state).
      d: (output, input).
      k: gain of the innovations, (state, output).
      noise: covariance of the innovations, (output, output).
      singular_values: by which states were ordered, (at most past times outputs,).
      rate: of the samples [Hz].
    """

    a: Array
    b: Array
    c: Array
    d: Array
    k: Array
    noise: Array
    singular_values: Array
    rate: float

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)

    @property
    def largest_pole(self) -> float:
        """Modulus of the largest pole; below 1 if the model is stable."""
        return float(np.abs(np.linalg.eigvals(self.a)).max())

    def response(self, frequency: Array) -> ComplexArray:
        """G from d to (f, x), (frequency, 4, 2)."""
        z = np.exp(2j * np.pi * np.asarray(frequency) / self.rate)
        resolvent = z[:, None, None] * np.eye(self.order) - self.a
        return np.asarray(
            self.c @ np.linalg.solve(resolvent, np.broadcast_to(self.b, (len(z), *self.b.shape))) + self.d
        )


def fit_subspace(
    records: JointRecords, frequency: Array, *, what: System = "arm", order: int | None = None, past: int = PAST
) -> Subspace:
    """State-space model by PBSIDopt.

    Args:
      records: trials of one system.
      frequency: at which the response is wanted [Hz], (frequency,); the order is chosen for it.
      what: response that is wanted.
      order: number of states; None chooses.
      past: lags of the past window.

    Warns:
      RuntimeWarning: the model is unstable.

    Raises:
      TypeError: an order is not a whole number.
      ValueError: an order is below 1, or higher than the past window bears, or the records are too short for it.
    """
    require_order("past", past)
    if order is not None:
        require_order("order", order)
    regression = Regression(records, past)
    states = _States(regression)
    if order is not None:
        if order > len(states.singular_values):
            raise ValueError(
                f"order = {order!r}; expected at most {len(states.singular_values)} with past = {past} (a longer past)"
            )
        chosen = states.model(order)
    else:
        reference = regression.model(past).response(frequency)
        best, variance = admittance_of(what, reference[0]), variance_of(what, *reference)
        n_states = past * regression.n_outputs
        models = [states.model(n) for n in range(1, min(MOST_STATES, n_states) + 1)]
        models = [model for model in models if model.largest_pole < 1.0] or models
        errors = [
            error_over_size(
                admittance_of(what, model.response(frequency)), variance * model.order / n_states, best, variance
            )
            for model in models
        ]
        chosen = models[int(np.argmin(errors))]
    if chosen.largest_pole >= 1.0:
        warnings.warn(
            f"the subspace model of order {chosen.order} is unstable (a pole of modulus {chosen.largest_pole:.4f})",
            RuntimeWarning,
            stacklevel=2,
        )
    return chosen


class _States:
    """States of all samples, as columns over the rows of the regression's factor, most important first."""

    def __init__(self, regression: Regression) -> None:
        past, n_inputs, n_outputs = regression.highest, regression.n_inputs, regression.n_outputs
        n_both = n_inputs + n_outputs
        self._regression = regression
        self._u = regression.factor[:, :n_inputs]
        lagged = regression.factor[:, n_inputs:-n_outputs]
        self._y = regression.factor[:, -n_outputs:]
        markov = regression.coefficients(past).T[:, n_inputs:]
        product = np.zeros((past * n_outputs, past * n_both))
        for step in range(past):
            # What is older than the window has died away.
            product[step * n_outputs : (step + 1) * n_outputs, : (past - step) * n_both] = markov[:, step * n_both :]
        spread = lagged[n_inputs : n_inputs + past * n_both]
        u, values, _ = np.linalg.svd(product @ spread.T / np.sqrt(regression.n_rows), full_matrices=False)
        # Without noise the last ones are round-off.
        self.singular_values = values[values > 1e-12 * values[0]]
        n_states = len(self.singular_values)
        self._of_past = u[:, :n_states].T @ product / np.sqrt(self.singular_values)[:, None]
        self._now = lagged @ self._of_past.T
        self._next = np.concatenate([self._y, self._u, lagged[:, :-n_both]], axis=1) @ self._of_past.T

    def model(self, order: int) -> Subspace:
        """The model of the first states."""
        regression = self._regression
        now = np.concatenate([self._now[:, :order], self._u], axis=1)
        to_y = np.linalg.lstsq(now, self._y, rcond=None)[0]
        innovations = self._y - now @ to_y
        # Innovations are orthogonal to what explains y: both regressions stay apart.
        to_next = np.linalg.lstsq(now, self._next[:, :order], rcond=None)[0]
        gain = np.linalg.lstsq(innovations, self._next[:, :order], rcond=None)[0]
        dof = regression.n_rows - regression.n_trials - now.shape[1]
        y_scale, u_scale = regression.response_scale, regression.input_scale
        return Subspace(
            a=to_next[:order].T,
            b=to_next[order:].T / u_scale,
            c=to_y[:order].T * y_scale[:, None],
            d=to_y[order:].T * y_scale[:, None] / u_scale,
            k=gain.T / y_scale,
            noise=innovations.T @ innovations / dof * np.outer(y_scale, y_scale),
            singular_values=self.singular_values,
            rate=regression.rate,
        )
