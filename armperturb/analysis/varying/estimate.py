"""Least squares of the parallel cascade with parameters that change.

Given delay, activation and threshold of the reflex, the torque is linear in all other parameters. These three are
searched (variable projection, Golub & Pereyra 1973), and the number of splines of each quantity is that which predicts
left-out repetitions, or left-out stretches of a single record, best.

In an ensemble the residual is whitened by an autoregressive model of the noise: maximum likelihood with noise of a
rational spectrum. Over a scheduling variable it is not: what the model lacks outweighs the noise there, and weights
would fit the high frequencies at the cost of the torque that is to be predicted. Standard errors are those of an
estimating equation (sandwich) over repetitions or stretches, which need no model of the noise.
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from scipy import linalg, optimize, signal

from armperturb.analysis.joint.model import Reflex
from armperturb.analysis.varying.bands import Fitted, smoothing_bias
from armperturb.analysis.varying.columns import DEGREE, Cascade, Signals, excitation, signals_of, splines
from armperturb.analysis.varying.result import Curve, VaryingEstimate
from armperturb.arrays import Array, Indices
from armperturb.validation import require_number, require_one_of

Variable = Literal["time", "scheduling"]

CANDIDATES: Mapping[str, tuple[int, ...]] = {"time": (1, 4, 8, 16, 32, 64, 128), "scheduling": (1, 3, 4, 6, 8, 12)}
"""Numbers of splines that are tried for stiffness; those up to `MOST_OF_OTHERS` also for damping and gain."""

MOST_OF_OTHERS = 32

FIRST: Mapping[str, int] = {"time": 8, "scheduling": 4}
"""Splines of each quantity before their numbers are chosen."""

STATIC = 8
"""Splines of the static torque over a scheduling variable."""

SETTLE = 0.3
"""What is left out at the start of each trial, whose reflexes answer to what was before it [s]."""

N_FOLDS = 5
STRETCH = 2.5
"""Length of the stretches of a single record that are left out in turn [s]."""

AR_ORDER = 10
FLOOR = 0.1
"""White noise beside that of the autoregressive model, as a share of the residual's power [-].

A person's noise is low-passed: without a floor, whitening would weigh what the model lacks at high frequencies most."""

N_SEARCHED = 20
"""Repetitions from which the cascade is searched."""

LOWER, UPPER = Cascade(0.01, 1.0, 0.3, -1.0), Cascade(0.15, 20.0, 2.0, 2.0)
STARTS = tuple(Cascade(delay, cutoff, 0.8, 0.0) for delay in (0.03, 0.045, 0.06) for cutoff in (3.0, 6.0))
"""Bounds of the cascade, and where its search may start."""

TYPICAL, DIFFERENCE = Cascade(0.01, 1.0, 0.2, 0.1), 1e-2
"""By how much its parameters are uncertain, and the share of that over which differences are taken [-]."""

REFINED = 2
"""Gauss-Newton steps to the cascade of all repetitions, of which only some are searched."""


class _Normal(NamedTuple):
    """Normal equations of each group of samples: (group, column, column), (group, column), (group,)."""

    gram: Array
    slope: Array
    power: Array

    def solved(self, groups: Indices | slice) -> Array:
        """Coefficients from some of the groups, (column,)."""
        gram, slope = self.gram[groups].sum(axis=0), self.slope[groups].sum(axis=0)
        return np.asarray(linalg.lstsq(gram, slope, lapack_driver="gelsy")[0])

    def cost(self, coefficients: Array, groups: Indices) -> float:
        """Sum of squares that coefficients leave in some groups."""
        gram, slope = self.gram[groups].sum(axis=0), self.slope[groups].sum(axis=0)
        return float(self.power[groups].sum() - 2 * coefficients @ slope + coefficients @ gram @ coefficients)


