"""What differs between the trials of a joint, and what that adds to the errors of an estimate that takes them as alike.

In trial t, damping, stiffness and reflex gain are those of the joint times 1 + u_tq, see `fit.trial_effects`, whose
mixed model tells the standard deviations w_q. With information I_t of trial t and D as there, estimates vary by

    A (sum_t I_t D diag(w^2) D^T I_t) A,   A = (sum_t I_t)^-1,

more than noise alone makes them. The noise is estimated with what differs taken out.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.analysis.fit.trial_effects import TrialScore, differing, fit_mixed, inverse
from armperturb.analysis.joint.estimate import JointEstimate
from armperturb.analysis.joint.likelihood import JointLikelihood, Loop
from armperturb.analysis.joint.signals import JointSignals
from armperturb.arrays import Array

QUANTITIES = ("damping", "stiffness", "short_range_stiffness", "reflex_gain")
"""What may differ between trials."""

ROUNDS = 4
"""Of what differs and noise, at most."""

SETTLED = 0.01
"""Change of the factors of trials below which the rounds end [-]."""


class TrialDifferences(NamedTuple):
    """How much the trials of a joint differ.

    Attributes:
      spread: quantity to the standard deviation over trials of the factor on it [-]; without those that do not differ.
      added: covariance of the estimates' errors that comes from it, (parameter, parameter).
      degrees_of_freedom: of the variance of each parameter, (parameter,); infinite where nothing differs.
    """

    spread: Mapping[str, float]
    added: Array
    degrees_of_freedom: Array


def trial_differences(fit: JointEstimate, signals: JointSignals, loop: Loop | None) -> TrialDifferences:
    """How much trials differ; nothing where there are fewer than three, which do not tell.

    Args:
      fit: of all trials.
      signals: of these.
      loop: the virtual environment of a force servo; None of a position servo.
    """
    names, free = fit.structure.parameters, np.flatnonzero(~fit.at_bound)
    added, dof = np.zeros((len(names), len(names))), np.full(len(names), np.inf)
    nothing = TrialDifferences({}, added, dof)
    likelihood = JointLikelihood(fit.structure, signals, loop)
    if likelihood.n_trials < FEWEST_TRIALS:
        return nothing
    design = np.array(
        [[fit.values[place] if names[place] == quantity else 0.0 for quantity in QUANTITIES] for place in free]
    )
    effects = np.zeros((likelihood.n_trials, len(QUANTITIES)))
    for _ in range(ROUNDS):
        likelihood.take_out(fit.values, free, effects @ design.T)
        likelihood.weigh(fit.values)
        rows = likelihood.derivatives(fit.values, likelihood.movement(fit.values))[free]
        scores = []
        for slopes, left, effect in zip(rows.swapaxes(0, 1), likelihood.residual(fit.values), effects, strict=True):
            information = slopes @ slopes.T
            score = slopes @ left + information @ (design @ effect)
            scores.append(TrialScore(range(len(free)), score, information, design))
        mixed = fit_mixed(scores, len(free))
        before = effects
        effects = np.array([w @ design.T @ each.score for w, each in zip(mixed.weights, scores, strict=True)])
        if np.abs(effects - before).max() < SETTLED:
            break
    if not mixed.spread.any():
        return nothing
    whole = inverse(np.sum([each.information for each in scores], axis=0))
    moved = whole @ np.sum(
        [each.information @ (design * mixed.spread**2) @ design.T @ each.information for each in scores], axis=0
    )
    added[np.ix_(free, free)] = moved @ whole
    dof[free] = mixed.dof
    return TrialDifferences(differing(QUANTITIES, mixed.spread), added, dof)
