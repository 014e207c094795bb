"""The linear arm-environment model in two joints (thesis 2.7 and appendix B).

Symbols: q = [shoulder, elbow] angle deviation [rad], x = handle displacement [m], d = disturbance force [N],
f = force that the handle exerts on the hand [N], s = j 2 pi frequency. Reflexes see, and muscles answer with,

    u_r = Ka q'' + Kv q' + Kp q + Kf tau,    tau_r = R u_r,    tau = B q' + K q + tau_r,

where tau is the torque with which all muscles oppose the movement, and R = diag(activation x delay) per joint. So force
feedback with a negative gain inhibits, as tendon organs do and as the gains of table C.3 are; the thesis prints no law
for it (eq. 2.8 holds Kv and Kp only). With it, the joint impedance from q to torque is

    Z(s) = I s^2 + (1 - R Kf)^-1 (B s + K + R (Ka s^2 + Kv s + Kp)),

and the endpoint admittance from f to x is that of the arm in series with the grip, J Z^-1 J^T + 1 / (b_h s + k_h).
Of a subject with a muscle law, responses are those of its linear parameters; only poles look at the law.
"""

import copy
from collections.abc import Sequence
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.analysis.arm import states
from armperturb.analysis.arm.geometry import hand_jacobian, segment_inertias
from armperturb.analysis.arm.joint_matrices import (
    Gradient,
    Joints,
    by_triple,
    inverse,
    joint_matrices,
    laplace,
    matrix_first,
    matrix_last,
    parameter_last,
    product,
)
from armperturb.analysis.arm.parameters import (
    ACTIVE_DAMPING,
    CUTOFFS,
    DELAYS,
    GRIP_DAMPING,
    GRIP_STIFFNESS,
    GROUPS,
    MATRIX,
    parameter_vector,
)
from armperturb.arrays import Array, ComplexArray
from armperturb.environment import Environment
from armperturb.subject import Subject
from armperturb.validation import require_one_of, require_type

Delay = Literal["exact", "pade"]
"""A pure neural delay, or its third-order Pade approximation (eq. B.12)."""


RIGID_GRIP = 1e5, 1e9
"""Damping [Ns/m] and stiffness [N/m] of a rigid grip in equations of motion, where it is a state: a hundred thousand
times stiffer than a hand, and so well damped that its own poles are never those that matter."""


