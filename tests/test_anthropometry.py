"""Bodies from tables against what the same sources print of the whole, and against the body's own bounds."""

from dataclasses import replace

import pytest

from armperturb.anthropometry import anthropometric_body
from armperturb.subject import RELAX


def test_forearm_and_hand_are_what_winter_prints_of_both_together():
    # Table 4.1: mass 0.022, centre 0.682 and radius 0.468 of the forearm's length, of a hand that is stretched out.
    body = anthropometric_body("male", 1.8, 75.0, "Winter")
    assert body["m_f"] == pytest.approx(0.022 * 75.0)
    assert body["c_f"] * body["l_f"] == pytest.approx(0.682 * 0.146 * 1.8, rel=0.05)
    assert body["r_f"] * body["l_f"] == pytest.approx(0.468 * 0.146 * 1.8, rel=0.05)


def test_both_sources_give_an_arm_of_much_the_same_inertia():
    arms = [replace(RELAX, **anthropometric_body("male", 1.8, 75.0, source)) for source in ("de Leva", "Winter")]
    for ours, theirs in zip(*(arm.segment_inertia for arm in arms), strict=True):
        assert ours == pytest.approx(theirs, rel=0.2)


def test_a_cuff_is_a_point_at_the_hand():
    bare, cuffed = (anthropometric_body("female", 1.7, 62.0, attached=mass) for mass in (0.0, 0.4))
    before, after = (replace(RELAX, **body).segment_inertia for body in (bare, cuffed))
    l_h, l_f = bare["l_h"], bare["l_f"]
    added = (0.4 * (l_h**2 + l_f**2), 0.4 * l_f**2, 0.4 * l_h * l_f)
    assert after == pytest.approx([one + other for one, other in zip(before, added, strict=True)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sex": "other"}, "sex = 'other'; expected one of male, female"),
        ({"source": "Dempster"}, "source = 'Dempster'; expected one of de Leva, Winter"),
        ({"height": 175.0}, r"height = 175\.0; expected a finite number at least 0\.5 and at most 2\.5"),
        ({"mass": 0.0}, r"mass = 0\.0; expected a finite number at least 5"),
        ({"attached": -1.0}, r"attached = -1\.0; expected a finite number at least 0"),
    ],
)
def test_bad_input_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        anthropometric_body(**{"sex": "male", "height": 1.8, "mass": 75.0, **change})
