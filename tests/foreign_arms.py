"""Arms that the package did not make: own equations of motion, integrated in own code, and their linear theory.

Two rigid segments of distributed mass turn in the horizontal plane about a fixed shoulder. Symbols: q = [shoulder,
elbow] turned from the start posture [rad], w = q', x = handle displacement [m], v = x', F = force of the handle on the
hand, d = disturbance [N]. Lagrange's equations, and those of the handle, are

    M(q) w' + c(q, w) + K q + B w + tau = J(q)^T F + n,      m x'' + b x' + k x = d - F,
    tau_i(t) = a_i(t - delay_i),      a_i'' + 2 zeta omega_i a_i' + omega_i^2 a_i = omega_i^2 (Kv w + Kp q)_i,

with n the noise of the person. The hand is the handle (rigid grip), or F = k_h (x - hand) + b_h (v - hand').
`foreign_recordings` perturbs and records them; `foreign_mujoco` is a second engine in the place of `simulate`.
"""

from dataclasses import dataclass

import numba
import numpy as np


@dataclass(frozen=True, kw_only=True)
class Arm:
    """An arm in one posture, SI; pairs are (upper arm, forearm with hand) or (shoulder, elbow)."""

    mass: tuple = (2.0, 1.5)
    length: tuple = (0.31, 0.34)
    centre: tuple = (0.44, 0.55)  # of mass from the proximal joint, share of length
    gyration: tuple = (0.32, 0.30)  # radius about the centre of mass, share of length
    posture_deg: tuple = (40.0, 85.0)
    k: tuple = (103.0, 28.0, 88.0)  # (s, se, e) of symmetric matrices
    b: tuple = (3.3, 0.9, 2.6)
    kv: tuple = (0.0, 0.0, 0.0)
    kp: tuple = (0.0, 0.0, 0.0)
    delay: tuple = (0.03, 0.03)
    cutoff: tuple = (3.0, 3.0)
    zeta: float = 0.7
    grip: tuple | None = None  # stiffness [N/m] and damping [Ns/m]; None is rigid

    def inertia(self):
        """Constants a, b, c of M = [[a + 2 b cos, c + b cos], [c + b cos, c]], cos that of the elbow [kg m^2]."""
        (m1, m2), (l1, l2) = self.mass, self.length
        c1, c2 = self.centre[0] * l1, self.centre[1] * l2
        i1, i2 = m1 * (self.gyration[0] * l1) ** 2, m2 * (self.gyration[1] * l2) ** 2
        return i1 + i2 + m1 * c1**2 + m2 * (l1**2 + c2**2), m2 * l1 * c2, i2 + m2 * c2**2

    def mass_matrix(self):
        """At the start posture [kg m^2], (joint, joint)."""
        a, b, c = self.inertia()
        cosine = np.cos(np.radians(self.posture_deg[1]))
        return np.array([[a + 2 * b * cosine, c + b * cosine], [c + b * cosine, c]])

    def jacobian(self):
        """At the start posture [m/rad], (axis, joint)."""
        first, both = np.cumsum(np.radians(self.posture_deg))
        l1, l2 = self.length
        fore = l2 * np.array([-np.sin(both), np.cos(both)])
        return np.column_stack([l1 * np.array([-np.sin(first), np.cos(first)]) + fore, fore])

    @property
    def reflex(self):
        return "position" if any(self.kp) else "velocity" if any(self.kv) else "none"


def symmetric(triple):
    return np.array([[triple[0], triple[1]], [triple[1], triple[2]]])


def joint_impedance(arm, frequency):
    """From angle to torque [Nm/rad], (frequency, joint, joint)."""
    s = 2j * np.pi * np.asarray(frequency, dtype=float)[:, None]
    omega = 2 * np.pi * np.array(arm.cutoff)
    muscle = np.exp(-s * np.array(arm.delay)) * omega**2 / (s**2 + 2 * arm.zeta * omega * s + omega**2)
    s = s[..., None]
    reflex = muscle[..., None] * (s * symmetric(arm.kv) + symmetric(arm.kp))
    return s**2 * arm.mass_matrix() + s * symmetric(arm.b) + symmetric(arm.k) + reflex


