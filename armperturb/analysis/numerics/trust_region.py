"""Bounded nonlinear least squares, compiled: the trust-region reflective method.

Minimises |r(x)|^2 / 2 within l < x < u.

Source: Branch, Coleman and Li (1999), SIAM J. Sci. Comput. 21, 1-23, whose subspace step is replaced by the exact one
of the Gauss-Newton model (More 1978), as in SciPy's `least_squares(method="trf")` and with its tolerances. With g the
gradient, v_i the distance to the bound that -g_i points at (one if there is none) and D = diag(v)^(1/2), the step D s
minimises

    m(s) = g^T D s + s^T (D J^T J D + C) s / 2,    C = diag(|g_i|) where v_i is a distance, within |s| <= radius.

A step that leaves the bounds competes with its reflection at them and with the steepest descent.
"""

import math
from typing import NamedTuple

import numpy as np

from armperturb.arrays import Array
from armperturb.jit import jit

INSIDE = 1e-10
"""How far inside its bounds a problem starts at least, relative to a bound above one."""

STEP_BACK = 0.995
"""Share of the way to a bound that a step goes at least, unless the gradient has nearly vanished."""

RADIUS_ERROR = 0.01
"""Relative error of a step's length, where the radius limits it."""

MAX_LENGTH_STEPS = 10
"""Newton steps for the length of a step."""

NO_CURVATURE = 2.2e-16
"""Along a direction with this share of the largest curvature, times the number of parameters, there is none."""

NOT_FINITE, EVALUATIONS_REACHED, NO_GRADIENT, COST_SETTLED, STEP_SETTLED, BOTH_SETTLED = range(-1, 5)
"""Why a search ended."""


class Step(NamedTuple):
    """What `judge` must know of a step.

    Attributes:
      predicted: how far the model falls.
      length: of the step s.
      moved: length of what is added to x.
      size: length of x.
      radius: of the trust region.
      damping: that the step has taken.
    """

    predicted: float
    length: float
    moved: float
    size: float
    radius: float
    damping: float


@jit
def first_radius(x: Array, gradient: Array, lower: Array, upper: Array) -> float:
    """Radius of the first step, from where the search starts."""
    squared = 0.0
    scale, _ = _scale(x, gradient, lower, upper)
    for i in range(x.size):
        squared += (x[i] / scale[i]) ** 2
    radius = math.sqrt(squared)
    return radius if radius > 0 and np.isfinite(radius) else 1.0


@jit
def next_point(
    x: Array, gradient: Array, hessian: Array, lower: Array, upper: Array, radius: float, damping: float
) -> tuple[Array, Step]:
    """Where to evaluate next.

    Args:
      x: inside its bounds, (parameter,).
      gradient: J^T r at x, (parameter,), not all zero.
      hessian: J^T J, (parameter, parameter).
      lower: bounds, (parameter,), below the upper; infinite where there is none.
      upper: likewise.
      radius: of the trust region.
      damping: of the last step.

    Returns:
      The point, (parameter,), and what `judge` must know of the step to it.
    """
    scale, sign = _scale(x, gradient, lower, upper)
    curvature = np.empty((x.size, x.size))
    for i in range(x.size):
        for j in range(x.size):
            curvature[i, j] = hessian[i, j] * scale[j] * scale[i]
        curvature[i, i] += gradient[i] * sign[i]
    slope = _product(scale, gradient)
    step, damping = _longest(slope, curvature, radius, damping)
    step, predicted = _feasible(step, slope, curvature, scale, radius, x, lower, upper)
    moved = _product(scale, step)
    point = inside(_ahead(x, 1.0, moved), lower, upper, 0.0)
    return point, Step(predicted, _norm(step), _norm(moved), _norm(x), radius, damping)


@jit
def judge(step: Step, cost: float, new_cost: float, ftol: float, xtol: float) -> tuple[float, float, int]:
    """What a step was worth.

    Args:
      step: from `next_point`.
      cost: half the sum of squares before it.
      new_cost: the same after it; not finite where the step was too long. Where it is lower, the step counts.
      ftol: the search ends when a step reduces the cost by less than this share, and the model was right about it.
      xtol: it ends when a step is shorter than this share of x.

    Returns:
      Radius and damping to go on with, and one of the constants of this module if the search has ended, else zero.
    """
    is_finite = np.isfinite(new_cost)
    reduction = cost - new_cost if is_finite else -np.inf
    ratio = 1.0 if reduction == step.predicted else 0.0
    if step.predicted > 0:
        ratio = reduction / step.predicted
    radius = step.radius
    if ratio < 0.25:
        radius = 0.25 * step.length
    elif ratio > 0.75 and step.length > 0.95 * radius:
        radius *= 2.0
    is_settled = is_finite and reduction < ftol * cost and ratio > 0.25
    is_short = is_finite and step.moved < xtol * (xtol + step.size)
    status = 0
    if is_settled:
        status = BOTH_SETTLED if is_short else COST_SETTLED
    elif is_short:
        status = STEP_SETTLED
    return radius, step.damping * step.radius / radius, status


