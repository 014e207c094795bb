"""The person's noise, drawn and simulated: as strong as it must be, and what it says of the errors of a fit.

Were the noise stationary, as its spectrum has it, white residuals would be white. But noise moves a muscle that yields
the more, the more the disturbance does: it comes in bursts. So the noise is drawn as torque on the joints and
simulated.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.nonlinear.noise import NoiseDraws
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.simulated import State
from armperturb.arrays import Array, Indices
from armperturb.planar_arm.simulation import Disturbances

PAIRS_OF_STRENGTH = 4
"""Pairs of draws from which the strength of draws is estimated."""

MOST_WEAKENED = 6
"""How often draws with which an arm diverges are made weaker: a person near instability was merely lucky."""

WEAKER = 0.7
"""Factor on the strength of such draws [-]."""

WILD = 8.0
"""How many times as much as without noise the movement of a trial may depend on the unknowns [-]. Noise that an arm
bears makes it twice as much; beyond that the arm runs away, by several times what any trial did, and its derivatives
are up to 10^5 times as large."""

MOST_ATTEMPTS = 20
"""How often the noise of a trial is drawn anew at a state. Where a search has come nearer to instability than the
person, hardly any noise is borne."""

LEAST_SHARE = 0.25
"""Least share of the information without noise that counts, see `inverse_of_mixed` [-]."""

TINY = 1e-12
"""Least eigenvalue of a scaled information matrix, over the largest [-]."""


class Deviations(NamedTuple):
    """White deviations of simulated trials from the mean response, of each trial (draw, number).

    Attributes:
      odd: parts that change sign with the noise.
      even: parts that do not.
    """

    odd: list[Array]
    even: list[Array]

    def signed(self) -> Iterator[list[Array]]:
        """The deviations of all trials with noise of either sign, draw by draw."""
        for draw in range(len(self.odd[0]) if self.odd else 0):
            for sign in (1.0, -1.0):
                yield [sign * odd[draw] + even[draw] for odd, even in zip(*self, strict=True)]


def predict_with_noise(problem: Problem, state: State, residual: Array, n_pairs: int, seed: int) -> NoiseDraws:
    """Let a problem predict in the presence of noise as last estimated, and return the draws.

    Draws are made twice. A fit explains part of the noise, most of all in the bursts that come when the arm has been
    moved, as unknowns act then as well: residuals of a first set of draws, after such a fit, tell how strong the second
    set must be for its residuals to be as large as those of the trials.

    Args:
      problem: what is fitted; predicts with the draws from now on.
      state: where the fit is.
      residual: of the trials there [m], (trial, time, axis).
      n_pairs: of draws.
      seed: of the draws.
    """
    slopes = problem.slopes(state)
    roots = tuple(noise.root for noise in problem.noises)
    strengths = tuple(np.ones(len(root)) for root in roots)
    first = problem.odd_and_even(state, NoiseDraws(roots, strengths, PAIRS_OF_STRENGTH, seed))
    odd = [problem.white(part) for part, _ in first if np.isfinite(part).all()]
    if odd:  # otherwise every noise draw makes the simulation diverge
        left, white = problem.unexplained(state, slopes, odd), problem.white(residual)
        strengths = tuple(
            noise.matched_strength(
                np.array(white[rows]), np.array([trial for record in left for trial in record[rows]])
            )
            for rows, noise in zip(problem.rows, problem.noises, strict=True)
        )
    return predict_with_stable_noise(problem, state, NoiseDraws(roots, strengths, n_pairs, seed))


def predict_with_stable_noise(problem: Problem, state: State, draws: NoiseDraws) -> NoiseDraws:
    """Let a problem predict in the presence of draws that all arms bear, and return those.

    Args:
      problem: predicts with the draws from now on.
      state: at which arms must bear them.
      draws: as strong as they are wanted.
    """
    draws = borne(problem, state, draws)
    problem.predict_with(draws)
    for _ in range(MOST_WEAKENED):
        if np.isfinite(problem.predict([state])).all():
            break
        draws = draws._replace(strengths=tuple(WEAKER * strength for strength in draws.strengths))
        problem.predict_with(draws)
    return draws


def run_away(alike: Sequence[Array]) -> bool:
    """Whether an answer to a draw is so much larger than others that the arm may run away."""
    sizes = np.array([np.linalg.norm(each) for each in alike])
    return bool((sizes > WILD * np.median(sizes)).any())


def is_borne(problem: Problem, state: State, draws: NoiseDraws) -> bool:
    """Whether no arm runs away in the presence of any draw."""
    most = WILD * problem.sensitivity(state)
    return all(
        bool((_sensitivity(problem, state, draws, pair, disturbances) <= most).all())
        for pair, disturbances in enumerate(problem.disturbed(draws))
    )


def _sensitivity(
    problem: Problem,
    state: State,
    draws: NoiseDraws,
    pair: int,
    disturbances: Sequence[Disturbances],
    trials: Indices | None = None,
) -> Array:
    """`Problem.sensitivity` to a pair of the draws, with the divisions of the elastic limits that predictions use."""
    return problem.sensitivity(state, disturbances, trials, first=2 * pair, n_divisions=2 * draws.n_pairs)


def borne(problem: Problem, state: State, draws: NoiseDraws) -> NoiseDraws:
    """The draws, with the noise of a trial drawn anew where it makes the arm run away.

    The trials that were recorded did not run away, so that noise is wanted given that they do not.

    Args:
      problem: what is fitted.
      state: of the unknowns.
      draws: as they come; the same object is returned if the arm bears them all.
    """
    before = draws
    attempts = draws.attempted(problem.n_trials).copy()
    most, last = WILD * problem.sensitivity(state), attempts + MOST_ATTEMPTS
    unchecked = {pair: np.arange(problem.n_trials) for pair in range(draws.n_pairs)}
    while unchecked:
        draws = draws._replace(attempts=attempts.copy())
        for pair, disturbances in zip(sorted(unchecked), problem.disturbed(draws, unchecked), strict=True):
            trials = unchecked[pair]
            is_wild = _sensitivity(problem, state, draws, pair, disturbances, trials) > most[trials]
            unchecked[pair] = trials[is_wild & (attempts[pair, trials] < last[pair, trials])]
            attempts[pair, unchecked[pair]] += 1
        unchecked = {pair: trials for pair, trials in unchecked.items() if len(trials)}
    return before if np.array_equal(attempts, before.attempted(problem.n_trials)) else draws


def borne_ahead(problem: Problem, here: State, ahead: State, draws: NoiseDraws) -> NoiseDraws:
    """Draws, some of them drawn anew, with which the arm runs away neither ahead nor here.

    Where it runs away ahead whatever the noise is, the noise is not to blame: the draws stay as they are.

    Args:
      problem: predicts with the draws from now on.
      here: where a search is.
      ahead: where it would go.
      draws: that the problem predicts with; the same object is returned if they stay.
    """
    other = borne(problem, ahead, draws)
    if other is not draws:
        problem.predict_with(other)
        if np.isfinite(problem.predict([here, ahead])).all():
            return other
        problem.predict_with(draws)
    return draws


def simulate_deviations(problem: Problem, state: State, draws: NoiseDraws, n_averaged: int) -> Deviations:
    """Deviations from the mean response that other noise of the person would cause.

    Noise with which an arm runs away is drawn anew. Draws with which one still diverges are left out; all are if fewer
    than two remain.

    Args:
      problem: what was fitted.
      state: where the fit is.
      draws: of the noise; other ones than predictions are averaged over.
      n_averaged: pairs over which predictions were averaged, which leaves some noise in them.
    """
    halves = _halves(problem, state, draws)
    if len(halves) < draws.n_pairs or any(
        run_away(of_trial) for of_trial in zip(*(odd for odd, _ in halves), strict=True)
    ):
        halves = _halves(problem, state, borne(problem, state, draws))
    if len(halves) < 2:
        return Deviations([], [])
    odd = [np.array([half[trial] for half, _ in halves]) for trial in range(problem.n_trials)]
    even = [np.array([half[trial] for _, half in halves]) for trial in range(problem.n_trials)]
    # With the variance that such deviations have from a mean over other draws.
    scale = np.sqrt((1.0 + 1.0 / n_averaged) * len(halves) / (len(halves) - 1.0))
    return Deviations(odd, [scale * (part - part.mean(axis=0)) for part in even])


def _halves(problem: Problem, state: State, draws: NoiseDraws) -> list[tuple[list[Array], list[Array]]]:
    """White odd and even parts of each pair with which no arm diverges, of each trial (number,)."""
    return [
        (problem.white(odd), problem.white(even))
        for odd, even in problem.odd_and_even(state, draws)
        if np.isfinite(odd).all() and np.isfinite(even).all()
    ]


def mixed_information(problem: Problem, state: State, slopes: Sequence[Array], answers: Sequence[Array]) -> Array:
    """By how much the score, `Normal.slope`, falls per change of the unknowns, without the prior, (unknown, unknown).

    The score weighs residuals by derivatives without noise, and predictions move by those in its presence.

    Args:
      problem: what is fitted.
      state: where the fit is.
      slopes: from `Problem.slopes`.
      answers: the noisy ones; the same ones count as they are.
    """
    of_movement = problem.gathered(state, [a @ b.T for a, b in zip(slopes, answers, strict=True)])
    return of_movement + problem.emg_normal(state).matrix


def inverse_of_mixed(alone: Array, mixed: Array) -> Array:
    """Inverse of `mixed_information`, (unknown, unknown).

    In directions in which the derivatives without noise and those in its presence have little in common, a share
    `LEAST_SHARE` of what the former alone would tell counts.

    Args:
      alone: information of the derivatives without noise alone, with the prior.
      mixed: with the prior.
    """
    scale = np.sqrt(np.diag(alone))
    power, directions = np.linalg.eigh(alone / np.outer(scale, scale))
    to_white = directions / np.sqrt(np.maximum(power, TINY * power[-1])) / scale[:, None]
    left, share, right = np.linalg.svd(to_white.T @ mixed @ to_white)
    return np.asarray(to_white @ (right.T / np.maximum(share, LEAST_SHARE)) @ left.T @ to_white.T)


def score_variance(problem: Problem, state: State, slopes: Sequence[Array], deviations: Deviations) -> Array:
    """Variance of `Normal.slope` over other noise of the person and of the EMG, (unknown, unknown).

    It is larger by what is uncertain of the spectra of both, as each is estimated from the trials that it weighs.

    Args:
      problem: what was fitted.
      state: where the fit is.
      slopes: from `Problem.slopes`.
      deviations: from `simulate_deviations`.
    """
    parts = []
    sure = [noise.sure for trials, noise in zip(problem.sets, problem.noises, strict=True) for _ in trials.onset]
    for columns, odd, even, of_trial in zip(slopes, *deviations, sure, strict=True):
        scores = (np.concatenate([odd, even]) / of_trial) @ columns.T
        parts.append(scores.T @ scores / len(odd))
    of_emg = problem.emg_normal(state, as_variance=True).matrix
    return problem.gathered(state, parts) + of_emg + np.diag(problem.prior(state))


def lack_of_fit(
    problem: Problem, state: State, predicted: Array, slopes: Sequence[Array], deviations: Deviations
) -> dict[str, LackOfFit]:
    """Condition to what is left in its residual that the disturbance explains, with the noise as last estimated.

    Were the noise stationary, the sum of squares would have a chi-squared distribution. Draws, as a fit leaves them,
    tell its distribution: it is approximated by a scaled chi-squared one of the same mean and variance.

    Args:
      problem: what was fitted.
      state: where the fit is.
      predicted: there.
      slopes: from `Problem.slopes`.
      deviations: from `simulate_deviations`; none if predictions are without noise.
    """
    left = [problem.white(problem.residual(predicted))]
    left += problem.unexplained(state, slopes, deviations.signed())
    sums: dict[str, Array] = {}
    dof: dict[str, int] = {}
    for trials, rows, noise in zip(problem.sets, problem.rows, problem.noises, strict=True):
        chi2, numbers = noise.lack_of_fit(np.array([record[rows] for record in left]), problem.perturbation[rows])
        sums[trials.label] = sums.get(trials.label, 0.0) + chi2
        dof[trials.label] = dof.get(trials.label, 0) + numbers
    result = {}
    for label, (of_trials, *of_draws) in sums.items():
        if of_draws:
            mean, variance = float(np.mean(of_draws)), float(np.var(of_draws, ddof=1))
            dof[label] = max(1, round(2.0 * mean**2 / variance))
            of_trials *= dof[label] / mean
        result[label] = LackOfFit(float(of_trials), dof[label])
    return result
