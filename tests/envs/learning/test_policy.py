"""The policy that the package ships."""

import gymnasium as gym
import numpy as np
import pytest

from armperturb.envs.learning.linear_policy import LinearPolicy, trained_policy


def test_actions_are_in_proportion_to_observations():
    policy = LinearPolicy(np.array([[2.0, 0.0, 1.0], [0.0, -1.0, 0.5]]))
    np.testing.assert_allclose(policy([3.0, 4.0]), [7.0, -3.5])
    np.testing.assert_allclose(policy([[3.0, 4.0], [0.0, 0.0]]), [[7.0, -3.5], [1.0, 0.5]])


def test_an_unknown_environment_is_refused():
    with pytest.raises(
        ValueError, match=r"name = 'CartPole-v1'; expected one of ArmPerturb/Position-v1, ArmPerturb/Pulse-v1"
    ):
        trained_policy("CartPole-v1")


@pytest.mark.slow(reason="24 trials of 10 s")
@pytest.mark.parametrize(("task", "earned", "least_spread"), [("Position", 0.572, 0.3), ("Pulse", 0.918, 0.1)])
def test_it_keeps_the_position_better_than_the_own_action(task, earned, least_spread):
    name = f"ArmPerturb/{task}-v1"
    reward, spread = {}, {}
    for who in ("trained", "own"):
        envs = gym.make_vec(name, num_envs=24, engine="compiled")
        policy = trained_policy(name) if who == "trained" else lambda seen, act=envs.own_action: np.tile(act, (24, 1))
        observations, _ = envs.reset(seed=[*range(1000, 1024)])
        total, sensed = 0.0, []
        for _ in range(500):
            sensed.append(observations.copy())
            observations, rewards, terminated, _, info = envs.step(policy(observations))
            assert not terminated.any()
            total += rewards.mean() / 500
        assert info["success"].all()
        envs.close()
        reward[who], spread[who] = total, np.concatenate(sensed).std(axis=0)
    assert reward["trained"] == pytest.approx(earned, abs=0.002)
    assert reward["trained"] > reward["own"] + 0.02
    assert spread["trained"].min() > least_spread
    assert spread["trained"].max() < 3.0