# Loops, as array expressions take many times as long to compile.


@jit
def _product(a: Array, b: Array) -> Array:
    """Of each pair of elements."""
    product = np.empty(a.size)
    for i in range(a.size):
        product[i] = a[i] * b[i]
    return product


@jit
def _ahead(start: Array, way: float, direction: Array) -> Array:
    """The point start + way * direction."""
    point = np.empty(start.size)
    for i in range(start.size):
        point[i] = start[i] + way * direction[i]
    return point


@jit
def _norm(values: Array) -> float:
    squared = 0.0
    for value in values:
        squared += value * value
    return math.sqrt(squared)


@jit
def inside(x: Array, lower: Array, upper: Array, margin: float) -> Array:
    """What is on or outside a bound moved inside: by the margin, or to the next number that there is."""
    inside = x.copy()
    for i in range(x.size):
        low, high = lower[i], upper[i]
        if margin > 0:
            low, high = low + margin * max(1.0, abs(low)), high - margin * max(1.0, abs(high))
        else:
            low, high = np.nextafter(low, high), np.nextafter(high, low)
        if not low <= high:
            low = high = 0.5 * (lower[i] + upper[i])
        # Bounds that are infinite leave no margin to keep.
        if np.isfinite(lower[i]):
            inside[i] = max(inside[i], low)
        if np.isfinite(upper[i]):
            inside[i] = min(inside[i], high)
    return inside


