"""The scatter of scores over trials, against scores that are drawn with a known one."""

import numpy as np
import pytest

from armperturb.analysis.fit.trial_effects import TrialScore, scatter
from armperturb.analysis.trials import ConditionTrials


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
