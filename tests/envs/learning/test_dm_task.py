"""The dm_control face against the study, the gymnasium face and dm_env's own tests."""

import copy
import pickle
from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from absl.testing import absltest
from dm_control import composer
from dm_control.viewer.runtime import Runtime
from dm_env import StepType, test_utils

import armperturb
from armperturb.cohort import average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial, subject_in
from armperturb.envs.learning.dm_task import ArmPerturbTask
from armperturb.envs.learning.registration import TASKS
from armperturb.envs.learning.task import TaskSettings
from armperturb.perturbations import Multisine, Pulse, Sampled
from armperturb.subject import RELAX

pytestmark = [
    pytest.mark.slow(reason="imports dm_control and compiles its models"),
    pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning"),  # that of version 0
]

POSITION_TASK, RELAX_TASK, PULSE_TASK = list(TASKS)[:3]
EACH_TASK = pytest.mark.parametrize("name", TASKS)
SHORT = {"duration": 0.4, "onset_window": (0.1, 0.2)}
AVERAGE = average_person().subjects
NARROW = Environment(workspace=0.03)
SENSES = ["joint_stretch", "joint_velocity", "hand_force", "handle_seen"]


class TestConformity(test_utils.EnvironmentTestMixin, absltest.TestCase):
    """The tests that dm_env has for environments."""

    def make_object_under_test(self):
        return armperturb.load_dm_env(PULSE_TASK, random_state=1, **SHORT)

    def make_action_sequence(self):
        spec, rng = self.environment.action_spec(), np.random.default_rng(2)
        for _ in range(25):  # a trial has 20
            yield rng.uniform(spec.minimum, spec.maximum)


def trial_of(subject, *, noise=True, rms=3.0, duration=0.6, seed=4):
    return Trial(
        subject=subject,
        perturbation=replace(Multisine.draw(seed=seed, rms=rms, crested=False), duration=duration),
        seed=seed,
        noise=HUMAN_NOISE[subject.task] if noise else None,
    )


def sensed(timestep):
    return np.concatenate([timestep.observation[name] for name in SENSES])


def actions_of(env, seed=0):
    spec, rng = env.action_spec(), np.random.default_rng(seed)
    while True:
        yield rng.uniform(spec.minimum, spec.maximum)


def episode(env, seed=0):
    """All that comes of random actions until the end, from a reset on: senses, reward, discount, (decision, value)."""
    timestep, rows = env.reset(), []
    for action in actions_of(env, seed):
        if timestep.last():
            return np.array(rows)
        timestep = env.step(action)
        rows.append(np.append(sensed(timestep), [timestep.reward, timestep.discount]))


def states(env, n):
    """Displacement and joint angles at the decisions of an episode played by the person itself."""
    env.reset()
    data, rows = env.physics.data, []
    for _ in range(n):
        rows.append(np.append(data.qpos[2:4], data.qpos[0:2]))
        env.step(env.task.own_action)
    return np.array(rows)


OWN = {
    "average PT": (POSITION_TASK, AVERAGE["PT"], {}),
    "published RT": (RELAX_TASK, RELAX, {"person": "published", "co_contraction": "common"}),
}


@pytest.mark.parametrize("case", OWN)
def test_own_action_is_the_trial_of_the_study_to_the_last_bit(case):
    name, subject, settings = OWN[case]
    trial = trial_of(subject, rms=3.0 if subject.task == "PT" else 0.6)
    env = armperturb.load_dm_env(name, **settings)
    env.task.choose(trial=trial)
    recording = run_experiment([trial], rate=50.0).isel(trial=0)
    expected = np.concatenate([recording.displacement, recording.joint_angle], axis=1)
    assert len(expected) == 30
    assert np.ptp(expected[:, 0]) > 1e-3
    np.testing.assert_array_equal(states(env, 30), expected)


@pytest.fixture(scope="module")
def played():
    """A function of a task's name: its environment, and all that came of an episode of random actions."""

    @cache
    def play(name):
        env = armperturb.load_dm_env(name, random_state=3, **SHORT)
        kept = [env.reset()]
        for action in actions_of(env):
            if kept[-1].last():
                return env, kept
            kept.append(env.step(action))

    return play


