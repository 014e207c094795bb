"""The level of co-contraction that a person would choose: effort against displacement.

A person who weighs displacement against effort co-contracts to the level c that minimises

    x(c)^2 + weight c^2,

with x the RMS displacement under the condition's multisine: cost of a quadratic loss, as in optimal control of
movement (Todorov & Jordan 2002), effort as activation squared (Crowninshield & Brand 1981 argue for the square or
cube of muscle stress). One condition whose level is known tells the weight; the rule then predicts the others. Of an
arm that is stiffness alone, x = F / (k c), it makes the level grow with the square root of the force.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import interpolate, optimize

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.arrays import Array
from armperturb.cohort import Person
from armperturb.environment import Environment
from armperturb.envs.lab.trial import Trial
from armperturb.study.protocol import Protocol
from armperturb.study.recording.practice import measured_displacement, practice_multisine
from armperturb.subject import Subject, at_level
from armperturb.validation import require_number

LEVELS = tuple(0.25 * 2.0 ** (number / 3) for number in range(11))
"""Levels of co-contraction that are simulated [-]: 0.25 to 2.5; the rule interpolates between them."""


def chosen_level(levels: ArrayLike, displacement: ArrayLike, weight: float) -> float:
    """The level that minimises displacement squared plus weight times level squared.

    Args:
      levels: of co-contraction, rising, > 0 [-], (level,), at least three.
      displacement: RMS displacement at them [m], > 0, (level,).
      weight: of the effort [m^2], > 0.

    Returns:
      The level, between the first and the last; logarithms are interpolated.

    Raises:
      TypeError: weight is no number.
      ValueError: an argument is out of its range, or shapes differ.
    """
    require_number("chosen_level", "weight", weight, above=0.0)
    log_level, response = _response(levels, displacement)
    # The cost may have several valleys: the best of a fine grid, then the bottom of that valley.
    grid = np.linspace(log_level[0], log_level[-1], 401)

    def cost(at: Array) -> Array:
        return np.asarray(np.exp(2.0 * response(at)) + weight * np.exp(2.0 * at))

    best = int(np.argmin(cost(grid)))
    around = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    lowest = optimize.minimize_scalar(cost, bounds=around, method="bounded", options={"xatol": 1e-9})
    return float(np.exp(lowest.x))


def weight_of(levels: ArrayLike, displacement: ArrayLike, level: float) -> float:
    """The weight of effort with which a person stays at a level [m^2]: there, neither more nor less of it pays.

    Args:
      levels: as in `chosen_level`.
      displacement: likewise.
      level: that the person is at, within `levels` [-].

    Raises:
      TypeError: level is no number.
      ValueError: an argument is out of its range, or more co-contraction moves the handle further at this level, which
        no weight explains.
    """
    log_level, response = _response(levels, displacement)
    require_number("weight_of", "level", level, at_least=np.exp(log_level[0]), at_most=np.exp(log_level[-1]))
    here = np.log(level)
    # d/dc (x^2 + w c^2) = 0 in logarithms: 2 x^2 dlog(x)/dlog(c) + 2 w c^2 = 0.
    slope = float(response.derivative()(here))
    if slope >= 0.0:
        raise ValueError(f"weight_of: the displacement grows with the level at {level:g}; expected one that falls")
    return float(-slope * np.exp(2.0 * (float(response(here)) - here)))


def displacement_at_levels(
    subject: Subject,
    force: float,
    *,
    levels: Sequence[float] = LEVELS,
    seed: int = 0,
    environment: Environment | None = None,
    n_threads: int = 0,
) -> tuple[Array, Array]:
    """How far the handle moves at different levels of co-contraction under the same multisine.

    Args:
      subject: who is perturbed, at level 1.
      force: RMS force per axis [N].
      levels: to try [-].
      seed: of the practice multisine.
      environment: what the hand holds; the thesis's manipulator if not given.
      n_threads: 0 takes all cores.

    Returns:
      The levels at which the arm is stable and stays in the workspace, (level,), and the RMS displacement per axis at
      each [m], (level,).
    """
    environment = environment or Environment()
    multisine = replace(practice_multisine(seed), rms=force)
    tried = [
        (level, at)
        for level, at in ((level, at_level(subject, level)) for level in levels)
        if all(largest_real_pole(arm, environment) < 0.0 for arm in at.linear_arms)
    ]
    if not tried:
        return np.empty(0), np.empty(0)
    trials = [Trial(subject=at, perturbation=multisine) for _, at in tried]
    displacement = measured_displacement(trials, environment, n_threads=n_threads)
    inside = np.isfinite(displacement)
    return np.array([level for level, _ in tried])[inside], displacement[inside]


def derived_levels(
    person: Person,
    protocol: Protocol,
    forces: Mapping[str, float],
    *,
    known: str = "PT7.5",
    levels: Sequence[float] = LEVELS,
    seed: int = 0,
    environment: Environment | None = None,
    n_threads: int = 0,
) -> dict[str, float]:
    """Levels that the rule predicts for a person in the position task, from the level in one condition.

    Args:
      person: whose level in the known condition tells how effort is weighed.
      protocol: whose conditions of the position task with a multisine are meant.
      forces: condition to RMS force per axis [N].
      known: condition whose level is taken as it is.
      levels: to try, rising [-].
      seed: of the multisine.
      environment: what the hand holds; the thesis's manipulator if not given.
      n_threads: 0 takes all cores.

    Returns:
      Condition to level, as a multiple of the subject's own [-].

    Raises:
      KeyError: the protocol lacks the known condition, or a force is missing.
      ValueError: the person is stable at fewer than three levels in a condition, or no weight explains the known one.
    """
    subject = person.subjects["PT"]
    conditions = [c for c in protocol.conditions if c.task == "PT" and c.has_multisine]
    responses = {
        condition.name: displacement_at_levels(
            subject, forces[condition.name], levels=levels, seed=seed, environment=environment, n_threads=n_threads
        )
        for condition in conditions
    }
    level = protocol.condition(known).co_contraction * person.levels.get(known, 1.0)
    weight = weight_of(*responses[known], level)
    return {name: chosen_level(*response, weight) for name, response in responses.items()}


def _response(levels: ArrayLike, displacement: ArrayLike) -> tuple[Array, interpolate.CubicSpline]:
    """Logarithm of the levels, and that of the displacement as a function of it."""
    at, moved = np.asarray(levels, dtype=float), np.asarray(displacement, dtype=float)
    if at.ndim != 1 or at.shape != moved.shape or len(at) < 3:
        raise ValueError(
            f"levels of shape {at.shape}, displacement of shape {moved.shape}; expected as many of both, at least three"
        )
    if not (np.all(np.diff(at) > 0.0) and at[0] > 0.0 and np.all(np.isfinite(at))):
        raise ValueError(f"levels = {at.tolist()}; expected finite numbers above 0 that rise")
    if not (np.all(moved > 0.0) and np.all(np.isfinite(moved))):
        raise ValueError(f"displacement = {moved.tolist()}; expected finite numbers above 0")
    return np.log(at), interpolate.CubicSpline(np.log(at), np.log(moved))
