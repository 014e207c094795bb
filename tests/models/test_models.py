"""The compiled rig against the thesis's matrices, eqs 2.6-2.13, 2.10, B.2 and B.28."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from armperturb.anthropometry import anthropometric_body
from armperturb.environment import Environment
from armperturb.models import rig as models
from armperturb.models.rig import build_model, history_length
from armperturb.subject import POSITION, RELAX, Subject

TALL = replace(RELAX, name="tall", m_h=2.9, m_f=2.3, l_h=0.37, l_f=0.41, theta_s_deg=35.0, theta_e_deg=61.0, Td_s=0.025)
RIGID = replace(POSITION, name="rigid", **anthropometric_body("female", 1.69, 60.0, attached=0.25))
PEOPLE = pytest.mark.parametrize("subject", [RELAX, POSITION, TALL, RIGID], ids=lambda subject: subject.name)
ENVIRONMENT = Environment(m_env=2.5, b_env=1.7, k_env=31.0, workspace=0.2)


def started(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def jacobian(subject: Subject, q: np.ndarray) -> np.ndarray:
    """Hand velocity per joint velocity, (axis, joint) (eq. B.28)."""
    s, se = q[0], q[0] + q[1]
    l_h, l_f = subject.l_h, subject.l_f
    return np.array(
        [
            [-l_f * np.sin(se) - l_h * np.sin(s), -l_f * np.sin(se)],
            [l_f * np.cos(se) + l_h * np.cos(s), l_f * np.cos(se)],
        ]
    )


def mass_matrix(subject: Subject, q: np.ndarray) -> np.ndarray:
    """T_q^T M T_q with T of eq. B.2 differentiated by hand, and the segments' own turning, (joint, joint)."""
    s, se = q[0], q[0] + q[1]
    c_h, c_f, l_h = subject.c_h * subject.l_h, subject.c_f * subject.l_f, subject.l_h
    of_h, of_f = subject.m_h * (subject.r_h * l_h) ** 2, subject.m_f * (subject.r_f * subject.l_f) ** 2
    t_q = np.array(
        [
            [-c_h * np.sin(s), 0.0],
            [c_h * np.cos(s), 0.0],
            [-c_f * np.sin(se) - l_h * np.sin(s), -c_f * np.sin(se)],
            [c_f * np.cos(se) + l_h * np.cos(s), c_f * np.cos(se)],
        ]
    )
    turning = np.array([[of_h + of_f, of_f], [of_f, of_f]])
    return t_q.T @ np.diag([subject.m_h, subject.m_h, subject.m_f, subject.m_f]) @ t_q + turning


def full_mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def ideal_grip(subject: Subject, x: np.ndarray, xd: np.ndarray) -> np.ndarray:
    return subject.k_h * x + subject.b_h * xd


@PEOPLE
def test_mass_matrix_is_that_of_two_segments_and_the_virtual_mass(subject):
    model = build_model(subject, ENVIRONMENT)
    data = started(model)
    for bend in (np.zeros(2), np.array([0.2, -0.4])):
        data.qpos[:2] = subject.posture + bend
        mujoco.mj_forward(model, data)
        full = full_mass_matrix(model, data)
        np.testing.assert_allclose(full[:2, :2], mass_matrix(subject, data.qpos[:2]), rtol=1e-9)
        np.testing.assert_allclose(full[2:, 2:], ENVIRONMENT.m_env * np.eye(2), rtol=1e-9, atol=1e-15)
        np.testing.assert_array_equal(full[:2, 2:], 0.0)


@PEOPLE
@pytest.mark.parametrize("visual", [True, False])
def test_stands_in_equilibrium_at_the_start_posture(subject, visual):
    model = build_model(subject, ENVIRONMENT, visual=visual)
    data = started(model)
    np.testing.assert_array_equal(data.qpos, [*subject.posture, 0.0, 0.0])
    np.testing.assert_allclose(data.qacc, 0.0, atol=1e-9)
    np.testing.assert_allclose(data.sensor(models.STRAIN_GAUGE).data, 0.0, atol=1e-9)
    mujoco.mj_step(model, data, 200)
    np.testing.assert_allclose(data.qpos, [*subject.posture, 0.0, 0.0], atol=1e-12)


