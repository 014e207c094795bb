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
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from armperturb.environment import Environment, Strap
from armperturb.subject import Subject

Array = NDArray[np.float64]
Response = NDArray[np.complex128]

Delay = Literal["exact", "pade"]
"""A pure neural delay, or its third-order Pade approximation (eq. B.12)."""

N_STATES = 18
_Q_DOT, _Q, _X_DOT, _X = slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)
_VELOCITIES, _POSITIONS = [0, 1, 4, 5], [2, 3, 6, 7]
_PADE = np.array([[8, 11], [9, 12], [10, 13]])  # derivative, joint
_ACTIVE_DOT, _ACTIVE = np.array([14, 16]), np.array([15, 17])
_ROWS = np.array([0, 1])
_INTEGRATORS = np.zeros((N_STATES, N_STATES))
_INTEGRATORS[_Q, _Q_DOT] = _INTEGRATORS[_X, _X_DOT] = np.eye(2)
_INTEGRATORS[_PADE[0], _PADE[1]] = _INTEGRATORS[_PADE[1], _PADE[2]] = _INTEGRATORS[_ACTIVE, _ACTIVE_DOT] = 1.0

_TRIPLES = ("b", "k", "kv", "kp", "ka", "kf")
PARAMETERS = (
    "m_h",
    "m_f",
    *(f"{quantity}_{joint}" for quantity in _TRIPLES for joint in ("s", "se", "e")),
    "Td_s",
    "Td_e",
    "fact_s",
    "fact_e",
    "b_h",
    "k_h",
)
"""Every parameter by which the arm's responses can be differentiated: fields of `Subject`, SI."""

_INDEX = {name: index for index, name in enumerate(PARAMETERS)}
_MASSES, _DELAYS, _CUTOFFS = slice(0, 2), slice(20, 22), slice(22, 24)
_GRIP_DAMPING, _GRIP_STIFFNESS = 24, 25
_GROUPS = {
    "m": _MASSES,
    **{quantity: slice(2 + 3 * n, 5 + 3 * n) for n, quantity in enumerate(_TRIPLES)},
    "Td": _DELAYS,
    "fact": _CUTOFFS,
    "grip": slice(24, 26),
}
_MATRIX = {quantity: np.array([[2 + 3 * n, 3 + 3 * n], [3 + 3 * n, 4 + 3 * n]]) for n, quantity in enumerate(_TRIPLES)}


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


class Environments(NamedTuple):
    """What the hands of a batch of arms hold.

    Attributes:
      m_env: virtual mass [kg], (batch,).
      b_env: virtual damping [Ns/m], (batch,).
      k_env: virtual stiffness [N/m], (batch,).
    """

    m_env: Array
    b_env: Array
    k_env: Array

    @classmethod
    def of(cls, environments: Sequence[Environment]) -> Self:
        """The environment of each hand."""
        return cls(*np.array([(one.m_env, one.b_env, one.k_env) for one in environments]).T)

    def take(self, index: NDArray[np.int64]) -> Self:
        """Some of them, in this order."""
        return type(self)(*(values[index] for values in self))


def _segment_velocities(subject: Subject) -> tuple[Array, Array]:
    """Velocity of each segment's end about its start per rad/s of its own turning [m/rad], (axis,) each."""
    shoulder, elbow = subject.posture
    humerus = subject.l_h * np.array([-np.sin(shoulder), np.cos(shoulder)])
    forearm = subject.l_f * np.array([-np.sin(shoulder + elbow), np.cos(shoulder + elbow)])
    return humerus, forearm


def hand_jacobian(subject: Subject) -> Array:
    """Jacobian from joint angles to hand position at the start posture [m/rad], (axis, joint). Source: eq. B.28."""
    humerus, forearm = _segment_velocities(subject)
    return np.column_stack([humerus + forearm, forearm])


def _segment_jacobians(subject: Subject) -> tuple[Array, Array]:
    """Jacobians from joint angles to the middles of humerus and forearm [m/rad], (axis, joint) each."""
    humerus, forearm = _segment_velocities(subject)
    t_h = np.column_stack([0.5 * humerus, np.zeros(2)])
    t_f = np.column_stack([humerus + 0.5 * forearm, 0.5 * forearm])
    return t_h, t_f


def _segment_inertias(subject: Subject) -> tuple[Array, Array]:
    """Derivatives of the joint mass matrix with respect to m_h and m_f [m^2], (joint, joint) each."""
    t_h, t_f = _segment_jacobians(subject)
    return t_h.T @ t_h, t_f.T @ t_f


