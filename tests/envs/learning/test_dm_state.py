"""Saved states, threads and the end of dm_control environments."""

import copy
import pickle

import numpy as np
import pytest

import armperturb

pytestmark = pytest.mark.slow(reason="imports dm_control and compiles its models")

NAME = "ArmPerturb/Pulse-v1"
SHORT = {"duration": 0.4, "onset_window": (0.1, 0.2)}


def loaded(seed=0, **settings):
    return armperturb.load_dm_env(NAME, random_state=seed, **SHORT, **settings)


def onwards(env, n=8):
    return [env.step(env.task.own_action) for _ in range(n)]


def assert_same(timesteps, expected):
    for one, other in zip(timesteps, expected, strict=True):
        assert one.step_type == other.step_type
        assert one.reward == other.reward
        assert one.observation.keys() == other.observation.keys()
        for name, values in one.observation.items():
            np.testing.assert_array_equal(values, other.observation[name], err_msg=name)


def test_a_state_from_before_the_first_reset_is_taken_by_a_running_environment():
    env, other = loaded(3), loaded(5)
    state = env.get_state()
    other.reset()
    onwards(other)
    other.set_state(state)
    expected = onwards(env)
    assert expected[0].first()
    assert_same(onwards(other), expected)


def test_what_was_enabled_meanwhile_is_observed_from_the_next_episode_on():
    env = loaded(3)
    env.task.observables["time"].enabled = True
    env.reset()
    onwards(env)
    env.task.observables["time"].enabled = False
    env.task.observables["perturbation"].enabled = True
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    rest = onwards(env, 20)
    assert "time" in rest[0].observation
    assert "perturbation" not in rest[0].observation
    assert "perturbation" in rest[-1].observation
    for other in copies:
        assert_same(onwards(other, 20), rest)


def bad_states(state):
    far = np.full(11, 9.0)
    random, options, enabled = state["began"]
    return [
        ({"actions": [*state["actions"], far]}, r"action\[0\] .* = 9.0; expected 0 to 1"),
        ({"actions": [np.zeros(3)]}, r"action of shape \(3,\)"),
        ({"actions": None}, "actions of type NoneType"),
        ({"next": {"force": 3.0}}, "unknown option 'force'"),
        ({"began": (random, {"peak": -1.0}, enabled)}, "peak = -1"),
        ({"began": (random, options)}, "no step leads to"),
        ({"random": ("MT19937", 3)}, "no step leads to"),
    ]


def test_refused_states_change_nothing():
    env = loaded(3, out_of_bounds="refuse")
    env.reset()
    onwards(env, 3)
    state = env.get_state()
    other = copy.deepcopy(env)
    onwards(env, 4)
    expected = copy.deepcopy(env)
    for key in state:
        with pytest.raises(ValueError, match="state of another environment"):
            env.set_state({name: value for name, value in state.items() if name != key})
    for changed, message in bad_states(state):
        with pytest.raises(ValueError, match=f"^set_state: .*({message})"):
            env.set_state({**state, **changed})
    assert_same(onwards(env), onwards(expected))
    env.set_state(state)
    assert_same(onwards(env), onwards(other))


def test_two_threads_in_one_environment_are_refused(another_thread_within):
    env = loaded()
    env.reset()
    state, own = env.get_state(), env.task.own_action
    with another_thread_within(env.task, "get_reward", lambda: env.step(own)):
        for call in (
            lambda: env.step(own),
            env.reset,
            env.get_state,
            lambda: env.set_state(state),
            lambda: copy.deepcopy(env),
            lambda: pickle.dumps(env),
            env.close,
        ):
            with pytest.raises(RuntimeError, match="another thread is using this environment"):
                call()
    env.step(own)


def test_a_closed_environment_says_so():
    env = loaded()
    env.reset()
    state = env.get_state()
    env.close()
    env.close()
    for name, call in (
        ("step", lambda: env.step(env.task.own_action)),
        ("reset", env.reset),
        ("set_state", lambda: env.set_state(state)),
    ):
        with pytest.raises(RuntimeError, match=f"{name}: the environment is closed; expected one that is open"):
            call()


def test_actions_of_another_shape_are_refused():
    env = loaded()
    env.reset()
    with pytest.raises(ValueError, match=r"action of shape \(1, 11\); expected \(11,\)"):
        env.step(np.zeros((1, 11)))
    with pytest.raises(ValueError, match=r"^action has rows of different lengths"):
        env.step([[0.0], [0.0, 1.0]])
