"""What says nothing of the arm changes no result: axes, offsets, order and copies of trials, and small sizes."""

from dataclasses import replace
from functools import cache

import invented_emg
import numpy as np
import one_joint
import pandas as pd
import pytest
from foreign_arms import Arm
from foreign_recordings import Setup

import armperturb as ap
from armperturb.analysis.response.estimate import METHODS

ANGLE_DEG = 40.0
TURN = np.array(
    [
        [np.cos(np.radians(ANGLE_DEG)), -np.sin(np.radians(ANGLE_DEG))],
        [np.sin(np.radians(ANGLE_DEG)), np.cos(np.radians(ANGLE_DEG))],
    ]
)
OPTIONS = {"multitaper": {"half_bandwidth": 0.5}}
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


@pytest.fixture(scope="module")
def response_to(recording):
    """A function of a method: the response that it finds in the recording."""
    return cache(lambda method: ap.response(recording, method, **OPTIONS.get(method, {})))


@pytest.fixture(scope="module")
def fit_to(recording):
    """A function of an estimator: its fit to the recording."""
    return cache(lambda estimator: ap.identify(recording, "1", estimator=estimator).fit)


@pytest.mark.slow(reason="estimates several responses")
@pytest.mark.parametrize("method", ["multisine", "noise", "arx"])
def test_a_response_turns_with_its_axes(response_to, other, method):
    before, after = response_to(method), ap.response(other, method)
    np.testing.assert_array_equal(after.frequency, before.frequency)
    turned = np.einsum("ij,...jk,lk->...il", TURN, before.response, TURN)
    assert np.abs(after.response - turned).max() < 1e-3 * np.abs(turned).max()


@pytest.mark.slow(reason="estimates responses")
@pytest.mark.parametrize("seed", [4, 5])
def test_the_order_of_trials_does_not_choose_that_of_a_polynomial(seed):
    arm = replace(Arm(), kp=(10.0, 3.0, 10.0), kv=(5.0, 1.0, 5.0))
    setup = Setup(arm=arm, kind="noise", duration=18.0, n_trials=2, rate=100.0, rms=3e-3, linear=True, seed=seed)
    recording = setup.recording()
    before, after = (ap.response(each, "noise").response for each in (recording, recording.isel(trial=[1, 0])))
    np.testing.assert_allclose(after, before, rtol=1e-6)


@pytest.mark.slow(reason="fits two recordings")
@pytest.mark.parametrize("estimator", ["record", "frequency"])
def test_parameters_are_the_same(fit_to, other, estimator):
    before, after = fit_to(estimator), ap.identify(other, "1", estimator=estimator).fit
    for name, value in before.values.items():
        assert after.values[name] == pytest.approx(value, abs=0.01 * before.standard_error[name]), name
        assert after.standard_error[name] == pytest.approx(before.standard_error[name], rel=0.01), name
    assert len(after.remarks) == len(before.remarks)
    area = [fit.endpoint()["stiffness"].area for fit in (before, after)]
    assert area[1] == pytest.approx(area[0], rel=1e-3)


COPIES = ("trial 3 repeats trial 0 and is left out", "trial 4 repeats trial 2 and is left out")


@pytest.fixture(scope="module")
def copied(recording):
    return recording.isel(trial=[0, 1, 2, 0, 2])


@pytest.mark.slow(reason="estimates several responses")
@pytest.mark.parametrize("method", list(METHODS))
def test_a_response_does_not_depend_on_copies(response_to, copied, method):
    before, after = response_to(method), ap.response(copied, method, **OPTIONS.get(method, {}))
    np.testing.assert_array_equal(after.response, before.response)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.remarks == (*COPIES, *before.remarks)


@pytest.mark.slow(reason="estimates a response")
def test_trials_of_several_recordings_count_once(response_to, recording, copied):
    before, after = response_to("welch"), ap.response([copied, recording.isel(trial=[1])], "welch")
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert after.remarks[-1] == "trial 0 of recording 1 repeats trial 1 of recording 0 and is left out"


@pytest.mark.slow(reason="fits two recordings")
@pytest.mark.parametrize("estimator", ["record", "frequency", "thesis"])
def test_parameters_do_not_depend_on_copies(fit_to, copied, estimator):
    before, after = fit_to(estimator), ap.identify(copied, "1", estimator=estimator).fit
    assert (after.values, after.standard_error) == (before.values, before.standard_error)
    assert [remark for remark in after.remarks if remark not in before.remarks] == list(COPIES)
    (of_all,) = (each.fit for each in ap.identify_conditions(copied, "1", estimator=estimator).values())
    assert (of_all.standard_error, of_all.remarks) == (after.standard_error, after.remarks)


@pytest.mark.slow(reason="fits joints twice")
@pytest.mark.parametrize("identify", [ap.identify_joint, ap.identify_varying])
def test_a_joint_does_not_depend_on_copies(identify):
    joint = one_joint.person("ankle", 1, "none")
    parts = [one_joint.recording(joint, 100 + trial, "position", duration=5.0) for trial in range(4)]
    recording = ap.stack_trials(parts)
    before, after = (
        identify(each, reflex="none").to_frame() for each in (recording, recording.isel(trial=[0, 1, 2, 0, 2, 3]))
    )
    pd.testing.assert_frame_equal(after, before)


def test_activity_does_not_depend_on_copies():
    volts = 1e-4 * np.random.default_rng(0).normal(size=(3, 2, 4000))
    recording = invented_emg.recorded(volts)
    path = np.random.default_rng(1).normal(size=recording["displacement"].shape)
    recording["displacement"] = recording["displacement"].copy(data=1e-3 * path)
    before, after = (ap.activity(ap.envelopes(each)) for each in (recording, recording.isel(trial=[0, 1, 2, 0, 2])))
    pd.testing.assert_frame_equal(after.levels, before.levels)
    assert after.remarks == (*COPIES, *before.remarks)
