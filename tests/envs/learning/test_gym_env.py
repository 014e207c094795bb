"""The gymnasium environments: their contract, and that they are the study's physics to the last bit."""

import hashlib
import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode

from armperturb import POSITION, RELAX, MultisineThenPulse, Pulse, Trial, run_experiment
from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.cohort import draw_person
from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise
from armperturb.environment import Environment
from armperturb.envs.lab.simulation import callbacks, silent_simulator
from armperturb.envs.learning.gym_env import moment
from armperturb.envs.learning.gym_vector_env import ArmPerturbVectorEnv
from armperturb.envs.learning.levels import subject_at
from armperturb.envs.learning.participants import SENSES, action_names
from armperturb.envs.learning.registration import TASKS
from armperturb.envs.learning.task import TaskSettings
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import Multisine
from armperturb.subject import at_level

NAMES = tuple(TASKS)
EACH = pytest.mark.parametrize("name", NAMES)
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")  # that of version 0
SHORT = {"duration": 0.6, "onset_window": (0.1, 0.2)}
PERSON = draw_person(0, 0)  # whose level in PT22.5 can be doubled at the usual step
CALM = {"noise": False, "perturbation": "none"}
LINEAR = {"person": "published", "co_contraction": "common"}


def made(name="ArmPerturb/Position-v1", **settings):
    return gym.make(name, **settings).unwrapped


def vectorised(n, name="ArmPerturb/Position-v1", mode=None, **settings):
    return gym.make_vec(name, num_envs=n, vectorization_mode=mode, **settings)


def path(env, n, seed=None, rng=0, options=None):
    """Observations, rewards and displacements of a trial with random actions around the person's own."""
    draws = np.random.default_rng(rng)
    observation, info = env.reset(seed=seed, options=options)
    rows = [(observation, 0.0, info["displacement"])]
    for _ in range(n):
        wanted = env.own_action + draws.uniform(-0.2, 0.2, env.own_action.shape)
        action = np.clip(wanted, env.action_space.low, env.action_space.high).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        rows.append((observation, reward, info["displacement"]))
        if terminated or truncated:
            break
    return [np.array(column) for column in zip(*rows, strict=True)]


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.slow(reason="draws pictures")
@EACH
def test_gymnasiums_checker_has_nothing_to_say(name):
    # Versions differ in what they reward and show, not in pictures.
    check_env(made(name, width=64, height=48), skip_render_check=name.endswith("v0"))


@pytest.mark.slow(reason="three trials of a second")
@EACH
def test_observations_are_as_specified_and_live(name):
    env = made(name, duration=6.0, onset_window=(0.2, 0.4))
    observations, rewards, _ = path(env, 60, seed=1)
    assert observations.dtype == np.float32
    assert observations.shape == (61, len(SENSES))
    assert all(observation in env.observation_space for observation in observations)
    assert np.isfinite(rewards).all()
    assert (observations[5:].std(axis=0) > 0).all()
    first, _ = env.reset(seed=1)
    kept = first.copy()
    first[:] = 7.0
    assert np.array_equal(env.reset(seed=1)[0], kept)


@pytest.mark.slow(reason="six trials of each task")
@EACH
def test_a_seed_gives_a_path_and_the_next_trial_is_another(name):
    env, other = made(name, **SHORT), made(name, **SHORT)
    first = path(env, 30, seed=4)
    following = path(env, 30)
    assert same(first, path(other, 30, seed=4))
    assert same(following, path(other, 30))  # and nothing is left of the trial before
    assert same(first, path(env, 30, seed=4))
    assert not same(first, following)


def test_the_compiled_engine_moves_people_as_mujoco_does():
    """In vectors, with all that an agent may set; and each person moves as alone."""
    paths, forces = {}, {}
    for engine in ("mujoco", "compiled"):
        envs = vectorised(3, "ArmPerturb/Pulse-v1", engine=engine, **SHORT)
        first, _ = envs.reset(seed=7)
        envs.action_space.seed(7)
        steps = [envs.step(envs.action_space.sample()) for _ in range(30)]
        paths[engine] = [first, *(step[0] for step in steps)]
        forces[engine] = [step[4]["force"] for step in steps]
    for of_engine in (paths, forces):
        ours, mujocos = (np.array(of_engine[engine]) for engine in ("compiled", "mujoco"))
        spread = mujocos.std(axis=(0, 1))
        assert (np.abs(ours - mujocos).max(axis=(0, 1)) < 2e-3 * spread).all()
        assert (spread > 0).all()
    alone = made("ArmPerturb/Pulse-v1", engine="compiled", **SHORT)
    alone.reset(seed=8)
    envs = vectorised(3, "ArmPerturb/Pulse-v1", engine="compiled", **SHORT)
    envs.reset(seed=7)
    for _ in range(20):
        together = envs.step(np.tile(alone.own_action, (3, 1)))[0]
        np.testing.assert_array_equal(alone.step(alone.own_action)[0], together[1])


