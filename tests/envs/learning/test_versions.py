"""What version 1 of the environments rewards and shows, and what it has in common with version 0."""

import time
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from armperturb.envs.learning.participants import TERMS
from armperturb.envs.learning.registration import TASKS, load_dm_env
from armperturb.envs.render.camera import Camera
from armperturb.models.rig import build_model

NEW, OLD = ([name for name in TASKS if name.endswith(version)] for version in ("v1", "v0"))
POSITION, RELAX, PULSE = NEW
EACH = pytest.mark.parametrize("name", NEW)
OLD_IS_ALLOWED = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
SHORT = {"duration": 0.6, "onset_window": (0.1, 0.2)}
SEVERE = {"task": "RT", "perturbation": "pulse", "peak": 900.0, "noise": False, **SHORT}


def random_actions(env, n):
    rng = np.random.default_rng(0)
    return [rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32) for _ in range(n)]


@EACH
def test_terms_sum_to_the_reward_from_0_to_1(name):
    env = gym.make(name, duration=2.0).unwrapped
    settings = env.settings
    _, info = env.reset(seed=0)
    assert {info[term] for term in TERMS} == {0.0}
    assert info["success"] is False
    squares = []
    for action in random_actions(env, 40):
        _, reward, terminated, _, info = env.step(action)
        terms = np.array([info[term] for term in TERMS])
        assert reward == pytest.approx(terms.sum(), rel=1e-14)
        assert (terms >= 0.0).all()
        assert reward <= 1.0
        if terminated:
            break
        torque, reflexes = np.mean(action[9:].astype(float) ** 2), np.mean(action[3:9].astype(float) ** 2)
        squares.append(np.sum(info["displacement"] ** 2))
        expected = [1.0 / (1.0 + settings.displacement_weight * squares[-1])]
        assert terms[[0, 2, 3]] == pytest.approx(
            np.array([*expected, 0.05 * (1.0 - reflexes), 0.15 * (1.0 - torque)]) / 1.35, rel=1e-12
        )
        assert 0.0 <= terms[1] <= 0.15 / 1.35
        assert info["success"] is bool(np.mean(squares) <= 4.0 / settings.displacement_weight)
    assert len(squares) > 10


def test_effort_is_a_share_of_the_most_that_can_be_set():
    env = gym.make(POSITION, highest_level=2.0, activation_time=0.0, noise=False, **SHORT)
    env.reset(seed=0)
    info = env.step(np.array([0.5] * 3 + [1.0] * 6 + [-1.0, 0.0], dtype=np.float32))[4]
    expected = np.array([0.15 * 0.75, 0.0, 0.15 * 0.5]) / 1.35
    assert [info[term] for term in TERMS[1:]] == pytest.approx(expected, rel=1e-12)


def test_all_effort_that_relaxed_people_may_set_leaves_nothing_of_its_terms():
    env = gym.make("ArmPerturb/Relax-v1", highest_level=0.3, activation_time=0.0, noise=False, **SHORT)
    env.reset(seed=0)
    info = env.step(np.ones(11, dtype=np.float32))[4]
    assert [info[term] for term in TERMS[1:]] == pytest.approx([0.0] * 3, abs=1e-12)


def test_ending_early_never_pays():
    env = gym.make(POSITION, **SEVERE)
    env.reset(seed=0)
    rewards, terminated = [], False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(env.unwrapped.own_action)
        assert not truncated
        rewards.append(reward)
    assert min(rewards[:-1]) > 0.0
    assert rewards[-1] == 0.0 == sum(info[term] for term in TERMS)
    assert info["success"] is False