@EACH_TASK
def test_it_is_the_gymnasium_environment_to_the_last_bit(name, played):
    env, (timestep, *following) = played(name)
    other = gym.make(name, disable_env_checker=True, **SHORT).unwrapped
    observation, _ = other.reset(options={"trial": env.task.trial})
    np.testing.assert_array_equal(sensed(timestep).astype(np.float32), observation)
    for timestep, action in zip(following, actions_of(env), strict=False):
        observation, reward, terminated, truncated, _ = other.step(action)
        np.testing.assert_array_equal(sensed(timestep).astype(np.float32), observation)
        assert timestep.reward == reward
        assert timestep.discount == (0.0 if terminated else 1.0)
        assert timestep.last() == (terminated or truncated)
    assert len(following) == 20
    spec, space = env.action_spec(), other.action_space
    np.testing.assert_array_equal([spec.minimum, spec.maximum], [space.low, space.high])
    np.testing.assert_array_equal(env.task.own_action, other.own_action)


@pytest.mark.parametrize(
    "settings",
    [
        {"proprioceptive_delay": 0.0, "visual_delay": 0.007},
        {"proprioceptive_delay": 0.25, "visual_delay": 0.02, "visual_gain": 0.0},
        {"visual_gain": 3.0, "co_contraction": "common", "reflexes": False, "control_rate": 100.0},
        {"torque": False, "activation_time": 0.0, "timestep": 5e-4, "highest_level": 2.0},
    ],
)
def test_other_settings_are_those_of_the_gymnasium_environment(settings):
    settings = {**settings, **SHORT}
    env = armperturb.load_dm_env(PULSE_TASK, **settings)
    seen = episode(env)
    other = gym.make(PULSE_TASK, disable_env_checker=True, **settings).unwrapped
    other.reset(options={"trial": env.task.trial})
    for action, row in zip(actions_of(env), seen, strict=False):
        observation, reward, *_ = other.step(action)
        np.testing.assert_array_equal(row[:8].astype(np.float32), observation)
        assert row[8] == reward
    assert len(seen) == round(0.4 * env.task.settings.control_rate)


def ends():
    """Where two episodes of one seed leave the arm."""
    env = armperturb.load_dm_env(PULSE_TASK, random_state=7, **SHORT)
    found = []
    for _ in range(2):
        timestep = env.reset()
        while not timestep.last():
            timestep = env.step(env.task.own_action)
        found.append(env.physics.data.qpos.tobytes())
    return found


def test_a_seed_gives_the_same_episodes_in_another_process_and_each_is_another(elsewhere):
    first, second = ends()
    assert first != second
    assert elsewhere["ends"] == [first, second]


def test_seeds_and_states_of_chance_are_taken():
    def one(random_state):
        env = armperturb.load_dm_env(PULSE_TASK, random_state=random_state, **SHORT)
        env.reset()
        return env.task.trial.seed

    first = one(1)
    assert one(np.random.RandomState(1)) == first
    assert len({first, one(2), one(None), one(None)}) == 4


@pytest.mark.parametrize("recompiled", [False, True])
def test_an_episode_after_another_is_that_episode_alone(recompiled):
    """Histories of reflexes and senses, filters, levels, muscles and the solver's warm start begin anew.

    The first episode is left in the middle, pressed against the limit of the workspace.
    """
    settings = {**TASKS[PULSE_TASK], **SHORT, "environment": NARROW}
    task = ArmPerturbTask(TaskSettings(**settings))
    padding = composer.ObservationPadding.INITIAL_VALUE
    env = composer.Environment(
        task,
        recompile_mjcf_every_episode=recompiled,
        delayed_observation_padding=padding,
        strip_singleton_obs_buffer_dim=True,
    )
    task.choose(peak=400.0, onset_window=(0.01, 0.01), directions_deg=0.0)
    env.reset()
    for action, _ in zip(actions_of(env, 5), range(12), strict=False):
        timestep = env.step(action)
        if timestep.last():
            break
    assert timestep.discount == 0.0
    assert env.physics.data.nefc > 0
    trial = trial_of(AVERAGE["PT"], duration=0.4)
    task.choose(trial=trial)
    after = episode(env)
    alone = armperturb.load_dm_env(PULSE_TASK, environment=NARROW, **SHORT)
    alone.task.choose(trial=trial)
    np.testing.assert_array_equal(after, episode(alone))