def digest():
    env = made("ArmPerturb/Pulse-v1", **SHORT)
    rows = [column for _ in range(2) for column in path(env, 30, seed=11)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(column).tobytes() for column in rows)).hexdigest()


@pytest.mark.slow(reason="needs another process")
def test_the_path_is_the_same_in_another_process(elsewhere):
    assert elsewhere["path"] == digest()


def study_trials(task):
    """As in the study: noise, a person's own level, a multisine and a pulse on it."""
    subject = PERSON.subjects[task]
    if task == "PT":
        subject = at_level(subject, PERSON.levels.get("PT22.5", 1.0))
    rms, peak = (16.6, 107.8) if task == "PT" else (1.8, 53.9)
    multisine = Multisine.draw(seed=3, rms=rms, duration=1.0, crested=False)
    joined = MultisineThenPulse.join(multisine, peak=peak, direction_deg=200.0, tail=0.5)
    pulse = Pulse(peak=peak, direction_deg=20.0, onset=0.3, duration=1.5)
    return [
        Trial(subject=subject, perturbation=perturbation, seed=number, noise=noise)
        for number, (perturbation, noise) in enumerate(
            ((joined, HUMAN_NOISE[task]), (pulse, HUMAN_NOISE[task]), (joined, None))
        )
    ]


@pytest.mark.slow(reason="whole trials of the study")
@pytest.mark.parametrize("task", ["PT", "RT"])
def test_own_parameters_reproduce_the_studys_trial_to_the_last_bit(task):
    trials = study_trials(task)
    recording = run_experiment(trials, rate=400.0)
    settings = {"task": task, "person": PERSON, "highest_level": 2.0}
    single = made("ArmPerturb/Position-v1", **settings)
    for number, trial in enumerate(trials):
        _, info = single.reset(options={"trial": trial})
        truncated, decision = False, 0
        while not truncated:
            at = 8 * decision
            np.testing.assert_array_equal(info["displacement"], recording["displacement"].values[number, at])
            np.testing.assert_array_equal(info["joint_angle"], recording["joint_angle"].values[number, at])
            np.testing.assert_allclose(
                info["perturbation"], recording["perturbation"].values[number, at], rtol=0, atol=1e-12
            )
            if decision:  # sensors tell of the start of the last step
                np.testing.assert_array_equal(info["force"], recording["force"].values[number, at - 1])
            _, _, terminated, truncated, info = single.step(single.own_action)
            assert not terminated
            decision += 1
        assert decision == 75
    several = vectorised(3, **settings)
    several.reset(options={"trial": trials[0]})
    for decision in range(1, 75):
        _, _, _, _, infos = several.step(np.tile(several.own_action, (3, 1)))
        for lane in range(3):
            np.testing.assert_array_equal(
                infos["displacement"][lane], recording["displacement"].values[0, 8 * decision]
            )


def test_linear_people_reproduce_their_trial_too():
    multisine = Multisine.draw(seed=1, rms=5.4, duration=0.8, crested=False)
    trial = Trial(subject=POSITION, perturbation=multisine, seed=2, noise=HUMAN_NOISE["PT"])
    recording = run_experiment([trial], rate=50.0)
    env = made(**LINEAR)
    _, info = env.reset(options={"trial": trial})
    for sample in recording["displacement"].values[0]:
        np.testing.assert_array_equal(info["displacement"], sample)
        info = env.step(env.own_action)[4]


BREAKING = {
    "task": "RT",
    "perturbation": "pulse",
    "peak": (30.0, 700.0),  # of which the second takes the handle to its limit
    "duration": 0.6,
    "onset_window": (0.1, 0.2),
}


