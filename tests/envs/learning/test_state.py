"""Copies, saved states, threads and forked children of the gymnasium environments."""

import copy
import multiprocessing
import pickle
import threading
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from armperturb import Trial
from armperturb.cohort import draw_person
from armperturb.perturbations import Pulse

SHORT = {"duration": 0.6, "onset_window": (0.1, 0.2)}
NAME = "ArmPerturb/Pulse-v1"
ENGINES = pytest.mark.parametrize("engine", ["mujoco", "compiled"])


def single(**settings):
    return gym.make(NAME, **SHORT, **settings)


def several(n=3, **settings):
    return gym.make_vec(NAME, num_envs=n, **SHORT, **settings)


def actions_of(env, n, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32) for _ in range(n)]


def onwards(env):
    """The rest of this trial and the whole next one, whose seed nobody gives."""
    rows = [env.step(action) for action in actions_of(env, 12, seed=1)]
    rows.append(env.reset())
    return [*rows, *(env.step(action) for action in actions_of(env, 12, seed=2))]


def in_the_middle(make, engine):
    env = make(engine=engine)
    env.reset(seed=3)
    for action in actions_of(env, 12):
        env.step(action)
    return env


def another_size(env):
    """Let a person of another size begin, whose model and memory take the place of the first one's."""
    subject = draw_person(0, 2).subjects["PT"]
    settings = env.unwrapped.settings
    body = replace(settings.subject, l_h=subject.l_h, l_f=subject.l_f)
    pulse = Pulse(peak=20.0, direction_deg=20.0, onset=0.1, duration=0.6)
    env.reset(options={"trial": Trial(subject=body, perturbation=pulse)})


@ENGINES
@pytest.mark.parametrize("make", [single, several])
def test_copies_and_saved_states_go_on_to_the_last_bit(make, engine):
    env = in_the_middle(make, engine)
    state = env.unwrapped.get_state()
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    fresh = make(engine=engine)
    fresh.reset(seed=8)
    fresh.unwrapped.set_state(pickle.loads(pickle.dumps(state)))
    expected = onwards(env)
    for other in (*copies, fresh):
        assert data_equivalence(onwards(other), expected, exact=True)
    another_size(env)
    env.unwrapped.set_state(state)
    assert data_equivalence(onwards(env), expected, exact=True)


def test_a_copy_before_the_first_reset_is_an_environment_too():
    env, other = single(), several()
    for made, copied in ((env, copy.deepcopy(env)), (other, pickle.loads(pickle.dumps(other)))):
        assert data_equivalence(made.reset(seed=1), copied.reset(seed=1), exact=True)


@pytest.mark.slow(reason="needs another process")
def test_a_pickle_goes_on_in_another_process(elsewhere):
    assert data_equivalence(elsewhere["onwards"], onwards(in_the_middle(several, "mujoco")), exact=True)


@pytest.mark.parametrize("make", [single, several])
def test_states_of_other_environments_are_refused(make):
    env, other = make().unwrapped, make(visual_gain=2.0).unwrapped
    env.reset(seed=0)
    state = env.get_state()
    for bad in (other.get_state(), {}, None, "state", {name: state[name] for name in list(state)[:-1]}):
        with pytest.raises(ValueError, match="state of another environment"):
            env.set_state(bad)
    with pytest.raises(ValueError, match="state with _session of type NoneType; expected one from get_state"):
        env.set_state({**state, "_session": None})
    env.step(actions_of(env, 1)[0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n": 2}, "num_envs = 2; expected 3"),
        ({"autoreset_mode": "Disabled"}, "autoreset_mode = AutoresetMode.DISABLED; expected AutoresetMode.NEXT_STEP"),
        ({"max_episode_steps": 5}, "max_episode_steps = 5; expected None"),
    ],
)
def test_states_of_other_vectors_are_refused(settings, message):
    with pytest.raises(ValueError, match=f"set_state: state of an environment with {message}"):
        several().set_state(several(**settings).get_state())


def rewards_of(envs, queue):
    queue.put(envs.step(np.tile(envs.unwrapped.own_action, (4, 1)))[1])


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_goes_on_with_its_parents_vector():
    envs = several(4, n_threads=2)
    envs.reset(seed=0)
    own = np.tile(envs.unwrapped.own_action, (4, 1))
    envs.step(own)  # which starts threads that the child will not have
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=rewards_of, args=(envs, queue))
    child.start()
    try:
        np.testing.assert_array_equal(queue.get(timeout=60), envs.step(own)[1])
    finally:
        child.kill()
        child.join()


@pytest.mark.parametrize("make", [single, several])
def test_two_threads_in_one_environment_are_refused(make, another_thread_within):
    env = make()
    env.reset(seed=0)
    plain = env.unwrapped
    state, action = plain.get_state(), np.zeros(env.action_space.shape, dtype=np.float32)
    with another_thread_within(plain._session.simulation, "advance", lambda: env.step(action)):
        for call in (
            lambda: env.step(action),
            env.reset,
            plain.get_state,
            lambda: plain.set_state(state),
            lambda: copy.deepcopy(plain),
            lambda: pickle.dumps(plain),
        ):
            with pytest.raises(RuntimeError, match="another thread is using this environment"):
                call()
    env.step(action)


class Intruder:
    """Part of an environment that has another thread step the latter when it is copied."""

    def __init__(self, env):
        self.env, self.errors = env, []

    def __reduce__(self):
        def step():
            try:
                self.env.step(np.zeros(self.env.action_space.shape))
            except RuntimeError as error:
                self.errors.append(error)

        thread = threading.Thread(target=step)
        thread.start()
        thread.join()
        return str, ()


@pytest.mark.parametrize("make", [single, several])
@pytest.mark.parametrize("take", [copy.deepcopy, pickle.dumps, lambda env: env.get_state()])
def test_no_thread_steps_what_is_being_copied(make, take):
    env = make(engine="compiled").unwrapped
    env.reset(seed=0)
    env._session.intruder = intruder = Intruder(env)
    take(env)
    assert [str(error)[:40] for error in intruder.errors] == ["another thread is using this environment"]
    env.step(np.zeros(env.action_space.shape))


@pytest.mark.slow(reason="draws pictures")
def test_a_state_has_the_same_picture_wherever_it_goes():
    size = {"width": 64, "height": 48}
    blind, seeing, another = single(), single(render_mode="rgb_array", **size), single(render_mode="rgb_array", **size)
    for env in (blind, seeing):
        env.reset(seed=3)
        for action in actions_of(env, 12):
            env.step(action)
    another.reset(seed=8)
    another.unwrapped.set_state(blind.unwrapped.get_state())
    np.testing.assert_array_equal(another.render(), seeing.render())
    for env in (seeing, another):
        env.close()
