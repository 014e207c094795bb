"""People differ from trial to trial: how much, and what that does to the estimate of the average person.

In trial t, damping, stiffness and each kind of feedback gain are those of the person times 1 + u_tq, one factor for
each quantity q, with mean zero and standard deviation w_q over trials. About the present estimate, the white residual
of a trial is

    r_t = S_t (D u_t + dtheta) + e,    S_t: derivative by the free parameters,  D_jq: parameter j if it is of q, or 0,

with white noise e: a linear mixed model, in which all that is needed of a trial is its score s_t = S_t^T r_t and its
information I_t = S_t^T S_t. The spreads w are those of the restricted likelihood, of the whole of whose factors the
average person has been estimated away (Patterson & Thompson 1971, Biometrika 58); dtheta follows by generalised least
squares, and u_t as the best linear prediction. The variance of dtheta depends on w, which a few trials tell poorly: its
degrees of freedom are Satterthwaite's (1946, Biometrics Bulletin 2), and intervals are those of Student's t.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize

from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.arrays import Array

QUANTITIES = ("b", "k", "kv", "kp", "ka")
"""Quantities that may differ from trial to trial, each with all its parameters in proportion."""

FEW = f"fewer than {FEWEST_TRIALS} trials: intervals leave out what differs between trials"
"""Remark on errors that are then those of noise alone."""

ASSUMED = 0.1
"""Spread where fewer trials have EMG, which makes errors smaller than people's differences between trials [-]."""

RANGE = (1e-4, 1.0)
"""Least and largest spread that is looked for [-]; the least is as good as none."""

START = 0.05
"""Spread from which the search starts [-]."""

LOOSE = 0.3
"""Spread with which the effects of each trial are predicted where the noise is estimated [-]: what tighter ones leave
of them would pass for noise, and make them tighter still."""

TOLD = 4.0
"""By so much minus twice the restricted likelihood has to fall for trials to differ [-]."""

FLAT = 0.5
"""Curvature of minus twice the restricted likelihood, by a spread's logarithm, that is as good as none [-]."""

LEAST_DOF = 2.0
"""Degrees of freedom are not fewer than this."""

LEAST_SPREAD = 1e-3
"""Spreads over trials below this are none [-]."""

STEP = 0.1
"""Of the logarithm of a spread, for derivatives [-]."""


SINGULAR = 1e-12
"""Least eigenvalue of the scaled information with which a structure can be identified [-]."""


class TrialScore(NamedTuple):
    """What one trial tells.

    Attributes:
      columns: of the free parameters that act in it, among all.
      score: of these, with the effects of the trial taken out of the model, (parameter,).
      information: (parameter, parameter).
      design: D, (parameter, quantity).
    """

    columns: Sequence[int]
    score: Array
    information: Array
    design: Array


class Mixed(NamedTuple):
    """The mixed model at its most likely spreads.

    Attributes:
      spread: w of each quantity [-], (quantity,).
      slope: of generalised least squares: its solution times `information`, (parameter,).
      information: inverse covariance of the free parameters, (parameter, parameter).
      weights: of each trial, from the score that an estimate leaves to its effects if these may be `LOOSE`, (quantity,
        quantity).
      dof: degrees of freedom of each parameter's variance, (parameter,).
    """

    spread: Array
    slope: Array
    information: Array
    weights: tuple[Array, ...]
    dof: Array


class _Solved(NamedTuple):
    """Generalised least squares at given spreads: see `Mixed`.

    Attributes:
      deviance: minus twice the restricted likelihood.
      gradient: of the deviance by the logarithms of the spreads of quantities that trials tell of.
      slope: see `Mixed`.
      information: likewise.
      weights: of each trial, as `Mixed` has them at these spreads.
    """

    deviance: float
    gradient: Array
    slope: Array
    information: Array
    weights: tuple[Array, ...]


