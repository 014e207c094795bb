"""Bounded nonlinear least squares for many problems at once: the trust-region reflective method.

Minimises |r(x)|^2 / 2 within l < x < u for every problem of a batch. All problems step in lockstep, each with its own
trust region, so that the cost of interpreting a step is shared; those that have ended leave the batch.

Source: Branch, Coleman and Li (1999), SIAM J. Sci. Comput. 21, 1-23, whose subspace step is replaced by the exact one
of the Gauss-Newton model (More 1978), as in SciPy's `least_squares(method="trf")` and with its tolerances. With g the
gradient, v_i the distance to the bound that -g_i points at (one if there is none) and D = diag(v)^(1/2), the step D s
minimises

    m(s) = g^T D s + s^T (D J^T J D + C) s / 2,    C = diag(|g_i|) where v_i is a distance, within |s| <= radius.

A step that leaves the bounds competes with its reflection at them and with the steepest descent.
"""

from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array

INSIDE = 1e-10
"""How far inside its bounds a problem starts at least, relative to a bound above one."""

STEP_BACK = 0.995
"""Share of the way to a bound that a step goes at least, unless the gradient has nearly vanished."""

RADIUS_ERROR = 0.01
"""Relative error of a step's length, where the radius limits it."""

MAX_LENGTH_STEPS = 10
"""Newton steps for the length of a step."""

NOT_FINITE, EVALUATIONS_REACHED, NO_GRADIENT, COST_SETTLED, STEP_SETTLED, BOTH_SETTLED = range(-1, 5)
"""Why a problem ended."""