def mass_matrix(subject: Subject) -> Array:
    """Joint mass matrix T_q^T M T_q at the start posture [kg m^2], (joint, joint).

    Source: eqs B.2, B.7 with point masses in the middle of the segments.
    """
    inertia_h, inertia_f = _segment_inertias(subject)
    return subject.m_h * inertia_h + subject.m_f * inertia_f


def parameter_vector(subject: Subject) -> Array:
    """The parameters of an arm in the order of `PARAMETERS`, (parameter,)."""
    return np.array([getattr(subject, name) for name in PARAMETERS])


def _matrix(values: Array, quantity: str) -> Array:
    """Joint matrix of a quantity, ready for frequencies, (joint, joint, ..., 1)."""
    return values[_MATRIX[quantity]][..., None]


def _columns_of(environment: Environment | Environments) -> tuple[Array, Array, Array]:
    """Mass, damping and stiffness, (..., 1) each."""
    m_env, b_env, k_env = environment.m_env, environment.b_env, environment.k_env
    return np.asarray(m_env)[..., None], np.asarray(b_env)[..., None], np.asarray(k_env)[..., None]


def _laplace(frequency: ArrayLike) -> Response:
    return 2j * np.pi * np.asarray(frequency, dtype=float)


# Inside this module frequency is the last axis and the arms of a batch are the one before: matrices are 2 x 2, so that
# loops over these are the long ones. Parameters are the first axis.