@pytest.mark.slow(reason="eighty decisions of four people, twice")
@pytest.mark.parametrize("name", ["ArmPerturb/Position-v1", "ArmPerturb/Position-v0"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vector_environment_is_gymnasiums_own_to_the_last_bit(name, mode):
    n = 4
    ours = vectorised(n, name, autoreset_mode=mode, **BREAKING)
    theirs = vectorised(n, name, mode="sync", vector_kwargs={"autoreset_mode": mode}, **BREAKING)
    assert ours.metadata["autoreset_mode"] is AutoresetMode(mode)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert data_equivalence(ours.reset(seed=5), theirs.reset(seed=5), exact=True)
    ours.action_space.seed(0)
    ends = np.zeros(2, dtype=int)
    for _ in range(80):
        actions = ours.action_space.sample()
        step, expected = ours.step(actions), theirs.step(actions)
        for got, wanted in zip(step, expected, strict=True):
            assert data_equivalence(got, wanted, exact=True)
        ends += step[2].any(), step[3].any()
    assert ends.min() >= 2  # both kinds of end were met


def test_without_autoreset_the_user_says_who_begins():
    envs = vectorised(2, autoreset_mode="Disabled", max_episode_steps=3, **CALM)
    envs.reset(seed=0)
    own = np.tile(envs.own_action, (2, 1))
    for _ in range(3):
        truncated = envs.step(own)[3]
    assert truncated.all()
    with pytest.raises(RuntimeError, match="environment 0 has no trial; expected reset first"):
        envs.step(own)
    _, infos = envs.reset(options={"reset_mask": np.array([True, False])})
    assert infos["_time"].tolist() == [True, False]
    with pytest.raises(RuntimeError, match="environment 1 has no trial"):
        envs.step(own)
    envs.reset(options={"reset_mask": np.array([False, True])})
    np.testing.assert_allclose(envs.step(own)[4]["time"], [0.02, 0.02])


def test_trials_are_truncated_by_their_own_clock():
    env = made(duration=0.1, **CALM)
    env.reset()
    ends = [env.step(env.own_action)[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    with pytest.raises(RuntimeError, match="the trial is over"):
        env.step(env.own_action)


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({}, 11),
        ({"co_contraction": "common"}, 9),
        ({"co_contraction": "off"}, 8),
        ({"reflexes": False}, 5),
        ({"torque": False}, 9),
        ({"co_contraction": "off", "reflexes": False}, 2),
    ],
)
def test_each_part_of_the_action_can_be_switched_off(settings, size):
    env = made(**settings, **SHORT)
    assert env.action_space.shape == (size,)
    assert len(action_names(env.settings)) == size
    # What is off stays the person's own.
    reference = made(**SHORT)
    env.reset(seed=2)
    reference.reset(seed=2)
    for _ in range(10):
        one, other = env.step(env.own_action), reference.step(reference.own_action)
    np.testing.assert_array_equal(one[4]["displacement"], other[4]["displacement"])


def test_senses_are_late_by_their_delays_and_vision_has_its_gain():
    delays = {"proprioceptive_delay": 0.04, "visual_delay": 0.1}
    env = made("ArmPerturb/Pulse-v1", **delays, visual_gain=3.0, senses="physical", **SHORT)
    observation, info = env.reset(seed=3)
    posture = env.settings.subject.posture
    infos, observations = [info], [observation]
    for _ in range(25):
        observation, _, _, _, info = env.step(env.own_action)
        infos.append(info)
        observations.append(observation)
    for now in range(5, 26):
        felt, seen = infos[now - 2], infos[now - 5]
        expected = np.concatenate(
            [felt["joint_angle"] - posture, felt["joint_velocity"], felt["force"], 3.0 * seen["displacement"]]
        )
        np.testing.assert_array_equal(observations[now], expected.astype(np.float32))
    assert not observations[1].any()  # 20 ms after the start nothing has arrived


def test_what_is_seen_may_be_as_large_as_its_gain_makes_it():
    seen = {}
    for senses in ("normalised", "physical"):
        env = made(visual_gain=10.0, visual_delay=0.0, senses=senses, **SHORT)
        env.reset(seed=0, options={"rms": 20.0})
        seen[senses] = np.array([env.step(env.own_action)[0][6:] for _ in range(20)])
        assert (np.abs(seen[senses]) <= env.observation_space.high[6:]).all()
    assert np.abs(seen["normalised"]).max() > 20.0
    np.testing.assert_allclose(seen["normalised"], seen["physical"] / 0.005, rtol=1e-5)


def test_in_the_dark_nothing_is_seen():
    env = made(visual_gain=0.0, visual_delay=0.0, **SHORT)
    observations, _, displacement = path(env, 20, seed=0)
    assert displacement[1:].any()
    assert not observations[:, 6:].any()


def test_cost_is_squared_displacement_minus_effort():
    weights = {
        "displacement_weight": 3e3,
        "co_contraction_weight": 0.5,
        "reflex_weight": 0.2,
        "torque_weight": 0.7,
        "activation_time": 0.0,
        "reward": "cost",
    }
    env = made(**weights, highest_torque=4.0, highest_level=2.0, **SHORT)
    env.reset(seed=0)
    action = np.array([0.5, 0.25, 0.75, 0.5, 0.4, 0.3, 0.2, 0.1, 0.6, 0.5, -0.25], dtype=np.float32)
    for _ in range(5):
        _, reward, _, _, info = env.step(action)
        level = 2.0 * action.astype(float)
        effort = 0.5 * np.mean(level[:3] ** 2) + 0.2 * np.mean(level[3:9] ** 2) + 0.7 * np.mean([0.25, 0.0625])
        assert reward == pytest.approx(-3e3 * np.sum(info["displacement"] ** 2) - effort, rel=1e-12)


def test_who_reaches_the_limit_pays_and_the_trial_ends():
    env = made(
        "ArmPerturb/Relax-v0", perturbation="pulse", peak=900.0, noise=False, duration=1.0, onset_window=(0.1, 0.1)
    )
    env.reset(seed=0)
    ends = []
    while not ends or not ends[-1][2]:
        ends.append(env.step(env.own_action))
        assert not ends[-1][3]
    x = ends[-1][4]["displacement"]
    assert np.abs(x).max() > 0.3
    # Of 50 decisions this one and those that were to come cost the far corner and all effort.
    worst = 100.0 * 2 * 0.35**2 + 0.3 + 0.1 + 0.3
    assert ends[-1][1] == pytest.approx(-worst * (51 - len(ends)), rel=1e-12)
    assert min(end[1] for end in ends[:-1]) > -worst
    recording = run_experiment(
        [
            Trial(
                subject=env.settings.subject,
                perturbation=Pulse(peak=900.0, direction_deg=20.0, onset=0.1, duration=1.0),
            )
        ],
        rate=400.0,
    )
    assert 0.0 <= 0.02 * len(ends) - recording["limit_time"].item() <= 0.02


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
def test_what_cannot_be_integrated_ends_its_own_trial_only():
    envs = vectorised(2, "ArmPerturb/Relax-v0", perturbation="pulse", noise=False, **SHORT)
    lone = vectorised(1, "ArmPerturb/Relax-v0", perturbation="pulse", noise=False, **SHORT)
    expected = lone.reset(seed=1)
    huge = Pulse(peak=1e30, direction_deg=20.0, onset=0.1, duration=0.6)
    envs.reset(options={"trial": Trial(subject=envs.settings.subject, perturbation=huge)})
    envs.reset(seed=[0, 1], options={"reset_mask": np.array([False, True])})
    still = np.zeros((2, *lone.single_action_space.shape), dtype=np.float32)
    ended = False
    for decision in range(30):
        observations, rewards, terminated, _, infos = envs.step(still)
        expected = lone.step(still[:1])
        assert np.isfinite(observations).all()
        if terminated[0]:
            ended = True
            assert infos["diverged"].tolist() == [True, False]
            assert rewards[0] == pytest.approx(-envs.settings.worst * (30 - decision))
        np.testing.assert_array_equal(infos["displacement"][1], expected[4]["displacement"][0])
    assert ended


def test_levels_follow_a_decision_with_the_activation_time():
    env = made(co_contraction="common", activation_time=0.1, duration=1.0, **CALM)
    _, info = env.reset(seed=0)
    assert info["co_contraction"].tolist() == [1.0, 1.0, 1.0]
    action = env.own_action.copy()
    action[0] = 0.25
    for decision in range(1, 10):
        info = env.step(action)[4]
        np.testing.assert_allclose(info["co_contraction"], 0.25 + 0.75 * np.exp(-0.2 * decision), rtol=1e-7)


def test_how_often_is_decided_hardly_changes_what_a_new_level_does():
    ends = []
    for rate in (20.0, 100.0):
        env = made(control_rate=rate, duration=0.5, perturbation="pulse", onset_window=(0.0, 0.0), noise=False)
        env.reset(seed=1)
        action = env.own_action.copy()
        action[:3] = 0.3
        for _ in range(round(0.5 * rate)):
            info = env.step(action)[4]
        ends.append(info["displacement"])
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.03)


def test_constant_levels_make_the_person_of_those_levels():
    settings = {"activation_time": 0.0, "noise": False, "duration": 0.6, "highest_level": 2.0}
    env = made(**settings)
    levels = np.array([[0.5, 0.25, 1.25], [0.25, 0.5, 0.75], [0.75, 0.5, 0.25]])
    env.reset(seed=0)
    action = np.append(levels.ravel() / 2.0, [0.0, 0.0]).astype(np.float32)
    trial = TaskSettings(**settings).drawing()(np.random.default_rng(0))
    person = subject_at(env.settings, levels)
    recording = run_experiment([replace(trial, subject=person)], rate=50.0)
    env.reset(options={"trial": trial})
    for sample in recording["displacement"].values[0, 1:]:
        # Sums of muscle groups are rounded in another order.
        np.testing.assert_allclose(env.step(action)[4]["displacement"], sample, rtol=1e-6, atol=1e-12)


@pytest.mark.slow(reason="waits until the arm is at rest")
def test_torque_moves_the_hand_as_statics_say():
    env = made(**LINEAR, task="RT", reflexes=False, duration=20.0, highest_torque=0.2, timestep=2.5e-3, **CALM)
    env.reset(seed=0)
    torque = np.array([0.1, -0.05])
    action = np.concatenate([[0.0], torque / 0.2]).astype(np.float32)
    for _ in range(999):
        info = env.step(action)[4]
    jacobian = hand_jacobian(RELAX)
    # The grip and the manipulator's spring in series act at the hand.
    spring = 1.0 / (1.0 / Environment().k_env + 1.0 / RELAX.k_h)
    rotation = np.linalg.solve(RELAX.joint_matrix("k") + spring * jacobian.T @ jacobian, torque)
    expected = jacobian @ rotation * spring / Environment().k_env
    np.testing.assert_allclose(info["displacement"], expected, rtol=0.03)


@pytest.mark.slow(reason="simulates trials")
def test_options_change_one_trial():
    env = made(duration=2.0, onset_window=(0.5, 1.0), noise=False)
    env.reset(seed=0, options={"perturbation": "none"})
    infos = [env.step(env.own_action)[4] for _ in range(20)]
    assert not any(info["perturbation"].any() for info in infos)
    assert np.abs(infos[-1]["displacement"]).max() < 1e-12
    env.reset()
    assert env.step(env.own_action)[4]["perturbation"].any()
    env.reset(options={"perturbation": "pulse", "peak": 40.0, "randomise": False, "directions_deg": 90.0})
    pushes = np.array([env.step(env.own_action)[4]["perturbation"] for _ in range(60)])
    assert np.abs(pushes[:, 0]).max() < 1e-12
    assert pushes[:, 1].max() == pytest.approx(40.0 * np.sin(np.pi * 0.5), rel=1e-9)  # 40 ms after the onset at 0.5 s
    assert np.flatnonzero(pushes[:, 1])[0] == 25


@pytest.mark.slow(reason="lowers the peaks of eight multisines")
def test_several_forces_are_drawn_from():
    settings = TaskSettings(rms=(1.0, 4.0), duration=1.0, onset_window=(0.1, 0.2))
    rng = np.random.default_rng(0)
    drawn = [settings.drawing()(rng).perturbation for _ in range(40)]
    assert {multisine.rms for multisine in drawn} == {1.0, 4.0}
    assert len({multisine.phases.tobytes() for multisine in drawn}) == 40
    # Turned phases are the same periodic signal, begun elsewhere: crest factors are those of few realisations.
    assert max(multisine.crest_factor().max() for multisine in drawn) < 1.9


FEELING = replace(PERSON, subjects={**PERSON.subjects, "PT": replace(PERSON.subjects["PT"], ka_s=0.5, kf_e=-0.3)})
"""A person with feedback that no level sets."""

MOVING = MuscleLaw(spindle_threshold_slope=0.2)
WARY = replace(PERSON, subjects={**PERSON.subjects, "PT": replace(PERSON.subjects["PT"], muscle=MOVING)})
"""A person whose spindles' threshold follows co-contraction, which no level sets either."""

BAD_SETTINGS = [
    ({"visual_delay": -0.1}, ValueError, "visual_delay = -0.1; expected a finite number at least 0"),
    ({"proprioceptive_delay": -1e-3}, ValueError, "proprioceptive_delay = -0.001"),
    ({"proprioceptive_delay": float("nan")}, ValueError, "proprioceptive_delay = nan"),
    ({"visual_gain": -1.0}, ValueError, "visual_gain = -1.0"),
    ({"task": "XT"}, ValueError, "task = 'XT'; expected one of PT, RT"),
    ({"person": "nobody"}, ValueError, "person = 'nobody'; expected one of average, published"),
    ({"person": PERSON.subjects["PT"]}, TypeError, r"person = Subject\(.*; expected a Person, which has a Subject for"),
    ({"perturbation": "noise"}, ValueError, "perturbation = 'noise'; expected one of none, multisine"),
    ({"control_rate": 30.0}, ValueError, "control_rate = 30 Hz; expected a whole number of steps"),
    ({"duration": 0.033}, ValueError, "duration = 0.033 s; expected a whole number of decisions"),
    ({"duration": -1.0}, ValueError, "duration = -1.0"),
    ({"rms": 0.0}, ValueError, "rms = 0.0"),
    ({"rms": ()}, ValueError, r"rms = \(\); expected at least one number"),
    ({"peak": (50.0, "strong")}, TypeError, "peak = 'strong'; expected a number"),
    ({"noise": 1}, TypeError, "noise = 1; expected True or False"),
    ({"environment": 3.0}, TypeError, "environment = 3.0; expected Environment"),
    ({"perturbation": "pulse", "onset_window": (1.0, 9.99)}, ValueError, "latest onset of onset_window = 9.99"),
    ({"onset_window": (2.0, 1.0)}, ValueError, "expected the earliest onset first"),
    ({"person": "published"}, ValueError, "expected 'common' or 'off', as a muscle group of subject 'position'"),
    ({"person": FEELING}, ValueError, "subject 'S01' has ka_s = 0.5; expected 0 where the agent sets levels"),
    ({"person": WARY}, ValueError, r"slope = \(0\.2, 0\.2, 0\.2\); expected 0 where the agent sets levels"),
    ({"person": FEELING, "co_contraction": "off"}, ValueError, "ka_s = 0.5; expected 0 where the agent sets levels"),
    (
        {"highest_level": 40.0},
        ValueError,
        "highest_level = 40.0: subject 'average': fastest pole of",
    ),
    ({"highest_level": 0.5}, ValueError, "highest_level = 0.5; expected a finite number at least 1"),
    ({"timestep": 1e-9}, ValueError, "timestep = 1e-09; expected a finite number at least 1e-05"),
    ({"timestep": 0.03}, ValueError, "expected a whole number of steps of 0.03 s in a decision"),
    ({"visual_gain": 1e39}, ValueError, r"visual_gain = 1e\+39"),
    ({"rms": 1e300}, ValueError, r"rms = 1e\+300"),
    ({"task": np.array(["PT", "RT"])}, ValueError, "task = array"),
    ({"delay": 0.1}, TypeError, "unknown setting 'delay'; expected some of task, person"),
    ({"view": "side"}, ValueError, "view = 'side'; expected one of oblique, top"),
    ({"width": 0}, ValueError, "width = 0; expected a finite number at least 1"),
    ({"width": 4000}, ValueError, "width = 4000; expected a finite number at least 1 and at most 1920"),
    ({"height": 1441}, ValueError, "height = 1441; expected a finite number at least 1 and at most 1440"),
]


@pytest.mark.parametrize(
    ("settings", "error", "message"), BAD_SETTINGS, ids=[f"{case[0]!s:.60}" for case in BAD_SETTINGS]
)
def test_bad_settings_are_refused(settings, error, message):
    with pytest.raises(error, match=message):
        made(**settings)
    with pytest.raises(error, match=message):
        vectorised(2, **settings)


def test_all_feedback_is_good_where_no_levels_are_set():
    assert TaskSettings(person=FEELING, co_contraction="off", reflexes=False).subject.kf_e == -0.3


def test_settings_are_not_the_callers_lists():
    forces, window, scales = [5.4], [0.1, 0.2], [0.02, 0.2, 5.0, 0.005]
    given = {"rms": forces, "peak": [20.0], "directions_deg": [0.0, 90.0]}
    env = made(**given, onset_window=window, sense_scales=scales, duration=0.6)
    settings = TaskSettings(**given, onset_window=window, sense_scales=scales, duration=0.6)
    for values in (forces, window, scales):
        values.append(100.0)
    assert env.settings == settings
    assert settings.rms == (5.4,)
    assert hash(settings) == hash(env.settings)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (0, 1.5, r"action\[0\] \(co-contraction, shoulder\) = 1.5; expected 0 to 1"),
        (4, -0.1, r"action\[4\] \(velocity feedback, two-joint\) = -0.1; expected 0 to 1"),
        (10, np.nan, r"action\[10\] \(torque, elbow\) = nan; expected -1 to 1"),
        (9, np.inf, r"action\[9\] \(torque, shoulder\) = inf"),
    ],
)
def test_bad_actions_are_refused_and_change_nothing(column, value, message):
    env, reference = (made(out_of_bounds="refuse", **SHORT) for _ in range(2))
    env.reset(seed=0)
    reference.reset(seed=0)
    action = env.own_action.astype(float)
    action[column] = value
    with pytest.raises(ValueError, match=message):
        env.step(action)
    one, other = env.step(env.own_action), reference.step(env.own_action)
    assert data_equivalence(one, other, exact=True)
    envs = vectorised(2, out_of_bounds="refuse", **SHORT)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="of environment 1"):
        envs.step(np.stack([env.own_action, action]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_actions_out_of_their_bounds_are_clipped_and_others_refused(value):
    env, reference = made(**SHORT), made(**SHORT)
    env.reset(seed=0)
    reference.reset(seed=0)
    action = env.own_action.astype(float)
    action[[0, 4, 9, 10]] = 1.0000001, -0.1, 7.0, -1e30
    clipped = np.clip(action, env.action_space.low, env.action_space.high)
    assert data_equivalence(env.step(action), reference.step(clipped), exact=True)
    action[9] = value
    with pytest.raises(ValueError, match=r"action\[9\] \(torque, shoulder\) = .*; expected -1 to 1"):
        env.step(action)
    assert data_equivalence(env.step(clipped), reference.step(clipped), exact=True)


def test_actions_of_another_shape_or_kind_are_refused():
    env = made(**SHORT)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action of shape \(3,\); expected \(11,\): co-contraction, shoulder"):
        env.step(np.zeros(3))
    with pytest.raises(TypeError, match="action of type <U1; expected numbers"):
        env.step(np.array(["a"] * 11))
    with pytest.raises(ValueError, match=r"action of shape \(1, 11\); expected \(11,\)"):
        env.step(np.zeros((1, 11)))
    with pytest.raises(ValueError, match=r"^action has rows of different lengths"):
        env.step([[0.0], [0.0, 1.0]])
    envs = vectorised(1, **SHORT)
    envs.reset(seed=0)
    for shape in ((11,), (1, 3), (1, 1, 11)):
        with pytest.raises(
            ValueError, match=f"action of shape {re.escape(str(shape))}; expected {re.escape('(1, 11)')}"
        ):
            envs.step(np.zeros(shape))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"pulse": 3}, ValueError, "unknown option 'pulse'; expected some of perturbation, rms"),
        ({"rms": -1.0}, ValueError, "rms = -1.0"),
        ("rms", TypeError, "options = 'rms'; expected a dict"),
        ({"peak": 90.0}, ValueError, "peak = 90.0 with perturbation = 'multisine', which has no pulse"),
        (
            {"perturbation": "pulse", "rms": 3.0},
            ValueError,
            "rms = 3.0 with perturbation = 'pulse', which has no multi",
        ),
        ({"trial": 3}, TypeError, "trial = 3; expected Trial"),
        ({"trial": study_trials("RT")[0]}, ValueError, "trial has the task RT; expected PT"),
        ({"trial": study_trials("PT")[0], "rms": 1.0}, ValueError, "expected nothing else beside a trial"),
        (
            {"trial": replace(study_trials("PT")[0], subject=replace(PERSON.subjects["PT"], Td_s=0.031))},
            ValueError,
            "Td_s of the trial's subject = 0.031; expected a finite number at most 0.03",
        ),
        (
            {"trial": replace(study_trials("PT")[0], subject=replace(PERSON.subjects["PT"], kf_e=-0.3))},
            ValueError,
            "subject 'S01' has kf_e = -0.3; expected 0 where the agent sets levels",
        ),
        (
            {"trial": replace(study_trials("PT")[0], subject=replace(PERSON.subjects["PT"], k_h=np.inf))},
            ValueError,
            "k_h = inf; expected a finite grip stiffness in a simulation",
        ),
    ],
    ids=["unknown", "range", "dict", "peak", "rms", "type", "task", "both", "delay", "feedback", "grip"],
)
def test_bad_options_are_refused(options, error, message):
    env = made(**SHORT)
    with pytest.raises(error, match=message):
        env.reset(seed=0, options=options)
    env.reset(seed=0)
    env.step(env.own_action)