class Problems(Protocol):
    """A batch of problems of the same size."""

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Residuals, (batch, residual), and their derivatives, (batch, residual, parameter), at x, (batch, parameter).

        A point at which any of them is not finite is refused as too long a step.
        """

    def take(self, index: NDArray[np.int64]) -> Self:
        """Some of the problems, in this order."""


class Minimum(NamedTuple):
    """Where the problems of a batch ended.

    Attributes:
      x: (batch, parameter).
      cost: half the sum of squared residuals, (batch,); not finite where it is not so at the start, which is x then.
      status: one of the constants of this module, (batch,).
      n_evaluations: (batch,).
    """

    x: Array
    cost: Array
    status: NDArray[np.int64]
    n_evaluations: NDArray[np.int64]


class _Model(NamedTuple):
    """The quadratic model m of the head of this module, of each problem.

    Attributes:
      scale: diagonal of D, (batch, parameter).
      gradient: D g, (batch, parameter).
      curvature: D J^T J D + C, (batch, parameter, parameter).
      step_back: share of the way to a bound that may be gone, (batch,).
    """

    scale: Array
    gradient: Array
    curvature: Array
    step_back: Array


@np.errstate(all="ignore")  # what overflows or divides by zero is dealt with where it is used
def minimise(
    problems: Problems,
    start: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    ftol: float,
    xtol: float,
    max_nfev: ArrayLike,
    sizes: ArrayLike | None = None,
) -> Minimum:
    """Local minimum of each problem of a batch.

    Args:
      problems: the batch.
      start: (batch, parameter); what is on or outside a bound starts just inside.
      lower: bounds, (parameter,) or (batch, parameter); infinite where there is none.
      upper: likewise.
      ftol: a problem ends when a step reduces its cost by less than this share, and the model was right about it.
      xtol: a problem ends when a step is shorter than this share of x.
      max_nfev: evaluations after which a problem ends in any case, that of the start included; of all or each.
      sizes: how many parameters each problem has, the first ones, (batch,); the others are there for the sake of larger
        problems, and change nothing. By default problems have all.

    Raises:
      ValueError: a lower bound is not below its upper bound.
    """
    first = np.atleast_2d(np.asarray(start, dtype=float))
    lower, upper = (np.broadcast_to(np.asarray(bound, dtype=float), first.shape) for bound in (lower, upper))
    if not (lower < upper).all():
        where = tuple(np.argwhere(~(lower < upper))[0])
        raise ValueError(f"bounds = {lower[where]:g} to {upper[where]:g}; expected a lower below an upper bound")
    limits = np.broadcast_to(np.asarray(max_nfev), len(first))
    sizes = np.broadcast_to(first.shape[1] if sizes is None else np.asarray(sizes), len(first))
    x = _inside(first, lower, upper, INSIDE)
    cost, gradient, hessian = _squares(*problems.evaluate(x))
    distance, _ = _distance(x, gradient, lower, upper)
    radius = _norm(x / np.sqrt(distance))
    radius[~(radius > 0) | ~np.isfinite(radius)] = 1.0
    damping = np.zeros(len(x))

    index, n = np.arange(len(x)), 1
    outcome = Minimum(x.copy(), cost.copy(), np.full(len(x), EVALUATIONS_REACHED), np.full(len(x), 1))
    ended = ~_finite(cost, hessian)
    outcome.status[ended] = NOT_FINITE
    while True:
        distance, sign = _distance(x, gradient, lower, upper)
        vanished = ~gradient.any(axis=1) & ~ended
        if vanished.any():
            outcome.status[index[vanished]] = NO_GRADIENT
            ended |= vanished
        ended |= n >= limits
        if ended.any():
            gone = index[ended]
            outcome.x[gone], outcome.cost[gone], outcome.n_evaluations[gone] = x[ended], cost[ended], n
            remaining = np.flatnonzero(~ended)
            index = index[remaining]
            if not len(index):
                return outcome
            problems = problems.take(remaining)
            limits, sizes = limits[remaining], sizes[remaining]
            x, cost, gradient, hessian, radius, damping, lower, upper, distance, sign = (
                values[remaining]
                for values in (x, cost, gradient, hessian, radius, damping, lower, upper, distance, sign)
            )

        model = _model(gradient, hessian, distance, sign)
        step, damping = _longest(model, radius, damping, sizes)
        step, predicted = _feasible(model, step, radius, x, lower, upper)
        moved = model.scale * step
        there = _inside(x + moved, lower, upper, 0.0)
        new_cost, new_gradient, new_hessian = _squares(*problems.evaluate(there))
        n += 1

        length = _norm(step)
        finite = _finite(new_cost, new_hessian)
        reduction = np.where(finite, cost - new_cost, -np.inf)
        ratio = np.where(predicted > 0, reduction / predicted, np.where(reduction == predicted, 1.0, 0.0))
        new_radius = np.where(ratio < 0.25, 0.25 * length, radius)
        new_radius[(ratio > 0.75) & (length > 0.95 * radius)] *= 2.0
        damping *= radius / new_radius
        radius = new_radius

        settled = finite & (reduction < ftol * cost) & (ratio > 0.25)
        short = finite & (_norm(moved) < xtol * (xtol + _norm(x)))
        ended = settled | short
        if ended.any():
            why = np.where(settled, np.where(short, BOTH_SETTLED, COST_SETTLED), STEP_SETTLED)
            outcome.status[index[ended]] = why[ended]
        better = reduction > 0
        if better.all():
            x, cost, gradient, hessian = there, new_cost, new_gradient, new_hessian
        else:
            for old, new in ((x, there), (cost, new_cost), (gradient, new_gradient), (hessian, new_hessian)):
                old[better] = new[better]


def _squares(residual: Array, jacobian: Array) -> tuple[Array, Array, Array]:
    """Cost, its gradient, and J^T J."""
    transposed = jacobian.swapaxes(1, 2)
    gradient = (transposed @ residual[..., None])[..., 0]
    return 0.5 * np.sum(residual**2, axis=-1), gradient, transposed @ jacobian


def _inside(x: Array, lower: Array, upper: Array, margin: float) -> Array:
    """What is on or outside a bound moved inside: by the margin, or the next number that there is."""
    low = lower + margin * np.maximum(1.0, np.abs(lower)) if margin else np.nextafter(lower, upper)
    high = upper - margin * np.maximum(1.0, np.abs(upper)) if margin else np.nextafter(upper, lower)
    narrow = ~(low <= high)
    middle = 0.5 * (lower + upper)
    low, high = np.where(narrow, middle, low), np.where(narrow, middle, high)
    # Bounds that are infinite leave no margin to keep.
    low, high = np.where(np.isfinite(lower), low, -np.inf), np.where(np.isfinite(upper), high, np.inf)
    return np.clip(x, low, high)


def _finite(cost: Array, hessian: Array) -> NDArray[np.bool_]:
    """Whether a problem can go on from here."""
    return np.asarray(np.isfinite(cost) & np.isfinite(hessian).all(axis=(1, 2)))


def _norm(values: Array) -> Array:
    return np.sqrt(np.sum(values**2, axis=-1))


def _dot(a: Array, b: Array) -> Array:
    return np.sum(a * b, axis=-1)


def _distance(x: Array, gradient: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Distance v to the bound that the descent points at, one where there is none, and its derivative."""
    to_upper, to_lower = (gradient < 0) & np.isfinite(upper), (gradient > 0) & np.isfinite(lower)
    distance = np.where(to_upper, upper - x, np.where(to_lower, x - lower, 1.0))
    return distance, np.asarray(to_lower * 1.0 - to_upper)


