"""The search of the likelihood: Gauss-Newton steps within bounds, iteratively reweighted.

The noise spectra are estimated before each of the first steps (`likelihood`). Steps that lead to an unstable arm or to
a smaller likelihood are shortened.
"""

from typing import NamedTuple, Protocol

import numpy as np
from scipy import optimize

from armperturb.analysis.fit.joint_likelihood import Effects, JointLikelihood
from armperturb.analysis.fit.trial_effects import SINGULAR, scaled
from armperturb.analysis.fit.whittle import Normal
from armperturb.analysis.numerics.bounds import names_at_bound
from armperturb.arrays import Array

MAX_ROUNDS = 60
"""Gauss-Newton steps after which a search ends in any case."""

WEIGHED_ROUNDS = 20
"""Steps before which the noise is re-estimated. A search that lasts longer alternates between two noise spectra: from
then on the noise is held."""

REFINED_ROUNDS = 6
"""The same of a search that refines another one."""

SETTLED, SKETCHED = 0.01, 0.2
"""A step this small in units of the standard error ends a search, and one that is to be refined or compared [-]."""

STALLED = 0.1
"""A step that had to be shortened so far below that size ends a search too, once the noise is held [-]: derivatives
that leave something out lead no further."""

UNUSUAL = 2.0
"""Factor by which delays and cut-offs are unusual if they differ by more from those of the structures' starts [-]."""

NEAR = 2.0
"""Twice the gain of likelihood that a step promises up to which it may be near a maximum [-]."""

SHORTENED = 0.8
"""Share of a step up to which it is shortened, where a parabola says that this is better [-]."""

CONVERGED = "converged: steps are far below the errors"
"""Of a search that ended at a maximum."""


class Searchable(Protocol):
    """A likelihood of free parameters within bounds, (parameter,), and how far they are from an unstable model."""

    lower: Array
    upper: Array

    def pole(self, values: Array) -> float:
        """Positive where the model is unstable."""
        ...

    def weigh(self, values: Array) -> None:
        """Estimate the noise that is left."""
        ...

    def cost(self, values: Array) -> float:
        """Weighed sum of squares."""
        ...

    def normal(self, values: Array) -> Normal:
        """Least squares at one point."""
        ...


class Searched(NamedTuple):
    """Where a search of the likelihood ended.

    Attributes:
      values: of the free parameters, (parameter,).
      information: inverse covariance of their errors, (parameter, parameter).
      status: how it ended, in words.
      converged: whether it ended at a maximum.
      n_rounds: steps that were made.
      effects: of trials that differ; None where they are taken to be alike.
      spread: of each quantity over trials [-], (quantity,).
      dof: degrees of freedom of each parameter's variance, (parameter,).
    """

    values: Array
    information: Array
    status: str
    converged: bool
    n_rounds: int
    effects: Effects | None = None
    spread: Array | None = None
    dof: Array | None = None


def bounded_step(normal: Normal, damping: float, lower: Array, upper: Array) -> Array:
    """Levenberg-Marquardt step that stays within bounds."""
    scale, power, directions = scaled(normal.information)
    root = np.sqrt(np.maximum(power, 0.0) + damping + SINGULAR)
    target = directions.T @ (normal.slope / scale) / root
    whole = directions @ (target / root) / scale
    if np.all((lower <= whole) & (whole <= upper)):
        return np.asarray(whole)
    design = root[:, None] * directions.T
    free = upper > lower
    step = np.zeros(len(scale))
    bounds = lower[free] * scale[free], upper[free] * scale[free]
    step[free] = optimize.lsq_linear(design[:, free], target, bounds, method="bvls").x
    return step / scale


def step_size(normal: Normal, step: Array) -> float:
    """Largest change of a parameter in units of its error, were all others known."""
    return float(np.max(np.abs(step) * np.sqrt(np.diag(normal.information))))


