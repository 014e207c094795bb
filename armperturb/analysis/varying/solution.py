"""Estimates of parameters that change, with their errors: one maximum of the likelihood, and several of them together.

A half-wave of a movement that often rests has a likelihood with several maxima over its threshold, which trials may not
tell apart, and whose gains differ by more than the errors of each.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from armperturb.analysis.fit.likelihood_search import search_from
from armperturb.analysis.fit.whittle import Normal
from armperturb.analysis.joint.model import THRESHOLD
from armperturb.analysis.joint.torque_likelihood import BlockScore
from armperturb.analysis.varying.likelihood import VaryingLikelihood
from armperturb.analysis.varying.model import DEGREE, VaryingModel
from armperturb.analysis.varying.result import Curve
from armperturb.analysis.varying.starts import at_dynamics, inverse, other_thresholds
from armperturb.arrays import Array, Indices

LESS_LIKELY = 10.0
"""Minus twice the log-likelihood beyond the least, from which on a maximum does not count [-]."""


class Search:
    """A likelihood as the search sees it: parameters that are held have no room.

    Args:
      likelihood: of the trials.
      values: of all parameters, for their number.
    """

    def __init__(self, likelihood: VaryingLikelihood, values: Array) -> None:
        self.likelihood, n = likelihood, len(values)
        self.lower, self.upper = np.full(n, -np.inf), np.full(n, np.inf)
        model, first = likelihood.model, likelihood.model.n_linear
        lower, upper = (
            dict(zip(model.structure.parameters, bound, strict=True)) for bound in model.structure.bounds(model.signals)
        )
        self.lower[first:] = [lower[name] for name in model.dynamics]
        self.upper[first:] = [upper[name] for name in model.dynamics]
        self.weigh, self.cost = likelihood.weigh, likelihood.cost

    def pole(self, values: Array) -> float:
        """The movement is imposed: nothing is unstable."""
        return -1.0

    def normal(self, values: Array) -> Normal:
        """Least squares of all parameters."""
        return self.likelihood.normal(values, np.eye(len(values)))

    def inside(self, values: Array) -> Indices:
        """Numbers of the parameters that are not at a bound."""
        return np.flatnonzero((self.lower < values) & (values < self.upper))


def size_of(influence: Array) -> Array:
    """Standard error from the influence of independent groups, (group, ...) to (...)."""
    n = len(influence)
    return np.asarray(np.sqrt(np.sum(influence**2, axis=0) * n / (n - 1.0)))


def together(groups: Sequence[BlockScore]) -> BlockScore:
    """Scores and information of groups, added up."""
    return BlockScore(*(np.sum(each, axis=0) for each in zip(*groups, strict=True)))


class Solution(NamedTuple):
    """Estimates and what is known of their errors.

    Attributes:
      model: with its numbers of splines.
      values: of all parameters, (parameter,).
      influence: of each repetition or stretch on them, (group, parameter); the sum over groups is zero.
    """

    model: VaryingModel
    values: Array
    influence: Array

    def curve(self, quantity: str, grid: Array) -> tuple[Array, Array]:
        """A quantity on a grid, (point,), and the influence of each group on it, (group, point)."""
        basis, part = self.model.basis(quantity, grid), self.model.part(quantity)
        return self.values[part] @ basis, self.influence[:, part] @ basis


def solved(likelihood: VaryingLikelihood, values: Array) -> Solution:
    """One step from near the estimate, and how much each group has to do with where it leads; the noise is held."""
    inside = Search(likelihood, values).inside(values)
    groups = likelihood.scores(values, np.eye(len(values))[:, inside])
    slope, information = together(groups)
    back = inverse(information)
    step = back @ slope
    influence = np.zeros((len(groups), len(values)))
    influence[:, inside] = [back @ (group.score - group.information @ step) for group in groups]
    solution = values.copy()
    solution[inside] += step
    return Solution(likelihood.model, solution, influence)


def curve_of(solution: Solution, likelihood: VaryingLikelihood, quantity: str, n_chosen: int, grid: Array) -> Curve:
    """A quantity over the grid; its band counts how much further than noise splines of twice the distance lead.

    Where the variable has no values, as between two postures, nothing is known, and the standard error is infinite.
    """
    coarse = likelihood.with_orders({**solution.model.orders, quantity: n_chosen})
    before = solved(coarse, at_dynamics(coarse, solution.values[solution.model.n_linear :]))
    (value, influence), (other, of_other) = (each.curve(quantity, grid) for each in (solution, before))
    moved, noise = (_over_knots(each, n_chosen) for each in ((value - other) ** 2, size_of(influence - of_other) ** 2))
    beyond = np.maximum(moved - noise, 0.0)
    bias = beyond * (beyond / np.maximum(moved, np.finfo(float).tiny))
    error = np.sqrt(size_of(influence) ** 2 + bias)
    model = solution.model
    reached = model.basis(quantity, np.unique(model.variable[:, model.signals.used])).any(axis=1)
    error[model.basis(quantity, grid)[~reached].any(axis=0)] = np.inf  # of splines without data nothing is known
    return Curve(value, error, model.orders[quantity])


class Maximum(NamedTuple):
    """A maximum of the likelihood.

    Attributes:
      objective: minus twice the log-likelihood, up to what all share.
      solution: parameters and their errors.
      curves: quantity to its curve.
      threshold: of the reflex, and its standard error; NaN without one.
    """

    objective: float
    solution: Solution
    curves: dict[str, Curve]
    threshold: tuple[float, float]


def maxima_near(
    likelihood: VaryingLikelihood, dynamics: Array, chosen: Mapping[str, int], grid: Array
) -> list[Maximum]:
    """Maxima of the likelihood at several thresholds that are nearly as likely, the most likely first.

    There is a single one without a threshold.

    Args:
      likelihood: of the structure.
      dynamics: delay, dynamics and threshold nearby.
      chosen: numbers of splines with which left-out data are the most likely.
      grid: where curves are given, (point,).
    """
    maxima: list[Maximum] = []
    for start in (at_dynamics(likelihood, dynamics), *other_thresholds(likelihood, dynamics)):
        values = search_from(Search(likelihood, start), start).values
        threshold = _threshold(likelihood, values)
        if any(abs(threshold[0] - each.threshold[0]) <= max(threshold[1], each.threshold[1]) for each in maxima):
            continue  # the same one
        solution = solved(likelihood, values)
        curves = {
            name: curve_of(solution, likelihood, name, chosen[name], grid)
            for name in likelihood.model.orders
            if name != "static"
        }
        maxima.append(Maximum(likelihood.objective(values), solution, curves, threshold))
    lowest = min(each.objective for each in maxima)
    return sorted((each for each in maxima if each.objective < lowest + LESS_LIKELY), key=lambda each: each.objective)


def _threshold(likelihood: VaryingLikelihood, values: Array) -> tuple[float, float]:
    """Threshold of the reflex and its standard error, 0 at a bound; NaN without one."""
    if THRESHOLD not in likelihood.model.dynamics:
        return math.nan, math.nan
    place, inside = len(values) - 1, Search(likelihood, values).inside(values)
    if place not in inside:
        return float(values[place]), 0.0
    information = likelihood.normal(values, np.eye(len(values))[:, inside]).information
    return float(values[place]), math.sqrt(max(float(inverse(information)[-1, -1]), 0.0))


def mixed(maxima: Sequence[Maximum]) -> dict[str, Curve]:
    """Curves over all maxima, each by its likelihood: what they differ by is part of the error.

    Args:
      maxima: the most likely first.
    """
    weights = np.exp(-0.5 * (np.array([each.objective for each in maxima]) - maxima[0].objective))
    weights /= weights.sum()
    curves = {}
    for name, first in maxima[0].curves.items():
        several = [each.curves[name] for each in maxima]
        value = np.sum([w * each.value for w, each in zip(weights, several, strict=True)], axis=0)
        variance = [
            w * (each.standard_error**2 + (each.value - value) ** 2) for w, each in zip(weights, several, strict=True)
        ]
        curves[name] = Curve(value, np.sqrt(np.sum(variance, axis=0)), first.n_basis)
    return curves


def _over_knots(squares: Array, n_basis: int) -> Array:
    """Means over twice the distance of knots, (point,): two of the splines that halving it adds."""
    width = min(round(2.0 * len(squares) / max(n_basis - DEGREE, 1)), 2 * len(squares))
    return np.asarray(ndimage.uniform_filter1d(squares, max(width, 1), mode="reflect"))