@pytest.mark.filterwarnings("error")
def test_who_is_refused_has_lost_nothing():
    envs, reference = (vectorised(3, autoreset_mode="Disabled", **SHORT) for _ in range(2))
    own = np.tile(envs.own_action, (3, 1))
    envs.reset(seed=0)
    reference.reset(seed=0)
    envs.step(own)
    reference.step(own)
    quick = HumanNoise(remnant_share=0.1, remnant_cutoff=600.0)  # the simulation cannot render it
    trial = replace(study_trials("PT")[0], noise=quick)
    mask = np.array([False, True, False])
    for seed, options, message in (
        (7, {"trial": trial, "reset_mask": mask}, "remnant_cutoff = 600"),
        (8, {"pulse": 3}, "unknown option"),
        ([1, -1, 2], None, "Seed must be greater or equal to zero"),
    ):
        with pytest.raises(Exception, match=message):
            envs.reset(seed=seed, options=options)
    assert data_equivalence(envs.step(own), reference.step(own), exact=True)
    assert data_equivalence(envs.reset(), reference.reset(), exact=True)


def test_infos_are_of_those_who_were_reset():
    settings = {"autoreset_mode": "Disabled", **SHORT}
    ours = vectorised(2, **settings)
    theirs = vectorised(2, mode="sync", vector_kwargs={"autoreset_mode": "Disabled"}, **SHORT)
    own = np.tile(ours.own_action, (2, 1))
    for envs in (ours, theirs):
        envs.reset(seed=0)
        envs.step(own)
    resets = [envs.reset(options={"reset_mask": np.array([False, True])}) for envs in (ours, theirs)]
    assert data_equivalence(*resets, exact=True)


