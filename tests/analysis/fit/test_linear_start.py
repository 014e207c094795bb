from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.fit.linear_start import linear_start
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.cohort import draw_subject
from armperturb.perturbations.multisine import CLUSTERS, PERIOD
from armperturb.subject import POSITION, RELAX

FREQUENCY = CLUSTERS.mean(axis=1) / PERIOD


def true_value(arm, name):
    return arm.m_h + arm.m_f if name == "m_tot" else getattr(arm, name)


def start_of(arm, structure, frequency=FREQUENCY):
    return dict(
        zip(structure.free, linear_start(frequency, arm_admittance(arm, frequency), arm, structure), strict=True)
    )


@pytest.mark.parametrize("seed", range(8))
def test_where_the_impedance_is_linear_in_all_that_is_free_the_start_is_the_arm(seed):
    arm, structure = draw_subject("position", seed), STRUCTURES["3a"]
    for name, value in start_of(arm, structure).items():
        lower, upper = structure.bounds[name]
        if all(lower <= true_value(arm, one) <= upper for one in structure.free):
            assert value == pytest.approx(true_value(arm, name), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_with_a_grip_that_is_guessed_the_start_is_near_the_arm(seed):
    arm = replace(draw_subject("relax", seed), k_h=8.2e3, b_h=30.0)  # guessed: 8.4 kN/m, 32.8 Ns/m
    for name, value in start_of(arm, STRUCTURES["1"], FREQUENCY).items():
        if name not in ("b_h", "k_h"):
            assert value == pytest.approx(true_value(arm, name), rel=0.15, abs=0.3 if name == "k_se" else 0.0)


def test_with_delay_and_cut_off_free_the_best_of_the_tried_ones_is_taken():
    fixed = {
        f"{quantity}_{joint}": getattr(POSITION, f"{quantity}_{joint}") for quantity in ("fact",) for joint in "se"
    }
    structure = STRUCTURES["3a"].freeing(Td_s=(0.0225, 0.03, 0.0525)).tying(Td_e={"Td_s": 1.0})
    found = start_of(POSITION, structure.fixing(**fixed))
    assert found["Td_s"] == pytest.approx(0.0275)  # tried: 27.5, 37.5 and 47.5 ms, the truth being 30 ms
    for name in ("m_tot", "k_s", "k_e", "kv_e"):
        assert found[name] == pytest.approx(true_value(POSITION, name), rel=0.15)


def test_bounds_hold_whatever_the_admittance():
    rng = np.random.default_rng(0)
    for name, structure in STRUCTURES.items():
        arm = POSITION if name != "1" else RELAX
        noisy = arm_admittance(arm, FREQUENCY) * np.exp(rng.normal(size=(len(FREQUENCY), 2, 2)))
        values = linear_start(FREQUENCY, noisy, arm, structure)
        lower, upper = np.array(list(structure.bounds.values())).T
        assert ((lower <= values) & (values <= upper)).all()


def test_a_bound_that_cuts_the_arm_off_is_met_and_the_others_make_up_for_it():
    structure = STRUCTURES["3b"].freeing(k_s=(0.0, 50.0, 100.0))
    found = start_of(POSITION, structure)
    assert found["k_s"] == pytest.approx(100.0)
    assert found["kp_s"] > POSITION.kp_s + 20.0
