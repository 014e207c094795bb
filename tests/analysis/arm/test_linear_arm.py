"""The linear model against python-control, limit cases, finite differences and the literature's Pade approximation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate

from armperturb.analysis.arm import state_space as state_space_module
from armperturb.analysis.arm.geometry import hand_jacobian, mass_matrix, with_rigid_segments
from armperturb.analysis.arm.linear_arm import (
    LinearArm,
    arm_admittance,
    environment_admittance,
    joint_impedance,
    total_admittance,
)
from armperturb.analysis.arm.parameters import PARAMETERS, parameter_vector
from armperturb.analysis.arm.state_space import largest_real_pole, require_stable, simulate_linear, state_space
from armperturb.environment import Environment
from armperturb.subject import POSITION, RELAX

ENVIRONMENT = Environment()
FREQUENCY = np.geomspace(0.1, 45.0, 25)
OTHER = replace(POSITION, Td_s=0.041, Td_e=0.024, fact_s=2.1, fact_e=5.2, zeta_act=1.0, theta_s_deg=50.0, l_f=0.41)
SENSING = replace(
    OTHER, ka_s=0.6, ka_se=0.3, ka_e=0.9, kf_s=-0.7, kf_se=-0.3, kf_e=-0.4, kp_s=20.0, kv_e=18.0, name="sensing"
)
RIGID = replace(SENSING, c_h=0.57, c_f=0.63, r_h=0.27, r_f=0.36, name="rigid")
LIGHT = replace(POSITION, m_h=0.02, m_f=0.02, i_s=0.41, i_se=0.13, i_e=0.12, zeta_act=0.8)
PEOPLE = pytest.mark.parametrize(
    "subject",
    [RELAX, POSITION, OTHER, SENSING, RIGID, LIGHT],
    ids=["relax", "position", "other", "sensing", "rigid", "light"],
)


def total(subject, frequency, delay):
    return total_admittance(subject, ENVIRONMENT, frequency, delay)


def hand(subject, q):
    return subject.l_h * np.exp(1j * q[0]) + subject.l_f * np.exp(1j * (q[0] + q[1]))


@PEOPLE
def test_jacobian_is_the_derivative_of_the_hand_position(subject):
    step = 1e-6
    for joint in range(2):
        change = step * np.eye(2)[joint]
        slope = (hand(subject, subject.posture + change) - hand(subject, subject.posture - change)) / (2 * step)
        np.testing.assert_allclose(hand_jacobian(subject)[:, joint], [slope.real, slope.imag], rtol=1e-8)


@PEOPLE
def test_mass_matrix_gives_the_kinetic_energy_of_the_segments(subject):
    rate, step = np.array([0.7, -1.3]), 1e-6
    masses = np.array([subject.m_h, subject.m_f])

    def centres(q):
        elbow = subject.l_h * np.exp(1j * q[0])
        return np.array([subject.c_h * elbow, elbow + subject.c_f * subject.l_f * np.exp(1j * (q[0] + q[1]))])

    speed = np.abs(centres(subject.posture + step * rate) - centres(subject.posture - step * rate)) / (2 * step)
    turning = np.array([subject.r_h * subject.l_h, subject.r_f * subject.l_f]) * np.cumsum(rate)
    energy = 0.5 * masses @ (speed**2 + turning**2) + 0.5 * rate @ subject.joint_matrix("i") @ rate
    assert 0.5 * rate @ mass_matrix(subject) @ rate == pytest.approx(energy, rel=1e-8)


@PEOPLE
def test_segments_have_the_inertia_of_the_mass_matrix(subject):
    a, b, c = subject.segment_inertia
    bend = c * np.cos(subject.posture[1])
    of_segments = np.array([[a + 2 * bend, b + bend], [b + bend, b]])
    np.testing.assert_allclose(of_segments + subject.joint_matrix("i"), mass_matrix(subject), rtol=1e-12)


@pytest.mark.parametrize("theta_e_deg", [60.0, 82.3, 120.0])
@pytest.mark.parametrize("c_f", [0.5, 0.05, 1.0])
def test_rigid_segments_have_the_joint_inertia_that_was_asked(theta_e_deg, c_f):
    body = replace(POSITION, c_h=0.57, r_h=0.27, c_f=0.65, r_f=0.35, theta_e_deg=theta_e_deg)
    wanted = mass_matrix(body)
    bare = replace(body, m_h=0.0, m_f=0.0, c_f=c_f, i_s=wanted[0, 0], i_se=wanted[0, 1], i_e=wanted[1, 1])
    rigid = with_rigid_segments(bare)
    assert not rigid.has_extra_inertia
    np.testing.assert_allclose(mass_matrix(rigid), wanted, rtol=1e-12)
    assert min(rigid.m_h, rigid.m_f) > 0.0
    assert with_rigid_segments(rigid) is rigid


@pytest.mark.parametrize("error", [0.97, 1.03])
def test_rigid_segments_at_a_right_angle_have_an_estimated_inertia_but_for_its_errors(error):
    body = replace(POSITION, c_h=0.5, r_h=0.26, c_f=0.55, r_f=0.3, theta_e_deg=90.0)
    wanted = mass_matrix(body)
    bare = replace(body, m_h=0.0, m_f=0.0, i_s=wanted[0, 0], i_se=error * wanted[0, 1], i_e=wanted[1, 1])
    rigid = with_rigid_segments(bare)
    rigid.require_simulable()
    np.testing.assert_allclose(mass_matrix(rigid), wanted, rtol=1e-9)
    assert rigid.m_f == pytest.approx(body.m_f, rel=0.3)
    with pytest.raises(ValueError, match="expected one that rigid segments can have at an elbow angle of 90 deg"):
        with_rigid_segments(replace(bare, i_se=0.8 * wanted[0, 1]))


@pytest.mark.parametrize("i_e", [0.1, 0.08, 0.0799])
def test_rigid_segments_of_an_impossible_inertia_are_refused(i_e):
    # At 82 deg the elbow couples segments more than the forearm alone does, and never less or as much, or hardly more.
    bare = replace(POSITION, m_h=0.0, m_f=0.0, i_s=0.4, i_se=0.08, i_e=i_e)
    with pytest.raises(
        ValueError, match=rf"joint inertia = \[\[0\.4, 0\.08\], \[0\.08, {i_e}\]\] kg m\^2; expected one that"
    ):
        with_rigid_segments(bare)


def test_rigid_grip_adds_no_compliance():
    rigid, stiff = (replace(SENSING, k_h=stiffness) for stiffness in (np.inf, 1e12))
    for function in (arm_admittance, lambda arm, f: total(arm, f, "exact")):
        np.testing.assert_allclose(function(rigid, FREQUENCY), function(stiff, FREQUENCY), rtol=1e-6)
    gradient = LinearArm(rigid, FREQUENCY).total_and_gradient(parameter_vector(rigid), ENVIRONMENT)[1]
    assert np.isfinite(gradient).all()


# Force feedback would feel what the joints have of the environment.
@pytest.mark.parametrize("subject", [RELAX, POSITION, replace(SENSING, kf_s=0.0, kf_se=0.0, kf_e=0.0)])
def test_rigid_grip_moves_as_hand_and_handle_in_one(subject):
    # An arm whose joints have the environment's mass, damper and spring, and whose hand holds as good as nothing.
    square = hand_jacobian(subject).T @ hand_jacobian(subject)
    with_both = {
        f"{name}_{joint}": getattr(subject, f"{name}_{joint}") + value * square[place]
        for name, value in (("i", ENVIRONMENT.m_env), ("b", ENVIRONMENT.b_env), ("k", ENVIRONMENT.k_env))
        for joint, place in (("s", (0, 0)), ("se", (0, 1)), ("e", (1, 1)))
    }
    alone = Environment(m_env=1.0, b_env=0.0, k_env=1.0)
    poles = np.linalg.eigvals(state_space(replace(subject, k_h=np.inf), ENVIRONMENT).a)
    expected = np.linalg.eigvals(state_space(replace(subject, k_h=1e-9, b_h=0.0, **with_both), alone).a)
    of_grip = np.abs(poles) > 1e3
    assert of_grip.sum() == 4
    assert poles[of_grip].real.max() < -1e3
    for pole in expected[np.abs(np.abs(expected) - 1.0) > 1e-6]:
        assert np.abs(poles - pole).min() < 1e-3 * np.abs(pole)


def test_rigid_grip_moves_in_time_as_a_very_stiff_one():
    rate = 200.0
    time = np.arange(400) / rate
    force = np.stack([np.sin(9 * time), 0.5 * np.cos(4 * time) - 0.5], axis=-1)
    rigid, stiff = (
        simulate_linear(replace(POSITION, k_h=k_h, b_h=100.0), ENVIRONMENT, force, rate) for k_h in (np.inf, 1e7)
    )
    for one, other in zip(rigid, stiff, strict=True):
        assert np.abs(one - other).max() < 1e-3 * np.abs(other).max()


@pytest.fixture(scope="module")
def control():
    """python-control, which takes a second to import."""
    import control

    return control


@pytest.mark.slow(reason="imports python-control")
@PEOPLE
def test_state_space_equals_the_transfer_functions(subject, control):
    system = control.ss(*state_space(subject, ENVIRONMENT))
    response = np.moveaxis(system(2j * np.pi * FREQUENCY), -1, 0)
    total = total_admittance(subject, ENVIRONMENT, FREQUENCY, "pade")
    np.testing.assert_allclose(response[:, 0:2], total, rtol=1e-9, atol=1e-9 * np.abs(total).max())
    force = np.linalg.solve(arm_admittance(subject, FREQUENCY, "pade"), total)
    np.testing.assert_allclose(response[:, 2:4], force, rtol=1e-8, atol=1e-8 * np.abs(force).max())


@pytest.mark.slow(reason="imports python-control")
def test_pade_delay_is_that_of_python_control(control):
    # With Kp = I, what reflexes add to the impedance is delay times activation filter.
    subject = replace(RELAX, kp_s=1.0, kp_e=1.0, Td_s=0.03, Td_e=0.05)
    reflex = joint_impedance(subject, FREQUENCY, "pade") - joint_impedance(RELAX, FREQUENCY)
    for joint, delay in enumerate((0.03, 0.05)):
        pade = control.tf(*control.pade(delay, 3))(2j * np.pi * FREQUENCY)
        omega = 2 * np.pi * subject.fact_s
        activation = control.tf([omega**2], [1, 2 * subject.zeta_act * omega, omega**2])(2j * np.pi * FREQUENCY)
        np.testing.assert_allclose(reflex[:, joint, joint], pade * activation, rtol=1e-9)


def test_pade_and_exact_delay_agree_where_the_approximation_holds():
    slow = FREQUENCY[FREQUENCY < 8]
    exact, pade = (arm_admittance(POSITION, slow, kind) for kind in ("exact", "pade"))
    np.testing.assert_allclose(pade, exact, rtol=2e-3, atol=2e-3 * np.abs(exact).min())


@PEOPLE
def test_slow_admittance_is_the_compliance_of_arm_and_grip(subject):
    jacobian = hand_jacobian(subject)
    muscle = subject.joint_matrix("k") + subject.joint_matrix("kp")
    stiffness = np.linalg.solve(np.eye(2) - subject.joint_matrix("kf"), muscle)
    compliance = jacobian @ np.linalg.solve(stiffness, jacobian.T) + np.eye(2) / subject.k_h
    np.testing.assert_allclose(arm_admittance(subject, [1e-6])[0].real, compliance, rtol=1e-9)


def test_environment_is_a_mass_spring_damper():
    s = 2j * np.pi * FREQUENCY
    expected = 1 / (ENVIRONMENT.m_env * s**2 + ENVIRONMENT.b_env * s + ENVIRONMENT.k_env)
    response = environment_admittance(ENVIRONMENT, FREQUENCY)
    np.testing.assert_allclose(response[:, 1, 1], expected)
    np.testing.assert_array_equal(response[:, 0, 1], 0)


@pytest.mark.parametrize("delay", ["exact", "pade"])
@PEOPLE
def test_gradient_equals_finite_differences(subject, delay):
    model, values = LinearArm(subject, FREQUENCY, delay), parameter_vector(subject)
    cases = (
        (arm_admittance, model.admittance_and_gradient(values)[1]),
        (joint_impedance, model.joint_impedance_gradient(values)),
        (total, model.total_and_gradient(values, ENVIRONMENT)[1]),
    )
    for column, name in enumerate(PARAMETERS):
        value = getattr(subject, name)
        step = 1e-5 * max(abs(value), 0.1)
        above, below = (replace(subject, **{name: value + sign * step}) for sign in (1, -1))
        for function, exact in cases:
            slope = (function(above, FREQUENCY, delay) - function(below, FREQUENCY, delay)) / (2 * step)
            scale = np.abs(function(subject, FREQUENCY, delay)).max() / max(abs(value), 0.1)
            np.testing.assert_allclose(exact[..., column], slope, rtol=1e-5, atol=1e-7 * scale, err_msg=name)


def test_force_feedback_makes_a_slow_arm_softer_or_stiffer():
    # At rest R = 1: tau = (K + Kp) q + Kf tau.
    still = [1e-6]
    for gain in (-0.8, 0.4):
        arm = replace(POSITION, kf_s=gain, kf_e=gain)
        expected = (POSITION.joint_matrix("k") + POSITION.joint_matrix("kp")) / (1.0 - gain)
        np.testing.assert_allclose(joint_impedance(arm, still)[0].real, expected, rtol=1e-9)


def test_one_prepared_arm_serves_any_parameters():
    model, values = LinearArm(POSITION, FREQUENCY), parameter_vector(SENSING)
    same_body = replace(POSITION, **dict(zip(PARAMETERS, values.tolist(), strict=True)))
    np.testing.assert_array_equal(model.admittance(values), arm_admittance(same_body, FREQUENCY))
    response, gradient = model.total_and_gradient(values, ENVIRONMENT)
    np.testing.assert_array_equal(response, total_admittance(same_body, ENVIRONMENT, FREQUENCY))
    assert gradient.shape == (len(FREQUENCY), 2, 2, len(PARAMETERS))


@pytest.mark.slow(reason="compares many arms")
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_random_arms_with_every_feedback_are_the_same_in_state_space(seed):
    rng = np.random.default_rng(seed)
    factors = rng.uniform(0.5, 1.5, len(PARAMETERS))
    arm = replace(SENSING, **dict(zip(PARAMETERS, (factors * parameter_vector(SENSING)).tolist(), strict=True)))
    a, b, c, d = state_space(arm, ENVIRONMENT)
    s = 2j * np.pi * FREQUENCY[:, None, None]
    response = c @ np.linalg.solve(s * np.eye(len(a)) - a, b) + d
    expected = total_admittance(arm, ENVIRONMENT, FREQUENCY, "pade")
    np.testing.assert_allclose(response[:, :2], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@PEOPLE
def test_poles_move_as_their_gradient_says(subject):
    model, values = LinearArm(subject, ()), parameter_vector(subject)

    def largest(moved):
        poles = model.poles(moved, ENVIRONMENT)
        return poles[np.argmax(poles.real + 1e-9 * poles.imag)]

    pole = largest(values)
    np.testing.assert_allclose(pole.real, largest_real_pole(subject, ENVIRONMENT))
    gradient = model.pole_gradient(values, ENVIRONMENT, pole)
    for column, name in enumerate(PARAMETERS):
        step = 1e-5 * max(abs(values[column]), 0.01)
        above, below = (largest(values + sign * step * np.eye(len(values))[column]) for sign in (1, -1))
        slope = (above - below).real / (2 * step)
        size = abs(pole) / max(abs(values[column]), 0.01)
        np.testing.assert_allclose(gradient[column], slope, rtol=1e-4, atol=1e-6 * size, err_msg=name)


@pytest.mark.slow(reason="integrates differential equations adaptively")
@PEOPLE
def test_time_response_equals_an_adaptive_integration(subject):
    rate = 200.0
    time = np.arange(160) / rate
    force = np.stack([np.sin(9 * time), 0.5 * np.cos(4 * time) - 0.5], axis=-1)
    a, b, c, _ = state_space(subject, ENVIRONMENT)

    def slope(t, state):
        sample = min(int(rate * t), len(force) - 2)
        return a @ state + b @ (force[sample] + (rate * t - sample) * (force[sample + 1] - force[sample]))

    solution = integrate.solve_ivp(
        slope, (0, time[-1]), np.zeros(18), "LSODA", time, rtol=1e-9, atol=1e-12, max_step=0.005
    )
    expected = c @ solution.y
    response = simulate_linear(subject, ENVIRONMENT, force, rate)
    together = np.concatenate([response.displacement, response.force, response.joint_angle], axis=1)
    np.testing.assert_allclose(together, expected.T, atol=2e-6 * np.abs(expected).max())


def test_unstable_subjects_are_refused():
    require_stable(POSITION, ENVIRONMENT)
    wild = replace(POSITION, kv_s=60.0, kv_e=90.0)
    assert largest_real_pole(wild, ENVIRONMENT) > 0
    with pytest.raises(ValueError, match=r"'position' and the environment are unstable: .* expected below 0"):
        require_stable(wild, ENVIRONMENT)


def test_an_arm_that_is_lost_costs_the_others_nothing():
    values = np.array([parameter_vector(POSITION)] * 3)
    values[1, 4] = np.nan
    poles = LinearArm(POSITION, [1.0]).poles(values, ENVIRONMENT)
    assert np.isnan(poles[1]).all()
    np.testing.assert_array_equal(poles[[0, 2]], LinearArm(POSITION, [1.0]).poles(values[[0, 2]], ENVIRONMENT))


def test_long_simulations_go_in_stretches(monkeypatch):
    force = np.random.default_rng(0).normal(size=(2, 1000, 2))
    usual = simulate_linear(POSITION, ENVIRONMENT, force, 200.0)
    monkeypatch.setattr(state_space_module, "LONGEST_STRETCH", 64)
    for found, expected in zip(simulate_linear(POSITION, ENVIRONMENT, force, 200.0), usual, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((POSITION, [1.0], "exakt"), "delay = 'exakt'; expected one of exact, pade"),
        ((POSITION, [1.0, np.nan]), "frequency = nan Hz; expected finite numbers of at least 0"),
        ((POSITION, [np.inf]), "frequency = inf Hz"),
        ((POSITION, [1.0, -2.0]), "frequency = -2 Hz"),
        ((POSITION, 1.0), r"frequency has shape \(\); expected \(frequency,\)"),
        ((POSITION, [[1.0]]), r"frequency has shape \(1, 1\)"),
        (("position", [1.0]), "subject = 'position'; expected a Subject"),
    ],
)
def test_requests_that_no_response_answers_are_refused(arguments, message):
    for function in (arm_admittance, joint_impedance):
        with pytest.raises((TypeError, ValueError), match=message):
            function(*arguments)