class LinearArm:
    """Frequency responses of one body's arm as functions of its parameters; what a fit evaluates again and again.

    Everything that is the same for all parameters is computed once. Values are in the order of `PARAMETERS`.

    Attributes:
      frequency: [Hz], (frequency,).
      delay: "exact" or "pade".
      jacobian: from joint angles to hand position [m/rad], (axis, joint).
      inertias: joint inertia per mass of either segment [m^2], (segment, joint, joint).
    """

    def __init__(self, body: Subject, frequency: ArrayLike, delay: Delay = "exact") -> None:
        """Prepare responses at frequencies.

        Args:
          body: gives posture, and lengths, centres of mass and radii of gyration of the segments; its parameters do not
            matter.
          frequency: [Hz], (frequency,).
          delay: "exact" or "pade".
        """
        self.delay: Delay = delay
        self.frequency = np.asarray(frequency, dtype=float)
        self.jacobian, self.inertias = hand_jacobian(body), np.array(segment_inertias(body))
        self._s = laplace(self.frequency)
        self._s2 = self._s**2
        self._left = self.jacobian[..., None]
        self._right = self._left.swapaxes(0, 1)
        self._eye = np.eye(2)[..., None]
        self._deflection = np.concatenate([-self.jacobian, np.eye(2)], axis=-1)
        self._latest: tuple[tuple[int, ...], bytes, Joints] | None = None

    def _at(self, s: ComplexArray) -> Self:
        """The same arm with Pade delays at other complex frequencies [1/s], (n,)."""
        other = copy.copy(self)
        other.delay, other._s, other._s2, other._latest = "pade", s, s**2, None
        return other

    def joint_impedance(self, values: Array) -> ComplexArray:
        """Joint impedance Z from angle to torque [Nm/rad], (frequency, joint, joint)."""
        return matrix_last(self._joints(values).impedance)

    def admittance(self, values: Array) -> ComplexArray:
        """Endpoint admittance H_xf of arm and grip, from f to x [m/N], (frequency, output, input)."""
        return matrix_last(self._endpoint(self._joints(values).compliance, values))

    def total_admittance(self, values: Array, environment: Environment) -> ComplexArray:
        """Admittance P_dx of arm and environment, from d to x [m/N], (frequency, output, input)."""
        arm = self._endpoint(self._joints(values).compliance, values)
        return matrix_last(product(arm, self._share(arm, environment)))

    def equivalent_torque(self, values: Array) -> ComplexArray:
        """Torque on the joints that moves the handle as a unit force on it does [m], (frequency, joint, axis).

        A force n reaches the joints through the grip, a torque the handle: with the grip's admittance G, and Y that of
        the arm behind it, x = P n for either n or a torque J^T (Y - G)^-1 Y n = (J^T + Z J^-1 G) n.
        """
        through_grip = product(self._joints(values).impedance, inverse(self._left)) * self._grip(values)
        return matrix_last(self._right + through_grip)

    def joint_impedance_gradient(self, values: Array) -> ComplexArray:
        """Derivative of `joint_impedance` by every parameter, (frequency, joint, joint, parameter)."""
        gradient = Gradient(self._s.shape, tuple(GROUPS))
        self._joint_change(gradient, values, self._joints(values), self._eye, self._eye)
        gradient.put("grip", np.zeros((), dtype=complex))
        return parameter_last(gradient.values)

    def admittance_and_gradient(
        self, values: Array, groups: Sequence[str] = tuple(GROUPS)
    ) -> tuple[ComplexArray, ComplexArray]:
        """`admittance` and its derivative by the groups' parameters, by default all of them.

        The derivative is (frequency, output, input, parameter).
        """
        arm, gradient = self._arm_and_gradient(values, None, groups)
        return matrix_last(arm), parameter_last(gradient)

    def total_and_gradient(
        self, values: Array, environment: Environment, groups: Sequence[str] = tuple(GROUPS)
    ) -> tuple[ComplexArray, ComplexArray]:
        """`total_admittance` and its derivative by the groups' parameters, by default all of them.

        The derivative is (frequency, output, input, parameter). As P^-1 = E^-1 + H^-1, dP = P H^-1 dH H^-1 P,
        where P H^-1 = H^-1 P = (1 + E^-1 H)^-1.
        """
        arm, gradient = self._arm_and_gradient(values, environment, groups)
        return matrix_last(product(arm, self._share(arm, environment))), parameter_last(gradient)

    def poles(self, values: Array, environment: Environment) -> ComplexArray:
        """Poles of arm and environment with third-order Pade delays [1/s], (..., state).

        Args:
          values: (..., parameter); those that are not finite have poles of NaN.
          environment: what the hand holds.
        """
        dynamics = self.force_and_dynamics(values, environment)[1]
        lost = np.asarray(~np.isfinite(dynamics).all(axis=(-2, -1)))
        # One of a batch must not cost the others theirs.
        poles = np.asarray(np.linalg.eigvals(np.where(lost[..., None, None], 0.0, dynamics)), dtype=complex)
        poles[lost] = np.nan
        return poles

    def pole_gradient(self, values: Array, environment: Environment, pole: complex) -> Array:
        """Derivative of the real part of a simple pole of arm and environment by every parameter, (parameter,).

        A pole is where F = det(1 + E^-1 H) vanishes, so that its derivative is -(dF/dp) / (dF/ds).

        Args:
          values: (parameter,).
          environment: what the hand holds.
          pole: [1/s].
        """
        step = 1e-6 * max(abs(pole), 1.0)
        near = self._at(np.array([pole, pole + step, pole - step]))
        held = near._held(environment)
        admittance, gradient = near.admittance_and_gradient(values)
        (p, q), (r, t) = near._eye + held * matrix_first(admittance)
        vanishing = p * t - q * r
        weight = np.array([[t[0], -r[0]], [-q[0], p[0]]]) * (-held[0] * 2 * step / (vanishing[1] - vanishing[2]))
        return np.asarray(np.tensordot(weight, gradient[0], axes=2).real)

    def force_and_dynamics(self, values: Array, environment: Environment) -> tuple[Array, Array]:
        """Hand reaction force f, (..., 2, 18), and matrix A, (..., 18, 18), of `state_space.StateSpace`."""
        b_h, k_h = _finite_grip(values)
        muscle = np.zeros((*values.shape[:-1], 2, states.N_STATES))
        muscle[..., states.Q_DOT], muscle[..., states.Q] = values[..., MATRIX["b"]], values[..., MATRIX["k"]]
        muscle[..., states.BOTH_JOINTS, states.ACTIVE] = 1.0
        force = np.zeros_like(muscle)
        force[..., states.VELOCITIES] = b_h * self._deflection
        force[..., states.POSITIONS] = k_h * self._deflection
        m_h, m_f = values[..., 0, None, None], values[..., 1, None, None]
        mass = m_h * self.inertias[0] + m_f * self.inertias[1] + values[..., MATRIX["i"]]
        acceleration = np.linalg.solve(mass, self.jacobian.swapaxes(-1, -2) @ force - muscle)

        excitation = values[..., MATRIX["ka"]] @ acceleration + values[..., MATRIX["kf"]] @ muscle
        excitation[..., states.Q_DOT] += values[..., MATRIX["kv"]]
        excitation[..., states.Q] += values[..., MATRIX["kp"]]

        delay, omega, zeta = values[..., DELAYS], 2 * np.pi * values[..., CUTOFFS], values[..., ACTIVE_DAMPING, None]
        first, second, third = states.PADE
        a = np.empty((*values.shape[:-1], states.N_STATES, states.N_STATES))
        a[...] = states.INTEGRATORS
        a[..., third, :] = excitation
        a[..., third, first] -= 120 / delay**3
        a[..., third, second] -= 60 / delay**2
        a[..., third, third] -= 12 / delay
        excitation[..., states.BOTH_JOINTS, first] -= 240 / delay**3
        excitation[..., states.BOTH_JOINTS, third] -= 24 / delay
        a[..., states.ACTIVE_DOT, :] = -(omega**2)[..., None] * excitation
        a[..., states.ACTIVE_DOT, states.ACTIVE_DOT] -= 2 * zeta * omega
        a[..., states.ACTIVE_DOT, states.ACTIVE] -= omega**2
        a[..., states.Q_DOT, :] = acceleration
        m_env, b_env, k_env = environment.m_env, environment.b_env, environment.k_env
        a[..., states.X_DOT, :] = -force / m_env
        a[..., states.BOTH_JOINTS + 4, states.BOTH_JOINTS + 4] -= b_env / m_env
        a[..., states.BOTH_JOINTS + 4, states.BOTH_JOINTS + 6] -= k_env / m_env
        return force, a

    def _held(self, environment: Environment) -> ComplexArray:
        """E^-1, of which the environment's is a multiple of the identity [N/m], (..., frequency)."""
        m_env, b_env, k_env = environment.m_env, environment.b_env, environment.k_env
        return np.asarray(m_env * self._s2 + b_env * self._s + k_env)

    def _share(self, arm: ComplexArray, environment: Environment) -> ComplexArray:
        """Share of d that the arm takes, (1 + E^-1 H)^-1 = H^-1 P, (axis, axis, ..., frequency)."""
        return inverse(self._eye + self._held(environment) * arm)

    def _endpoint(self, compliance: ComplexArray, values: Array) -> ComplexArray:
        arm = product(product(self._left, compliance), self._right)
        grip = self._grip(values)
        arm[0, 0] += grip
        arm[1, 1] += grip
        return arm

    def _grip(self, values: Array) -> ComplexArray:
        """Admittance of the grip, as a multiple of the identity [m/N], (..., frequency)."""
        return np.asarray(1.0 / (values[..., GRIP_DAMPING, None] * self._s + values[..., GRIP_STIFFNESS, None]))

    def _joints(self, values: Array) -> Joints:
        """What is remembered of the latest values: a search asks for a response, then for its derivatives there."""
        key, latest = (values.shape, values.tobytes()), self._latest
        if latest is None or latest[:2] != key:
            self._latest = latest = *key, self._joints_of(values)
        return latest[2]

    def _joints_of(self, values: Array) -> Joints:
        s, s2, values = self._s, self._s2, np.moveaxis(values, -1, 0)
        zeta = values[ACTIVE_DAMPING, ..., None]
        delay, omega = values[DELAYS][..., None], 2 * np.pi * values[CUTOFFS][..., None]
        u = s * delay
        if self.delay == "exact":
            delayed = np.exp(-u)
        else:
            delayed = (120 + u * (-60 + u * (12 - u))) / (120 + u * (60 + u * (12 + u)))
        active = omega**2 / (s2 + 2 * zeta * omega * s + omega**2)

        r = (delayed * active)[:, None]
        b, k, kv, kp, ka, kf, i = joint_matrices(values)
        feedback = ka * s2 + kv * s + kp
        loop, muscle, reflex = None, b * s + k + r * feedback, feedback
        if kf.any():
            loop = inverse(self._eye - r * kf)
            muscle = product(loop, muscle)
            reflex = feedback + product(kf, muscle)
        mass = values[0] * matrix_first(self.inertias[0]) + values[1] * matrix_first(self.inertias[1])
        impedance = (mass[..., None] + i) * s2 + muscle
        return Joints(delayed=delayed, active=active, loop=loop, muscle=muscle, reflex=reflex, impedance=impedance)

    def _dynamics_change(self, values: Array, joints: Joints) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Derivatives of R by the delay, the cut-off frequency and the filter's damping, (joint, frequency) each."""
        s, delayed, active = self._s, joints.delayed, joints.active
        zeta, delay, omega = values[ACTIVE_DAMPING], values[DELAYS, None], 2 * np.pi * values[CUTOFFS, None]
        if self.delay == "exact":
            by_delay = -s * delayed
        else:
            u = s * delay
            by_delay = s * (-60 + u * (24 - 3 * u) - delayed * (60 + u * (24 + 3 * u)))
            by_delay /= 120 + u * (60 + u * (12 + u))
        denominator = self._s2 + 2 * zeta * omega * s + omega**2
        by_cutoff = 4 * np.pi * (omega - active * (zeta * s + omega)) / denominator
        by_damping = -2.0 * s * omega * active / denominator
        return by_delay * active, delayed * by_cutoff, delayed * by_damping

    def _arm_and_gradient(
        self, values: Array, environment: Environment | None, groups: Sequence[str] = tuple(GROUPS)
    ) -> tuple[ComplexArray, NDArray[Any]]:
        """The arm's admittance and its derivative, or that of the total admittance if there is an environment.

        Returns:
          (output, input, frequency) and (parameter, output, input, frequency).
        """
        joints = self._joints(values)
        arm = self._endpoint(joints.compliance, values)
        left, right = product(self._left, joints.compliance), product(joints.compliance, self._right)
        through_grip = self._eye
        if environment is not None:
            share = self._share(arm, environment)
            left, right, through_grip = product(share, left), product(right, share), product(share, share)
        gradient = Gradient(self._s.shape, groups)
        self._joint_change(gradient, values, joints, -left, right)
        if gradient.wants("grip"):
            by_stiffness = -(self._grip(values) ** 2) * through_grip
            gradient.put("grip", np.stack([self._s * by_stiffness, by_stiffness]))
        return arm, gradient.values

    def _joint_change(
        self, out: Gradient, values: Array, joints: Joints, left: NDArray[Any], right: NDArray[Any]
    ) -> None:
        """Put left x (derivative of Z) x right for every wanted parameter but the grip's.

        With W = (1 - R Kf)^-1 (B s + K + R G) the muscle's part of Z and G the part of the feedback that sees q,
        dW = (1 - R Kf)^-1 (dB s + dK + R (dG + dKf W) + dR (G + Kf W)).
        """
        s, s2 = self._s, self._s2
        if out.wants("m"):
            inertias = (matrix_first(inertia)[..., None] for inertia in self.inertias)
            out.put("m", np.stack([s2 * product(product(left, each), right) for each in inertias]))
        if out.wants("i"):
            out.put("i", s2 * by_triple(left[:, :, None, None] * right))
        left = left if joints.loop is None else product(left, joints.loop)
        reflexive = left * (joints.delayed * joints.active)
        if out.wants("b", "k"):
            stiffness = by_triple(left[:, :, None, None] * right)
            for group, factor in (("b", s), ("k", None)):
                if out.wants(group):
                    out.put(group, stiffness if factor is None else factor * stiffness)
        if out.wants("kv", "kp", "ka"):
            position = by_triple(reflexive[:, :, None, None] * right)
            for group, factor in (("kv", s), ("kp", None), ("ka", s2)):
                if out.wants(group):
                    out.put(group, position if factor is None else factor * position)
        if out.wants("kf"):
            out.put("kf", by_triple(reflexive[:, :, None, None] * product(joints.muscle, right)))
        if out.wants("Td", "fact", "zeta"):
            moved = (left[:, :, None] * product(joints.reflex, right)[None]).swapaxes(0, 1)
            for group, slope in zip(("Td", "fact", "zeta"), self._dynamics_change(values, joints), strict=True):
                if out.wants(group):
                    change = moved * slope[:, None, None]
                    # One damping ratio is that of both joints.
                    out.put(group, change.sum(axis=0, keepdims=True) if group == "zeta" else change)