def admittance(arm, frequency):
    """Of arm and grip, from F to x [m/N], (frequency, axis, axis)."""
    s = 2j * np.pi * np.asarray(frequency, dtype=float)[:, None, None]
    jacobian = arm.jacobian()
    grip = 0.0 if arm.grip is None else np.eye(2) / (arm.grip[0] + s * arm.grip[1])
    return jacobian @ np.linalg.inv(joint_impedance(arm, frequency)) @ jacobian.T + grip


def paths(arm, load, frequency):
    """From d to x [m/N], and from the torque n to x [m/Nm], (frequency, axis, axis) and (frequency, axis, joint)."""
    s = 2j * np.pi * np.asarray(frequency, dtype=float)[:, None, None]
    share = np.linalg.inv(np.eye(2) + (load[0] * s**2 + load[1] * s + load[2]) * admittance(arm, frequency))
    return share @ admittance(arm, frequency), share @ arm.jacobian() @ np.linalg.inv(joint_impedance(arm, frequency))


@numba.njit(cache=True)
def _slope(y, d, n, active, constants, linear, rigid, slope, force):
    """Time derivative of y = [q, w, x, v, a, a'], each of shoulder and elbow or x and y; and the force F."""
    # constants: inertia 0:3, l1, l2, posture 5:7, K 7:10, B 10:13, Kv 13:16, Kp 16:19, omega 19:21, zeta, load, grip
    p = constants
    l1, l2, mass, damping, stiffness, grip_k, grip_b = p[3], p[4], p[22], p[23], p[24], p[25], p[26]
    first = p[5] + (0.0 if linear else y[0])
    elbow = p[6] + (0.0 if linear else y[1])
    both, sine, cosine = first + elbow, np.sin(elbow), np.cos(elbow)
    m11, m12, m22 = p[0] + 2 * p[1] * cosine, p[2] + p[1] * cosine, p[2]
    jx2, jy2 = -l2 * np.sin(both), l2 * np.cos(both)
    jx1, jy1 = jx2 - l1 * np.sin(first), jy2 + l1 * np.cos(first)
    w1, w2 = y[2], y[3]
    vx, vy = jx1 * w1 + jx2 * w2, jy1 * w1 + jy2 * w2
    t1 = n[0] - active[0] - p[7] * y[0] - p[8] * y[1] - p[10] * w1 - p[11] * w2
    t2 = n[1] - active[1] - p[8] * y[0] - p[9] * y[1] - p[11] * w1 - p[12] * w2
    if linear:
        hx, hy, cx, cy = jx1 * y[0] + jx2 * y[1], jy1 * y[0] + jy2 * y[1], 0.0, 0.0
    else:
        hx = l1 * (np.cos(first) - np.cos(p[5])) + l2 * (np.cos(both) - np.cos(p[5] + p[6]))
        hy = l1 * (np.sin(first) - np.sin(p[5])) + l2 * (np.sin(both) - np.sin(p[5] + p[6]))
        cx = -l1 * np.cos(first) * w1**2 - l2 * np.cos(both) * (w1 + w2) ** 2
        cy = -l1 * np.sin(first) * w1**2 - l2 * np.sin(both) * (w1 + w2) ** 2
        t1 += p[1] * sine * (2 * w1 * w2 + w2**2)
        t2 -= p[1] * sine * w1**2
    if rigid:  # the handle's mass moves with the hand
        fx = d[0] - mass * cx - damping * vx - stiffness * hx
        fy = d[1] - mass * cy - damping * vy - stiffness * hy
        m11 += mass * (jx1**2 + jy1**2)
        m12 += mass * (jx1 * jx2 + jy1 * jy2)
        m22 += mass * (jx2**2 + jy2**2)
    else:
        fx = grip_k * (y[4] - hx) + grip_b * (y[6] - vx)
        fy = grip_k * (y[5] - hy) + grip_b * (y[7] - vy)
    t1 += jx1 * fx + jy1 * fy
    t2 += jx2 * fx + jy2 * fy
    determinant = m11 * m22 - m12**2
    slope[0], slope[1] = w1, w2
    slope[2], slope[3] = (m22 * t1 - m12 * t2) / determinant, (m11 * t2 - m12 * t1) / determinant
    if rigid:
        fx -= mass * (jx1 * slope[2] + jx2 * slope[3])
        fy -= mass * (jy1 * slope[2] + jy2 * slope[3])
        slope[4:8] = 0.0
        y[4], y[5] = hx, hy
    else:
        slope[4], slope[5] = y[6], y[7]
        slope[6] = (d[0] - fx - damping * y[6] - stiffness * y[4]) / mass
        slope[7] = (d[1] - fy - damping * y[7] - stiffness * y[5]) / mass
    force[0], force[1] = fx, fy
    for i in range(2):
        drive = p[13 + i] * w1 + p[14 + i] * w2 + p[16 + i] * y[0] + p[17 + i] * y[1]
        slope[8 + i] = y[10 + i]
        slope[10 + i] = p[19 + i] ** 2 * (drive - y[8 + i]) - 2 * p[21] * p[19 + i] * y[10 + i]


