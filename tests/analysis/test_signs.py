"""What no handle can show is said of recordings that come as arrays, which no converter has checked."""

import re

import numpy as np
import one_joint
import pytest
from foreign_arms import Arm
from foreign_recordings import Setup
from laboratory import handle, laboratory_recording

import armperturb as ap
from armperturb.analysis.manipulator import impossible
from armperturb.analysis.trials import prepared

WRONG = {
    "as it would if the sign of force were turned": lambda d, f, x: (d, -f, x),
    "as it would if x and y of displacement were swapped": lambda d, f, x: (d, f, x[..., ::-1]),
    "d - f moves a mass of 0.003 kg; expected 0.1 to 60 kg": lambda d, f, x: (d, f, 1e3 * x),
}


@pytest.mark.parametrize("said", WRONG)
def test_signs_axes_and_units_that_no_handle_has_are_named(said):
    assert impossible([prepared(laboratory_recording(*map(handle, range(2))))]) == ()
    trials = prepared(laboratory_recording(*(WRONG[said](*handle(seed)) for seed in range(2))))
    (wrong,) = impossible([trials])
    assert said in wrong
    assert impossible([trials.take([0])]) == (wrong,)


@pytest.mark.parametrize("seconds", [0.5, 3.0])
def test_records_that_are_too_short_to_judge_are_left_alone(seconds):
    d, f, x = handle()
    n = round(200 * seconds)
    assert impossible([prepared(laboratory_recording((d[:n], -f[:n], x[:n])))]) == ()


@pytest.mark.slow(reason="fits recordings")
def test_responses_and_fits_remark_on_them():
    recording = Setup(arm=Arm(), n_trials=2, duration=20.0).recording()
    assert ap.response(recording).remarks == ()
    turned = recording.assign(force=-recording["force"])
    found = ap.response(turned)
    (wrong,) = found.remarks
    assert "as it would if the sign of force were turned" in wrong
    assert wrong[:60] in found.summary()
    millimetres = recording.assign(displacement=1e3 * recording["displacement"])
    millimetres["displacement"].attrs = recording["displacement"].attrs
    said = ap.identify(millimetres, "1", estimator="frequency").fit.remarks
    assert any("kg; expected 0.1 to 60 kg (a wrong unit of displacement" in remark for remark in said)
    assert np.isfinite(ap.response(millimetres).response).all()


def scaled(recording, name, factor):
    """The recording with a signal multiplied by a factor, in the unit that it had."""
    return recording.assign({name: (factor * recording[name]).assign_attrs(recording[name].attrs)})


TURNED = r"inertia comes out at -0\.0.*as it would if the sign of force were turned"


@pytest.mark.slow(reason="balances many recordings")
@pytest.mark.parametrize(
    ("servo", "name", "factor", "said"),
    [
        ("position", "displacement", -1.0, TURNED),
        ("force", "force", -1.0, TURNED),
        (
            "position",
            "displacement",
            np.degrees(1.0),
            r"to 0\.4 kg m\^2 of the ankle \(an angle in degrees declared",
        ),
    ],
)
def test_signs_and_units_that_no_joint_has_are_remarked_on(servo, name, factor, said):
    recording = one_joint.recording(one_joint.person("ankle", 9, "linear"), 9, servo, duration=12.0, decibel=20.0)
    wrong = scaled(recording, name, factor)
    for function, options in ((ap.response, {"frequency": [3.0, 9.0]}), (ap.identify_joint, {"reflex": "none"})):
        right, remarks = (function(each, **options).remarks for each in (recording, wrong))
        assert [sum("comes out at" in each for each in found) for found in (right, remarks)] == [0, 1]
        assert any(re.search(said, remark) for remark in remarks)