@PEOPLE
def test_hand_stands_where_the_posture_puts_it(subject):
    model = build_model(subject)
    data = started(model)
    hand = data.site(models.HAND_SITE).xpos
    expected = subject.l_h * np.exp(1j * subject.posture[0]) + subject.l_f * np.exp(1j * subject.posture.sum())
    np.testing.assert_allclose(hand[:2], [expected.real, expected.imag], atol=1e-12)
    np.testing.assert_allclose(data.body("carriage").xpos, hand, atol=1e-12)
    np.testing.assert_allclose(data.site("ceiling").xpos - data.site("sling").xpos, [0.0, 0.0, 2.0], atol=1e-12)


@PEOPLE
@pytest.mark.parametrize(("quantity", "field"), [("k", "qpos"), ("b", "qvel")])
def test_joint_matrices_are_those_of_the_subject(subject, quantity, field):
    model = build_model(subject)
    # Without the grip only muscle is left at the joints; the slides keep the environment.
    for name in models.GRIP:
        tendon = model.tendon(name).id
        model.tendon_stiffness[tendon] = model.tendon_damping[tendon] = 0.0
    data = started(model)
    matrix = np.zeros((model.nv, model.nv))
    for joint in range(model.nv):
        torque = []
        for step in (1e-3, -1e-3):
            mujoco.mj_resetData(model, data)
            getattr(data, field)[joint] += step
            mujoco.mj_forward(model, data)
            torque.append(data.qfrc_passive.copy())
        matrix[:, joint] = -(torque[0] - torque[1]) / 2e-3
    expected = np.zeros((4, 4))
    expected[:2, :2] = subject.joint_matrix(quantity)
    expected[2:, 2:] = np.eye(2) * {"k": Environment().k_env, "b": Environment().b_env}[quantity]
    np.testing.assert_allclose(matrix, expected, rtol=1e-9, atol=1e-9)


@PEOPLE
@pytest.mark.parametrize("direction", np.arange(16) * np.pi / 8)
def test_grip_is_an_isotropic_spring_and_damper_on_both_sides(subject, direction):
    model = build_model(subject)
    data = started(model)
    along = np.array([np.cos(direction), np.sin(direction)])
    across = np.array([-along[1], along[0]])
    for x, xd in ((7e-3 * along, 0 * along), (7e-3 * along, 0.5 * across), (0 * along, 0.5 * along)):
        mujoco.mj_resetData(model, data)
        data.qpos[2:], data.qvel[2:] = x, xd
        mujoco.mj_forward(model, data)
        f = ideal_grip(subject, x, xd)
        error = 1e-3 * np.linalg.norm(f)
        gauge = data.sensor(models.STRAIN_GAUGE).data
        np.testing.assert_allclose(gauge[:2], f, rtol=0, atol=error)
        # The hand side, with the arm at its posture: tau_e = J^T f (eq. 2.7) and muscle is slack.
        j = jacobian(subject, data.qpos[:2])
        np.testing.assert_allclose(np.linalg.solve(j.T, data.qfrc_passive[:2]), f, rtol=0, atol=error)
        # The environment feels the same, opposite, beside its own spring and damper.
        reaction = data.qfrc_passive[2:] + Environment().k_env * x + Environment().b_env * xd
        np.testing.assert_allclose(reaction, -gauge[:2], rtol=1e-9, atol=1e-9)


@PEOPLE
def test_grip_follows_a_hand_that_moves_far(subject):
    model = build_model(subject)
    data = started(model)
    start = data.site(models.HAND_SITE).xpos[:2].copy()
    data.qpos[:2] += [0.15, -0.2]
    data.qvel[:2] = [1.0, -2.0]
    mujoco.mj_forward(model, data)
    data.qpos[2:] = data.site(models.HAND_SITE).xpos[:2] - start + [3e-3, -4e-3]
    mujoco.mj_forward(model, data)
    hand_velocity = jacobian(subject, data.qpos[:2]) @ data.qvel[:2]
    f = ideal_grip(subject, np.array([3e-3, -4e-3]), -hand_velocity)
    np.testing.assert_allclose(data.sensor(models.STRAIN_GAUGE).data[:2], f, rtol=0, atol=1e-3 * np.linalg.norm(f))


def test_strain_gauge_balances_the_environment_in_motion():
    # d - f = M_e xdd + B_e xd + K_e x (eq. 2.11), with the sensor as f, at every moment of a push.
    model = build_model(POSITION, ENVIRONMENT)
    data = started(model)
    d = np.array([40.0, -25.0])
    data.qfrc_applied[2:] = d
    for _ in range(60):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        f = data.sensor(models.STRAIN_GAUGE).data[:2]
        x, xd, xdd = data.qpos[2:], data.qvel[2:], data.qacc[2:]
        np.testing.assert_allclose(
            f, d - ENVIRONMENT.m_env * xdd - ENVIRONMENT.b_env * xd - ENVIRONMENT.k_env * x, rtol=1e-9, atol=1e-9
        )
    assert np.linalg.norm(data.qpos[2:]) > 1e-3


