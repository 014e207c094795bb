"""EMG as an output of the arm's model: which muscles make a group's difference."""

from dataclasses import replace

import numpy as np
import pytest
from invented_emg import noise, recorded

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.outputs import dead_muscles, reflex_outputs
from armperturb.analysis.trials import ConditionTrials
from armperturb.recording import Action

MUSCLES = {"one": Action("s", 1), "two": Action("s", 1), "against": Action("s", -1)}


@pytest.fixture(scope="module")
def recording():
    return recorded(noise((3, 3, 20_000)), muscles=MUSCLES)


def dead(amplitudes, *columns):
    """The same envelopes, in whose second trial channels are dead for a second."""
    power, rectified = amplitudes.power.copy(), amplitudes.rectified.copy()
    for column in columns:
        power[1, 200:400, column] = rectified[1, 200:400, column] = np.nan
    return replace(amplitudes, power=power, rectified=rectified)


def test_a_muscle_that_is_dead_in_a_trial_is_left_out_of_all(recording):
    trials, amplitudes = ConditionTrials.prepare(recording), envelopes(recording)
    assert (dead_muscles(trials, amplitudes), dead_muscles(trials, dead(amplitudes, 0))) == ([], ["one"])
    without = reflex_outputs(trials, dead(amplitudes, 0)).difference
    values = amplitudes.amplitudes(slice(None))
    expected = values[..., 2] - values[..., 1]
    expected -= expected.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(without[..., 0], expected[:, : without.shape[1]], atol=1e-12)
    both = reflex_outputs(trials, dead(amplitudes, 0, 2)).difference
    alone = -values[..., 1] + values[..., 1].mean(axis=1, keepdims=True)
    np.testing.assert_allclose(both[..., 0], alone[:, : both.shape[1]], atol=1e-12)
    with pytest.raises(ValueError, match=r"EMG is not used: every muscle is dead in some trial of RT7\.5"):
        reflex_outputs(trials, dead(amplitudes, 0, 1, 2))