def fit_mixed(trials: Sequence[TrialScore], n_parameters: int, assumed: float | None = None) -> Mixed:
    """The spreads, and what follows from them.

    Args:
      trials: what each tells.
      n_parameters: free parameters of all trials.
      assumed: spread of every quantity [-]; None for the most likely ones.
    """
    n_quantities = trials[0].design.shape[1]
    within = np.array([trial.design.T @ trial.information @ trial.design for trial in trials])
    force = np.array([trial.design.T @ trial.score for trial in trials])
    across = np.zeros((len(trials), n_parameters, n_quantities))
    slope_alike, information_alike = np.zeros(n_parameters), np.zeros((n_parameters, n_parameters))
    for trial, of_trial in zip(trials, across, strict=True):
        of_trial[trial.columns] = trial.information @ trial.design
        slope_alike[trial.columns] += trial.score
        information_alike[np.ix_(trial.columns, trial.columns)] += trial.information
    tells = np.sum([np.diag(matrix) for matrix in within], axis=0) > 0.0

    def solve(spread: Array) -> _Solved:
        gram, weights = _gram_and_weight(within, spread)
        weighted = across @ weights
        slope = slope_alike - np.einsum("tpq,tq->p", weighted, force)
        information = information_alike - np.einsum("tpq,trq->pr", weighted, across, optimize=True)
        deviance = float(np.sum(np.linalg.slogdet(gram)[1]) - np.einsum("tq,tqr,tr->", force, weights, force))
        scale, power, directions = scaled(information)
        known = power > SINGULAR
        root = directions[:, known] / np.sqrt(power[known]) / scale[:, None]
        along = root.T @ slope
        deviance += float(np.sum(np.log(power[known])) + 2 * np.sum(np.log(scale)) - np.sum(along**2))
        left = np.einsum("tqr,tr->tq", weights, force) - weighted.swapaxes(1, 2) @ (root @ along)
        # As w^-2 + D^T I D is the inverse of a weight W, its derivative by log w_q is 2 W_:q W_q: / w_q^2.
        of_weights = np.diagonal(weights, axis1=1, axis2=2) + left**2
        of_weights += np.sum((weighted.swapaxes(1, 2) @ root) ** 2, axis=2)
        gradient = 2.0 * (len(trials) - of_weights[:, tells].sum(axis=0) / np.maximum(spread[tells], RANGE[0]) ** 2)
        return _Solved(deviance, gradient, slope, information, tuple(weights))

    def spread_of(logarithms: Array) -> Array:
        spread = np.zeros(n_quantities)
        spread[tells] = np.exp(logarithms)
        return spread

    loose = solve(np.where(tells, LOOSE, 0.0)).weights
    if assumed is not None:
        spread = np.where(tells, assumed, 0.0)
        solved = solve(spread)
        return Mixed(spread, solved.slope, solved.information, loose, np.full(n_parameters, np.inf))
    alike = solve(np.zeros(n_quantities))
    as_alike = Mixed(np.zeros(n_quantities), alike.slope, alike.information, loose, np.full(n_parameters, np.inf))
    if not tells.any():
        return as_alike
    bounds = [tuple(np.log(RANGE))] * int(tells.sum())
    start = np.full(len(bounds), np.log(START))
    logarithms = optimize.minimize(
        lambda v: solve(spread_of(v))[:2], start, jac=True, method="L-BFGS-B", bounds=bounds
    ).x
    spread = spread_of(logarithms)
    solved = solve(spread)
    if solved.deviance > alike.deviance - TOLD:
        return as_alike

    def gradient_and_variances(values: Array) -> tuple[Array, Array]:
        solved = solve(spread_of(values))
        return solved.gradient, np.diag(inverse(solved.information))

    moving = [i for i, value in enumerate(logarithms) if value > bounds[i][0] + 1.0]
    dof = _satterthwaite(gradient_and_variances, logarithms, moving)
    return Mixed(spread, solved.slope, solved.information, loose, dof)