def test_sensors_read_angles_and_handle():
    data = started(model := build_model(RELAX))
    data.qpos[:] = [0.5, 1.3, 0.01, -0.02]
    mujoco.mj_forward(model, data)
    read = [data.sensor(name).data[0] for name in (*models.ANGLE_SENSORS, *models.HANDLE_SENSORS)]
    np.testing.assert_array_equal(read, data.qpos)
    assert [model.joint(name).id for name in (*models.JOINTS, *models.SLIDES)] == [0, 1, 2, 3]


@PEOPLE
def test_pendulum_rope_carries_the_weight_and_pulls_back(subject):
    model = build_model(subject, rope="pendulum")
    data = started(model)
    weight = (subject.m_h + subject.m_f) * 9.81
    sling = data.site("sling").xpos.copy()
    data.qpos[:2] += [0.05, -0.1]
    mujoco.mj_forward(model, data)
    displacement = data.site("sling").xpos - sling
    vector = data.site("ceiling").xpos - data.site("sling").xpos
    tension = model.tendon_stiffness[model.tendon(models.ROPE).id] * data.tendon(models.ROPE).length
    force = tension * vector / np.linalg.norm(vector)
    np.testing.assert_allclose(force[2], weight, rtol=1e-12)
    np.testing.assert_allclose(force[:2], -weight / 2.0 * displacement[:2], rtol=1e-9)
    # And that is what the joints get, beside what they get with an ideal rope.
    ideal_model = build_model(subject)
    ideal = started(ideal_model)
    ideal.qpos[:] = data.qpos
    mujoco.mj_forward(ideal_model, ideal)
    jacp = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacp, None, model.site("sling").id)
    np.testing.assert_allclose(data.qfrc_passive - ideal.qfrc_passive, jacp.T @ force, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("subject", [RELAX, RIGID], ids=lambda subject: subject.name)
def test_a_push_leaves_the_energy_that_it_gave(subject):
    still = dict.fromkeys(("b_s", "b_se", "b_e", "b_h", *(f"k{v}_{j}" for v in "vp" for j in ("s", "se", "e"))), 0.0)
    model = build_model(replace(subject, **still), Environment(b_env=0.0), timestep=1e-4)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.body_gravcomp[:] = 0.0
    data = started(model)
    data.qvel[:] = [1.5, -2.0, 0.0, 0.0]
    mujoco.mj_forward(model, data)
    given = data.energy.sum()
    rate = data.qvel[:2]
    assert data.energy[1] == pytest.approx(0.5 * rate @ mass_matrix(subject, data.qpos[:2]) @ rate, rel=1e-9)
    mujoco.mj_step(model, data, 3000)
    mujoco.mj_forward(model, data)
    assert np.abs(data.qpos[:2] - subject.posture).max() > 0.01
    assert data.energy.sum() - given == pytest.approx(0.0, abs=1e-4 * data.energy[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"i_s": 0.1}, r"i_s, i_se, i_e = 0\.1, 0, 0; expected 0 in a simulation, .*geometry\.with_rigid_segments"),
        ({"k_h": np.inf}, "k_h = inf; expected a finite grip stiffness in a simulation"),
    ],
)
def test_what_only_the_linear_arm_can_have_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        build_model(replace(RELAX, **change))


def test_ideal_rope_adds_no_force():
    model = build_model(RELAX)
    rope = model.tendon(models.ROPE).id
    assert model.tendon_stiffness[rope] == model.tendon_damping[rope] == 0.0


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_workspace_ends(axis, sign):
    model = build_model(RELAX, Environment(workspace=0.05))
    data = started(model)
    data.qfrc_applied[2 + axis] = sign * 100.0
    mujoco.mj_step(model, data, 1500)
    assert 0.049 < sign * data.qpos[2 + axis] < 0.055


@pytest.mark.parametrize("path", [models.ARM_XML, models.MANIPULATOR_XML, models.RIG_XML], ids=lambda path: path.stem)
def test_files_load_on_their_own(path):
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 10)
    assert np.isfinite(data.qpos).all()


