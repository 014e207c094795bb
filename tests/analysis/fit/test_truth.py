import math
from dataclasses import replace

import pytest

from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.fit.truth import at_truth, departures
from armperturb.anthropometry import anthropometric_body
from armperturb.cohort import draw_person
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import POSITION, RELAX


def remarks(model, truth):
    return departures(at_truth(STRUCTURES[model], truth).named(model), truth)


@pytest.mark.parametrize(("model", "truth"), [("3b", POSITION), ("3", POSITION), ("4", POSITION), ("1", RELAX)])
def test_nothing_is_said_of_an_arm_that_the_structure_can_be(model, truth):
    assert remarks(model, truth) == ()


def test_feedback_that_is_left_out_is_named():
    (left_out,) = remarks("1", replace(POSITION, Td_s=0.04))  # a delay of nothing is no matter
    assert left_out.startswith("model 1 leaves out kv, kp of 'position': estimates will be biased")
    (left_out,) = remarks("2", POSITION)
    assert "leaves out kp of" in left_out


def test_shares_of_the_mass_that_differ_from_the_tied_ones_are_named():
    (tied,) = remarks("3a", draw_person(0, 0, muscles="linear").subjects["PT"])
    assert "model 3a is not exact for 'S01': m_h = 1.929 instead of 2.067 kg, m_f = 2.007 instead of 1.874 kg" in tied
    assert remarks("3b", replace(POSITION, m_h=1.656, m_f=1.724)) == ()  # rounded in a file


def test_what_identify_fixes_elsewhere_is_named_with_the_option():
    _, fixed = remarks("3b", RELAX)
    assert fixed == (
        "identify --model 3b fixes b_h = 32.8 instead of 22.3 Ns/m, k_h = 8400 instead of 8200 N/m: "
        "what is said here holds with --fix b_h=22.3 k_h=8200 only"
    )
    (rigid,) = remarks("3b", replace(POSITION, k_h=math.inf))
    assert rigid.endswith("--fix k_h=rigid only")
    (delay,) = remarks("3b", replace(POSITION, Td_e=0.04))
    assert "fixes Td_e = 0.03 instead of 0.04 s" in delay


def test_what_is_fixed_beside_the_truth_on_purpose_is_named():
    (wrong,) = departures(STRUCTURES["3b"].fixing(k_h=20000.0).named("3b"), POSITION)
    assert "k_h = 2e+04 instead of 2.24e+04 N/m" in wrong


def test_a_muscle_law_is_in_no_model():
    (muscle,) = remarks("3b", replace(POSITION, muscle=MuscleLaw()))
    assert muscle.startswith("no model has the [muscle] of 'position'")


def test_segments_that_are_no_point_masses_are_named():
    (mass,) = remarks("1", replace(RELAX, **anthropometric_body("male", 1.8, 75.0)))
    assert mass.startswith(
        "identify --model 1 takes segments for point masses in their middle, which those of 'relax' "
    )
    assert "c_h = " in mass
