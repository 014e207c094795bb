"""Maximum-likelihood estimate of a joint with one structure, and profiles of its likelihood."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from armperturb.analysis.fit.ladder import left_out_loss
from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.joint.likelihood import JointLikelihood, Loop
from armperturb.analysis.joint.model import (
    INTRINSIC,
    LONGEST_DELAY,
    OF_REFLEX,
    SHORT_RANGE,
    THRESHOLD,
    JointModel,
    JointStructure,
)
from armperturb.analysis.joint.signals import JointSignals
from armperturb.analysis.results import Interval
from armperturb.arrays import Array

DELAYS = (0.02, 0.035, 0.05, 0.065, 0.08, 0.1, 0.12, 0.14, 0.16, 0.18)
"""Delays from which a search may start [s]."""

FREQUENCIES = (1.5, 3.0)
"""Natural frequencies of the reflex path from which a search may start [Hz]."""

THRESHOLDS = (0.0, 0.6)
"""Thresholds from which a search may start, over the RMS velocity [-]."""

STARTS = 2
"""Searches from different starts."""

ROUNDS = 8
"""Most rounds of weighing the noise anew."""

SEARCHES = 2
"""Rounds of a force servo that search the least squares of its movement; the others solve those of instruments."""

SETTLED = 0.05
"""Change of the objective below which the rounds end on a position servo [-]."""

STILL = 0.2
"""Largest change of a parameter, over its standard error, below which they end on a force servo [-]."""


PROFILE_STEPS = (0.7, 1.4, 2.1, 2.8)
"""Where a profile of the likelihood is taken, over the standard error to either side [-]."""

PROFILE_RISE = 6.6
"""Rise that it reaches to either side [-]: that of an interval of 99 %."""

MOST_STEPS = 8
"""Points to either side."""

ELSEWHERE = (-0.3, -0.1, 0.1, 0.3)
"""Thresholds at which the profile of the threshold is taken besides, over the RMS velocity [-]."""

PROMISING = 0.2
"""Rise that a start elsewhere must promise to save for a search from it [-]."""


class JointEstimate(NamedTuple):
    """Maximum of the likelihood of one structure.

    Attributes:
      structure: of the joint.
      values: of its parameters, (parameter,).
      covariance: of their errors, (parameter, parameter).
      at_bound: which sit on a bound, (parameter,).
      objective: minus twice the log-likelihood, but for a constant [-].
      loss: of likelihood on blocks that are left out, see `fit.ladder` [-].
      converged: whether the rounds ended.
      lack: whether it leaves something that a linear response to the servo's input explains.
    """

    structure: JointStructure
    values: Array
    covariance: Array
    at_bound: NDArray[np.bool_]
    objective: float
    loss: float
    converged: bool
    lack: LackOfFit


class Profile(NamedTuple):
    """Rise of minus twice the log-likelihood with one parameter held and the others estimated.

    Attributes:
      values: at which it was held, in its unit, (point,).
      rise: over the least [-], (point,).
      bounds: of the parameter.
    """

    values: Array
    rise: Array
    bounds: tuple[float, float]

    def interval(self, half: float) -> Interval:
        """Values at which the root of the rise is a quantile of the normal distribution, within the bounds.

        Args:
          half: the quantile, 1.96 for an interval of 95 %.
        """
        least = int(np.argmin(self.rise))
        ends = []
        for side in (slice(least, None, -1), slice(least, None)):
            root, value = np.sqrt(self.rise[side]), self.values[side]
            last = int(np.flatnonzero(root <= half)[-1])  # a likelihood may have two maxima: the outermost counts
            end = float(np.interp(half, root[last : last + 2], value[last : last + 2]))
            if half > root[-1] > 0.0:
                end = float(value[0] + (value[-1] - value[0]) * half / root[-1])
            ends.append(float(np.clip(end, *self.bounds)))
        return Interval(*ends)


def estimate_joint(
    structure: JointStructure,
    signals: JointSignals,
    loop: Loop | None = None,
    *,
    longest_delay: float = LONGEST_DELAY,
) -> JointEstimate:
    """Fit one structure to trials.

    Args:
      structure: of the joint.
      signals: of the trials.
      loop: the virtual environment of a force servo; None of a position servo.
      longest_delay: of the reflex [s].
    """
    fits = []
    for start in _starts(structure, signals, longest_delay):
        likelihood = JointLikelihood(structure, signals, loop)
        fits.append((*_searched(likelihood, start, longest_delay), likelihood))
    values, objective, converged, likelihood = min(fits, key=lambda fit: fit[1])
    lower, upper = structure.bounds(signals, longest_delay)
    span = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    at_bound = (values - lower < 1e-4 * span) | (upper - values < 1e-4 * span)
    free = ~at_bound
    covariance = np.full((len(values), len(values)), np.nan)
    covariance[np.ix_(free, free)] = _covariance(likelihood, values, free)
    loss, lack = left_out_loss(likelihood.scores(values)), likelihood.lack_of_fit(values)
    return JointEstimate(structure, values, covariance, at_bound, objective, loss, converged, lack)


def likelihood_profiles(
    fit: JointEstimate,
    signals: JointSignals,
    loop: Loop | None,
    names: Sequence[str],
    *,
    added: Array | None = None,
    longest_delay: float = LONGEST_DELAY,
) -> dict[str, Profile]:
    """Rise of the sum of squares with each parameter held at values about its estimate, and the others estimated.

    On a force servo it is that of the movement, which a nonlinear reflex makes slightly less efficient than
    instruments. The noise is that of the estimate, so that differences are those of chi squared with one degree of
    freedom. What trials that differ add to the variance of a parameter, over its variance, makes its profile flatter.

    The likelihood of a threshold may have two maxima, either side of the velocity at which a movement rests. Its
    profile is therefore taken at a few more thresholds, and other parameters are searched again from its points where
    these promise less of a rise.

    Args:
      fit: of the joint.
      signals: of the trials it was fitted to.
      loop: the virtual environment of a force servo; None of a position servo.
      names: of the parameters, which have a standard error.
      added: covariance that differences between trials add, (parameter, parameter); None for none.
      longest_delay: of the reflex [s].
    """
    likelihood = JointLikelihood(fit.structure, signals, loop)
    likelihood.weigh(fit.values)
    profiles: dict[str, Profile] = {}
    along: list[_Point] = []
    for name in sorted(names, key=lambda name: name != THRESHOLD):
        place = fit.structure.parameters.index(name)
        wider = 1.0 if added is None else 1.0 + float(added[place, place] / fit.covariance[place, place])
        points, bounds = _profiled(likelihood, fit, place, along, longest_delay, wider)
        rise = np.array([point.cost for point in points])
        held = np.array([point.values[place] for point in points])
        profiles[name] = Profile(held, (rise - rise.min()) / wider, bounds)
        if name == THRESHOLD:
            along = points
    return {name: profiles[name] for name in names}


class _Point(NamedTuple):
    """What a profile has where it was taken: all parameters, (parameter,), and the sum of squares."""

    values: Array
    cost: float


def _profiled(
    likelihood: JointLikelihood,
    fit: JointEstimate,
    place: int,
    along: Sequence[_Point],
    longest_delay: float,
    wider: float,
) -> tuple[list[_Point], tuple[float, float]]:
    """Points of the profile of one parameter, in its order, and the parameter's bounds.

    Args:
      likelihood: with the noise of the estimate.
      fit: the estimate.
      place: of the parameter.
      along: points of the threshold's profile; none without.
      longest_delay: of the reflex [s].
      wider: factor by which differences between trials increase the variance [-].
    """
    others = np.arange(len(fit.values)) != place
    lower, upper = fit.structure.bounds(likelihood.signals, longest_delay)
    bounds = float(lower[place]), float(upper[place])
    variance = float(fit.covariance[place, place])
    estimate, error, given = float(fit.values[place]), float(np.sqrt(wider * variance)), variance
    if along:
        given -= float(fit.covariance[place, -1] ** 2 / fit.covariance[-1, -1])  # with the threshold held

    def fitted(at: float, start: Array) -> _Point:
        values = start.copy()
        values[place] = at
        values = _minimised(likelihood, values, longest_delay, others)
        left = likelihood.output_rows(values, likelihood.movement(values)) * likelihood.sure
        return _Point(values, float(np.sum(left**2)))

    def lowest(at: float, start: Array) -> _Point:
        point = fitted(at, start)
        promised = [each.cost + (at - each.values[place]) ** 2 / given for each in along]
        if along and min(promised) < point.cost - PROMISING:
            point = min(point, fitted(at, along[int(np.argmin(promised))].values), key=lambda each: each.cost)
        return point

    centre = fitted(estimate, fit.values)
    points, beyond = [centre], np.empty(0)
    if fit.structure.parameters[place] == THRESHOLD:
        beyond = (np.array(ELSEWHERE) * likelihood.signals.velocity_scale - estimate) / error
    for side, bound in zip((-1.0, 1.0), bounds, strict=True):
        point = centre
        steps = [*PROFILE_STEPS, *sorted((side * beyond)[side * beyond > PROFILE_STEPS[-1]].tolist())]
        most = MOST_STEPS + len(steps) - len(PROFILE_STEPS)
        for step in steps:
            at = max(estimate - step * error, bound) if side < 0.0 else min(estimate + step * error, bound)
            point = lowest(at, point.values)
            points.append(point)
            if at == bound:
                break
            if step == steps[-1] and point.cost - centre.cost < wider * PROFILE_RISE and len(steps) < most:
                steps.append(1.5 * step)
    return sorted(points, key=lambda each: float(each.values[place])), bounds


def _starts(structure: JointStructure, signals: JointSignals, longest_delay: float) -> list[Array]:
    """Starts of the search: the best of a grid over what is not linear, the rest by least squares."""
    likelihood = JointLikelihood(JointStructure(reflex="none"), signals)
    likelihood.weigh(_linear(likelihood, JointStructure(reflex="none"), {}, signals)[1])
    likelihood.weigh(_linear(likelihood, JointStructure(reflex="none"), {}, signals)[1])
    choices: dict[str, tuple[float, ...]] = {}
    if structure.short_range:
        choices["short_range_limit"] = (0.2 * signals.angle_scale,)
    if structure.reflex != "none":
        choices["reflex_delay"] = tuple(each for each in DELAYS if each < longest_delay) or (0.5 * longest_delay,)
        choices["reflex_frequency"], choices["reflex_damping_ratio"] = FREQUENCIES, (1.0,)
    if structure.reflex == "half-wave":
        choices[THRESHOLD] = tuple(each * signals.velocity_scale for each in THRESHOLDS)
    tried = [
        _linear(likelihood, structure, dict(zip(choices, each, strict=True)), signals)
        for each in itertools.product(*choices.values())
    ]
    return [values for _, values in sorted(tried, key=lambda each: each[0])[: STARTS if len(tried) > 1 else 1]]


def _linear(
    likelihood: JointLikelihood, structure: JointStructure, given: dict[str, float], signals: JointSignals
) -> tuple[float, Array]:
    """Cost and values with what is linear by least squares."""
    linear = [*INTRINSIC, SHORT_RANGE[0], OF_REFLEX[0]]
    values = np.array([given.get(name, 1.0 if name in linear else 0.0) for name in structure.parameters])
    columns = JointModel(structure, signals).derivatives(values)
    free = [place for place, name in enumerate(structure.parameters) if name in linear]
    names = [structure.parameters[place] for place in free]
    matrix = np.stack([likelihood.rows(columns[name]).ravel() for name in names])
    target = likelihood.rows(signals.torque).ravel()
    scale = np.linalg.norm(matrix, axis=1)
    values[free] = np.linalg.lstsq((matrix / scale[:, None]).T, target, rcond=None)[0] / scale
    return float(np.sum((target - values[free] @ matrix) ** 2)), values


def _covariance(likelihood: JointLikelihood, values: Array, free: NDArray[np.bool_]) -> Array:
    """Covariance of the errors of free parameters: of least squares, or of the equations of instruments.

    Either counts that the noise is estimated from the same trials, see `fit.whittle`.
    """

    def columns_at(movement: JointSignals) -> Array:
        rows = likelihood.derivatives(values, movement)[free] * likelihood.sure
        return np.asarray(rows.reshape(int(free.sum()), -1))

    instruments = columns_at(likelihood.movement(values))
    information = instruments @ instruments.T
    if likelihood.signals.servo == "position":
        return np.asarray(np.linalg.pinv(information, hermitian=True))
    columns, scale = columns_at(likelihood.signals), _sizes(instruments)
    inverse = np.linalg.pinv((instruments @ columns.T) / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(inverse @ information @ inverse.T)


def _searched(likelihood: JointLikelihood, start: Array, longest_delay: float) -> tuple[Array, float, bool]:
    """Values, objective and whether it settled, weighing the noise anew after each search."""
    lower, upper = likelihood.structure.bounds(likelihood.signals, longest_delay)
    values = np.clip(start, lower, upper)
    before, converged = np.inf, False
    everything = np.ones(len(values), dtype=bool)
    for number in range(ROUNDS):
        likelihood.weigh(values)
        if likelihood.signals.servo == "position":
            values = _minimised(likelihood, values, longest_delay, everything)
            objective = likelihood.weighed_objective(values)
            converged = abs(before - objective) < SETTLED
            before = objective
        elif number < SEARCHES:
            values = _minimised(likelihood, values, longest_delay, everything)
        else:
            values, change = _instrumented(likelihood, values, lower, upper)
            converged = change < STILL
        if converged:
            break
    likelihood.weigh(values)
    return values, likelihood.weighed_objective(values), converged


def _minimised(likelihood: JointLikelihood, start: Array, longest_delay: float, free: Array) -> Array:
    """Least squares of some parameters with the noise as last weighed."""
    lower, upper = likelihood.structure.bounds(likelihood.signals, longest_delay)
    inside = np.clip(start, lower + _margin(lower), upper - _margin(upper))

    def full(part: Array) -> Array:
        values = inside.copy()
        values[free] = part
        return values

    def residual(part: Array) -> Array:
        values = full(part)
        try:
            return likelihood.output_rows(values, likelihood.movement(values)).ravel()
        except ValueError:  # a closed loop that oscillates
            return np.full(2 * likelihood.n_trials * len(likelihood.frequency), 1e3)

    def slopes(part: Array) -> Array:
        values = full(part)
        columns = likelihood.derivatives(values, likelihood.movement(values))
        # More resistance leaves less of the torque, but moves a joint on a force servo less.
        sign = -1.0 if likelihood.signals.servo == "position" else 1.0
        return sign * columns[free].reshape(int(free.sum()), -1).T

    end = optimize.least_squares(
        residual, inside[free], jac=slopes, bounds=(lower[free], upper[free]), x_scale="jac", ftol=1e-6, max_nfev=30
    )
    return full(end.x)


def _margin(bound: Array) -> Array:
    return np.where(np.isfinite(bound), 1e-9 * (1.0 + np.abs(np.where(np.isfinite(bound), bound, 0.0))), 0.0)


def _instrumented(likelihood: JointLikelihood, values: Array, lower: Array, upper: Array) -> tuple[Array, float]:
    """Values at which the torque's residual is not correlated with derivatives at the movement without noise.

    Returns:
      The values, (parameter,), and the largest change of any, over its standard error.
    """
    start, error = values, np.ones(len(values))
    for _ in range(3):
        movement = likelihood.movement(values)
        instruments = likelihood.derivatives(values, movement).reshape(len(values), -1)
        columns = likelihood.derivatives(values, likelihood.signals).reshape(len(values), -1)
        scale = _sizes(instruments)
        error = np.sqrt(np.diag(np.linalg.pinv(instruments @ instruments.T / np.outer(scale, scale)))) / scale
        matrix = (instruments @ columns.T) / np.outer(scale, scale)
        slope = instruments @ likelihood.residual(values).ravel() / scale
        step = np.linalg.lstsq(matrix, slope, rcond=1e-8)[0] / scale
        moved = np.clip(values + step, lower, upper)
        try:
            likelihood.movement(moved)
        except ValueError:  # a closed loop that oscillates
            break
        values = moved
    return values, float(np.max(np.abs(values - start) / np.where(error > 0.0, error, np.inf)))


def _sizes(rows: Array) -> Array:
    """Lengths of rows; one of those that are zero, as derivatives by a delay are where nothing is delayed."""
    size = np.linalg.norm(rows, axis=1)
    return np.where(size > 0.0, size, 1.0)
