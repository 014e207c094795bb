"""The nonlinear skeletal model against the equations of motion of the thesis, and against the linear model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.anthropometry import anthropometric_body
from armperturb.environment import Environment
from armperturb.muscle_law import MuscleLaw
from armperturb.planar_arm.skeletal import STEP, simulate_skeletal
from armperturb.subject import POSITION, RELAX

RATE = 200.0
ONSET = 120
"""Sample at which the pulse starts."""
WINDOW = {"PT": 0.3, "RT": 1.0}
RIGID = replace(POSITION, **anthropometric_body("male", 1.85, 80.0, attached=0.3))
HUGE = Environment(workspace=2.0)
"""No limit on the way."""


def disturbance(task, peak):
    """Sines that move the arm about, then a pulse of 80 ms on top of their last 40 ms [N], (time, axis)."""
    n = ONSET + round(WINDOW[task] * RATE) + 1
    time = np.arange(n) / RATE
    strength = {"PT": 8.0, "RT": 1.5}[task] * np.clip(1.0 - (time - ONSET / RATE) / 0.04, 0.0, 1.0)
    phase = 2 * np.pi * np.outer(time, [0.7, 2.3, 5.1])
    starts = np.array([[0.3, 1.0, 2.0], [2.0, 0.0, 1.0]])
    sines = np.sin(phase[:, None] + starts).sum(axis=-1)
    pulse = peak * np.sin(np.pi * np.clip(time - ONSET / RATE, 0.0, 0.08) / 0.08)
    return strength[:, None] * sines + np.multiply.outer(pulse, [np.cos(0.4), np.sin(0.4)])


class Equations:
    """Eqs 2.6 or 2.17, 2.8, 2.11, the law of the grip, B.12 and B.19, written down once more.

    States: q', q, x', x, three of each delay, two of each activation.
    """

    def __init__(self, arm, environment, force):
        self.arm, self.environment, self.force = arm, environment, force
        self.rest = np.radians([arm.theta_s_deg, arm.theta_e_deg])
        self.mass = np.diag([arm.m_h, arm.m_h, arm.m_f, arm.m_f])
        of_forearm = arm.m_f * (arm.r_f * arm.l_f) ** 2
        self.turning = np.full((2, 2), of_forearm)
        self.turning[0, 0] += arm.m_h * (arm.r_h * arm.l_h) ** 2

        def matrix(name):
            s, se, e = (getattr(arm, f"{name}_{joint}") for joint in ("s", "se", "e"))
            return np.array([[s, se], [se, e]])

        self.damping, self.stiffness, self.kv, self.kp = map(matrix, ("b", "k", "kv", "kp"))
        self.delay, self.omega = np.array([arm.Td_s, arm.Td_e]), 2 * np.pi * np.array([arm.fact_s, arm.fact_e])

    def geometry(self, angle):
        """Jacobian to the centres of mass of the segments and to the hand, place of the hand."""
        upper = np.array([np.cos(angle[0]), np.sin(angle[0])]) * self.arm.l_h
        lower = np.array([np.cos(angle.sum()), np.sin(angle.sum())]) * self.arm.l_f
        across = np.array([[0.0, -1.0], [1.0, 0.0]])
        upper_slope, lower_slope = across @ upper, across @ lower
        middles = np.zeros((4, 2))
        middles[:2, 0] = self.arm.c_h * upper_slope
        middles[2:, 0], middles[2:, 1] = upper_slope + self.arm.c_f * lower_slope, self.arm.c_f * lower_slope
        return middles, np.column_stack([upper_slope + lower_slope, lower_slope]), upper, lower

    def slope(self, time, state, linear):
        arm, environment = self.arm, self.environment
        q_dot, q, x_dot, x = state[:8].reshape(4, 2)
        angle = self.rest + q
        middles, jacobian, upper, lower = self.geometry(self.rest if linear else angle)
        if linear:
            hand, convective = jacobian @ q, np.zeros(4)
        else:
            at_rest = self.geometry(self.rest)
            hand = upper + lower - at_rest[2] - at_rest[3]
            turning, both = q_dot[0] ** 2, q_dot.sum() ** 2
            of_forearm = upper * turning + arm.c_f * lower * both
            convective = -np.concatenate([arm.c_h * upper * turning, of_forearm])
        grip = arm.b_h * (x_dot - jacobian @ q_dot) + arm.k_h * (x - hand)
        spindles = self.kv @ q_dot + self.kp @ q
        memory = state[8:14].reshape(3, 2)
        delayed = 240 / self.delay**3 * memory[0] + 24 / self.delay * memory[2] - spindles
        active_dot, active = state[14:].reshape(2, 2)
        torque = jacobian.T @ grip - active - self.damping @ q_dot - self.stiffness @ q
        torque -= middles.T @ self.mass @ convective
        sample = time * RATE
        push = [np.interp(sample, np.arange(len(self.force)), axis) for axis in self.force.T]
        held = environment.b_env * x_dot + environment.k_env * x
        return np.concatenate(
            [
                np.linalg.solve(middles.T @ self.mass @ middles + self.turning, torque),
                q_dot,
                (push - held - grip) / environment.m_env,
                x_dot,
                memory[1],
                memory[2],
                spindles
                - 120 / self.delay**3 * memory[0]
                - 60 / self.delay**2 * memory[1]
                - 12 / self.delay * memory[2],
                self.omega**2 * (delayed - active) - 2 * arm.zeta_act * self.omega * active_dot,
                active_dot,
            ]
        )

    def solve(self, first, last, state, linear):
        """From sample to sample, as the force has a corner at each; (state, sample)."""
        states = [state]
        for sample in range(first, last):
            span = sample / RATE, (sample + 1) / RATE
            # Each begins with a single step, which is as accurate as is needed unless the error says otherwise.
            options = dict(rtol=1e-7, atol=1e-10, first_step=span[1] - span[0], args=(linear,))
            states.append(solve_ivp(self.slope, span, states[-1], "DOP853", **options).y[:, -1])
        return np.array(states).T

    def displacement(self):
        before = self.solve(0, ONSET, np.zeros(18), True)
        return self.solve(ONSET, len(self.force) - 1, before[:, -1], False)[6:8].T


@pytest.mark.slow(reason="integrates the equations of motion in small steps")
@pytest.mark.parametrize("arm", [POSITION, RELAX, RIGID], ids=["position", "relax", "rigid"])
def test_a_pulse_moves_the_arm_as_the_equations_of_motion_have_it(arm):
    force = disturbance(arm.task, 100.0)
    ours = simulate_skeletal(arm, HUGE, force, RATE, ONSET)
    theirs = Equations(arm, HUGE, force).displacement()
    furthest = np.linalg.norm(theirs, axis=1).max()
    assert np.abs(ours - theirs).max() < 1e-3 * furthest


OTHER = replace(POSITION, Td_s=0.0455, Td_e=0.0253, fact_s=5.0, fact_e=2.2, zeta_act=1.0, l_h=0.30, theta_s_deg=40.0)
QUICK = replace(POSITION, m_h=0.6, m_f=0.5, k_h=30e3, b_h=80.0)


@pytest.mark.parametrize("onset", [0, ONSET])
@pytest.mark.parametrize("arm", [POSITION, RELAX, OTHER, QUICK, RIGID], ids=["pt", "rt", "other", "quick", "rigid"])
def test_under_small_forces_it_is_the_linear_model(arm, onset):
    force = disturbance(arm.task, 100.0) / 1e3
    ours = simulate_skeletal(arm, Environment(), force, RATE, onset)
    linear = simulate_linear(arm, Environment(), force, RATE).displacement[onset:]
    assert ours.shape == linear.shape
    assert np.abs(ours - linear).max() < 2e-3 * np.linalg.norm(linear, axis=1).max()


@pytest.mark.parametrize("onset", [0, ONSET])
@pytest.mark.parametrize("arm", [POSITION, RELAX], ids=["position", "relax"])
def test_halving_the_step_changes_next_to_nothing(arm, onset):
    force = disturbance(arm.task, 100.0)
    coarse, fine = (
        simulate_skeletal(arm, Environment(), force, RATE, onset, longest_step=step) for step in (STEP, STEP / 2)
    )
    assert 0.0 < np.abs(coarse - fine).max() < 2e-4 * np.linalg.norm(fine, axis=1).max()


def test_a_muscle_law_takes_no_part():
    force = disturbance("RT", 10.0)
    yielding = replace(RELAX, muscle=MuscleLaw(short_range_stiffness=5.0, elastic_limit_deg=1.0))
    np.testing.assert_array_equal(
        simulate_skeletal(yielding, HUGE, force, RATE, ONSET), simulate_skeletal(RELAX, HUGE, force, RATE, ONSET)
    )


def test_from_the_workspace_limit_on_there_is_no_prediction():
    force = disturbance("RT", 100.0)
    free = simulate_skeletal(RELAX, HUGE, force, RATE, ONSET)
    assert np.isfinite(free).all()
    narrow = Environment(workspace=0.05)
    limited = simulate_skeletal(RELAX, narrow, force, RATE, ONSET)
    reached = np.argmax(np.abs(free).max(axis=1) >= narrow.workspace)
    assert reached > 0
    np.testing.assert_array_equal(limited[:reached], free[:reached])
    assert np.isnan(limited[reached:]).all()


def test_an_arm_that_diverges_is_nan_from_there_on():
    path = simulate_skeletal(RELAX, Environment(workspace=1e14), 1e13 * disturbance("RT", 100.0), RATE)
    assert np.isfinite(path[0]).all()
    assert np.isnan(path[-1]).all()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"perturbation": np.zeros((9, 3))}, ValueError, r"perturbation of shape \(9, 3\); expected \(n, 2\)"),
        ({"perturbation": np.full((9, 2), np.nan)}, ValueError, "perturbation is not finite"),
        ({"onset": 8}, ValueError, "onset = 8; expected"),
        ({"onset": -1}, ValueError, "onset = -1; expected"),
        ({"onset": 1.5}, TypeError, r"onset = 1\.5; expected a whole number"),
        ({"rate": 0.0}, ValueError, r"rate = 0\.0; expected"),
        ({"arm": replace(POSITION, kf_s=-0.1)}, ValueError, "has acceleration or force feedback"),
        ({"arm": replace(POSITION, kv_s=-500.0)}, ValueError, "are unstable"),
    ],
)
def test_refusals(changes, error, message):
    asked = {"arm": POSITION, "environment": Environment(), "perturbation": np.zeros((9, 2)), "rate": RATE}
    with pytest.raises(error, match=message):
        simulate_skeletal(**asked | changes)
