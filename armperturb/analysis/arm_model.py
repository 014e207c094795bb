"""The linear arm-environment model in two joints (thesis 2.7 and appendix B).

Symbols: q = [shoulder, elbow] angle deviation [rad], x = handle displacement [m], d = disturbance force [N],
f = force that the handle exerts on the hand [N], s = j 2 pi frequency. The joint impedance from q to torque is

    Z(s) = I s^2 + B s + K + R(s) (Kv s + Kp),    R = diag(activation x delay) per joint,

and the endpoint admittance from f to x is that of the arm in series with the grip, J Z^-1 J^T + 1 / (b_h s + k_h).
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from armperturb.environment import Environment
from armperturb.subject import Subject

Delay = Literal["exact", "pade"]
"""A pure neural delay, or its third-order Pade approximation (eq. B.12)."""

N_STATES = 18


class StateSpace(NamedTuple):
    """Coupled arm and environment: x' = A x + B d, y = C x + D d.

    Attributes:
      a: (18, 18); states are q', q, x', x (two each), Pade states (three per joint), activation states (two per joint).
      b: (18, 2); inputs are d_x, d_y [N].
      c: (6, 18); outputs are handle displacement [m], hand reaction force f [N], joint angle deviation [rad].
      d: (6, 2).
    """

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    c: NDArray[np.float64]
    d: NDArray[np.float64]


class LinearResponse(NamedTuple):
    """Response of the linear model in time.

    Attributes:
      displacement: of the handle [m], (time, axis).
      force: hand reaction force f [N], (time, axis).
      joint_angle: deviation from the posture [rad], (time, joint).
    """

    displacement: NDArray[np.float64]
    force: NDArray[np.float64]
    joint_angle: NDArray[np.float64]


def _segment_velocities(subject: Subject) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocity of each segment's end about its start per rad/s of its own turning [m/rad], (axis,) each."""
    shoulder, elbow = subject.posture
    humerus = subject.l_h * np.array([-np.sin(shoulder), np.cos(shoulder)])
    forearm = subject.l_f * np.array([-np.sin(shoulder + elbow), np.cos(shoulder + elbow)])
    return humerus, forearm


def hand_jacobian(subject: Subject) -> NDArray[np.float64]:
    """Jacobian from joint angles to hand position at the start posture [m/rad], (axis, joint). Source: eq. B.28."""
    humerus, forearm = _segment_velocities(subject)
    return np.column_stack([humerus + forearm, forearm])


def _segment_inertias(subject: Subject) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of the joint mass matrix with respect to m_h and m_f [m^2], (joint, joint) each."""
    humerus, forearm = _segment_velocities(subject)
    t_h = np.column_stack([0.5 * humerus, np.zeros(2)])
    t_f = np.column_stack([humerus + 0.5 * forearm, 0.5 * forearm])
    return t_h.T @ t_h, t_f.T @ t_f


def mass_matrix(subject: Subject) -> NDArray[np.float64]:
    """Joint mass matrix T_q^T M T_q at the start posture [kg m^2], (joint, joint).

    Source: eqs B.2, B.7 with point masses in the middle of the segments.
    """
    inertia_h, inertia_f = _segment_inertias(subject)
    return subject.m_h * inertia_h + subject.m_f * inertia_f


def _delay(
    s: NDArray[np.complex128], delay: float, kind: Delay
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Transfer function of a delay and its derivative with respect to the delay."""
    if kind == "exact":
        value = np.exp(-s * delay)
        return value, -s * value
    u = s * delay
    numerator = 120 - 60 * u + 12 * u**2 - u**3
    denominator = 120 + 60 * u + 12 * u**2 + u**3
    slope = (-60 + 24 * u - 3 * u**2) / denominator - numerator * (60 + 24 * u + 3 * u**2) / denominator**2
    return numerator / denominator, s * slope


