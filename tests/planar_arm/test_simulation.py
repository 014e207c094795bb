"""Compiled arms against MuJoCo's, and against the linear model where arms are linear."""

import sys
from dataclasses import replace

import nonlinear_trials as made
import numpy as np
import pytest

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.cohort import draw_person
from armperturb.environment import Environment
from armperturb.muscle_law import MuscleLaw
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import POSITION, RELAX

OPPOSED = replace(RELAX, k_s=80.0, k_se=-30.0, k_e=70.0, b_s=3.0, b_se=-0.8, b_e=2.5, c_f=0.64, r_f=0.35)
"""Two-joint muscles that act against each other, and a forearm of distributed mass."""


@pytest.fixture(autouse=True, scope="module")
def compiled(once):
    once("compiled arms", made.compile_arms)


def answered(people, pushes, environment=None, rate=made.RATE, threads=1):
    """What compiled arms do, one for each push."""
    disturbances = Disturbances(np.array(pushes), rate, threads)
    lanes = lane_table(people, [environment or Environment()] * len(people), disturbances.timestep)
    return disturbances.responses(lanes, np.arange(len(people)))


@pytest.mark.parametrize(("task", "rms"), [("RT", 1.8), ("PT", 10.0)])
def test_people_of_the_cohort_move_as_in_mujoco(task, rms):
    person = draw_person(0, 3).subjects[task]
    force = made.push(1, rms, duration=6.0)
    (moved,) = answered([person], [force])
    for timestep, share in ((2.5e-3, 2e-4), (1e-3, 5e-3)):
        recorded = made.record(person, [force], timestep=timestep)["displacement"].values[0]
        # The elastic limits must have been passed for this to say anything of the law.
        assert np.abs(recorded).max() > 0.01
        assert np.abs(moved - recorded).max() < share * np.abs(recorded).max()


def test_law_and_reflexes_of_a_group_are_those_of_each_arm():
    people = [draw_person(n, 3).subjects[task] for n in range(5) for task in ("RT", "PT")]
    # Delays of whole, half and other numbers of steps.
    for n, (shoulder, elbow) in enumerate([(0.025, 0.03375), (0.0312, 0.0296), (0.0075, 0.35)]):
        people[2 * n + 1] = replace(people[2 * n + 1], Td_s=shoulder, Td_e=elbow)
    disturbances = Disturbances(np.array([made.push(n, 3.0, duration=3.0) for n in range(len(people))]), made.RATE)
    grouped = lane_table(people, [Environment()] * len(people), disturbances.timestep)
    assert grouped["grouped"].all()
    assert not grouped["lawful"].any()
    alone = grouped.copy()
    alone["lawful"], alone["grouped"] = 1.0, 0.0
    together, each = (disturbances.responses(lanes, np.arange(len(people))) for lanes in (grouped, alone))
    assert np.abs(together - each).max() < 1e-9 * np.abs(each).max()


def test_every_mechanism_acts_as_in_mujoco():
    law = MuscleLaw(
        short_range_stiffness=(9.0, 6.0, 4.0),
        elastic_limit_deg=(0.5, 0.7, 0.9),
        elastic_limit_spread=0.4,
        elastic_limit_slope=0.02,
        loss_angle_deg=(20.0, 30.0, 25.0),
        recovery_time=0.7,
        thinning_velocity=(0.4, 0.5, 0.6),
        spindle_saturation=0.3,
        spindle_direction=(0.5, -0.5, 1.0),
        spindle_threshold=(0.02, -0.05, 0.1),
    )
    reflexes = {
        "kv_s": 0.4,
        "kv_se": 0.2,
        "kv_e": 0.5,
        "kp_s": 0.5,
        "kp_se": 0.2,
        "kp_e": 0.4,
        "kf_s": -0.3,
        "ka_e": 0.02,
    }
    person = replace(RELAX, muscle=law, Td_e=0.041, c_h=0.58, c_f=0.62, r_h=0.27, r_f=0.36, **reflexes)
    environment = Environment(m_env=3.0, b_env=4.0, k_env=60.0)
    force = made.push(2, 3.0, duration=6.0)
    recorded = made.record(person, [force])["displacement"].values[0]
    (moved,) = answered([person], [force])
    assert np.abs(moved - recorded).max() < 2e-4 * np.abs(recorded).max()
    # What the hand holds is not the default either.
    assert np.abs(answered([person], [force], environment)[0] - recorded).max() > 0.1 * np.abs(recorded).max()


@pytest.mark.parametrize("arm", [RELAX, POSITION, OPPOSED], ids=["relax", "position", "opposed"])
def test_small_movements_are_those_of_the_linear_model(arm):
    force = made.push(3, 1e-4, duration=6.0, rate=400.0, top=6.0)
    environment = Environment(m_env=2.5, b_env=6.0, k_env=30.0)
    expected = simulate_linear(arm, environment, force, 400.0).displacement
    (moved,) = answered([arm], [force], environment, rate=400.0)
    assert np.abs(moved - expected).max() < 2e-3 * np.abs(expected).max()


def test_a_multisine_up_to_a_fifth_of_the_sampling_rate_is_right_between_its_samples():
    frequency = np.arange(1, 120) / 6.0
    phase = np.random.default_rng(2).uniform(0.0, 2.0 * np.pi, len(frequency))
    force = np.cos(2.0 * np.pi * np.arange(2400)[:, None] / 400.0 * frequency + phase).sum(axis=1)[:, None] * [1.0, 0.5]
    between = Disturbances(force[None, ::4], 100.0).force[0, ::2]
    inside = slice(200, 2200)  # at the ends there is nothing to go on
    error = between[inside] - force[inside]
    assert error.std() < 2e-5 * force.std()


def test_a_lane_is_the_same_beside_any_others_and_on_any_number_of_threads():
    people = [draw_person(1, i).subjects["RT"] for i in range(5)]
    pushes = [made.push(i, 1.0, duration=2.0) for i in range(5)]
    together = answered(people, pushes, threads=3)
    for i in range(5):
        alone = answered(people[i : i + 1], pushes[i : i + 1])
        np.testing.assert_array_equal(together[i], alone[0])


def test_an_arm_that_diverges_is_nan_from_there_on():
    wild = replace(POSITION, kv_s=300.0, kv_e=300.0)
    (moved,) = answered([wild], [made.push(1, 5.0, duration=4.0)])
    lost = np.isnan(moved[:, 0])
    assert 0 < np.argmax(lost) < len(lost) - 1
    assert lost[np.argmax(lost) :].all()


def test_what_the_compiled_arm_has_not_is_refused():
    with pytest.raises(ValueError, match=r"delay = 0.001 s; expected at least three steps of 0.0025 s"):
        lane_table([replace(RELAX, Td_s=0.001)], [Environment()], 2.5e-3)
    with pytest.raises(ValueError, match=r"i_s, i_se, i_e = 0.1, 0, 0; expected 0 in a simulation"):
        lane_table([replace(RELAX, i_s=0.1)], [Environment()], 2.5e-3)
    with pytest.raises(ValueError, match=r"k_h = inf; expected a finite grip stiffness in a simulation"):
        lane_table([replace(RELAX, k_h=np.inf)], [Environment()], 2.5e-3)


def test_without_numba_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "armperturb.planar_arm.compiled", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"the compiled arm needs numba, .*armperturb\[nonlinear\]"):
        answered([RELAX], [np.zeros((4, 2))])