def _model(gradient: Array, hessian: Array, distance: Array, sign: Array) -> _Model:
    scale = np.sqrt(distance)
    curvature = hessian * (scale[:, None] * scale[..., None])
    diagonal = np.arange(curvature.shape[-1])
    curvature[:, diagonal, diagonal] += gradient * sign
    steepest = np.abs(gradient * distance).max(axis=1)
    return _Model(scale, scale * gradient, curvature, np.maximum(STEP_BACK, 1.0 - steepest))


def _longest(model: _Model, radius: Array, damping: Array, sizes: NDArray[np.int64]) -> tuple[Array, Array]:
    """Minimum of the model within the radius, (batch, parameter), and the damping that it takes, (batch,).

    Along directions without curvature there is no gradient either: the step keeps out of them. The length of
    s(a) = -(B + a)^-1 D g falls with the damping a, and 1 / |s(a)| is nearly linear in it: Newton steps on that,
    kept between bounds of the solution.
    """
    curvature, basis = _directions(model.curvature, sizes)
    known = curvature > len(curvature[0]) * np.finfo(float).eps * curvature.max(axis=1, keepdims=True)
    slope = np.where(known, (model.gradient[:, None] @ basis)[:, 0], 0.0)
    curvature = np.where(known, curvature, 1.0)
    squared = slope**2

    length = _norm(slope / curvature)
    limited = length > radius
    excess = length - radius
    low = np.where(limited, excess * length / np.sum(squared / curvature**3, axis=1), 0.0)
    high = _norm(slope) / radius
    damping = np.where(limited, damping, 0.0)
    searching = limited
    for _ in range(MAX_LENGTH_STEPS):
        if not searching.any():
            break
        outside = searching & ~((damping >= low) & (damping <= high) & (damping > 0))
        damping = np.where(outside, np.maximum(1e-3 * high, np.sqrt(low * high)), damping)
        damped = curvature + damping[:, None]
        terms = squared / damped**2
        length = np.sqrt(np.sum(terms, axis=1))
        excess = length - radius
        newton = excess * length / np.sum(terms / damped, axis=1)
        high = np.where(searching & (excess < 0), damping, high)
        low = np.where(searching, np.maximum(low, damping + newton), low)
        damping = np.where(searching, damping + newton * length / radius, damping)
        searching = searching & (np.abs(excess) > RADIUS_ERROR * radius)
    along = slope / (curvature + damping[:, None])
    along *= np.where(limited, radius / _norm(along), 1.0)[:, None]
    return -(basis @ along[..., None])[..., 0], damping