def _finite_grip(values: Array) -> tuple[Array, Array]:
    """Grip damping and stiffness with `RIGID_GRIP` in the place of infinity, (..., 1, 1) each."""
    b_h, k_h = values[..., GRIP_DAMPING, None, None], values[..., GRIP_STIFFNESS, None, None]
    is_rigid = np.isposinf(k_h)
    return np.where(is_rigid, RIGID_GRIP[0], b_h), np.where(is_rigid, RIGID_GRIP[1], k_h)


def _arm_of(subject: Subject, frequency: ArrayLike, delay: Delay) -> LinearArm:
    """What a response of a subject is computed from; raises as `joint_impedance`."""
    require_type("linear arm: subject", subject, Subject, "a Subject, e.g. POSITION")
    require_one_of("linear arm", "delay", delay, get_args(Delay))
    wanted = np.asarray(frequency, dtype=float)
    if wanted.ndim != 1:
        raise ValueError(f"linear arm: frequency has shape {wanted.shape}; expected (frequency,)")
    wrong = ~((wanted >= 0.0) & np.isfinite(wanted))
    if wrong.any():
        raise ValueError(f"linear arm: frequency = {wanted[wrong][0]:g} Hz; expected finite numbers of at least 0")
    return LinearArm(subject, wanted, delay)