def search_from(
    problem: Searchable,
    values: Array,
    *,
    weighed: int = WEIGHED_ROUNDS,
    settled: float = SETTLED,
    most: int = MAX_ROUNDS,
) -> Searched:
    """Gauss-Newton steps within bounds.

    No step leads to an unstable arm, or from an unstable start to one that is less stable.

    Args:
      problem: the likelihood.
      values: to start from, (parameter,).
      weighed: first steps before each of which the noise is estimated anew.
      settled: size of the step that ends the search, in units of the standard error [-].
      most: steps after which it ends in any case.
    """
    damping = 0.0
    limit = max(0.0, problem.pole(values))
    for n_rounds in range(1, most + 1):
        if n_rounds <= weighed:
            problem.weigh(values)
        normal = problem.normal(values)
        room = problem.lower - values, problem.upper - values
        reason = "no smaller step increases the likelihood"
        whole = bounded_step(normal, 0.0, *room)
        if step_size(normal, whole) < settled:
            return Searched(values, normal.information, CONVERGED, True, n_rounds)
        while True:
            step = bounded_step(normal, damping, *room) if damping else whole
            after = np.clip(values + step, problem.lower, problem.upper)
            if not problem.pole(after) < limit:
                reason = "at the border of stability"
            elif (cost := problem.cost(after)) < normal.cost:
                between = _best_along(normal, values, after, cost)
                if between is not after and problem.pole(between) < limit and problem.cost(between) < cost:
                    after = between
                break
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e8:
                return _stopped(values, normal, whole, settled, reason, n_rounds)
        if n_rounds > weighed and step_size(normal, after - values) < STALLED * settled:
            return _stopped(after, normal, whole, settled, reason, n_rounds)
        values, damping = after, damping / 10.0 if damping > 1e-6 else 0.0
    return Searched(values, normal.information, f"not converged: {most} steps were not enough", False, most)


def _stopped(values: Array, normal: Normal, whole: Array, settled: float, reason: str, n_rounds: int) -> Searched:
    """The end of a search that finds no further step, with the last normal equations and whole step.

    It is a maximum if that step promises next to nothing: along what trials hardly tell, steps are small beside the
    error that is left, and large beside round-off.
    """
    is_maximum = float(normal.slope @ whole) < settled**2
    status = CONVERGED if is_maximum else f"not converged: {reason}"
    return Searched(values, normal.information, status, is_maximum, n_rounds)


def _best_along(normal: Normal, values: Array, after: Array, cost: float) -> Array:
    """Where a step should end, by the parabola through the costs at both ends and the slope at the first.

    Curvature that Gauss and Newton leave out makes steps too long: a search would go to and fro across its valley. Far
    from a maximum, a step is as likely to find a better one whatever its length.

    Args:
      normal: at the start of the step.
      values: there, (parameter,).
      after: end of the step, which is returned where a shorter one promises little.
      cost: there.
    """
    gain = 2.0 * float(normal.slope @ (after - values))
    curvature = cost - normal.cost + gain
    if gain > NEAR or 0.5 * gain > SHORTENED * curvature:
        return after
    return np.asarray(values + 0.5 * gain / curvature * (after - values))


def search_best(problem: JointLikelihood, start: Array) -> Searched:
    """The most likely values; of long trials, full derivatives refine what quick ones lead to."""
    if not problem.is_long:
        return search_from(problem, start)
    problem.quick = True
    start = search_from(problem, start, settled=SKETCHED).values
    problem.quick = False
    return search_from(problem, start, weighed=REFINED_ROUNDS)


def has_unusual_delays(problem: JointLikelihood, values: Array) -> bool:
    """Whether a delay or a cut-off sits on a bound, or is far from that of the structures' starts."""
    at_bound, usual = names_at_bound(problem.names, values, problem.lower, problem.upper), problem.published()
    return any(
        name.startswith(("Td_", "fact_")) and (name in at_bound or not start / UNUSUAL < value < start * UNUSUAL)
        for name, value, start in zip(problem.names, values, usual, strict=True)
    )


def with_usual_delays(problem: JointLikelihood) -> Array:
    """The most likely values whose delays and activation dynamics are those of the structures' starts, (parameter,).

    Where they are free the likelihood has further maxima, at delays that are far too long, from which a search does not
    find back.
    """
    bounds, usual = (problem.lower.copy(), problem.upper.copy()), problem.published()
    for column, name in enumerate(problem.names):
        if name.startswith(("Td_", "fact_", "zeta_")):
            problem.lower[column] = problem.upper[column] = usual[column]
    values = search_best(problem, problem.stabilised(usual)).values
    problem.lower, problem.upper = bounds
    return values