def test_only_bodies_that_move_weigh_something():
    model = build_model(RELAX, ENVIRONMENT)
    mass = {model.body(i).name: model.body_mass[i] for i in range(model.nbody)}
    assert mass.pop("gauge") == pytest.approx(0.0, abs=1e-9)
    expected = {"world": 0.0, "manipulator": 0.0, "humerus": RELAX.m_h, "forearm": RELAX.m_f, "carriage": 2.5}
    assert mass == pytest.approx(expected)


def pushed(model: mujoco.MjModel, steps: int = 150) -> np.ndarray:
    """State after each step of a push with random reflex torques, (time, nq + nv)."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    states = np.empty((steps, model.nq + model.nv))
    for k in range(steps):
        data.ctrl[:] = rng.normal(size=6) * [1.0, 1.0, 1.0, 1.0, 10.0, 10.0]
        mujoco.mj_step(model, data)
        states[k] = np.concatenate([data.qpos, data.qvel])
    return states


@pytest.mark.parametrize(
    ("Td_s", "Td_e", "timestep"),
    [(0.030, 0.030, 0.001), (0.0304, 0.0217, 0.001), (0.003, 0.0045, 0.001), (0.030, 0.025, 0.0005)],
)
def test_longer_history_changes_no_bit(Td_s, Td_e, timestep):
    subject = replace(POSITION, Td_s=Td_s, Td_e=Td_e)
    needed = history_length(subject, timestep)
    trajectory = pushed(build_model(subject, timestep=timestep))
    for n_history in (needed + 1, needed + 50):
        longer = build_model(subject, timestep=timestep, n_history=n_history)
        np.testing.assert_array_equal(pushed(longer), trajectory)


@pytest.mark.parametrize("rope", models.ROPES)
def test_leaving_out_visuals_changes_no_bit(rope):
    bare = build_model(POSITION, rope=rope, visual=False)
    assert bare.ngeom == bare.ncam == bare.nlight == 0
    np.testing.assert_array_equal(pushed(bare), pushed(build_model(POSITION, rope=rope)))


@pytest.mark.parametrize("delay", [0.030, 0.0305])
def test_reflex_torque_acts_after_the_delay(delay):
    model = build_model(replace(RELAX, Td_s=delay, Td_e=delay))
    data = mujoco.MjData(model)
    for _ in range(100):
        data.ctrl[:2] = [3.0 * data.time, -data.time]
        now = data.time
        mujoco.mj_step(model, data)
    # mj_step leaves the forces of its start.
    mujoco.mj_forward(model, data)
    expected = np.array([3.0, -1.0]) * (now + model.opt.timestep - delay)
    np.testing.assert_allclose(data.qfrc_actuator[:2], expected, rtol=1e-9)


def test_people_share_one_batch():
    people = [RELAX, POSITION, TALL]
    n_history = max(history_length(subject) for subject in people)
    built = [build_model(subject, n_history=n_history, visual=False) for subject in people]
    for size in ("nq", "nv", "nu", "nsensordata", "nhistory", "ntendon", "nsite"):
        assert len({getattr(model, size) for model in built}) == 1, size
    batch = Batch(built[0], len(people), 2)
    batch.set_models(built)
    batch.reset()
    batch.step(nstep=50)
    np.testing.assert_allclose(batch.qpos[:, :2], [subject.posture for subject in people], atol=1e-12)


@pytest.mark.parametrize("field", ["Td_s", "Td_e"])
def test_refuses_a_delay_shorter_than_a_step(field):
    with pytest.raises(ValueError, match=rf"{field} = 0\.005; expected .* at least 0\.0075"):
        build_model(replace(RELAX, **{field: 0.005}))


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"rope": "elastic"}, ValueError, "rope = 'elastic'; expected one of ideal, pendulum"),
        ({"strap": 5000.0}, TypeError, r"strap = 5000\.0; expected Strap or None"),
        ({"timestep": 0.0}, ValueError, r"timestep = 0\.0; expected .* above 0"),
        ({"timestep": "1 ms"}, TypeError, "timestep = '1 ms'; expected a number"),
        ({"n_history": 13}, ValueError, "n_history = 13; expected .* at least 14"),
        ({"n_history": 40.5}, TypeError, r"n_history = 40\.5; expected a whole number"),
    ],
)
def test_refuses_bad_settings(settings, error, message):
    with pytest.raises(error, match=message):
        build_model(RELAX, **settings)
