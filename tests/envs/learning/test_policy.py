"""The policies that the package ships."""

from importlib import resources

import gymnasium as gym
import numpy as np
import pytest

import armperturb as ap
from armperturb.envs.learning.policy import Policy
from armperturb.files import packaged_table

SHIPPED = packaged_table("armperturb.envs.learning", "policies.toml")


def test_actions_of_a_single_layer_are_in_proportion_to_observations():
    policy = Policy((np.array([[2.0, 0.0, 1.0], [0.0, -1.0, 0.5]]),))
    np.testing.assert_allclose(policy([3.0, 4.0]), [7.0, -3.5])
    np.testing.assert_allclose(policy([[3.0, 4.0], [0.0, 0.0]]), [[7.0, -3.5], [1.0, 0.5]])


def test_layers_follow_each_other_through_hyperbolic_tangents():
    hidden, last = np.array([[0.5, 0.1], [-2.0, 0.0]]), np.array([[1.0, 3.0, -0.2]])
    expected = np.tanh(0.5 * 0.7 + 0.1) + 3.0 * np.tanh(-2.0 * 0.7) - 0.2
    np.testing.assert_allclose(Policy((hidden, last))([0.7]), [expected], rtol=1e-6)


@pytest.mark.parametrize("observation", [np.zeros(3), np.zeros((2, 3)), 1.0])
def test_observations_of_another_length_are_refused(observation):
    with pytest.raises(ValueError, match=r"observation of shape \(.*\); expected \(\.\.\., 8\)"):
        ap.trained_policy("ArmPerturb/Position-v1")(observation)


def test_an_unknown_environment_is_refused():
    with pytest.raises(ValueError, match=r"name = 'CartPole-v1'; expected one of ArmPerturb/Position-v1, .*Pulse-v1"):
        ap.trained_policy("CartPole-v1")


def test_policies_are_small():
    assert resources.files("armperturb.envs.learning").joinpath("policies.toml").stat().st_size < 1e6


@pytest.mark.slow(reason="24 trials of 10 s")
@pytest.mark.parametrize("task", ["Position", "Relax", "Pulse"])
def test_it_earns_more_than_the_own_action_with_observations_of_order_1(task):
    name = f"ArmPerturb/{task}-v1"
    policy, reward, spread = ap.trained_policy(name), {}, {}
    for who in ("trained", "own"):
        envs = gym.make_vec(name, num_envs=24, engine="compiled")
        observations, _ = envs.reset(seed=[*range(1000, 1024)])
        own, total, sensed = np.tile(envs.own_action, (24, 1)), 0.0, []
        for _ in range(500):
            sensed.append(observations.copy())
            act = policy(observations) if who == "trained" else own
            observations, rewards, terminated, _, info = envs.step(act)
            assert not terminated.any()
            total += rewards.mean() / 500
        assert info["success"].all()
        envs.close()
        reward[who], spread[who] = total, np.concatenate(sensed).std(axis=0)
    assert reward["trained"] == pytest.approx(SHIPPED[name]["reward"], abs=0.001)
    assert reward["trained"] > reward["own"] + 0.005
    assert spread["trained"].min() > 0.3
    assert spread["trained"].max() < 3.0