def _activation(
    s: NDArray[np.complex128], cutoff: float, zeta: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Activation filter (eq. B.19) and its derivative with respect to the cut-off frequency [Hz]."""
    omega = 2 * np.pi * cutoff
    denominator = s**2 + 2 * zeta * omega * s + omega**2
    value = omega**2 / denominator
    slope = (2 * omega - value * (2 * zeta * s + 2 * omega)) / denominator
    return value, 2 * np.pi * slope


def _laplace(frequency: ArrayLike) -> NDArray[np.complex128]:
    return 2j * np.pi * np.asarray(frequency, dtype=float)


def joint_impedance(subject: Subject, frequency: ArrayLike, delay: Delay = "exact") -> NDArray[np.complex128]:
    """Joint impedance Z from angle to torque [Nm/rad], (frequency, joint, joint).

    Args:
      subject: the arm.
      frequency: [Hz], (frequency,).
      delay: "exact" or "pade".

    Source: eqs 2.6, 2.8, B.12, B.19.
    """
    s = _laplace(frequency)
    reflex = np.stack(
        [
            _delay(s, getattr(subject, f"Td_{j}"), delay)[0]
            * _activation(s, getattr(subject, f"fact_{j}"), subject.zeta_act)[0]
            for j in ("s", "e")
        ],
        axis=-1,
    )
    s = s[:, None, None]
    intrinsic = mass_matrix(subject) * s**2 + subject.joint_matrix("b") * s + subject.joint_matrix("k")
    return intrinsic + reflex[:, :, None] * (subject.joint_matrix("kv") * s + subject.joint_matrix("kp"))


def arm_admittance(subject: Subject, frequency: ArrayLike, delay: Delay = "exact") -> NDArray[np.complex128]:
    """Endpoint admittance H_xf of arm and grip, from f to x [m/N], (frequency, output, input).

    Args:
      subject: the arm.
      frequency: [Hz], (frequency,).
      delay: "exact" or "pade".

    Source: figure 2.7; see the head of this module.
    """
    jacobian = hand_jacobian(subject)
    grip = 1.0 / (subject.b_h * _laplace(frequency) + subject.k_h)
    arm = jacobian @ np.linalg.solve(joint_impedance(subject, frequency, delay), jacobian.T)
    return arm + grip[:, None, None] * np.eye(2)


def joint_impedance_gradient(
    subject: Subject, frequency: ArrayLike, parameters: Sequence[str], delay: Delay = "exact"
) -> NDArray[np.complex128]:
    """Derivative of `joint_impedance` with respect to parameters, (frequency, joint, joint, parameter).

    The impedance is linear in masses, b_*, k_*, kv_* and kp_*; the grip (b_h, k_h) is no part of it.

    Args:
      subject: the arm at which to differentiate.
      frequency: [Hz], (frequency,).
      parameters: names of fields of `Subject`: masses, b_*, k_*, kv_*, kp_*, Td_*, fact_*, b_h, k_h.
      delay: "exact" or "pade".

    Raises:
      ValueError: a name is none of these.
    """
    s = _laplace(frequency)
    inertia = dict(zip(("m_h", "m_f"), _segment_inertias(subject), strict=True))
    entries = {"s": ((0, 0),), "se": ((0, 1), (1, 0)), "e": ((1, 1),)}
    rows = {"s": 0, "e": 1}
    delays = [_delay(s, getattr(subject, f"Td_{joint}"), delay) for joint in rows]
    activations = [_activation(s, getattr(subject, f"fact_{joint}"), subject.zeta_act) for joint in rows]
    feedback = subject.joint_matrix("kv") * s[:, None, None] + subject.joint_matrix("kp")

    gradient = np.zeros((len(s), 2, 2, len(parameters)), dtype=complex)
    for column, name in enumerate(parameters):
        quantity, _, joint = name.partition("_")
        if name in inertia:
            gradient[..., column] = inertia[name] * s[:, None, None] ** 2
        elif quantity in ("b", "k", "kv", "kp") and joint in entries:
            for row, col in entries[joint]:
                factor = s if quantity in ("b", "kv") else np.ones_like(s)
                reflex = delays[row][0] * activations[row][0] if quantity in ("kv", "kp") else 1.0
                gradient[:, row, col, column] = factor * reflex
        elif quantity in ("Td", "fact") and joint in rows:
            row = rows[joint]
            (delayed, delay_slope), (active, active_slope) = delays[row], activations[row]
            slope = delay_slope * active if quantity == "Td" else delayed * active_slope
            gradient[:, row, :, column] = slope[:, None] * feedback[:, row, :]
        elif name not in ("b_h", "k_h"):
            raise ValueError(f"parameter {name!r} has no derivative; expected a mechanical parameter of Subject")
    return gradient


def arm_admittance_gradient(
    subject: Subject, frequency: ArrayLike, parameters: Sequence[str], delay: Delay = "exact"
) -> NDArray[np.complex128]:
    """Derivative of `arm_admittance` with respect to parameters, (frequency, output, input, parameter).

    Args:
      subject: the arm at which to differentiate.
      frequency: [Hz], (frequency,).
      parameters: as in `joint_impedance_gradient`.
      delay: "exact" or "pade".

    Raises:
      ValueError: as `joint_impedance_gradient`.
    """
    s = _laplace(frequency)
    jacobian = hand_jacobian(subject)
    inverse = np.linalg.inv(joint_impedance(subject, frequency, delay))
    change = np.moveaxis(joint_impedance_gradient(subject, frequency, parameters, delay), -1, 1)
    gradient = -(jacobian @ inverse)[:, None] @ change @ (inverse @ jacobian.T)[:, None]
    grip = 1.0 / (subject.b_h * s + subject.k_h)
    for column, name in enumerate(parameters):
        if name in ("b_h", "k_h"):
            slope = -(grip**2) * (s if name == "b_h" else 1.0)
            gradient[:, column] = slope[:, None, None] * np.eye(2)
    return np.moveaxis(gradient, 1, -1)


def environment_admittance(environment: Environment, frequency: ArrayLike) -> NDArray[np.complex128]:
    """Admittance E_xz of the environment, from d - f to x [m/N], (frequency, output, input). Source: eq. 2.11."""
    s = _laplace(frequency)
    impedance = environment.m_env * s**2 + environment.b_env * s + environment.k_env
    return np.multiply.outer(1.0 / impedance, np.eye(2))


def total_admittance(
    subject: Subject, environment: Environment, frequency: ArrayLike, delay: Delay = "exact"
) -> NDArray[np.complex128]:
    """Admittance P_dx of arm and environment together, from d to x [m/N], (frequency, output, input).

    Source: figure 2.6 with x = E (d - f) and x = H f, hence P = (E^-1 + H^-1)^-1; the signs of eq. A.20 belong to the
    opposite sign of f.
    """
    arm, held = arm_admittance(subject, frequency, delay), environment_admittance(environment, frequency)
    return held @ np.linalg.solve(arm + held, arm)


def state_space(subject: Subject, environment: Environment) -> StateSpace:
    """Arm and environment as one linear system with third-order Pade delays.

    Source: appendix B, with two slips of its text corrected: the feed-through of the Pade approximation is -1, not 1
    (B.16), and the activation matrix holds omega_c^2 where B.20 prints omega_c.
    """
    q_dot, q, x_dot, x = slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)
    eye = np.eye(2)
    jacobian = hand_jacobian(subject)
    inverse_mass = np.linalg.inv(mass_matrix(subject))

    force = np.zeros((2, N_STATES))
    force[:, q_dot], force[:, q] = -subject.b_h * jacobian, -subject.k_h * jacobian
    force[:, x_dot], force[:, x] = subject.b_h * eye, subject.k_h * eye

    excitation = np.zeros((2, N_STATES))
    excitation[:, q_dot], excitation[:, q] = subject.joint_matrix("kv"), subject.joint_matrix("kp")

    a = np.zeros((N_STATES, N_STATES))
    reflex_torque = np.zeros((2, N_STATES))
    for row, joint in enumerate(("s", "e")):
        delay, omega = getattr(subject, f"Td_{joint}"), 2 * np.pi * getattr(subject, f"fact_{joint}")
        pade = slice(8 + 3 * row, 11 + 3 * row)
        act_dot, act = 14 + 2 * row, 15 + 2 * row
        a[pade, pade] = [[0, 1, 0], [0, 0, 1], [-120 / delay**3, -60 / delay**2, -12 / delay]]
        a[pade.stop - 1] += excitation[row]
        delayed = -excitation[row]
        delayed[pade] = [240 / delay**3, 0, 24 / delay]
        a[act_dot, act_dot] = -2 * subject.zeta_act * omega
        a[act_dot, act] = -(omega**2)
        a[act_dot] += omega**2 * delayed
        a[act, act_dot] = 1.0
        reflex_torque[row, act] = 1.0

    torque = jacobian.T @ force - reflex_torque
    torque[:, q_dot] -= subject.joint_matrix("b")
    torque[:, q] -= subject.joint_matrix("k")
    a[q_dot] = inverse_mass @ torque
    a[q, q_dot] = eye
    a[x_dot] = -force / environment.m_env
    a[x_dot, x_dot] -= environment.b_env / environment.m_env * eye
    a[x_dot, x] -= environment.k_env / environment.m_env * eye
    a[x, x_dot] = eye

    b = np.zeros((N_STATES, 2))
    b[x_dot] = eye / environment.m_env
    select = np.eye(N_STATES)
    return StateSpace(a, b, np.vstack([select[x], force, select[q]]), np.zeros((6, 2)))


def largest_real_pole(subject: Subject, environment: Environment) -> float:
    """Largest real part of the poles of arm and environment [1/s]; the system is stable if it is negative.

    Source: sigma_max of eq. 2.21.
    """
    return float(np.linalg.eigvals(state_space(subject, environment).a).real.max())


def require_stable(subject: Subject, environment: Environment) -> None:
    """Refuse a subject whose arm is unstable on this environment.

    Raises:
      ValueError: the largest real part of a pole is not negative.
    """
    pole = largest_real_pole(subject, environment)
    if not pole < 0:
        raise ValueError(
            f"subject {subject.name!r} and the environment are unstable: largest real part of a pole = {pole:.3g} 1/s; "
            "expected below 0 (smaller feedback gains or delays)"
        )


def fastest_pole(subject: Subject, environment: Environment) -> float:
    """Largest modulus of the poles of arm and environment without reflexes [1/s]; it sets the step of a simulation."""
    return float(np.abs(np.linalg.eigvals(state_space(subject, environment).a[:8, :8])).max())


def simulate_linear(subject: Subject, environment: Environment, perturbation: ArrayLike, rate: float) -> LinearResponse:
    """Response of the linear model, from rest, to a sampled disturbance that runs straight between its samples.

    Args:
      subject: the arm.
      environment: what the hand holds.
      perturbation: d [N], (time, axis).
      rate: of the samples [Hz].
    """
    force = np.asarray(perturbation, dtype=float)
    time = np.arange(len(force)) / rate
    _, y, _ = signal.lsim(tuple(state_space(subject, environment)), force, time)
    return LinearResponse(y[:, 0:2], y[:, 2:4], y[:, 4:6])
