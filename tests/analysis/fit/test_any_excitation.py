"""Estimates of arms that the package did not make, from any excitation, from rest or amid the movement."""

import numpy as np
import pytest
from foreign_arms import admittance
from foreign_recordings import draw_foreign

from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.identify import identify
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.response.closed_loop import estimate_noise

JUDGED = ("k_s", "k_se", "k_e", "b_s", "b_se", "b_e")
# Linear arms that move little: no search is made longer because another geometry, which is tried too, fits worse.
QUICK = {"reflex": "none", "grip": "rigid", "rate": 100.0, "rms": 0.001, "linear": True}


STRUCTURE = composed(inertia="free", grip="rigid", reflex="none")


def estimated(setup):
    """What `identify` makes of trials in the geometry that they were recorded in, without its search for another."""
    return estimate([Group.prepare(setup.recording(), STRUCTURE)])


def scores(fit, truth):
    return np.array([(fit.values[name] - truth[name]) / fit.standard_error[name] for name in JUDGED])


@pytest.mark.slow(reason="simulates and fits foreign arms")
@pytest.mark.parametrize("amid", [False, True], ids=["from rest", "amid"])
@pytest.mark.parametrize("kind", ["multisine", "noise", "filtered noise", "chirp", "pulses"])
def test_any_excitation_tells_the_arm(kind, amid):
    setup = draw_foreign(3, kind=kind, amid=amid, n_trials=4, duration=12.0, **QUICK)
    # With all of it where the disturbance is of another kind than those of multisines in the tests of the ladder.
    searched = amid and kind != "multisine"
    found = identify(setup.recording(), STRUCTURE).fit.detail if searched else estimated(setup)
    assert np.abs(scores(found, setup.truth)).max() < 4.0
    assert found.chi2 < 1.5 * found.dof
    assert not found.is_suspicious


@pytest.mark.parametrize("rate", [25.0, 40.0, 50.0])
def test_slow_samples_tell_the_arm_amid_movement(rate):
    options = {**QUICK, "rate": rate, "kind": "multisine", "n_trials": 2, "duration": 12.0, "period": 5.0}
    setup = draw_foreign(3, amid=True, top=8.0, **options)
    found = estimated(setup)
    assert np.abs(scores(found, setup.truth)).max() < 4.0


@pytest.mark.slow(reason="simulates and fits foreign arms")
def test_records_may_differ_in_length():
    long, short = (draw_foreign(3, kind="noise", n_trials=2, duration=duration, **QUICK) for duration in (12.0, 8.0))
    both, alone = estimate([Group.prepare([long.recording(), short.recording()], STRUCTURE)]), estimated(long)
    assert np.abs(scores(both, long.truth)).max() < 4.0
    for name in JUDGED:
        assert both.standard_error[name] < alone.standard_error[name]


@pytest.mark.slow(reason="simulates and fits foreign arms")
def test_trials_that_differ_widen_intervals_and_are_told():
    options = {"kind": "multisine", "n_trials": 8, "duration": 15.0, "period": 5.0, **QUICK}
    alike, differing = (estimated(draw_foreign(5, spread=spread, **options)) for spread in (0.0, 0.1))
    assert not alike.trial_spread
    assert 0.05 < differing.trial_spread["k"] < 0.2
    assert differing.standard_error["k_s"] > 3 * alike.standard_error["k_s"]
    assert 6.0 < differing.degrees_of_freedom["k_e"] < 20.0


@pytest.mark.slow(reason="simulates trials")
def test_below_the_start_of_sweeps_nothing_is_asked():
    setup = draw_foreign(921, kind="chirp", rate=200.0)
    recording = setup.recording()
    with pytest.raises(ValueError, match=r"not independent at 0\.1"):
        estimate_noise(recording, frequency=[0.1])
    found = estimate_noise(recording)
    assert 0.1 < found.frequency[0] < 0.3  # they start at 0.2 Hz
    assert len(found.frequency) > 20
    truth = admittance(setup.arm, found.frequency)
    off = np.abs(found.response - truth) / np.abs(truth).max(axis=(1, 2), keepdims=True)
    assert np.median(off) < 0.03