class _Problem:
    """Regressors of one recording, made when they are asked for."""

    def __init__(self, signals: Signals, reflex: Reflex, fit_until: float | None) -> None:
        self.signals, self.reflex = signals, reflex
        self.quantities = ("stiffness", "damping") + (() if reflex == "none" else ("gain",))
        n_settle = round(SETTLE * signals.rate)
        self.low, self.high = float(signals.variable[:, n_settle:].min()), float(signals.variable.max())
        self.torque = signals.prepared(signals.torque[None])[0]
        n_trials, n_slow = self.torque.shape
        rate = signals.rate / signals.stride
        self.n_used = n_slow if fit_until is None else min(n_slow, round(fit_until * rate))
        self.whitener = np.ones(1)
        self._cached: dict[tuple[str, int, Cascade], Array] = {}
        self.n_left = round(SETTLE * rate)
        n_fitted = self.n_used - self.n_left
        length = n_fitted if signals.ensemble else round(STRETCH * rate)
        of_time = np.minimum(np.arange(n_fitted) // length, max(n_fitted // length, 1) - 1)
        self.group = np.arange(n_trials)[:, None] * (of_time[-1] + 1) + of_time

    def columns(self, quantity: str, n_basis: int, cascade: Cascade) -> Array:
        """Regressors of a quantity that changes, (basis, trial, slow time)."""
        signals = self.signals
        if quantity == "static":
            return signals.prepared(splines(signals.variable, n_basis, self.low, self.high))
        factor = {"stiffness": signals.angle, "damping": signals.velocity}.get(quantity)
        if factor is None:
            factor = excitation(signals, self.reflex, cascade.threshold)
        made = []
        for basis in splines(signals.variable, n_basis, self.low, self.high):  # one at a time, for memory
            product = (basis * factor)[None]
            made.append(signals.prepared(signals.activated(product, cascade) if quantity == "gain" else product)[0])
        return np.stack(made)

    def design(self, orders: Mapping[str, int], cascade: Cascade) -> Array:
        """All regressors: the acceleration first, then each quantity's, (column, trial, slow time)."""
        parts = [self.signals.prepared(self.signals.acceleration[None])]
        parts += [self._remembered(quantity, orders[quantity], cascade) for quantity in self.quantities]
        if not self.signals.ensemble:
            parts.append(self.columns("static", STATIC, cascade))
        return np.concatenate(parts)

    def _remembered(self, quantity: str, n_basis: int, cascade: Cascade) -> Array:
        key = quantity, n_basis, cascade
        if key not in self._cached:
            if any(other != cascade for _, _, other in self._cached):
                self._cached.clear()
            self._cached[key] = self.columns(quantity, n_basis, cascade)
        return self._cached[key]

    def tangents(self, orders: Mapping[str, int], cascade: Cascade, coefficients: Array) -> dict[str, Array]:
        """What a change of the cascade adds to the torque; parameters at a bound are left out.

        Args:
          orders: numbers of splines.
          cascade: about which it changes.
          coefficients: of `design`, (column,).

        Returns:
          Parameter to its derivative, (trial, slow time).
        """
        if self.reflex == "none":
            return {}
        first = 1 + sum(orders[quantity] for quantity in ("stiffness", "damping"))
        weights = coefficients[first : first + orders["gain"]]
        free = [each for each in Cascade._fields if each != "threshold" or self.reflex == "half-wave"]
        inside = [each for each in free if getattr(LOWER, each) < getattr(cascade, each) < getattr(UPPER, each)]
        tangents = {}
        for name in inside:
            there, step = getattr(cascade, name), getattr(TYPICAL, name) * DIFFERENCE
            up, down = (
                self.columns("gain", orders["gain"], cascade._replace(**{name: there + sign * step}))
                for sign in (1.0, -1.0)
            )
            tangents[name] = np.tensordot(weights, up - down, 1) / (2.0 * step)
        return tangents

    def whitened(self, values: Array) -> Array:
        """What is fitted, with white noise; (..., trial, used time)."""
        return np.asarray(signal.lfilter(self.whitener, [1.0], values[..., : self.n_used]))[..., self.n_left :]

    def normal(self, design: Array) -> _Normal:
        """Normal equations of each group."""
        x, y = self.whitened(design), self.whitened(self.torque)
        n_groups = int(self.group.max()) + 1
        gram = np.empty((n_groups, len(x), len(x)))
        slope, power = np.empty((n_groups, len(x))), np.empty(n_groups)
        for i in range(n_groups):
            inside = self.group == i
            rows, values = x[:, inside], y[inside]
            gram[i], slope[i], power[i] = rows @ rows.T, rows @ values, values @ values
        return _Normal(gram, slope, power)

    def whiten(self, design: Array) -> None:
        """Take the noise's spectrum from the residual of a fit, in an ensemble."""
        if not self.signals.ensemble:
            return
        normal = self.normal(design)
        coefficients = normal.solved(np.arange(len(normal.power)))
        left = (self.torque - np.tensordot(coefficients, design, 1))[:, self.n_left : self.n_used]
        length = left.shape[1]
        power = [float(np.mean(left[:, lag:] * left[:, : length - lag])) for lag in range(AR_ORDER + 1)]
        power[0] *= 1.0 + FLOOR
        self.whitener = np.concatenate([[1.0], -linalg.solve_toeplitz(power[:-1], power[1:])])

    def searched(self, orders: Mapping[str, int], start: Cascade | None) -> Cascade:
        """Delay, activation and threshold that leave the least whitened residual."""
        few = slice(0, N_SEARCHED)
        part = self if len(self.torque) <= N_SEARCHED else self._part(few)
        fixed = part.design({**orders, "gain": 1}, STARTS[0])
        first = 1 + sum(orders[quantity] for quantity in ("stiffness", "damping"))
        others = part.whitened(np.delete(fixed, first, axis=0)).reshape(len(fixed) - 1, -1)
        basis = linalg.qr(others.T, mode="economic", pivoting=True)[0]
        target = part.whitened(part.torque).ravel()
        target = target - basis @ (basis.T @ target)
        names = [True, True, True, self.reflex == "half-wave"]

        def left(point: Array) -> Array:
            values = np.array(STARTS[0])
            values[names] = point
            of_gain = part.columns("gain", orders["gain"], Cascade(*values))
            rows = part.whitened(of_gain).reshape(orders["gain"], -1).T
            rows = rows - basis @ (basis.T @ rows)
            return np.asarray(target - rows @ linalg.lstsq(rows, target)[0])

        starts = STARTS if start is None else (start,)
        costs = [float(np.sum(left(np.array(each)[names]) ** 2)) for each in starts]
        begin = np.array(starts[int(np.argmin(costs))])
        searched = optimize.least_squares(
            left,
            begin[names],
            bounds=(np.array(LOWER)[names], np.array(UPPER)[names]),
            x_scale=np.array(TYPICAL)[names],
            diff_step=1e-3,
            xtol=1e-4,
            ftol=1e-6,
            max_nfev=20,
        )
        values = begin.copy()
        values[names] = searched.x
        return Cascade(*map(float, values))

    def _part(self, trials: slice) -> "_Problem":
        s = self.signals
        few = {name: getattr(s, name)[trials] for name in ("angle", "velocity", "acceleration", "torque", "variable")}
        part = _Problem(Signals(**few, rate=s.rate, stride=s.stride, ensemble=s.ensemble), self.reflex, None)
        part.n_used, part.whitener = self.n_used, self.whitener
        part.low, part.high = self.low, self.high
        return part

    def left_out(self, normal: _Normal) -> float:
        """Whitened sum of squares of groups that the fit did not see."""
        groups = np.arange(len(normal.power))
        total = 0.0
        for fold in range(min(N_FOLDS, len(groups))):
            out = groups % N_FOLDS == fold
            total += normal.cost(normal.solved(groups[~out]), groups[out])
        return total


def identify_varying(
    recording: xr.Dataset,
    variable: Variable = "time",
    *,
    reflex: Reflex = "half-wave",
    fit_until: float | None = None,
    n_points: int = 201,
) -> VaryingEstimate:
    """Stiffness, damping and reflex gain of one joint over time in an ensemble, or over a scheduling variable.

    Args:
      recording: of one axis on a position servo: repetitions with different perturbations of the same course of
        parameters, or, for "scheduling", any trials with a scheduling signal.
      variable: what parameters depend on.
      reflex: static nonlinearity of the reflex path, or "none".
      fit_until: time from which on samples are held out [s]; None fits all.
      n_points: of the curves.

    Raises:
      ValueError: the recording is of another kind, an option is unknown, or too little is left to fit.
    """
    require_one_of("identify_varying", "variable", variable, tuple(CANDIDATES))
    require_one_of("identify_varying", "reflex", reflex, ("none", "linear", "half-wave"))
    signals = signals_of(recording, variable)
    last = float(recording["time"].values[-1])
    require_number("identify_varying", "fit_until", fit_until, above=0.0, at_most=last, optional=True)
    problem = _Problem(signals, reflex, fit_until)
    n_groups = int(problem.group.max(initial=0)) + 1
    if n_groups < 2:
        raise ValueError(
            f"recording: {problem.n_used * signals.stride / signals.rate:g} s to fit; expected at least "
            f"{2 * STRETCH:g} s, of which a part is left out in turn"
        )
    orders = dict.fromkeys(problem.quantities, FIRST[variable])
    cascade = Cascade()
    for first in (True, False):
        if reflex != "none":
            cascade = problem.searched(orders, None if first else cascade)
        problem.whiten(problem.design(orders, cascade))
    orders = _chosen(problem, orders, cascade, CANDIDATES[variable])
    if reflex != "none":
        cascade = problem.searched(orders, cascade)
    problem.whiten(problem.design(orders, cascade))
    for _ in range(REFINED if reflex != "none" else 0):
        cascade = Cascade(*np.clip(cascade + _solved(problem, orders, cascade).step, LOWER, UPPER).tolist())
    return _estimate(problem, orders, cascade, variable, n_points)


def _chosen(
    problem: _Problem, orders: Mapping[str, int], cascade: Cascade, candidates: tuple[int, ...]
) -> dict[str, int]:
    """Numbers of splines that predict left-out groups best, one quantity after the other, twice."""
    chosen = dict(orders)
    scores: dict[tuple[int, ...], float] = {}
    for _ in range(2):
        for quantity in problem.quantities:
            allowed = [n for n in candidates if quantity == "stiffness" or n <= MOST_OF_OTHERS]
            for n_basis in allowed:
                tried = {**chosen, quantity: n_basis}
                key = tuple(tried.values())
                if key not in scores:
                    scores[key] = problem.left_out(problem.normal(problem.design(tried, cascade)))
            chosen[quantity] = min(allowed, key=lambda n: scores[tuple({**chosen, quantity: n}.values())])
    return chosen


class _Solution(NamedTuple):
    """Coefficients of all regressors, and what is known of them.

    Attributes:
      orders: numbers of splines.
      coefficients: of `_Problem.design`, (column,).
      covariance: of their errors, those of the cascade counted, (column, column).
      step: to the cascade that leaves the least, as far as the model is linear there, (parameter of `Cascade`,).
    """

    orders: Mapping[str, int]
    coefficients: Array
    covariance: Array
    step: Array

    def curve(self, problem: _Problem, quantity: str, grid: Array) -> Fitted:
        """A quantity on a grid."""
        names = list(problem.quantities)
        first = 1 + sum(self.orders[name] for name in names[: names.index(quantity)])
        part = slice(first, first + self.orders[quantity])
        basis = splines(grid, self.orders[quantity], problem.low, problem.high)
        error = np.sqrt(np.einsum("bp,bc,cp->p", basis, self.covariance[part, part], basis))
        return Fitted(self.coefficients[part] @ basis, error)


def _solved(problem: _Problem, orders: Mapping[str, int], cascade: Cascade) -> _Solution:
    """Least squares, with the cascade as one more unknown near where it was found."""
    design = problem.design(orders, cascade)
    n = len(design)
    coefficients = problem.normal(design).solved(slice(None))
    tangents = problem.tangents(orders, cascade, coefficients)
    step = np.zeros(len(cascade))
    normal = problem.normal(np.concatenate([design, *(tangent[None] for tangent in tangents.values())]))
    n_groups = len(normal.power)
    coefficients = normal.solved(slice(None))
    for place, name in enumerate(tangents):
        step[Cascade._fields.index(name)] = coefficients[n + place]
    size = np.sqrt(np.diag(normal.gram.sum(axis=0)))
    inverse = linalg.pinvh(normal.gram.sum(axis=0) / np.outer(size, size)) / np.outer(size, size)
    scores = normal.slope - normal.gram @ coefficients
    covariance = inverse @ (scores.T @ scores) @ inverse * n_groups / (n_groups - 1.0)
    return _Solution(orders, coefficients[:n], covariance[:n, :n], step)


def _estimate(
    problem: _Problem, orders: Mapping[str, int], cascade: Cascade, variable: Variable, n_points: int
) -> VaryingEstimate:
    whole = _solved(problem, orders, cascade)
    grid = np.linspace(problem.low, problem.high, n_points)
    curves = {}
    for quantity in problem.quantities:
        curve, n_basis = whole.curve(problem, quantity, grid), orders[quantity]
        bias = np.zeros(n_points)
        if n_basis >= 4:
            halved, quartered = (
                _solved(problem, {**orders, quantity: n}, cascade).curve(problem, quantity, grid)
                for n in (n_basis // 2, n_basis // 4)
            )
            bias = smoothing_bias(curve, halved, quartered, round(n_points / max(n_basis // 2 - DEGREE, 1)))
        curves[quantity] = Curve(curve.value, np.hypot(curve.standard_error, bias), n_basis)
    left = problem.torque - np.tensordot(whole.coefficients, problem.design(orders, cascade), 1)
    used, rest = slice(problem.n_left, problem.n_used), slice(problem.n_used, None)

    def vaf(part: slice) -> float:
        return float(100.0 * (1.0 - left[:, part].var() / problem.torque[:, part].var()))

    options: dict[str, Any] = {"n_trials": len(problem.torque), "reflex": problem.reflex, "cascade": cascade}
    return VaryingEstimate(
        variable=variable,
        grid=grid,
        curves=curves,
        inertia=float(whole.coefficients[0]),
        inertia_error=float(np.sqrt(whole.covariance[0, 0])),
        vaf=vaf(used),
        held_out_vaf=vaf(rest) if problem.n_used < problem.torque.shape[1] else None,
        **options,
    )