def whole_trials(name, choose, n=6):
    """Mean reward, who succeeds, and observations of n people, who do what `choose(envs, rng)` says."""
    envs = gym.make_vec(name, num_envs=n, engine="compiled")
    seen, rng, total, running = [envs.reset(seed=0)[0]], np.random.default_rng(0), 0.0, np.ones(n, dtype=bool)
    for _ in range(500):
        observation, reward, terminated, truncated, infos = envs.step(choose(envs, rng).astype(np.float32))
        seen.append(observation)
        total += reward[running].sum() / n
        running &= ~terminated
    assert (truncated | ~running).all()
    return total / 500, running & infos["success"], seen[:500]


@pytest.fixture(scope="module")
def own_trials():
    """A function of a task's name: what people get who stay as they are."""
    return cache(lambda name: whole_trials(name, lambda envs, _: np.tile(envs.own_action, (envs.num_envs, 1))))


@pytest.mark.slow(reason="whole trials of each task")
@EACH
def test_returns_are_ordered_as_a_person_would_order_them(name, own_trials):
    """The task's own person earns most; letting go costs where the handle is to be held, and nothing in Relax."""
    own, held, _ = own_trials(name)
    zero, slack, _ = whole_trials(name, lambda envs, _: np.zeros(envs.action_space.shape))
    chance, wild, _ = whole_trials(name, lambda envs, rng: rng.uniform(envs.action_space.low, envs.action_space.high))
    assert 0.0 <= min(own, zero, chance) <= max(own, zero, chance) <= 1.0
    assert own > chance + 0.1
    assert held.all()
    assert not wild.any()
    if name == RELAX:
        assert zero == own
    else:
        assert own > zero + 0.1
        assert not slack.any()


@EACH
def test_normalised_observations_are_the_physical_ones_over_their_scales(name):
    env, physical = gym.make(name, duration=1.0), gym.make(name, duration=1.0, senses="physical")
    scales = np.repeat(env.unwrapped.settings.sense_scales, 2)
    assert (env.observation_space.high == 20.0).all()
    first, other = env.reset(seed=1)[0], physical.reset(seed=1)[0]
    for action in random_actions(env, 45):
        np.testing.assert_allclose(first, np.clip(other / scales, -20.0, 20.0), rtol=1e-6)
        assert first in env.observation_space
        first, other = env.step(action)[0], physical.step(action)[0]


@pytest.mark.slow(reason="whole trials")
@EACH
def test_observations_are_of_order_1_and_meet_their_bounds(name, own_trials):
    _, _, seen = own_trials(name)
    assert (np.std(seen, axis=(0, 1)) > 0.3).all()
    assert (np.std(seen, axis=(0, 1)) < 3.0).all()
    assert np.abs(seen).max() < 20.0
    envs = gym.make_vec(name, num_envs=1, **{**SEVERE, "task": TASKS[name]["task"], "peak": 3000.0})
    envs.reset(seed=0)
    reached = [np.abs(envs.step(np.zeros((1, 11)))[0]).max() for _ in range(25)]
    assert max(reached) == 20.0


@OLD_IS_ALLOWED
@pytest.mark.parametrize("names", list(zip(NEW, OLD, strict=True)), ids=NEW)
def test_versions_have_the_same_trials(names):
    envs = [gym.make(name, senses="physical", **SHORT) for name in names]
    resets = [env.reset(seed=2) for env in envs]
    np.testing.assert_array_equal(resets[0][0], resets[1][0])
    for action in random_actions(envs[0], 20):
        (seen, _, *ends, info), (expected, cost, *others, known) = (env.step(action) for env in envs)
        np.testing.assert_array_equal(seen, expected)
        assert ends == others
        assert cost < 0.0
        assert {*info} - {*known} == {*TERMS}
        assert "success" in known
        assert data_equivalence({name: info[name] for name in known}, known, exact=True)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec, load_dm_env])
def test_version_0_is_deprecated(make):
    if make is load_dm_env:
        pytest.importorskip("dm_control")
    with pytest.warns(DeprecationWarning, match=r"Pulse-v0 is out of date.*v1"):
        make(OLD[2], **SHORT)