def test_a_choice_is_for_one_episode():
    env = armperturb.load_dm_env(POSITION_TASK, duration=2.0, onset_window=(0.5, 0.5))
    env.task.choose(perturbation="pulse", peak=60.0, noise=False)
    env.reset()
    assert isinstance(env.task.trial.perturbation, Pulse)
    assert env.task.trial.noise is None
    env.reset()
    assert isinstance(env.task.trial.perturbation, Multisine)
    assert env.task.trial.noise is not None


def test_a_trial_is_of_the_person_as_it_is_in_that_trial():
    """Muscles that a person's variation changes are in the model, in springs and dampers alike."""
    env = armperturb.load_dm_env(RELAX_TASK, **SHORT)
    trial = trial_of(AVERAGE["RT"], rms=0.6)
    env.task.choose(trial=trial)
    env.reset()
    subject = subject_in(trial, env.task.settings.environment)
    model, arm = env.physics.model, env.task.root_entity.arm
    intact = np.array(subject.muscle.of_elements("short_range_stiffness"))
    for quantity, hinges, tendons, beside in (
        ("k", env.physics.bind(arm.joints).stiffness, model.tendon_stiffness, intact),
        ("b", env.physics.bind(arm.joints).damping, model.tendon_damping, np.zeros(3)),
    ):
        two_joint = tendons[env.physics.bind(arm.biarticular).element_id]
        groups = subject.muscle_groups(quantity)
        assert (hinges[0], two_joint, hinges[1]) == tuple(groups + beside)
        assert tuple(groups) != tuple(AVERAGE["RT"].muscle_groups(quantity))


BAD_ACTIONS = [
    (np.full(11, np.nan), ValueError, r"action\[0\] .* = nan; expected 0 to 1"),
    (np.full(11, 1.01), ValueError, r"action\[0\] .* = 1.01; expected 0 to 1"),
    (np.append(np.zeros(10), -2.0), ValueError, r"action\[10\] \(torque, elbow\) = -2.0; expected -1 to 1"),
    (np.zeros(3), ValueError, "expected .*co-contraction, shoulder"),
    (["a"] * 11, TypeError, "expected numbers"),
]


def test_bad_actions_are_refused_and_change_nothing():
    trial = trial_of(AVERAGE["PT"], duration=0.1)
    results = []
    for bad in (BAD_ACTIONS, []):
        env = armperturb.load_dm_env(POSITION_TASK, out_of_bounds="refuse")
        env.task.choose(trial=trial)
        env.reset()
        env.step(env.task.own_action)
        for action, error, message in bad:
            with pytest.raises(error, match=message):
                env.step(action)
        results.append(sensed(env.step(env.task.own_action)))
    np.testing.assert_array_equal(*results)


TALL = replace(AVERAGE["PT"], l_h=0.36)
QUICK = replace(AVERAGE["PT"], Td_e=0.029)


BAD_CHOICES = [
    ({"trial": trial_of(TALL)}, ValueError, "l_h = 0.36; expected 0.34"),
    ({"trial": trial_of(QUICK)}, ValueError, "Td_e = 0.029; expected 0.03"),
    ({"trial": trial_of(RELAX)}, ValueError, "task RT; expected PT"),
    ({"trial": "pulse"}, TypeError, "expected Trial"),
    ({"force": 3.0}, ValueError, "unknown option 'force'"),
    ({"peak": -1.0}, ValueError, "peak = -1"),
]


def test_bad_choices_are_refused_at_once_and_change_nothing():
    env = armperturb.load_dm_env(PULSE_TASK, **SHORT)
    env.task.choose(noise=False)
    for options, error, message in BAD_CHOICES:
        with pytest.raises(error, match=message):
            env.task.choose(**options)
    assert env.reset().first()
    assert env.task.trial.noise is None


def test_a_trial_of_another_body_is_run_by_an_environment_of_that_person():
    person = replace(average_person(), subjects={"PT": TALL, "RT": replace(AVERAGE["RT"], l_h=0.36)})
    trial = trial_of(TALL, duration=0.2)
    env = armperturb.load_dm_env(POSITION_TASK, person=person)
    env.task.choose(trial=trial)
    recording = run_experiment([trial], rate=50.0).isel(trial=0)
    np.testing.assert_array_equal(states(env, 10)[:, :2], recording.displacement)