def test_warnings_and_clock_of_the_simulator_come_back_after_threads():
    before = [callback.value for callback, _ in callbacks()]
    envs = [made(**SHORT) for _ in range(3)]
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda env: path(env, 15, seed=0), envs))
    assert any(before)
    assert [callback.value for callback, _ in callbacks()] == before


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on Windows")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_that_is_forked_in_silence_ends_it():
    (handler, _), (clock, _) = callbacks()
    before, child, ended_well = (handler.value, clock.value), None, False
    try:
        with silent_simulator():
            child = os.fork()
        ended_well = (handler.value, clock.value) == before
    finally:
        if child == 0:
            os._exit(0 if ended_well else 1)
    assert ended_well
    assert os.waitpid(child, 0)[1] == 0


def test_no_step_before_reset():
    with pytest.raises(RuntimeError, match="expected reset first"):
        made(**SHORT).step(np.zeros(11))
    with pytest.raises(RuntimeError, match="environment 0 has no trial"):
        vectorised(2, **SHORT).step(np.zeros((2, 11)))


def test_seeds_and_masks_must_fit():
    envs = vectorised(3, **SHORT)
    with pytest.raises(ValueError, match="2 seeds; expected 3"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="reset_mask of type bool and shape"):
        envs.reset(options={"reset_mask": np.array([True])})
    with pytest.raises(ValueError, match=r"^reset: reset_mask has rows of different lengths"):
        envs.reset(options={"reset_mask": [[True], [True, False], True]})


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"num_envs": 2.5}, TypeError, "num_envs = 2.5; expected a whole number"),
        ({"num_envs": 0}, ValueError, "num_envs = 0"),
        ({"max_episode_steps": 2.5}, TypeError, "max_episode_steps = 2.5"),
        ({"n_threads": -1}, ValueError, "n_threads = -1"),
        ({"n_threads": "a"}, TypeError, "n_threads = 'a'"),
        (
            {"autoreset_mode": "NEXT_STEP"},
            ValueError,
            "autoreset_mode = 'NEXT_STEP'; expected one of NextStep",
        ),
    ],
)
def test_bad_numbers_of_people_are_refused(settings, error, message):
    with pytest.raises(error, match=message):
        ArmPerturbVectorEnv(**{"num_envs": 2, **settings})