@OLD_IS_ALLOWED
@pytest.mark.parametrize("name", TASKS)
def test_the_length_of_trials_is_known_at_any_duration(name):
    assert gym.make(name).spec.max_episode_steps == 500
    assert gym.make_vec(name, num_envs=2).spec.max_episode_steps == 500
    env = gym.make(name, duration=11.0)
    assert env.spec.max_episode_steps == 550
    again = gym.make(env.spec)
    assert again.spec.max_episode_steps == 550
    assert gym.make(name, max_episode_steps=30).spec.max_episode_steps == 30
    assert gym.make_vec(name, num_envs=2, max_episode_steps=30).spec.max_episode_steps == 30
    # A limit beyond the trial's end ends nothing.
    assert gym.make_vec(name, num_envs=2, max_episode_steps=1000).spec.max_episode_steps == 500
    assert gym.make(name, max_episode_steps=1000).unwrapped.spec.max_episode_steps == 500


def test_a_trial_without_pulse_may_be_shorter_than_one():
    env = gym.make(POSITION, duration=0.06)
    env.reset(seed=0)
    assert [env.step(env.unwrapped.own_action)[3] for _ in range(3)] == [False, False, True]
    with pytest.raises(ValueError, match=r"duration with a pulse = 0\.06; expected a finite number above 0\.08"):
        env.reset(options={"perturbation": "pulse"})


@pytest.mark.parametrize("duration", [0.1, 0.16, 1.0, 30.0])
def test_pulses_fit_into_trials_of_any_duration(duration):
    settings = gym.make(PULSE, duration=duration, noise=False).unwrapped.settings
    for seed in range(20):
        pulse = settings.drawing()(np.random.default_rng(seed)).perturbation
        assert 0.0 <= pulse.onset <= duration - pulse.width
        assert pulse.onset >= 0.1 * duration or duration < 0.2
    with pytest.raises(ValueError, match=r"duration with a pulse = 0\.06; expected a finite number above 0\.08"):
        gym.make(PULSE, duration=0.06)


@OLD_IS_ALLOWED
@pytest.mark.slow(reason="starts processes")
@pytest.mark.parametrize("name", [PULSE, OLD[2]])
def test_asynchronous_vectors_are_ours_to_the_last_bit(name):
    ours = gym.make_vec(name, num_envs=2, **SHORT)
    context = {"context": "forkserver"}
    theirs = gym.make_vec(f"armperturb:{name}", 2, vectorization_mode="async", vector_kwargs=context, **SHORT)
    try:
        assert data_equivalence(ours.reset(seed=4), theirs.reset(seed=4), exact=True)
        ours.action_space.seed(0)
        for _ in range(35):
            actions = ours.action_space.sample()
            for got, wanted in zip(theirs.step(actions), ours.step(actions), strict=True):
                assert data_equivalence(got, wanted, exact=True)
    finally:
        theirs.close()


@pytest.mark.slow(reason="draws pictures")
def test_pictures_of_a_running_trial_take_a_fraction_of_the_finest_ones():
    env = gym.make(PULSE, render_mode="rgb_array", width=320, height=240)
    env.reset(seed=0)

    def seconds(draw):
        draw()
        start = time.process_time()
        for _ in range(2):
            draw()
        return time.process_time() - start

    with Camera(build_model(env.unwrapped.settings.subject), width=320, height=240) as finest:
        assert seconds(env.render) < 0.35 * seconds(finest.draw)
    env.close()


@pytest.mark.slow(reason="draws and encodes pictures")
def test_gymnasium_records_videos(tmp_path):
    pytest.importorskip("moviepy")
    env = gym.make(PULSE, render_mode="rgb_array", width=64, height=48, **SHORT)
    env = gym.wrappers.RecordVideo(env, str(tmp_path / "films"), disable_logger=True)
    env.reset(seed=0)
    for action in random_actions(env, 30):
        env.step(action)
    env.close()
    (film,) = tmp_path.glob("films/*.mp4")
    assert film.stat().st_size > 1000
