"""The thesis's numbers in SI units."""

import math

import pytest

from armperturb.study import published


def test_units_are_si():
    assert published.joint_motion("PT7.5", "s", "rms_rotation").mean == pytest.approx(math.radians(1.7))
    assert published.joint_motion("RT22.5", "e", "rms_velocity").sd == pytest.approx(math.radians(8.5))
    assert published.joint_motion("PT0", "e", "peak_rotation", pulse="max").mean == pytest.approx(math.radians(17.2))
    assert published.rms_displacement("RT2.5") == pytest.approx((4.3e-3, 1.5e-3))
    assert published.applied_force("PT22.5") == pytest.approx((16.6, 4.8))
    assert published.pulse_unit() == pytest.approx((53.9, 13.0))
    assert published.parameter("RT22.5", "k_h").mean > 1e3


@pytest.mark.parametrize(
    "call",
    [
        lambda: published.applied_force("PT0"),
        lambda: published.rms_displacement("PT5"),
        lambda: published.joint_motion("PT0", "s", "rms_rotation"),
        lambda: published.parameter("PT2.5", "k_s"),
        lambda: published.parameter("PT7.5", "kf_s"),
    ],
)
def test_what_is_not_printed_is_a_key_error(call):
    with pytest.raises(KeyError, match=r"no "):
        call()
