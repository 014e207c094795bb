"""Subspace models of trials: optimised predictor-based subspace identification.

Of the joint system from u = d to y = (f, x) (`joint_records`) in innovation form

    s(k+1) = A s(k) + B u(k) + K e(k),    y(k) = C s(k) + D u(k) + e(k),

the state is, but for what came before the past window, a sum over past data: s(k) = M z(k), with z(k) the y and u of
the last p samples. The ARX model of the same data with p lags (`arx`) gives the product Gamma M of the extended
observability matrix and M; its singular values, weighted with the spread of z, rank the states. With states known, A,
B, C and D are least squares (Chiuso 2007, Automatica 43: PBSIDopt).

The states of the next sample are those of z(k+1), which is z(k) less its oldest lag, with u(k) and y(k). So all is
linear in what the regression's triangular factor holds, and data are visited once.

**Order.** As for ARX models, the one with the least estimated error of the wanted response, among those that are
stable. The ARX model of p lags is taken to have no bias; its 4p states vary as its covariance says, and n of them by
the share n / 4p of that. This serves the choice alone: the covariance of an estimate comes from the jackknife.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.response.arx import Regression, error_over_size
from armperturb.analysis.response.frequency_response import System
from armperturb.analysis.response.joint_records import admittance_of, variance_of
from armperturb.analysis.response.local_polynomial import N_INPUTS
from armperturb.analysis.trials import TrialRecord
from armperturb.arrays import Array, ComplexArray
from armperturb.validation import require_whole

PAST = 24
"""Lags of the past window, and samples of the future one: 0.12 s at 200 Hz, four times the reflex delay."""

MOST_STATES = 60
"""Highest order that is tried."""


class Subspace(NamedTuple):
    """A state-space model.

    Attributes:
      a: (state, state).
      b: (state, input).
      c: (output, state).
      d: (output, input).
      singular_values: by which states were ranked, (at most past times outputs,).
      rate: of the samples [Hz].
    """

    a: Array
    b: Array
    c: Array
    d: Array
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
        z = np.exp(2j * np.pi * np.asarray(frequency) / self.rate)[:, None, None]
        states = np.linalg.solve(z * np.eye(self.order) - self.a, np.broadcast_to(self.b, (len(z), *self.b.shape)))
        return np.asarray(self.c @ states + self.d)


def fit_subspace(
    records: Sequence[TrialRecord],
    frequency: Array,
    *,
    what: System = "arm",
    order: int | None = None,
    past: int = PAST,
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
    require_whole("ARX and subspace models", "past", past, at_least=1)
    if order is not None:
        require_whole("ARX and subspace models", "order", order, at_least=1)
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
        shares = [(admittance_of(what, model.response(frequency)), model.order / n_states) for model in models]
        errors = [error_over_size(response, variance * share, best, variance) for response, share in shares]
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
        past, n_outputs, n_both = regression.highest, regression.n_outputs, len(regression.scale)
        self._regression = regression
        self._u, lagged, self._y = np.split(regression.factor, [N_INPUTS, regression.width(past)], axis=1)
        markov = regression.coefficients(past).T[:, N_INPUTS:]
        product = np.zeros((past * n_outputs, past * n_both))
        for step in range(past):
            # What is older than the window has died away.
            product[step * n_outputs : (step + 1) * n_outputs, : (past - step) * n_both] = markov[:, step * n_both :]
        spread = lagged[N_INPUTS : N_INPUTS + past * n_both]
        u, values, _ = np.linalg.svd(product @ spread.T / np.sqrt(regression.n_rows), full_matrices=False)
        # Without noise the last ones are round-off.
        self.singular_values = values[values > 1e-12 * values[0]]
        of_past = u[:, : len(self.singular_values)].T @ product / np.sqrt(self.singular_values)[:, None]
        self._now = lagged @ of_past.T
        self._next = np.concatenate([self._y, self._u, lagged[:, :-n_both]], axis=1) @ of_past.T

    def model(self, order: int) -> Subspace:
        """The model of the first states."""
        now = np.concatenate([self._now[:, :order], self._u], axis=1)
        to_y, to_next = (np.linalg.lstsq(now, part, rcond=None)[0].T for part in (self._y, self._next[:, :order]))
        y_scale, u_scale = np.split(self._regression.scale, [self._regression.n_outputs])
        return Subspace(
            a=to_next[:, :order],
            b=to_next[:, order:] / u_scale,
            c=to_y[:, :order] * y_scale[:, None],
            d=to_y[:, order:] * y_scale[:, None] / u_scale,
            singular_values=self.singular_values,
            rate=self._regression.rate,
        )
