"""The composer entities against the model that the package's own experiment runs."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from dm_control import composer, mjcf

from armperturb.cohort import average_person
from armperturb.environment import Environment, Strap
from armperturb.envs.learning.entities import Rig
from armperturb.models.rig import build_model
from armperturb.subject import POSITION, RELAX

pytestmark = pytest.mark.slow(reason="imports dm_control and compiles its models")

STEPS = 1000
PER_CONTROL = 10
AVERAGE = average_person().subjects
ODD = replace(
    POSITION,
    name="odd",
    l_h=1.0 / 3.0,
    l_f=0.3519,
    m_h=np.e,
    theta_s_deg=37.77,
    theta_e_deg=61.3,
    Td_s=0.0273,
    Td_e=0.0391,
    k_h=19.1e3 / 7.0,
)
HEAVY = Environment(m_env=np.pi, b_env=1.7, k_env=31.1, workspace=0.21)
NARROW = Environment(workspace=0.005)
RIGS = {
    "position": (POSITION, Environment(), {}),
    "average RT": (AVERAGE["RT"], Environment(), {}),
    "odd": (ODD, HEAVY, {}),
    "pendulum": (ODD, HEAVY, {"rope": "pendulum", "timestep": 0.0008}),
    "strap": (ODD, HEAVY, {"strap": Strap(stiffness=4321.0, damping=123.0, mass=6.7)}),
    "at the limit": (RELAX, NARROW, {}),
}
EACH = pytest.mark.parametrize("case", RIGS)


class Driven(composer.NullTask):
    """A rig that given torques and forces drive, (step, joint) and (step, axis), and that logs its states."""

    def __init__(self, rig, torques, forces):
        super().__init__(rig)
        self.torques, self.forces = torques, forces
        self.control_timestep = PER_CONTROL * self.physics_timestep
        self.log = []

    def initialize_episode(self, physics, random_state):
        self.motors = physics.bind(self.root_entity.arm.reflexes).element_id
        self.step = 0
        self.log = []

    def before_step(self, physics, action, random_state):
        pass

    def before_substep(self, physics, action, random_state):
        physics.data.ctrl[self.motors] = self.torques[self.step]
        physics.data.ctrl[-2:] = self.forces[self.step]
        self.step += 1

    def after_substep(self, physics, random_state):
        data = physics.data
        gauge = physics.bind(self.root_entity.manipulator.gauge).sensordata
        self.log.append(np.concatenate([data.qpos, data.qvel, gauge]))


def drives(n_steps=STEPS):
    """Torques that change with each step, so that a delay of another length shows, and strong forces."""
    rng = np.random.default_rng(5)
    return rng.normal(0.0, 2.0, (n_steps, 2)), rng.normal([3.0, -2.0], 20.0, (n_steps, 2))


def environment_of(rig, n_steps=STEPS, **options):
    task = Driven(rig, *drives(n_steps))
    padding = composer.ObservationPadding.INITIAL_VALUE
    return composer.Environment(task, delayed_observation_padding=padding, **options)


@EACH
def test_moves_as_the_model_of_the_experiment_does_to_the_last_bit(case):
    subject, environment, options = RIGS[case]
    env = environment_of(Rig(subject, environment, **options))
    env.reset()
    for _ in range(STEPS // PER_CONTROL):
        env.step(np.zeros(2))

    model = build_model(subject, environment, **options)
    data = mujoco.MjData(model)
    torques, forces = drives()
    expected = []
    limited = 0
    for torque, force in zip(torques, forces, strict=True):
        data.ctrl[:2], data.ctrl[-2:] = torque, force
        mujoco.mj_step(model, data)
        expected.append(np.concatenate([data.qpos, data.qvel, data.sensor("strain_gauge").data]))
        limited += data.nefc > 0
    np.testing.assert_array_equal(env.task.log, expected)
    assert (limited > 0) == (environment is NARROW)
    assert np.ptp(np.array(expected)[:, -3]) > 1.0


KINDS = {
    "body": "nbody",
    "joint": "njnt",
    "geom": "ngeom",
    "site": "nsite",
    "tendon": "ntendon",
    "actuator": "nu",
    "sensor": "nsensor",
    "camera": "ncam",
    "light": "nlight",
    "material": "nmat",
    "mesh": "nmesh",
    "texture": "ntex",
}
PLACES = {"id", "name", "adr", "bodyid", "parentid", "rootid", "weldid", "dataid", "matid", "texid"}
PLACES |= {"geomadr", "geomnum"}
"""Fields that say where something is in the model; the frames that hold the entities shift them."""


def named(model):
    """What a model says of its elements, whichever entity they are in: {(kind, name, field): value}."""
    found = {}
    for kind, size in KINDS.items():
        for index in range(getattr(model, size)):
            element = getattr(model, kind)(index)
            for field in dir(element):
                if not field.startswith("_") and field not in PLACES:
                    found[kind, element.name.rsplit("/", 1)[-1], field] = np.asarray(getattr(element, field))
    return found


@EACH
def test_every_number_is_that_of_the_model_of_the_experiment(case):
    subject, environment, options = RIGS[case]
    ours = named(mjcf.Physics.from_mjcf_model(Rig(subject, environment, **options).mjcf_model).model.ptr)
    theirs = named(build_model(subject, environment, **options))
    differ = [key for key, value in theirs.items() if not np.array_equal(ours[key], value)]
    assert not differ
    # All that is more are the frames that hold the entities.
    assert {name for kind, name, _ in ours.keys() - theirs.keys()} == {""}


def test_options_are_those_of_the_model_of_the_experiment():
    ours = mjcf.Physics.from_mjcf_model(Rig(ODD, HEAVY, timestep=0.0008).mjcf_model).model.ptr
    theirs = build_model(ODD, HEAVY, timestep=0.0008)
    for field in dir(theirs.opt):
        if not field.startswith("_"):
            np.testing.assert_array_equal(getattr(ours.opt, field), getattr(theirs.opt, field))
    for field in ("meaninertia", "extent", "center"):
        np.testing.assert_array_equal(getattr(ours.stat, field), getattr(theirs.stat, field))


def test_coordinates_are_in_the_order_that_controllers_expect():
    rig = Rig(RELAX)
    physics = mjcf.Physics.from_mjcf_model(rig.mjcf_model)
    assert [physics.model.id2name(i, "joint") for i in range(physics.model.njnt)] == [
        "arm/shoulder",
        "arm/elbow",
        "manipulator/carriage_x",
        "manipulator/carriage_y",
    ]
    np.testing.assert_array_equal(physics.bind(rig.arm.joints).element_id, [0, 1])
    np.testing.assert_array_equal(physics.bind(rig.arm.reflexes).element_id, [0, 1])
    np.testing.assert_array_equal(physics.bind(rig.manipulator.slides).element_id, [2, 3])
    # The force sums over tendons in this order, and sums of floats depend on it.
    tendons = [physics.model.id2name(i, "tendon").removeprefix("arm/") for i in range(physics.model.ntendon)]
    assert tendons == ["biarticular", "rope", "grip_right", "grip_left", "grip_front", "grip_back"]


def test_a_person_s_muscles_can_be_changed_between_steps_to_the_last_bit():
    rig = Rig(replace(POSITION, m_h=RELAX.m_h, m_f=RELAX.m_f))
    physics = mjcf.Physics.from_mjcf_model(rig.mjcf_model)
    joints, arm = physics.bind(rig.arm.joints), RELAX
    (k_s, k_se, k_e), (b_s, b_se, b_e) = arm.muscle_groups("k"), arm.muscle_groups("b")
    joints.stiffness, joints.damping = [k_s, k_e], [b_s, b_e]
    biarticular, grip = physics.bind(rig.arm.biarticular), physics.bind(rig.arm.grip)
    biarticular.stiffness, biarticular.damping = k_se, b_se
    grip.stiffness, grip.damping = arm.k_h / 2, arm.b_h / 2

    model = build_model(RELAX)
    data = mujoco.MjData(model)
    for torque, force in zip(*drives(500), strict=True):
        for own in (data, physics.data):
            own.ctrl[:2], own.ctrl[-2:] = torque, force
        mujoco.mj_step(model, data)
        physics.step()
        np.testing.assert_array_equal(physics.data.qpos, data.qpos)


def test_nothing_is_observed_unless_enabled():
    rig = Rig(RELAX)
    env = environment_of(rig)
    assert env.observation_spec() == {}
    rig.observables.enable_all()
    rig.arm.observables.enable_all()
    assert list(environment_of(rig).observation_spec()) == ["arm/joint_angles", "arm/joint_velocities"]


def test_observations_are_the_states_with_their_delays_padded_with_the_first():
    rig = Rig(ODD, HEAVY)
    columns = {  # of the log, and the delay
        "arm/joint_angles": (slice(0, 2), 25),
        "arm/joint_velocities": (slice(4, 6), 0),
        "manipulator/handle_displacement": (slice(2, 4), 7),
        "manipulator/handle_velocity": (slice(6, 8), 10),
        "manipulator/hand_force": (slice(8, 10), 1),
    }
    for key, one in (rig.arm.observables.as_dict() | rig.manipulator.observables.as_dict()).items():
        one.enabled, one.buffer_size, one.delay = True, 3, columns[key][1]
    env = environment_of(rig)
    timestep = env.reset()
    start = np.concatenate([env.physics.data.qpos, np.zeros(4), np.zeros(3)])
    assert set(timestep.observation) == set(columns)
    for control in range(12):
        now = control * PER_CONTROL
        states = np.array([start, *env.task.log])
        for key, observed in timestep.observation.items():
            place, delay = columns[key]
            seen = np.maximum(now - delay + np.arange(-2, 1), 0)
            np.testing.assert_array_equal(observed, states[seen, place], err_msg=f"{key} at {now}")
        timestep = env.step(np.zeros(2))


def test_the_hand_is_pushed_by_what_the_handle_is_pushed_by():
    """A steady force, less what the environment's spring holds, arrives at the hand."""
    rig = Rig(POSITION, Environment(k_env=200.0, b_env=100.0))
    rig.manipulator.observables.enable_all()
    task = Driven(rig, np.zeros((6000, 2)), np.tile([4.0, -3.0], (6000, 1)))
    env = composer.Environment(task, strip_singleton_obs_buffer_dim=True)
    env.reset()
    for _ in range(600):
        seen = env.step(np.zeros(2)).observation
    balance = np.array([4.0, -3.0]) - 200.0 * seen["manipulator/handle_displacement"]
    np.testing.assert_allclose(seen["manipulator/hand_force"], balance, rtol=1e-4)


def test_bad_input_is_refused_as_by_the_model():
    with pytest.raises(ValueError, match="rope = 'chain'"):
        Rig(RELAX, rope="chain")