@jit
def _scale(x: Array, gradient: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Diagonal of D, and the derivative of its square by x."""
    scale, sign = np.ones(x.size), np.zeros(x.size)
    for i in range(x.size):
        if gradient[i] < 0 and np.isfinite(upper[i]):
            scale[i], sign[i] = math.sqrt(upper[i] - x[i]), -1.0
        elif gradient[i] > 0 and np.isfinite(lower[i]):
            scale[i], sign[i] = math.sqrt(x[i] - lower[i]), 1.0
    return scale, sign


@jit
def _factor(matrix: Array, damping: float, least: float, lower: Array) -> bool:
    """Cholesky factor of matrix + damping into `lower`; whether all its pivots are above the least."""
    n = len(matrix)
    for j in range(n):
        pivot = matrix[j, j] + damping
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        if not pivot > least:
            return False
        root = math.sqrt(pivot)
        lower[j, j] = root
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total / root
    return True


@jit
def _solve(lower: Array, slope: Array, step: Array) -> float:
    """Put -(L L^T)^-1 slope into `step`; returns step^T (L L^T)^-1 step."""
    n = slope.size
    for i in range(n):
        total = -slope[i]
        for k in range(i):
            total -= lower[i, k] * step[k]
        step[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * step[k]
        step[i] = total / lower[i, i]
    squared = 0.0
    half = np.empty(n)
    for i in range(n):
        total = step[i]
        for k in range(i):
            total -= lower[i, k] * half[k]
        half[i] = total / lower[i, i]
        squared += half[i] * half[i]
    return squared


@jit
def _longest(slope: Array, curvature: Array, radius: float, damping: float) -> tuple[Array, float]:
    """Minimum of the model within the radius, (parameter,), and the damping that it takes.

    The length of s(a) = -(B + a)^-1 D g falls with the damping a, and 1 / |s(a)| is nearly linear in it: Newton steps
    on that, kept between bounds of the solution. Along directions without curvature there is no gradient either:
    damping keeps the step out of them.
    """
    n = slope.size
    factor, step = np.zeros((n, n)), np.zeros(n)
    largest = 0.0
    for i in range(n):
        largest = max(largest, curvature[i, i])
    least = n * NO_CURVATURE * largest
    low, high = 0.0, _norm(slope) / radius
    if _factor(curvature, 0.0, least, factor):
        squared = _solve(factor, slope, step)
        length = _norm(step)
        if length <= radius:
            return step, 0.0
        low = (length - radius) * length / squared
    for _ in range(MAX_LENGTH_STEPS):
        if not (damping >= low and damping <= high and damping > 0):
            damping = max(1e-3 * high, math.sqrt(low * high))
        if not _factor(curvature, damping, 0.0, factor):
            low, damping = max(low, damping), 0.0
            continue
        squared = _solve(factor, slope, step)
        length = _norm(step)
        excess = length - radius
        newton = excess * length / squared
        if excess < 0:
            high = damping
        low = max(low, damping + newton)
        damping += newton * length / radius
        if abs(excess) <= RADIUS_ERROR * radius:
            break
    if damping > 0 and _factor(curvature, damping, 0.0, factor):
        _solve(factor, slope, step)
    # A model that is flat along some direction may have its minimum within the radius all the same.
    length = _norm(step)
    if length > (1.0 - 10 * RADIUS_ERROR) * radius:
        for i in range(n):
            step[i] *= radius / length
    return step, damping


@jit
def _value(slope: Array, curvature: Array, step: Array) -> float:
    """The model at a step."""
    return float(np.dot(step, slope) + 0.5 * np.dot(step, np.dot(curvature, step)))


@jit
def _feasible(
    step: Array, slope: Array, curvature: Array, scale: Array, radius: float, x: Array, lower: Array, upper: Array
) -> tuple[Array, float]:
    """The step, or what is best in its place where it leaves the bounds, and how far the model falls along it.

    That is the best of the step cut short at the first bound, its reflection there, and the steepest descent.
    """
    n, moved = x.size, _product(scale, step)
    leaves, steepest = False, 0.0
    for i in range(n):
        leaves |= x[i] + moved[i] < lower[i] or x[i] + moved[i] > upper[i]
        steepest = max(steepest, abs(slope[i] * scale[i]))
    if not leaves:
        return step, -_value(slope, curvature, step)
    theta = max(STEP_BACK, 1.0 - steepest)
    to_bound, hit = _way_to_bound(x, moved, lower, upper)
    nowhere = np.zeros(n)
    cut = _ahead(nowhere, to_bound, step)
    best = _ahead(nowhere, theta, cut)
    best_value = _value(slope, curvature, best)

    # From the bound along the reflection, to the radius or the next bound, but not back to where it began.
    reflected, on_bound = np.empty(n), np.empty(n)
    for i in range(n):
        reflected[i] = -step[i] if hit[i] else step[i]
        on_bound[i] = min(max(x[i] + scale[i] * cut[i], lower[i]), upper[i])
    a, b, c = np.dot(reflected, reflected), np.dot(cut, reflected), np.dot(cut, cut) - radius**2
    to_radius = (-b + math.sqrt(max(b * b - a * c, 0.0))) / a
    to_next, _ = _way_to_bound(on_bound, _product(scale, reflected), lower, upper)
    farthest = min(to_next, to_radius)
    most = theta * to_next if to_next <= to_radius else to_radius
    if farthest > 0:
        least = (1.0 - theta) * to_bound / farthest
        if least <= most:
            turned = np.dot(curvature, reflected)
            way = _least_along(np.dot(reflected, turned), np.dot(slope, reflected) + np.dot(cut, turned), least, most)
            candidate = _ahead(cut, way, reflected)
            value = _value(slope, curvature, candidate)
            if value < best_value:
                best, best_value = candidate, value

    to_edge, _ = _way_to_bound(x, _ahead(nowhere, -1.0, _product(scale, slope)), lower, upper)
    to_radius = radius / _norm(slope)
    most = theta * to_edge if to_edge < to_radius else to_radius
    down = _least_along(np.dot(slope, np.dot(curvature, slope)), -np.dot(slope, slope), 0.0, most)
    candidate = _ahead(nowhere, -down, slope)
    value = _value(slope, curvature, candidate)
    if value < best_value:
        best, best_value = candidate, value
    return best, -best_value


@jit
def _way_to_bound(x: Array, direction: Array, lower: Array, upper: Array) -> tuple[float, Array]:
    """Multiple of a direction that leads to the first bound, and which that is, (parameter,)."""
    ways, way = np.empty(x.size), np.inf
    for i in range(x.size):
        ways[i] = np.inf
        if direction[i] != 0:
            ways[i] = max((lower[i] - x[i]) / direction[i], (upper[i] - x[i]) / direction[i])
        way = min(way, ways[i])
    return way, ways == way


@jit
def _least_along(quadratic: float, linear: float, least: float, most: float) -> float:
    """Where between least and most quadratic t^2 / 2 + linear t is least."""
    if quadratic > 0:
        return min(max(-linear / quadratic, least), most)
    return most if linear < 0 else least