def joint_impedance(subject: Subject, frequency: ArrayLike, delay: Delay = "exact") -> ComplexArray:
    """Joint impedance Z from angle to torque [Nm/rad], (frequency, joint, joint).

    Args:
      subject: the arm.
      frequency: [Hz], (frequency,), none below 0.
      delay: "exact" or "pade".

    Raises:
      TypeError: subject is no `Subject`.
      ValueError: frequency is no row of finite numbers from 0 on, or delay is something else.

    Source: eqs 2.6, 2.8, B.12, B.19, and the head of this module.
    """
    return _arm_of(subject, frequency, delay).joint_impedance(parameter_vector(subject))


def arm_admittance(subject: Subject, frequency: ArrayLike, delay: Delay = "exact") -> ComplexArray:
    """Endpoint admittance H_xf of arm and grip, from f to x [m/N], (frequency, output, input).

    Args:
      subject: the arm.
      frequency: [Hz], (frequency,), none below 0.
      delay: "exact" or "pade".

    Raises:
      TypeError: subject is no `Subject`.
      ValueError: frequency is no row of finite numbers from 0 on, or delay is something else.

    Source: figure 2.7; see the head of this module.
    """
    return _arm_of(subject, frequency, delay).admittance(parameter_vector(subject))


def environment_admittance(environment: Environment, frequency: ArrayLike) -> ComplexArray:
    """Admittance E_xz of the environment, from d - f to x [m/N], (frequency, output, input). Source: eq. 2.11."""
    s = laplace(frequency)
    impedance = environment.m_env * s**2 + environment.b_env * s + environment.k_env
    return np.multiply.outer(1.0 / impedance, np.eye(2))


def total_admittance(
    subject: Subject, environment: Environment, frequency: ArrayLike, delay: Delay = "exact"
) -> ComplexArray:
    """Admittance P_dx of arm and environment together, from d to x [m/N], (frequency, output, input).

    Args:
      subject: the arm.
      environment: what the hand holds.
      frequency: [Hz], (frequency,), none below 0.
      delay: "exact" or "pade".

    Raises:
      TypeError: subject is no `Subject`.
      ValueError: frequency is no row of finite numbers from 0 on, or delay is something else.

    Source: figure 2.6 with x = E (d - f) and x = H f, hence P = (E^-1 + H^-1)^-1; the signs of eq. A.20 belong to the
    opposite sign of f.
    """
    return _arm_of(subject, frequency, delay).total_admittance(parameter_vector(subject), environment)