def differing(names: Sequence[str], spread: Array) -> dict[str, float]:
    """Quantities that differ from trial to trial, and their spreads [-].

    Args:
      names: of all quantities.
      spread: of these, (quantity,).
    """
    return {name: float(value) for name, value in zip(names, spread, strict=True) if value > LEAST_SPREAD}


def _gram_and_weight(within: Array, spread: Array) -> tuple[Array, Array]:
    """1 + w D^T I D w and w (1 + w D^T I D w)^-1 w, (..., quantity, quantity) both."""
    gram = np.eye(len(spread)) + spread[:, None] * within * spread
    return gram, spread[:, None] * np.linalg.solve(gram, np.diag(spread))


def scatter(trials: Sequence[TrialScore], spread: Array, information: Array) -> float:
    """How much more the trials' scores vary from trial to trial than their information says [-]; one on average.

    It is tr(A^-1 sum_t g_t g_t^T) n / (n - 1) / p, with g_t the scores that the n trials have at the estimate of p
    parameters, and A their information: what cluster-robust standard errors (Liang & Zeger 1986, Biometrika 73, 13-22)
    make of every parameter by itself, as one factor for all, which a few trials tell well enough.

    Args:
      trials: at the estimate.
      spread: w of each quantity [-], (quantity,).
      information: A, (parameter, parameter).
    """
    scale, power, directions = scaled(information)
    known = power > SINGULAR
    root = directions[:, known] / np.sqrt(power[known])
    total = 0.0
    for trial in trials:
        across = trial.information @ trial.design
        _, weight = _gram_and_weight(trial.design.T @ across, spread)
        score = np.zeros(len(information))
        score[trial.columns] = trial.score - across @ weight @ (trial.design.T @ trial.score)
        total += float(np.sum((root.T @ (score / scale)) ** 2))
    return total * len(trials) / (len(trials) - 1) / int(known.sum())


def _satterthwaite(
    gradient_and_variances: Callable[[Array], tuple[Array, Array]], at: Array, moving: Sequence[int]
) -> Array:
    """Degrees of freedom of variances that depend on spreads, by differences, (parameter,).

    Args:
      gradient_and_variances: derivative of minus twice the restricted likelihood by the spreads' logarithms, and the
        variances, (parameter,), as functions of these.
      at: the most likely ones.
      moving: which of them are not at their least.
    """
    _, variances = gradient_and_variances(at)
    if not moving:
        return np.full(len(variances), np.inf)
    ends = [[gradient_and_variances(at + sign * step) for sign in (1, -1)] for step in STEP * np.eye(len(at))[moving]]
    bend = np.array([upper[0] - lower[0] for upper, lower in ends])[:, moving] / (2 * STEP)
    slopes = np.array([upper[1] - lower[1] for upper, lower in ends]) / (2 * STEP)
    # Where the restricted likelihood is flat, a spread is as good as unknown within its range.
    power, directions = np.linalg.eigh(0.5 * (bend + bend.T))
    covariance = (directions * (2.0 / np.maximum(power, FLAT))) @ directions.T
    with np.errstate(divide="ignore"):
        dof = 2.0 * variances**2 / np.einsum("ip,ij,jp->p", slopes, covariance, slopes)
    return np.maximum(dof, LEAST_DOF)


def scaled(information: Array) -> tuple[Array, Array, Array]:
    """Scale that gives the information a diagonal of ones, its eigenvalues then, rising, and its directions."""
    scale = np.sqrt(np.diag(information))
    scale[scale == 0.0] = 1.0
    power, directions = np.linalg.eigh(information / np.outer(scale, scale))
    return scale, np.asarray(power), np.asarray(directions)


def inverse(information: Array) -> Array:
    """Its inverse, without the directions in which it tells nothing, (parameter, parameter)."""
    scale, power, directions = scaled(information)
    known = power > SINGULAR
    return np.asarray((directions[:, known] / power[known]) @ directions[:, known].T / np.outer(scale, scale))
