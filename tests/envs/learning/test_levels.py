"""A subject at constant levels against an agent that keeps to them."""

import gymnasium as gym
import numpy as np
import pytest

from armperturb import Multisine, Trial, run_experiment
from armperturb.envs.learning.levels import subject_at
from armperturb.envs.learning.task import TaskSettings
from armperturb.subject import at_level

LEVELS = np.array([[0.6, 1.3, 0.9], [1.5, 0.4, 0.0], [0.2, 1.1, 2.0]])
"""Of co-contraction, velocity and position feedback of the muscle groups."""


@pytest.mark.slow(reason="whole trials in both tasks")
@pytest.mark.parametrize("task", ["PT", "RT"])
def test_an_agent_that_keeps_to_its_levels_is_this_subject(task):
    settings = {"task": task, "noise": False, "torque": False, "highest_level": 2.0, "activation_time": 0.0}
    subject = subject_at(TaskSettings(**settings), LEVELS)
    trial = Trial(subject=subject, perturbation=Multisine.draw(seed=3, rms=2.0, duration=1.5, crested=False))
    recorded = run_experiment([trial], rate=50.0)["displacement"].values[0]
    env = gym.make_vec("ArmPerturb/Position-v1", num_envs=1, autoreset_mode="Disabled", **settings)
    env.reset(options={"trial": Trial(subject=TaskSettings(**settings).subject, perturbation=trial.perturbation)})
    for sample in recorded[1:]:
        *_, infos = env.step(LEVELS.reshape(1, 9) / 2.0)
        np.testing.assert_allclose(infos["displacement"][0], sample, rtol=0.0, atol=1e-12)
    assert np.abs(recorded).max() > 1e-3


def test_levels_of_zero_and_one_are_the_person_s_own():
    settings = TaskSettings(task="PT")
    relaxed, position = settings.people
    assert subject_at(settings, np.ones((3, 3))) == position
    at_rest = subject_at(settings, np.zeros((3, 3)))
    for quantity in ("b", "k", "kv", "kp"):
        assert at_rest.joint_triple(quantity) == relaxed.joint_triple(quantity)
    assert at_rest.muscle.of_elements("short_range_stiffness") == relaxed.muscle.of_elements("short_range_stiffness")


def test_beyond_one_all_torques_are_in_proportion_to_the_level():
    person = TaskSettings().subject
    found, expected = subject_at(TaskSettings(), np.full((3, 3), 1.7)), at_level(person, 1.7)
    for quantity in ("b", "k", "kv", "kp"):
        assert found.joint_triple(quantity) == pytest.approx(expected.joint_triple(quantity), rel=1e-12)
    short_range = expected.muscle.of_elements("short_range_stiffness")
    assert found.muscle.of_elements("short_range_stiffness") == pytest.approx(short_range, rel=1e-12)


@pytest.mark.parametrize(
    ("levels", "error", "message"),
    [
        (np.ones((3, 2)), ValueError, r"shape \(3, 2\); expected \(3, 3\)"),
        (-LEVELS, ValueError, "co-contraction, shoulder = -0.6"),
        (np.full((3, 3), np.nan), ValueError, "co-contraction, shoulder = nan"),
        (np.full((3, 3), "1"), TypeError, "expected numbers"),
    ],
)
def test_levels_are_refused(levels, error, message):
    with pytest.raises(error, match=message):
        subject_at(TaskSettings(), levels)
