"""Arm and environment as one linear system with Pade delays: poles, stability, movements (thesis appendix B)."""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from armperturb.analysis.arm.geometry import mass_matrix, segment_jacobians
from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import CUTOFFS, parameter_vector
from armperturb.analysis.arm.states import ACTIVE_DOT, N_STATES, PADE, Q_DOT, X_DOT, Q, X
from armperturb.arrays import Array
from armperturb.environment import Environment, Strap
from armperturb.subject import Subject

N_REMEMBERED = 1024
"""Arms whose dynamics are remembered: each trial of a person asks for the same ones."""


LONGEST_STRETCH = 2**17
"""Steps that are simulated at once, for the sake of memory."""


class StateSpace(NamedTuple):
    """Coupled arm and environment: x' = A x + B d, y = C x + D d.

    Attributes:
      a: (18, 18); states are q', q, x', x (two each), Pade states (three per joint), activation states (two per joint).
      b: (18, 2); inputs are d_x, d_y [N].
      c: (6, 18); outputs are handle displacement [m], hand reaction force f [N], joint angle deviation [rad].
      d: (6, 2).
    """

    a: Array
    b: Array
    c: Array
    d: Array


class LinearResponse(NamedTuple):
    """Response of the linear model in time.

    Attributes:
      displacement: of the handle [m], (..., time, axis).
      force: hand reaction force f [N], (..., time, axis).
      joint_angle: deviation from the posture [rad], (..., time, joint).
    """

    displacement: Array
    force: Array
    joint_angle: Array


def state_space(subject: Subject, environment: Environment) -> StateSpace:
    """Arm and environment as one linear system with third-order Pade delays.

    Source: appendix B, with two slips of its text corrected: the feed-through of the Pade approximation is -1, not 1
    (B.16), and the activation matrix holds omega_c^2 where B.20 prints omega_c.
    """
    arm = LinearArm(subject, ())
    values = parameter_vector(subject)
    force, a = arm.force_and_dynamics(values, environment)
    b = np.zeros((N_STATES, 2))
    b[X_DOT] = np.eye(2) / environment.m_env
    select = np.eye(N_STATES)
    return StateSpace(a, b, np.vstack([select[X], force, select[Q]]), np.zeros((6, 2)))


def strapped_dynamics(subject: Subject, environment: Environment, strap: Strap) -> Array:
    """Matrix A of arm and environment, with a shoulder that its strap lets move.

    Returns:
      (22, 22); states are those of `StateSpace`, then velocity and displacement of the shoulder (two each).

    Source: the arm's segments in the frame of the shoulder (eq. B.2), whose position p joins the coordinates:
    mass p'' + damping p' + stiffness p = f - (momentum of the segments)'. The trunk does not turn, so muscles do not
    drive it.
    """
    arm, values = LinearArm(subject, ()), parameter_vector(subject)
    fixed_force, fixed = arm.force_and_dynamics(values, environment)
    of_arm, shoulder = slice(0, N_STATES), slice(N_STATES, N_STATES + 4)
    p_dot, p = slice(N_STATES, N_STATES + 2), slice(N_STATES + 2, N_STATES + 4)
    force = np.hstack([fixed_force, -fixed_force[:, X_DOT], -fixed_force[:, X]])
    mass, (t_h, t_f) = mass_matrix(subject), segment_jacobians(subject)
    coupling = subject.m_h * t_h + subject.m_f * t_f
    moved = (strap.mass + subject.m_h + subject.m_f) * np.eye(2)

    torque = arm.jacobian.T @ force
    torque[:, of_arm] = mass @ fixed[Q_DOT]
    push = force.copy()
    push[:, p_dot] -= strap.damping * np.eye(2)
    push[:, p] -= strap.stiffness * np.eye(2)
    acceleration = np.linalg.solve(np.block([[mass, coupling.T], [coupling, moved]]), np.vstack([torque, push]))

    a = np.zeros((N_STATES + 4, N_STATES + 4))
    a[of_arm, of_arm] = fixed
    a[X_DOT, shoulder] = -force[:, shoulder] / environment.m_env
    a[p_dot], a[p, p_dot] = acceleration[2:], np.eye(2)
    # What the shoulder adds to the joints' acceleration, acceleration feedback sees too.
    added = acceleration[:2]
    added[:, of_arm] -= fixed[Q_DOT]
    excitation = subject.joint_matrix("ka") @ added
    a[Q_DOT] += added
    a[PADE[2]] += excitation
    a[ACTIVE_DOT] -= (2 * np.pi * values[CUTOFFS, None]) ** 2 * excitation
    return a