@pytest.mark.parametrize("seed", [1.5, {0: 1}, "1", [1, 2.5], True])
def test_odd_seeds_are_refused(seed):
    with pytest.raises(TypeError, match="expected a whole number, or one"):
        vectorised(2, **SHORT).reset(seed=seed)
    if not isinstance(seed, list):
        with pytest.raises(TypeError, match=f"seed = {re.escape(repr(seed))}; expected a whole number"):
            made(**SHORT).reset(seed=seed)


def test_seeds_may_be_numpys():
    env = made(**SHORT)
    np.testing.assert_array_equal(env.reset(seed=np.int64(3))[1]["perturbation"], env.reset(seed=3)[1]["perturbation"])
    assert env.np_random_seed == 3
    envs = vectorised(2, **SHORT)
    plain = envs.reset(seed=3)[1]["perturbation"]
    for seed in (np.int64(3), np.array([3, 4]), (3, 4)):
        np.testing.assert_array_equal(envs.reset(seed=seed)[1]["perturbation"], plain)


def test_nothing_to_see_before_reset():
    for envs in (made(render_mode="rgb_array", **SHORT), vectorised(2, render_mode="rgb_array", **SHORT)):
        with pytest.raises(RuntimeError, match="no trial has begun; expected reset first"):
            envs.render()