def _product(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    return a[:, :1] * b[:1] + a[:, 1:] * b[1:]


def _inverse(a: NDArray[Any]) -> NDArray[Any]:
    (p, q), (r, t) = a
    inverse = np.array([[t, -q], [-r, p]])
    inverse /= p * t - q * r
    return inverse


def _matrix_last(a: NDArray[Any]) -> NDArray[Any]:
    return np.moveaxis(a, (0, 1), (-2, -1))


def _matrix_first(a: NDArray[Any]) -> NDArray[Any]:
    return np.moveaxis(a, (-2, -1), (0, 1))


def _parameter_last(gradient: Response) -> Response:
    return np.moveaxis(gradient, (0, 1, 2), (-1, -3, -2))


def _triple(outer: Response) -> Response:
    """Derivative by (s, se, e) from that by the entries, (output, row, column, input, n) to (3, output, input, n)."""
    return np.stack([outer[:, 0, 0], outer[:, 0, 1] + outer[:, 1, 0], outer[:, 1, 1]])


class _Gradient:
    """Derivatives by groups of parameters as they are computed, (parameter, output, input, ..., frequency).

    Attributes:
      values: of the wanted groups one after the other; complex, or the real part of weight x derivative.
      weight: (output, input, ..., frequency), if there is one.
    """

    def __init__(self, shape: tuple[int, ...], groups: Sequence[str], weight: Response | None) -> None:
        self.weight = weight
        sizes = [_GROUPS[group].stop - _GROUPS[group].start for group in groups]
        ends = np.cumsum(sizes)
        self.values = np.empty((int(ends[-1]), 2, 2, *shape), dtype=complex if weight is None else float)
        self._rows = {
            group: slice(end - size, end) for group, size, end in zip(groups, sizes, ends.tolist(), strict=True)
        }

    def wants(self, *groups: str) -> bool:
        """Whether any of these groups is wanted."""
        return any(group in self._rows for group in groups)

    def weighted(self, values: Response) -> Response:
        """Values with output first, then (inner axes,) input, ..., frequency, times the weight."""
        if self.weight is None:
            return values
        inner = values.ndim - self.weight.ndim
        return values * self.weight[:, *(None,) * inner]

    def put(self, group: str, values: Response) -> None:
        """Keep the weighted derivatives by a wanted group."""
        self.values[self._rows[group]] = values if self.weight is None else values.real


class _Joints(NamedTuple):
    """What joint impedance and its derivatives share; rows are joints.

    Attributes:
      delayed: transfer function of the delay, (joint, ..., frequency).
      active: that of the activation filter, (joint, ..., frequency).
      delay_slope: derivative by the delay, (joint, ..., frequency).
      active_slope: derivative by the cut-off frequency, (joint, ..., frequency).
      loop: (1 - R Kf)^-1, (joint, joint, ..., frequency).
      muscle: from q to tau, (joint, joint, ..., frequency).
      reflex: from q to u_r, (joint, joint, ..., frequency).
      impedance: Z, (joint, joint, ..., frequency).
    """

    delayed: Response
    active: Response
    delay_slope: Response
    active_slope: Response
    loop: Response
    muscle: Response
    reflex: Response
    impedance: Response


class LinearArm:
    """Frequency responses of one body's arm as functions of its parameters; what a fit evaluates again and again.

    Everything that is the same for all parameters is computed once. Values are in the order of `PARAMETERS`. Of several
    bodies, it evaluates a batch: each body at its own values. Below, ... is (batch,) then, and nothing for one body.

    Attributes:
      frequency: [Hz], (..., frequency).
      delay: "exact" or "pade".
      jacobian: from joint angles to hand position [m/rad], (..., axis, joint).
    """

    def __init__(self, body: Subject | Sequence[Subject], frequency: ArrayLike, delay: Delay = "exact") -> None:
        """Prepare responses at frequencies.

        Args:
          body: gives segment lengths, posture and damping of the activation filter; its parameters do not matter. A
            sequence makes a batch.
          frequency: [Hz], (frequency,), or one row for each body.
          delay: "exact" or "pade".
        """
        if isinstance(body, Subject):
            jacobian, zeta, inertias = hand_jacobian(body), np.array(body.zeta_act), np.array(_segment_inertias(body))
        else:
            # Trials of a person share a body; computing it once is worth it.
            found = {one: (hand_jacobian(one), one.zeta_act, _segment_inertias(one)) for one in dict.fromkeys(body)}
            jacobian, zeta, inertias = (np.array([found[one][k] for one in body]) for k in range(3))
            inertias = inertias.swapaxes(0, 1)
        self.delay: Delay = delay
        f = np.asarray(frequency, dtype=float)
        self._prepare(np.broadcast_to(f, (*zeta.shape, f.shape[-1])), jacobian, zeta, inertias)

    def _prepare(self, frequency: Array, jacobian: Array, zeta: Array, inertias: Array) -> None:
        self.frequency, self.jacobian, self._zeta, self._inertias = frequency, jacobian, zeta, inertias
        self._s = _laplace(frequency)
        self._s2 = self._s**2
        eye = np.broadcast_to(np.eye(2), jacobian.shape)
        self._left = _matrix_first(jacobian)[..., None]
        self._right = self._left.swapaxes(0, 1)
        self._eye = _matrix_first(eye)[..., None]
        self._deflection = np.concatenate([-jacobian, eye], axis=-1)

    def take(self, index: NDArray[np.int64]) -> Self:
        """Some arms of a batch, in this order."""
        taken = copy.copy(self)
        taken._prepare(self.frequency[index], self.jacobian[index], self._zeta[index], self._inertias[:, index])
        return taken

    def _at(self, s: Response) -> Self:
        """The same arm with Pade delays at other complex frequencies [1/s], (..., n)."""
        other = copy.copy(self)
        other.delay, other._s, other._s2 = "pade", s, s**2
        return other

    def joint_impedance(self, values: Array) -> Response:
        """Joint impedance Z from angle to torque [Nm/rad], (..., frequency, joint, joint)."""
        return _matrix_last(self._joints(values).impedance)

    def admittance(self, values: Array) -> Response:
        """Endpoint admittance H_xf of arm and grip, from f to x [m/N], (..., frequency, output, input)."""
        return _matrix_last(self._endpoint(_inverse(self._joints(values).impedance), values))

    def total_admittance(self, values: Array, environment: Environment) -> Response:
        """Admittance P_dx of arm and environment, from d to x [m/N], (..., frequency, output, input)."""
        arm = self._endpoint(_inverse(self._joints(values).impedance), values)
        return _matrix_last(_product(arm, self._share(arm, environment)))

    def joint_impedance_gradient(self, values: Array) -> Response:
        """Derivative of `joint_impedance` by every parameter, (..., frequency, joint, joint, parameter)."""
        groups = [group for group in _GROUPS if group != "grip"]
        gradient = _Gradient(self._s.shape, groups, None)
        self._joint_change(gradient, self._joints(values), self._eye, self._eye)
        without_grip = np.zeros((2, *gradient.values.shape[1:]))
        return _parameter_last(np.concatenate([gradient.values, without_grip]))

    def admittance_and_gradient(self, values: Array) -> tuple[Response, Response]:
        """`admittance` and its derivative by every parameter, (..., frequency, output, input, parameter)."""
        arm, gradient = self._arm_and_gradient(values, None)
        return _matrix_last(arm), _parameter_last(gradient)

    def admittance_and_weighted_gradient(
        self, values: Array, weigh: Callable[[Response], Response], groups: Sequence[str]
    ) -> tuple[Response, Array]:
        """`admittance` and the real part of its weighted derivative, which a fit of moduli needs.

        Args:
          values: (..., parameter).
          weigh: the admittance to the weight of its derivative, (..., frequency, output, input) both.
          groups: of parameters by which to differentiate, as `groups_of` gives them.

        Returns:
          The admittance, and the derivative, (..., frequency, output, input, parameter), by the groups' parameters.
        """
        arm, gradient = self._arm_and_gradient(values, None, weigh, groups)
        return _matrix_last(arm), np.asarray(_parameter_last(gradient), dtype=float)

    def total_and_gradient(self, values: Array, environment: Environment) -> tuple[Response, Response]:
        """`total_admittance` and its derivative by every parameter, (..., frequency, output, input, parameter).

        As P^-1 = E^-1 + H^-1, dP = P H^-1 dH H^-1 P, where P H^-1 = H^-1 P = (1 + E^-1 H)^-1.
        """
        arm, gradient = self._arm_and_gradient(values, environment)
        return _matrix_last(_product(arm, self._share(arm, environment))), _parameter_last(gradient)

    def poles(self, values: Array, environment: Environment | Environments) -> Response:
        """Poles of arm and environment with third-order Pade delays [1/s], (..., state).

        Args:
          values: (..., parameter); those that are not finite have poles of NaN.
          environment: what the hand holds, or those of a batch hold.
        """
        dynamics = self._force_and_dynamics(values, environment)[1]
        lost = np.asarray(~np.isfinite(dynamics).all(axis=(-2, -1)))
        # One of a batch must not cost the others theirs.
        poles = np.asarray(np.linalg.eigvals(np.where(lost[..., None, None], 0.0, dynamics)), dtype=complex)
        poles[lost] = np.nan
        return poles

    def pole_gradient(
        self,
        values: Array,
        environment: Environment | Environments,
        pole: ArrayLike,
        groups: Sequence[str] = tuple(_GROUPS),
    ) -> Array:
        """Derivative of the real part of a simple pole of arm and environment by parameters, (..., parameter).

        A pole is where F = det(1 + E^-1 H) vanishes, so that its derivative is -(dF/dp) / (dF/ds).

        Args:
          values: (..., parameter).
          environment: as in `poles`.
          pole: [1/s], (...,).
          groups: of parameters, as `groups_of` gives them; by default all.
        """
        where = np.asarray(pole, dtype=complex)[..., None]
        step = 1e-6 * np.maximum(np.abs(where), 1.0)
        here = self._at(np.concatenate([where, where + step, where - step], axis=-1))
        held = here._held(environment)

        def weigh(arm: Response) -> Response:
            """-(dF/dH) / (dF/ds) at the pole, and nothing beside it."""
            (p, q), (r, t) = here._eye + held * _matrix_first(arm)
            vanishing = p * t - q * r
            slope = (vanishing[..., 1] - vanishing[..., 2])[..., None] / (2 * step)
            weight = np.array([[t, -r], [-q, p]]) * (-held / slope)
            weight[..., 1:] = 0.0
            return _matrix_last(weight)

        return here.admittance_and_weighted_gradient(values, weigh, groups)[1].sum(axis=(-4, -3, -2))

    def _force_and_dynamics(self, values: Array, environment: Environment | Environments) -> tuple[Array, Array]:
        """Hand reaction force f, (..., 2, 18), and matrix A, (..., 18, 18), of `StateSpace`."""
        muscle = np.zeros((*values.shape[:-1], 2, N_STATES))
        muscle[..., _Q_DOT], muscle[..., _Q] = values[..., _MATRIX["b"]], values[..., _MATRIX["k"]]
        muscle[..., _ROWS, _ACTIVE] = 1.0
        force = np.zeros_like(muscle)
        force[..., _VELOCITIES] = values[..., _GRIP_DAMPING, None, None] * self._deflection
        force[..., _POSITIONS] = values[..., _GRIP_STIFFNESS, None, None] * self._deflection
        m_h, m_f = values[..., 0, None, None], values[..., 1, None, None]
        mass = m_h * self._inertias[0] + m_f * self._inertias[1]
        acceleration = np.linalg.solve(mass, self.jacobian.swapaxes(-1, -2) @ force - muscle)

        excitation = values[..., _MATRIX["ka"]] @ acceleration + values[..., _MATRIX["kf"]] @ muscle
        excitation[..., _Q_DOT] += values[..., _MATRIX["kv"]]
        excitation[..., _Q] += values[..., _MATRIX["kp"]]

        delay, omega = values[..., _DELAYS], 2 * np.pi * values[..., _CUTOFFS]
        first, second, third = _PADE
        a = np.empty((*values.shape[:-1], N_STATES, N_STATES))
        a[...] = _INTEGRATORS
        a[..., third, :] = excitation
        a[..., third, first] -= 120 / delay**3
        a[..., third, second] -= 60 / delay**2
        a[..., third, third] -= 12 / delay
        excitation[..., _ROWS, first] -= 240 / delay**3
        excitation[..., _ROWS, third] -= 24 / delay
        a[..., _ACTIVE_DOT, :] = -(omega**2)[..., None] * excitation
        a[..., _ACTIVE_DOT, _ACTIVE_DOT] -= 2 * self._zeta[..., None] * omega
        a[..., _ACTIVE_DOT, _ACTIVE] -= omega**2
        a[..., _Q_DOT, :] = acceleration
        m_env, b_env, k_env = _columns_of(environment)
        a[..., _X_DOT, :] = -force / m_env[..., None]
        a[..., _ROWS + 4, _ROWS + 4] -= b_env / m_env
        a[..., _ROWS + 4, _ROWS + 6] -= k_env / m_env
        return force, a

    def _held(self, environment: Environment | Environments) -> Response:
        """E^-1, of which the environment's is a multiple of the identity [N/m], (..., frequency)."""
        m_env, b_env, k_env = _columns_of(environment)
        return np.asarray(m_env * self._s2 + b_env * self._s + k_env)

    def _share(self, arm: Response, environment: Environment) -> Response:
        """Share of d that the arm takes, (1 + E^-1 H)^-1 = H^-1 P, (axis, axis, ..., frequency)."""
        return _inverse(self._eye + self._held(environment) * arm)

    def _endpoint(self, compliance: Response, values: Array) -> Response:
        arm = _product(_product(self._left, compliance), self._right)
        grip = self._grip(values)
        arm[0, 0] += grip
        arm[1, 1] += grip
        return arm

    def _grip(self, values: Array) -> Response:
        """Admittance of the grip, as a multiple of the identity [m/N], (..., frequency)."""
        return np.asarray(1.0 / (values[..., _GRIP_DAMPING, None] * self._s + values[..., _GRIP_STIFFNESS, None]))

    def _joints(self, values: Array) -> _Joints:
        s, s2, values = self._s, self._s2, np.moveaxis(values, -1, 0)
        zeta = self._zeta[..., None]
        delay, omega = values[_DELAYS][..., None], 2 * np.pi * values[_CUTOFFS][..., None]
        u = s * delay
        if self.delay == "exact":
            delayed = np.exp(-u)
            delay_slope = -s * delayed
        else:
            denominator = 120 + u * (60 + u * (12 + u))
            delayed = (120 + u * (-60 + u * (12 - u))) / denominator
            delay_slope = s * (-60 + u * (24 - 3 * u) - delayed * (60 + u * (24 + 3 * u))) / denominator
        denominator = s2 + 2 * zeta * omega * s + omega**2
        active = omega**2 / denominator
        active_slope = 4 * np.pi * (omega - active * (zeta * s + omega)) / denominator

        r = (delayed * active)[:, None]
        force = _matrix(values, "kf")
        feedback = _matrix(values, "ka") * s2 + _matrix(values, "kv") * s + _matrix(values, "kp")
        loop = _inverse(self._eye - r * force)
        muscle = _product(loop, _matrix(values, "b") * s + _matrix(values, "k") + r * feedback)
        mass = values[0] * _matrix_first(self._inertias[0]) + values[1] * _matrix_first(self._inertias[1])
        return _Joints(
            delayed=delayed,
            active=active,
            delay_slope=delay_slope,
            active_slope=active_slope,
            loop=loop,
            muscle=muscle,
            reflex=feedback + _product(force, muscle),
            impedance=mass[..., None] * s2 + muscle,
        )

    def _arm_and_gradient(
        self,
        values: Array,
        environment: Environment | None,
        weigh: Callable[[Response], Response] | None = None,
        groups: Sequence[str] = tuple(_GROUPS),
    ) -> tuple[Response, NDArray[Any]]:
        """The arm's admittance and its derivative, or that of the total admittance if there is an environment.

        Returns:
          (output, input, ..., frequency) and (parameter, output, input, ..., frequency).
        """
        joints = self._joints(values)
        compliance = _inverse(joints.impedance)
        arm = self._endpoint(compliance, values)
        left, right = _product(self._left, compliance), _product(compliance, self._right)
        through_grip = self._eye
        if environment is not None:
            share = self._share(arm, environment)
            left, right, through_grip = _product(share, left), _product(right, share), _product(share, share)
        weight = None if weigh is None else _matrix_first(weigh(_matrix_last(arm)))
        gradient = _Gradient(self._s.shape, groups, weight)
        self._joint_change(gradient, joints, -left, right)
        if gradient.wants("grip"):
            by_stiffness = gradient.weighted(-(self._grip(values) ** 2) * through_grip)
            gradient.put("grip", np.stack([self._s * by_stiffness, by_stiffness]))
        return arm, gradient.values

    def _joint_change(self, out: _Gradient, joints: _Joints, left: NDArray[Any], right: NDArray[Any]) -> None:
        """Put left x (derivative of Z) x right for every wanted parameter but the grip's.

        With W = (1 - R Kf)^-1 (B s + K + R G) the muscle's part of Z and G the part of the feedback that sees q,
        dW = (1 - R Kf)^-1 (dB s + dK + R (dG + dKf W) + dR (G + Kf W)).
        """
        s, s2 = self._s, self._s2
        if out.wants("m"):
            inertias = (_matrix_first(inertia)[..., None] for inertia in self._inertias)
            out.put("m", np.stack([out.weighted(s2 * _product(_product(left, one), right)) for one in inertias]))
        left = _product(left, joints.loop)
        changed = out.weighted(np.broadcast_to(right, (2, 1, *right.shape)))
        reflexive = left * (joints.delayed * joints.active)
        if out.wants("b", "k"):
            stiffness = _triple(left[:, :, None, None] * changed)
            for group, factor in (("b", s), ("k", None)):
                if out.wants(group):
                    out.put(group, stiffness if factor is None else factor * stiffness)
        if out.wants("kv", "kp", "ka"):
            position = _triple(reflexive[:, :, None, None] * changed)
            for group, factor in (("kv", s), ("kp", None), ("ka", s2)):
                if out.wants(group):
                    out.put(group, position if factor is None else factor * position)
        if out.wants("kf"):
            sensed = _product(joints.muscle, right)
            sensed = out.weighted(np.broadcast_to(sensed, (2, 1, *sensed.shape)))
            out.put("kf", _triple(reflexive[:, :, None, None] * sensed))
        if out.wants("Td", "fact"):
            moved = out.weighted(left[:, :, None] * _product(joints.reflex, right)[None]).swapaxes(0, 1)
            for group, slope in (
                ("Td", joints.delay_slope * joints.active),
                ("fact", joints.delayed * joints.active_slope),
            ):
                if out.wants(group):
                    out.put(group, moved * slope[:, None, None])


def groups_of(parameters: NDArray[np.bool_]) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """Groups of parameters by which derivatives come together.

    Args:
      parameters: whether each of `PARAMETERS` is wanted.

    Returns:
      The groups that hold them, and the index of each parameter of these groups.
    """
    groups = tuple(group for group, rows in _GROUPS.items() if parameters[rows].any())
    return groups, np.concatenate([np.arange(len(PARAMETERS))[_GROUPS[group]] for group in groups])


def joint_impedance(subject: Subject, frequency: ArrayLike, delay: Delay = "exact") -> Response:
    """Joint impedance Z from angle to torque [Nm/rad], (frequency, joint, joint).

    Args:
      subject: the arm.
      frequency: [Hz], (frequency,).
      delay: "exact" or "pade".

    Source: eqs 2.6, 2.8, B.12, B.19, and the head of this module.
    """
    return LinearArm(subject, frequency, delay).joint_impedance(parameter_vector(subject))


def arm_admittance(subject: Subject, frequency: ArrayLike, delay: Delay = "exact") -> Response:
    """Endpoint admittance H_xf of arm and grip, from f to x [m/N], (frequency, output, input).

    Args:
      subject: the arm.
      frequency: [Hz], (frequency,).
      delay: "exact" or "pade".

    Source: figure 2.7; see the head of this module.
    """
    return LinearArm(subject, frequency, delay).admittance(parameter_vector(subject))


def _columns(parameters: Sequence[str]) -> list[int]:
    for name in parameters:
        if name not in _INDEX:
            raise ValueError(f"parameter {name!r} has no derivative; expected one of {', '.join(PARAMETERS)}")
    return [_INDEX[name] for name in parameters]


def joint_impedance_gradient(
    subject: Subject, frequency: ArrayLike, parameters: Sequence[str], delay: Delay = "exact"
) -> Response:
    """Derivative of `joint_impedance` by parameters, (frequency, joint, joint, parameter).

    Args:
      subject: the arm at which to differentiate.
      frequency: [Hz], (frequency,).
      parameters: names in `PARAMETERS`.
      delay: "exact" or "pade".

    Raises:
      ValueError: a name is none of these.
    """
    columns = _columns(parameters)
    return LinearArm(subject, frequency, delay).joint_impedance_gradient(parameter_vector(subject))[..., columns]


def arm_admittance_gradient(
    subject: Subject, frequency: ArrayLike, parameters: Sequence[str], delay: Delay = "exact"
) -> Response:
    """Derivative of `arm_admittance` by parameters, (frequency, output, input, parameter).

    Args:
      subject: the arm at which to differentiate.
      frequency: [Hz], (frequency,).
      parameters: names in `PARAMETERS`.
      delay: "exact" or "pade".

    Raises:
      ValueError: a name is none of these.
    """
    columns = _columns(parameters)
    return LinearArm(subject, frequency, delay).admittance_and_gradient(parameter_vector(subject))[1][..., columns]


def environment_admittance(environment: Environment, frequency: ArrayLike) -> Response:
    """Admittance E_xz of the environment, from d - f to x [m/N], (frequency, output, input). Source: eq. 2.11."""
    s = _laplace(frequency)
    impedance = environment.m_env * s**2 + environment.b_env * s + environment.k_env
    return np.multiply.outer(1.0 / impedance, np.eye(2))


def total_admittance(
    subject: Subject, environment: Environment, frequency: ArrayLike, delay: Delay = "exact"
) -> Response:
    """Admittance P_dx of arm and environment together, from d to x [m/N], (frequency, output, input).

    Args:
      subject: the arm.
      environment: what the hand holds.
      frequency: [Hz], (frequency,).
      delay: "exact" or "pade".

    Source: figure 2.6 with x = E (d - f) and x = H f, hence P = (E^-1 + H^-1)^-1; the signs of eq. A.20 belong to the
    opposite sign of f.
    """
    return LinearArm(subject, frequency, delay).total_admittance(parameter_vector(subject), environment)


def total_admittance_gradient(
    subject: Subject,
    environment: Environment,
    frequency: ArrayLike,
    parameters: Sequence[str],
    delay: Delay = "exact",
) -> Response:
    """Derivative of `total_admittance` by parameters, (frequency, output, input, parameter).

    Args:
      subject: the arm at which to differentiate.
      environment: what the hand holds.
      frequency: [Hz], (frequency,).
      parameters: names in `PARAMETERS`.
      delay: "exact" or "pade".

    Raises:
      ValueError: a name is none of these.
    """
    columns = _columns(parameters)
    arm = LinearArm(subject, frequency, delay)
    return arm.total_and_gradient(parameter_vector(subject), environment)[1][..., columns]


def state_space(subject: Subject, environment: Environment) -> StateSpace:
    """Arm and environment as one linear system with third-order Pade delays.

    Source: appendix B, with two slips of its text corrected: the feed-through of the Pade approximation is -1, not 1
    (B.16), and the activation matrix holds omega_c^2 where B.20 prints omega_c.
    """
    arm = LinearArm(subject, ())
    values = parameter_vector(subject)
    force, a = arm._force_and_dynamics(values, environment)
    b = np.zeros((N_STATES, 2))
    b[_X_DOT] = np.eye(2) / environment.m_env
    select = np.eye(N_STATES)
    return StateSpace(a, b, np.vstack([select[_X], force, select[_Q]]), np.zeros((6, 2)))


def _strapped_dynamics(subject: Subject, environment: Environment, strap: Strap) -> Array:
    """Matrix A of arm and environment, with a shoulder that its strap lets move.

    Returns:
      (22, 22); states are those of `StateSpace`, then velocity and displacement of the shoulder (two each).

    Source: the arm's segments in the frame of the shoulder (eq. B.2), whose position p joins the coordinates:
    mass p'' + damping p' + stiffness p = f - (momentum of the segments)'. The trunk does not turn, so muscles do not
    drive it.
    """
    arm, values = LinearArm(subject, ()), parameter_vector(subject)
    fixed_force, fixed = arm._force_and_dynamics(values, environment)
    of_arm, shoulder = slice(0, N_STATES), slice(N_STATES, N_STATES + 4)
    p_dot, p = slice(N_STATES, N_STATES + 2), slice(N_STATES + 2, N_STATES + 4)
    force = np.hstack([fixed_force, -subject.b_h * np.eye(2), -subject.k_h * np.eye(2)])
    mass, (t_h, t_f) = mass_matrix(subject), _segment_jacobians(subject)
    coupling = subject.m_h * t_h + subject.m_f * t_f
    moved = (strap.mass + subject.m_h + subject.m_f) * np.eye(2)

    torque = arm.jacobian.T @ force
    torque[:, of_arm] = mass @ fixed[_Q_DOT]
    push = force.copy()
    push[:, p_dot] -= strap.damping * np.eye(2)
    push[:, p] -= strap.stiffness * np.eye(2)
    acceleration = np.linalg.solve(np.block([[mass, coupling.T], [coupling, moved]]), np.vstack([torque, push]))

    a = np.zeros((N_STATES + 4, N_STATES + 4))
    a[of_arm, of_arm] = fixed
    a[_X_DOT, shoulder] = -force[:, shoulder] / environment.m_env
    a[p_dot], a[p, p_dot] = acceleration[2:], np.eye(2)
    # What the shoulder adds to the joints' acceleration, acceleration feedback sees too.
    added = acceleration[:2]
    added[:, of_arm] -= fixed[_Q_DOT]
    excitation = subject.joint_matrix("ka") @ added
    a[_Q_DOT] += added
    a[_PADE[2]] += excitation
    a[_ACTIVE_DOT] -= (2 * np.pi * values[_CUTOFFS, None]) ** 2 * excitation
    return a


def largest_real_pole(subject: Subject, environment: Environment, strap: Strap | None = None) -> float:
    """Largest real part of the poles of arm and environment [1/s]; the system is stable if it is negative.

    Of a nonlinear arm, the largest among its `Subject.linear_arms`.

    Args:
      subject: the arm.
      environment: what the hand holds.
      strap: what lets the shoulder move; None holds it in place.

    Source: sigma_max of eq. 2.21.
    """
    if strap is not None:
        return max(
            float(np.linalg.eigvals(_strapped_dynamics(arm, environment, strap)).real.max())
            for arm in subject.linear_arms
        )
    return max(
        float(LinearArm(arm, ()).poles(parameter_vector(arm), environment).real.max()) for arm in subject.linear_arms
    )


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
    if strap is not None:
        passive = np.r_[:8, N_STATES : N_STATES + 4]
        return max(
            float(
                np.abs(np.linalg.eigvals(_strapped_dynamics(arm, environment, strap)[np.ix_(passive, passive)])).max()
            )
            for arm in subject.linear_arms
        )
    return max(
        float(np.abs(np.linalg.eigvals(state_space(arm, environment).a[:8, :8])).max()) for arm in subject.linear_arms
    )


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


def simulate_linear(subject: Subject, environment: Environment, perturbation: ArrayLike, rate: float) -> LinearResponse:
    """Response of the linear model, from rest, to sampled disturbances that run straight between their samples.

    Args:
      subject: the arm.
      environment: what the hand holds.
      perturbation: d [N], (..., time, axis).
      rate: of the samples [Hz].
    """
    force = np.asarray(perturbation, dtype=float)
    system = state_space(subject, environment)
    # Exponential of a sample's time of state, force and the force's rise within the sample.
    generator = np.zeros((N_STATES + 4, N_STATES + 4))
    generator[:N_STATES] = np.hstack([system.a / rate, system.b / rate, np.zeros((N_STATES, 2))])
    generator[N_STATES : N_STATES + 2, N_STATES + 2 :] = np.eye(2)
    step, of_force, of_rise = np.split(linalg.expm(generator)[:N_STATES].T, [N_STATES, N_STATES + 2])
    state = np.zeros((*force.shape[:-1], N_STATES))
    state[..., 1:, :] = force[..., :-1, :] @ of_force + np.diff(force, axis=-2) @ of_rise
    y = _accumulated(state, step) @ system.c.T
    return LinearResponse(y[..., 0:2], y[..., 2:4], y[..., 4:6])