@functools.lru_cache(maxsize=N_REMEMBERED)
def largest_real_pole(subject: Subject, environment: Environment, strap: Strap | None = None) -> float:
    """Largest real part of the poles of arm and environment [1/s]; the system is stable if it is negative.

    Of a nonlinear arm, the largest among its `Subject.linear_arms`.

    Args:
      subject: the arm.
      environment: what the hand holds.
      strap: what lets the shoulder move; None holds it in place.

    Source: sigma_max of eq. 2.21.
    """
    dynamics = _dynamics(subject, environment, strap)
    return max(float(np.linalg.eigvals(a).real.max()) for a in dynamics)


def require_stable(subject: Subject, environment: Environment, strap: Strap | None = None) -> None:
    """Refuse a subject whose arm is unstable on this environment, and under this strap if there is one.

    Raises:
      ValueError: the largest real part of a pole is not negative.
    """
    pole = largest_real_pole(subject, environment, strap)
    if not pole < 0:
        held = " and the environment" if strap is None else ", the environment and the strap"
        raise ValueError(
            f"subject {subject.name!r}{held} are unstable: largest real part of a pole = {pole:.3g} 1/s; "
            "expected below 0 (smaller feedback gains or delays)"
        )


def fastest_pole(subject: Subject, environment: Environment, strap: Strap | None = None) -> float:
    """Largest modulus of the poles of arm and environment without reflexes [1/s]; it sets the step of a simulation.

    Of a nonlinear arm, the largest among its `Subject.linear_arms`. With a strap, also of its poles.
    """
    dynamics = _dynamics(subject, environment, strap)
    passive = np.r_[:8, N_STATES : len(dynamics[0])]
    return max(float(np.abs(np.linalg.eigvals(a[np.ix_(passive, passive)])).max()) for a in dynamics)


@functools.lru_cache(maxsize=N_REMEMBERED)
def _dynamics(subject: Subject, environment: Environment, strap: Strap | None) -> list[Array]:
    """Matrix A of each of the linear arms."""
    return [
        state_space(arm, environment).a if strap is None else strapped_dynamics(arm, environment, strap)
        for arm in subject.linear_arms
    ]


def _accumulated(added: Array, step: Array) -> Array:
    """States x_i = x_(i - 1) step + w_i from what is added to them, w, (..., time, state).

    Every second state follows from the one two before, x_i = x_(i - 2) step^2 + (w_(i - 1) step + w_i); the others
    from the one before.
    """
    if added.shape[-2] == 1:
        return added
    pairs = added[..., 1::2, :] + added[..., 0:-1:2, :] @ step
    state = np.empty_like(added)
    state[..., 1::2, :] = _accumulated(pairs, step @ step)
    state[..., 0, :] = added[..., 0, :]
    state[..., 2::2, :] = added[..., 2::2, :] + state[..., 1:-1:2, :] @ step
    return state


def linear_states(subject: Subject, environment: Environment, perturbation: ArrayLike, rate: float) -> Array:
    """States of the linear model as `StateSpace` orders them, from rest, (..., time, state).

    Args:
      subject: the arm.
      environment: what the hand holds.
      perturbation: d [N], (..., time, axis); it runs straight between its samples.
      rate: of the samples [Hz].
    """
    force = np.asarray(perturbation, dtype=float)
    return _states(state_space(subject, environment), force, rate, np.zeros(N_STATES))


def _states(system: StateSpace, force: Array, rate: float, first: Array) -> Array:
    """States (..., time, state) from the first of them on, (..., state)."""
    # Exponential of a sample's time of state, force and the force's rise within the sample.
    generator = np.zeros((N_STATES + 4, N_STATES + 4))
    generator[:N_STATES] = np.hstack([system.a / rate, system.b / rate, np.zeros((N_STATES, 2))])
    generator[N_STATES : N_STATES + 2, N_STATES + 2 :] = np.eye(2)
    step, of_force, of_rise = np.split(linalg.expm(generator)[:N_STATES].T, [N_STATES, N_STATES + 2])
    state = np.empty((*force.shape[:-1], N_STATES))
    state[..., 0, :] = first
    state[..., 1:, :] = force[..., :-1, :] @ of_force + np.diff(force, axis=-2) @ of_rise
    return _accumulated(state, step)


def simulate_linear(subject: Subject, environment: Environment, perturbation: ArrayLike, rate: float) -> LinearResponse:
    """Response of the linear model, from rest, to sampled disturbances that run straight between their samples.

    Args:
      subject: the arm.
      environment: what the hand holds.
      perturbation: d [N], (..., time, axis).
      rate: of the samples [Hz].
    """
    system, force = state_space(subject, environment), np.asarray(perturbation, dtype=float)
    parts, state = [], np.zeros((*force.shape[:-2], N_STATES))
    for start in range(0, max(force.shape[-2] - 1, 1), LONGEST_STRETCH):
        states = _states(system, force[..., start : start + LONGEST_STRETCH + 1, :], rate, state)
        parts.append(states[..., min(start, 1) :, :] @ system.c.T)
        state = states[..., -1, :]
    y = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-2)
    return LinearResponse(y[..., 0:2], y[..., 2:4], y[..., 4:6])