def test_bad_names_and_settings_are_refused():
    with pytest.raises(ValueError, match="name = 'position'; expected one of ArmPerturb/Position-v1"):
        armperturb.load_dm_env("position")
    with pytest.raises(TypeError, match="unknown setting 'rsm'"):
        armperturb.load_dm_env(POSITION_TASK, rsm=1.0)
    with pytest.raises(ValueError, match="visual_delay = -1"):
        armperturb.load_dm_env(POSITION_TASK, visual_delay=-1.0)


def pushed(force):
    """A step of force along x on the relaxed arm, which ends after 0.4 s."""
    perturbation = Sampled(force=np.tile([[force, 0.0]], (20, 1)), rate=50.0)
    return Trial(subject=AVERAGE["RT"], perturbation=perturbation)


@pytest.mark.parametrize("reward", ["bounded", "cost"])
def test_the_limit_of_the_workspace_terminates_and_the_end_truncates(reward):
    env = armperturb.load_dm_env(RELAX_TASK, environment=NARROW, reward=reward, perturbation="pulse")
    last = {}
    for force in (20.0, 0.1):
        env.task.choose(trial=pushed(force))
        timestep, n = env.reset(), 0
        while not timestep.last():
            assert timestep.discount in (None, 1.0)
            timestep = env.step(env.task.own_action)
            n += 1
        last[force] = timestep, n
        assert env.step(env.task.own_action).step_type is StepType.FIRST
    limited, over = last[20.0], last[0.1]
    assert limited[0].discount == 0.0
    lost = 0.0 if reward == "bounded" else -env.task.settings.worst * (21 - limited[1])
    assert limited[0].reward == pytest.approx(lost)
    assert limited[1] < 20
    assert over[0].discount == 1.0
    assert over[0].reward > -1.0
    assert over[1] == 20


@pytest.mark.filterwarnings("ignore:The 'warn' function is deprecated")
@pytest.mark.parametrize("force", [1e10, 1e100])
def test_what_cannot_be_integrated_terminates_with_the_penalty_and_the_next_episode_is_sound(force):
    settings = {"proprioceptive_delay": 0.0, "visual_delay": 0.005, "reward": "cost"}
    env = armperturb.load_dm_env(RELAX_TASK, **settings)
    env.task.choose(trial=pushed(force))
    env.reset()
    timestep = env.step(env.task.own_action)
    assert timestep.last()
    assert timestep.discount == 0.0
    assert timestep.reward < -env.task.settings.worst
    assert np.isfinite(sensed(timestep)).all()
    results = []
    for one in (env, armperturb.load_dm_env(RELAX_TASK, **settings)):
        one.task.choose(trial=pushed(0.1))
        results.append(episode(one))
    np.testing.assert_array_equal(*results)


def test_senses_come_late_and_begin_with_their_initial_value():
    """A constant added to a sense is there from the start: what pads the delay is the initial value, not zero."""
    env = armperturb.load_dm_env(POSITION_TASK, **SHORT)
    observables = env.task.observables
    assert {name: one.delay for name, one in observables.items() if one.enabled} == {
        "joint_stretch": 12,
        "joint_velocity": 12,
        "hand_force": 12,
        "handle_seen": 60,
    }
    for name in SENSES:
        observables[name].corruptor = lambda value, random_state: value + 0.5
        observables[name].buffer_size = 2
    timestep = env.reset()
    for n in range(8):
        for name in SENSES:
            assert timestep.observation[name].shape == (2, 2)
            moved = timestep.observation[name][-1] != 0.5
            # The newest is that of the last step, n decisions of 8 steps after the first.
            assert moved.all() == (8 * n > observables[name].delay), f"{name} after {n} decisions"
        timestep = env.step(env.task.own_action)