@pytest.mark.slow(reason="draws pictures")
def test_pictures_show_the_handle_moving():
    env = made("ArmPerturb/Pulse-v1", render_mode="rgb_array", view="top", width=160, height=120, **SHORT)
    env.reset(seed=0)
    before = env.render()
    for _ in range(15):
        env.step(env.own_action)
    after = env.render()
    assert before.shape == after.shape == (120, 160, 3)
    assert before.dtype == np.uint8
    assert (before != after).any()
    env.close()
    env.close()
    env.step(env.own_action)  # which needs nothing that was closed
    envs = vectorised(2, render_mode="rgb_array", width=64, height=48, **SHORT)
    envs.reset(seed=0)
    pictures = envs.render()
    assert [picture.shape for picture in pictures] == [(48, 64, 3)] * 2
    envs.close()
    for closed in (env, envs):
        with pytest.raises(RuntimeError, match="render: the environment is closed; expected one that is open"):
            closed.render()


def test_arrows_have_the_scale_of_the_largest_force_of_task_and_trial():
    settings = made(**SHORT).unwrapped.settings
    small, large = (moment(settings, PERSON.subjects["PT"], [np.zeros(8)], force).scale for force in (1.0, 110.0))
    assert small == pytest.approx(0.25 / (3.0 * settings.rms))
    assert large == pytest.approx(0.25 / 110.0)


def test_no_window_opens_after_close(monkeypatch):
    monkeypatch.setattr("armperturb.envs.learning.gym_env.require_display", lambda: None)
    shown = []
    env = made(render_mode="human", **SHORT)
    monkeypatch.setattr(env._live_view, "show", shown.append)
    env.reset(seed=0)
    env.step(env.own_action)
    env.close()
    for name, call in (("step", lambda: env.step(env.own_action)), ("reset", env.reset)):
        with pytest.raises(RuntimeError, match=f"{name}: the environment is closed"):
            call()
    assert [len(moment.trail) for moment in shown] == [1, 2]


def test_a_window_needs_a_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(RuntimeError, match="no display"):
        made(render_mode="human")
    with pytest.raises(ValueError, match="render_mode = 'human'; expected one of None, rgb_array"):
        vectorised(2, render_mode="human")
