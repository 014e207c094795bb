"""What says nothing of the arm changes no result: axes, offsets, order of trials, and the size of small movements."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_arms import Arm
from foreign_recordings import Setup

import armperturb as ap

ANGLE_DEG = 40.0
TURN = np.array(
    [
        [np.cos(np.radians(ANGLE_DEG)), -np.sin(np.radians(ANGLE_DEG))],
        [np.sin(np.radians(ANGLE_DEG)), np.cos(np.radians(ANGLE_DEG))],
    ]
)
OFFSETS = {"perturbation": [0.0, 0.0], "force": [3.0, -2.0], "displacement": [0.04, -0.02]}


@pytest.fixture(scope="module")
def recording():
    """An arm that moves by a millimetre amid a multisine, so that the geometry of its posture is all that matters."""
    arm = replace(Arm(), kp=(0.0, 0.0, 0.0))
    return Setup(arm=arm, period=5.0, duration=18.0, n_trials=3, rms=1e-3, amid=True, rate=100.0).recording()


@pytest.fixture(scope="module")
def other(recording):
    """The same in axes that are turned, a third as large, with offsets, in single precision and in another order."""
    turned = {
        name: recording[name].copy(data=np.float32(recording[name].values @ TURN.T / 3.0 + offset))
        for name, offset in OFFSETS.items()
    }
    shoulder = recording["theta_s_deg"] + ANGLE_DEG
    return recording.assign(turned).assign_coords(theta_s_deg=shoulder).isel(trial=[2, 0, 1])


@pytest.mark.slow(reason="estimates several responses")
@pytest.mark.parametrize("method", ["multisine", "noise", "arx"])
def test_a_response_turns_with_its_axes(recording, other, method):
    before, after = (ap.response(each, method=method) for each in (recording, other))
    np.testing.assert_array_equal(after.frequency, before.frequency)
    turned = np.einsum("ij,...jk,lk->...il", TURN, before.response, TURN)
    assert np.abs(after.response - turned).max() < 1e-3 * np.abs(turned).max()


@pytest.mark.slow(reason="fits two recordings")
@pytest.mark.parametrize("estimator", ["record", "frequency"])
def test_parameters_are_the_same(recording, other, estimator):
    before, after = (ap.identify(each, "1", estimator=estimator).fit for each in (recording, other))
    for name, value in before.values.items():
        assert after.values[name] == pytest.approx(value, abs=0.01 * before.standard_error[name]), name
        assert after.standard_error[name] == pytest.approx(before.standard_error[name], rel=0.01), name
    assert len(after.remarks) == len(before.remarks)
    area = [fit.endpoint()["stiffness"].area for fit in (before, after)]
    assert area[1] == pytest.approx(area[0], rel=1e-3)