def test_what_is_padded_stays_as_it_was():
    env = armperturb.load_dm_env(PULSE_TASK, **SHORT)
    names = ["time", "perturbation", "co_contraction"]
    for name in names:
        env.task.observables[name].configure(enabled=True, buffer_size=4)
    first = env.reset().observation
    seen = [first, *(env.step(np.zeros(11)).observation for _ in range(3))]
    for name in names:
        expected = [first[name][-1], *(one[name][-1] for one in seen[1:])]
        np.testing.assert_array_equal(seen[-1][name], expected)
        np.testing.assert_array_equal(seen[1][name], [expected[0]] * 3 + [expected[1]])
    assert (np.diff(seen[-1]["co_contraction"], axis=0) < 0.0).all()


def test_what_no_person_knows_can_be_observed():
    env = armperturb.load_dm_env(POSITION_TASK, **SHORT)
    observables = env.task.observables
    hidden = ["time", "perturbation", "co_contraction", "arm/joint_angles", "manipulator/handle_displacement"]
    assert not {*hidden} & {*env.observation_spec()}
    for name in hidden:
        observables[name].enabled = True
    timestep = env.reset()
    other = gym.make(POSITION_TASK, disable_env_checker=True, **SHORT).unwrapped
    _, truth = other.reset(options={"trial": env.task.trial})
    names = ["time", "perturbation", "co_contraction", "joint_angle", "displacement"]
    for action, _ in zip(actions_of(env), range(12), strict=False):
        for ours, theirs in zip(hidden, names, strict=True):
            np.testing.assert_array_equal(timestep.observation[ours], truth[theirs], err_msg=ours)
        timestep = env.step(action)
        truth = other.step(action)[-1]
    assert {*hidden, *SENSES} <= {*env.observation_spec()}


@EACH_TASK
def test_observations_are_finite_not_constant_and_share_no_memory(name, played):
    _, kept = played(name)
    rows = np.array([sensed(timestep) for timestep in kept])
    assert np.isfinite(rows).all()
    assert (np.ptp(rows, axis=0) > 0.0).all()
    np.testing.assert_array_equal(rows[0], 0.0)
    arrays = [timestep.observation[name] for timestep in kept for name in SENSES]
    assert len({array.__array_interface__["data"][0] for array in arrays}) == len(arrays)


def test_actions_are_named():
    spec = armperturb.load_dm_env(POSITION_TASK, co_contraction="common", reflexes=False).action_spec()
    assert spec.name.split("\t") == ["co-contraction", "torque, shoulder", "torque, elbow"]
    np.testing.assert_array_equal(spec.minimum, [0.0, -1.0, -1.0])


def test_the_viewer_runs_it():
    env = armperturb.load_dm_env(PULSE_TASK, **SHORT)
    runtime = Runtime(env, policy=lambda _: env.task.own_action)
    errors = []
    runtime.on_error += errors.append
    for _ in range(12):
        runtime.tick(0.05, paused=False)
    assert not errors
    assert runtime.get_time() == pytest.approx(0.4)
    runtime.restart()
    runtime.tick(0.05, paused=False)
    runtime.tick(0.05, paused=True)
    assert not errors
    assert 0.0 < runtime.get_time() < 0.2


def onwards(env):
    """The rest of an episode and the next one, which nobody seeds."""
    return np.vstack([episode_from_here(env, 1), episode(env, 2)])


def episode_from_here(env, seed):
    rows = []
    for action in actions_of(env, seed):
        timestep = env.step(action)
        rows.append(np.append(sensed(timestep), [timestep.reward, timestep.discount]))
        if timestep.last():
            return np.array(rows)


def test_copies_and_saved_states_go_on_to_the_last_bit():
    env = armperturb.load_dm_env(PULSE_TASK, random_state=3, **SHORT)
    episode(env)
    env.task.choose(perturbation="multisine")
    env.task.observables["perturbation"].enabled = True
    env.reset()
    for _, action in zip(range(7), actions_of(env, 5), strict=False):
        env.step(action)
    state, copies = env.get_state(), [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = onwards(env)
    env.task.choose(peak=20.0)
    env.set_state(state)
    fresh = armperturb.load_dm_env(PULSE_TASK, random_state=8, **SHORT)
    fresh.set_state(state)
    for other in (env, fresh, *copies):
        np.testing.assert_array_equal(onwards(other), expected)
        assert "perturbation" in other.observation_spec()
    with pytest.raises(ValueError, match="state of another environment"):
        armperturb.load_dm_env(RELAX_TASK, **SHORT).set_state(state)
