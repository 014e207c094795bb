"""Profile likelihood of a parameter."""

from collections.abc import Sequence

import numpy as np

from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.likelihood_search import search_from
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import unit
from armperturb.arrays import Array


def profile(
    groups: Sequence[Group], fitted: Estimate, name: str, points: Sequence[float], *, share: Sequence[str] = ()
) -> Array:
    """Profile likelihood of a parameter: the likelihood ratio where it is held and all others are fitted again.

    Trials are taken to be alike: where they differ (`Estimate.trial_spread`), intervals are wider than this tells.

    Args:
      groups: the trials.
      fitted: the maximum likelihood estimate.
      name: of the parameter, as in `Estimate.values`.
      points: values at which to hold it, SI.
      share: as it was for the estimate.

    Returns:
      Twice the logarithm of the likelihood ratio [-], (point,), with the noise as weighed at the estimate. A point
      belongs to the 95 % interval if it is below 3.84 (times `Estimate.dispersion`).

    Raises:
      ValueError: the parameter is unknown, or a point is outside its bounds.
    """
    problem = JointLikelihood([group.under(fitted.law) for group in groups], fitted.method, share)
    if name not in problem.names:
        raise ValueError(f"no parameter {name!r}; expected one of {', '.join(problem.names)}")
    column = problem.names.index(name)
    best = np.array([fitted.values[label] for label in problem.names])
    problem.weigh(best)
    least = problem.cost(best)
    bounds = problem.lower.copy(), problem.upper.copy()
    deviance = np.empty(len(points))
    for index, point in enumerate(points):
        if not bounds[0][column] <= point <= bounds[1][column]:
            raise ValueError(
                f"{name} = {point!r}; expected {bounds[0][column]:g} to {bounds[1][column]:g} {unit(name.split()[0])}"
            )
        problem.lower[column] = problem.upper[column] = point
        held = search_from(problem, np.clip(best, problem.lower, problem.upper), weighed=0)
        deviance[index] = problem.cost(held.values) - least
        problem.lower, problem.upper = bounds[0].copy(), bounds[1].copy()
    return deviance
