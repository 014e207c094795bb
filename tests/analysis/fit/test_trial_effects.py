"""Differences between trials against dense restricted likelihood, and scatter against scores that are drawn."""

import numpy as np
import pytest

from armperturb.analysis.fit.trial_effects import TrialScore, fit_mixed, scatter
from armperturb.analysis.trials import ConditionTrials


def test_spreads_are_the_most_likely_and_the_rest_is_generalised_least_squares():
    rng, n_trials = np.random.default_rng(0), 8
    design = np.zeros((5, 2))
    design[[0, 1], 0], design[[2, 3], 1] = (2.0, 3.0), (1.5, 2.5)
    slopes = 8.0 * rng.standard_normal((n_trials, 40, 5))
    effects = rng.standard_normal((n_trials, 2)) * [0.1, 0.2]
    residual = np.einsum("tnp,pq,tq->tn", slopes, design, effects) + rng.standard_normal((n_trials, 40))
    trials = [TrialScore(range(5), s.T @ r, s.T @ s, design) for s, r in zip(slopes, residual, strict=True)]

    def restricted(spread):
        """Minus twice the restricted likelihood, the information, and the estimate, from dense covariances."""
        of_effects = slopes @ (design * spread)
        covariance = np.eye(40) + of_effects @ of_effects.swapaxes(1, 2)
        weighted = np.linalg.solve(covariance, slopes)
        information, slope = np.einsum("tnp,tnq->pq", slopes, weighted), np.einsum("tnp,tn->p", weighted, residual)
        estimate = np.linalg.solve(information, slope)
        left = residual - slopes @ estimate
        square = np.einsum("tn,tn->", left, np.linalg.solve(covariance, left[..., None])[..., 0])
        return (
            np.linalg.slogdet(covariance)[1].sum() + np.linalg.slogdet(information)[1] + square,
            information,
            estimate,
        )

    mixed = fit_mixed(trials, 5)
    least, information, estimate = restricted(mixed.spread)
    for change in 0.01 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]):
        # Where it is least, it rises with the square of a change.
        assert 0.0 < restricted(mixed.spread * np.exp(change))[0] - least < 0.01
    np.testing.assert_allclose(mixed.information, information, rtol=1e-9, atol=1e-9 * np.abs(information).max())
    np.testing.assert_allclose(np.linalg.solve(mixed.information, mixed.slope), estimate, rtol=1e-8)


@pytest.mark.parametrize("larger", [1.0, 3.0])
def test_scatter_is_how_much_more_scores_vary_than_their_information_says(larger):
    rng = np.random.default_rng(0)
    scatters = []
    for _ in range(200):
        informations = [np.cov(rng.standard_normal((4, 20))) + np.eye(4) for _ in range(8)]
        total = np.sum(informations, axis=0)
        scores = [np.sqrt(larger) * np.linalg.cholesky(each) @ rng.standard_normal(4) for each in informations]
        step = np.linalg.solve(total, np.sum(scores, axis=0))  # to the estimate, where they sum to zero
        left = zip(scores, informations, strict=True)
        trials = [TrialScore(range(4), score - each @ step, each, np.zeros((4, 1))) for score, each in left]
        scatters.append(scatter(trials, np.zeros(1), total))
    assert np.mean(scatters) == pytest.approx(larger, rel=0.05)


def test_trials_that_share_a_perturbation_are_not_independent(relax_recording):
    assert ConditionTrials.prepare(relax_recording).are_independent
    turned = relax_recording.copy(deep=True)
    turned["perturbation"][1] = -0.5 * turned["perturbation"][0]
    assert not ConditionTrials.prepare(turned, is_checked=True).are_independent
    pulsed = relax_recording.copy(deep=True)
    pulsed["perturbation"][:, [-300, -200], 0] = 1e3  # which no fit before the pulses uses
    onsets = ("trial", np.full(len(pulsed.trial), pulsed.time.values[-400]))
    assert ConditionTrials.prepare(pulsed.assign_coords(pulse_onset=onsets), is_checked=True).are_independent
    late = relax_recording.copy(deep=True)
    late["perturbation"][1] = np.roll(late["perturbation"][0], 20, axis=0)
    assert not ConditionTrials.prepare(late, is_checked=True).are_independent