def _directions(curvature: Array, sizes: NDArray[np.int64]) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors of the curvature, zero beyond the size of a problem."""
    distinct = np.unique(sizes)
    if len(distinct) == 1 and distinct[0] == curvature.shape[-1]:
        return np.linalg.eigh(curvature)
    values, basis = np.zeros(curvature.shape[:-1]), np.zeros_like(curvature)
    for size in distinct:
        rows = np.flatnonzero(sizes == size)
        values[rows, :size], basis[rows, :size, :size] = np.linalg.eigh(curvature[rows, :size, :size])
    return values, basis


def _feasible(model: _Model, step: Array, radius: Array, x: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """The step, or what is best in its place where it leaves the bounds, and how far the model falls along it."""
    there = x + model.scale * step
    out = np.flatnonzero(((there < lower) | (there > upper)).any(axis=1))
    fall = -_dot(step, 0.5 * (model.curvature @ step[..., None])[..., 0] + model.gradient)
    if len(out):
        part = _Model(*(values[out] for values in model))
        step[out], fall[out] = _turned(part, step[out], radius[out], x[out], lower[out], upper[out])
    return step, fall


def _turned(model: _Model, step: Array, radius: Array, x: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """The best of a step cut short at the first bound, its reflection there, and the steepest descent."""
    to_bound, hit = _way_to_bound(x, model.scale * step, lower, upper)
    cut = step * to_bound[:, None]
    reflected, descent = np.where(hit, -step, step), -model.gradient
    directions = np.stack([cut, reflected, descent], axis=-1)
    curved = model.curvature @ directions
    quadratic = directions.swapaxes(1, 2) @ curved
    linear = (model.gradient[:, None] @ directions)[:, 0]

    theta = model.step_back
    cut_value = theta * linear[:, 0] + 0.5 * theta**2 * quadratic[:, 0, 0]

    # From the bound along the reflection, to the radius or the next bound, but not back to where it began.
    a, b, c = _dot(reflected, reflected), _dot(cut, reflected), _dot(cut, cut) - radius**2
    to_radius = (-b + np.sqrt(np.maximum(b**2 - a * c, 0.0))) / a
    on_bound = np.clip(x + model.scale * cut, lower, upper)
    to_next, _ = _way_to_bound(on_bound, model.scale * reflected, lower, upper)
    farthest = np.minimum(to_next, to_radius)
    most = np.where(to_next <= to_radius, theta * to_next, to_radius)
    least = (1.0 - theta) * to_bound / farthest
    possible = (farthest > 0) & (least <= most)
    way, value = _least_along(quadratic[:, 1, 1], linear[:, 1] + quadratic[:, 0, 1], least, most)
    value = np.where(possible, value + linear[:, 0] + 0.5 * quadratic[:, 0, 0], np.inf)

    to_edge, _ = _way_to_bound(x, model.scale * descent, lower, upper)
    to_radius = radius / _norm(descent)
    most = np.where(to_edge < to_radius, theta * to_edge, to_radius)
    down, down_value = _least_along(quadratic[:, 2, 2], linear[:, 2], np.zeros_like(most), most)

    values = np.stack([cut_value, value, down_value], axis=-1)
    best = np.argmin(np.where(np.isfinite(values), values, np.inf), axis=-1)
    steps = np.stack([theta[:, None] * cut, cut + way[:, None] * reflected, down[:, None] * descent], axis=1)
    rows = np.arange(len(best))
    return steps[rows, best], -values[rows, best]


def _way_to_bound(x: Array, direction: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Multiple of a direction that leads to the first bound, (batch,), and which that is, (batch, parameter)."""
    ways = np.where(direction != 0, np.maximum((lower - x) / direction, (upper - x) / direction), np.inf)
    way = ways.min(axis=1)
    return way, ways == way[:, None]


def _least_along(quadratic: Array, linear: Array, least: Array, most: Array) -> tuple[Array, Array]:
    """Where between least and most quadratic t^2 / 2 + linear t is least, and its value there."""
    way = np.where(quadratic > 0, np.clip(-linear / quadratic, least, most), np.where(linear < 0, most, least))
    return way, way * (linear + 0.5 * quadratic * way)