@numba.njit(cache=True)
def _integrate(d, n, step, every, constants, delay, linear, rigid):
    """Runge-Kutta of fourth order from rest; d and n at half steps. F and x at every so many steps, (sample, axis)."""
    n_steps = (len(d) - 1) // 2
    past = np.zeros((n_steps + 1, 4))
    force, path = np.empty((n_steps // every + 1, 2)), np.empty((n_steps // every + 1, 2))
    y, stage, active = np.zeros(12), np.zeros(12), np.zeros(2)
    slopes, f = np.zeros((4, 12)), np.zeros(2)
    for index in range(n_steps + 1):
        for part in range(4):
            half = (part + 1) // 2  # half steps from the start of this one
            for i in range(2):  # what left the activation a delay ago, by cubic Hermite interpolation
                at = index + 0.5 * half - delay[i] / step
                before = int(np.floor(at))
                u, active[i] = at - before, 0.0
                if before >= 0:
                    a, b = past[before], past[before + 1]
                    active[i] = (1 + 2 * u) * (1 - u) ** 2 * a[i] + u**2 * (3 - 2 * u) * b[i]
                    active[i] += step * u * (1 - u) * ((1 - u) * a[2 + i] - u * b[2 + i])
            stage[:] = y if part == 0 else y + slopes[part - 1] * step * (1.0 if part == 3 else 0.5)
            here = min(2 * index + half, len(d) - 1)
            _slope(stage, d[here], n[here], active, constants, linear, rigid, slopes[part], f)
            if part == 0 and index % every == 0:
                force[index // every], path[index // every] = f, stage[4:6]
        y += step / 6.0 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        if index < n_steps:
            past[index + 1] = y[8:12]
    return force, path


def simulate(arm, load, d, n, step, every, linear=False):
    """F [N] and x [m], (sample, axis), under d [N] and the torque n [Nm], at half steps, (half step, 2)."""
    constants = [*arm.inertia(), *arm.length, *np.radians(arm.posture_deg), *arm.k, *arm.b, *arm.kv, *arm.kp]
    constants += [*2 * np.pi * np.array(arm.cutoff), arm.zeta, *load, *(arm.grip or (0.0, 0.0))]
    rigid = arm.grip is None
    return _integrate(d, n, step, every, np.array(constants), np.array(arm.delay), linear, rigid)
