"""Joints whose trials differ: their intervals are those of the mean over trials."""

import numpy as np
import one_joint
import pytest
from scipy import stats

from armperturb.analysis.fit.trial_effects import FEW
from armperturb.analysis.joint.estimate import estimate_joint
from armperturb.analysis.joint.identify import identify_joint
from armperturb.analysis.joint.likelihood import environment_of
from armperturb.analysis.joint.model import JointStructure
from armperturb.analysis.joint.signals import joint_signals
from armperturb.analysis.joint.trial_differences import trial_differences


@pytest.mark.parametrize(
    "servo", ["position", pytest.param("force", marks=pytest.mark.slow(reason="ten closed loops"))]
)
def test_intervals_hold_the_mean_over_trials_that_differ(servo):
    held, held_by_noise, found = [], [], []
    for seed in range(10):
        joint = one_joint.person("ankle", seed, "none")
        signals = joint_signals(one_joint.trials(joint, seed, 0.08, servo=servo))
        loop = environment_of(signals) if servo == "force" else None
        fit = estimate_joint(JointStructure(reflex="none"), signals, loop)
        differences = trial_differences(fit, signals, loop)
        found.append([differences.spread.get(name, 0.0) for name in ("damping", "stiffness")])
        miss = np.abs(fit.values - [joint.inertia, joint.damping, joint.stiffness])[1:]
        covariance = fit.covariance + differences.added
        limit = stats.t.ppf(0.975, differences.degrees_of_freedom) * np.sqrt(np.diag(covariance))
        held.extend(miss < limit[1:])
        held_by_noise.extend(miss < 1.96 * np.sqrt(np.diag(fit.covariance))[1:])
    # Of 20 intervals of 95 %, fewer than 17 hold in 1.6 % of cases.
    assert sum(held) >= 17
    assert sum(held_by_noise) <= 10
    assert 0.05 < np.mean(found) < 0.11


@pytest.mark.slow(reason="identifies a joint")
def test_trials_that_are_alike_widen_no_interval():
    differing = 0
    for seed in range(6):
        joint = one_joint.person("ankle", seed, "none")
        signals = joint_signals(one_joint.trials(joint, seed, 0.0))
        fit = estimate_joint(JointStructure(reflex="none"), signals)
        differences = trial_differences(fit, signals, None)
        differing += bool(differences.spread)
        if not differences.spread:
            assert not differences.added.any()
            assert np.isinf(differences.degrees_of_freedom).all()
    assert differing <= 1


@pytest.mark.slow(reason="a fit of three trials with a half-wave, and its profiles")
def test_a_result_says_what_differs_and_widens_profiles():
    joint = one_joint.person("ankle", 3)
    recording = one_joint.trials(joint, 3, 0.15, n_trials=3)
    result = identify_joint(recording, reflex="half-wave")
    assert {"stiffness", "reflex_gain"} <= result.trial_spread.keys()
    assert any("intervals are of the mean over trials" in fact for fact in result.describe().facts)
    assert FEW not in result.remarks
    limits = result.interval("reflex_gain")
    half = 0.5 * (limits.upper - limits.lower)
    assert half > 2.0 * result.standard_error["reflex_gain"]  # Student's t, where 1.96 is the normal quantile
    assert half / result.values["reflex_gain"] > 0.1
    alone = identify_joint(recording.isel(trial=[0]), reflex="none")
    assert FEW in alone.remarks
    assert not alone.trial_spread
