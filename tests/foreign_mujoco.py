"""MuJoCo as the engine of `foreign_recordings`: its rigid bodies in the place of the equations of `foreign_arms`.

Muscles, reflexes and manipulator are forces that a callback adds at every stage of MuJoCo's Runge-Kutta steps. A rigid
grip is a point mass, the handle's, that is fixed to the forearm.
"""

from math import floor
from operator import mul

import mujoco
import numpy as np
from foreign_arms import symmetric
from scipy.linalg import expm

MODEL = """
<mujoco>
  <option timestep="{step!r}" integrator="RK4" gravity="0 0 0"><flag contact="disable" constraint="disable"/></option>
  <compiler angle="degree" inertiafromgeom="false"/>
  <worldbody>
    <body euler="0 0 {posture[0]!r}">
      <joint name="shoulder" axis="0 0 1"/>
      <inertial mass="{mass[0]!r}" pos="{centre[0]!r} 0 0" diaginertia="{spin[0]!r} {spin[0]!r} {spin[0]!r}"/>
      <body pos="{length[0]!r} 0 0" euler="0 0 {posture[1]!r}">
        <joint name="elbow" axis="0 0 1"/>
        <inertial mass="{mass[1]!r}" pos="{centre[1]!r} 0 0" diaginertia="{spin[1]!r} {spin[1]!r} {spin[1]!r}"/>
        <site name="hand" pos="{length[1]!r} 0 0"/>
        {fixed}
      </body>
    </body>
    {loose}
  </worldbody>
</mujoco>
"""
FIXED = '<body pos="{at!r} 0 0"><inertial mass="{mass!r}" pos="0 0 0" diaginertia="1e-12 1e-12 1e-12"/></body>'
LOOSE = """
    <body>
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
      <inertial mass="{mass!r}" pos="0 0 0" diaginertia="1 1 1"/>
    </body>
"""


def build(arm, load, step):
    """The compiled model; its first two degrees of freedom are shoulder and elbow, further two a loose handle."""
    rigid = arm.grip is None
    centre = [share * length for share, length in zip(arm.centre, arm.length, strict=True)]
    spin = [m * (g * l) ** 2 for m, g, l in zip(arm.mass, arm.gyration, arm.length, strict=True)]  # noqa: E741
    text = MODEL.format(
        step=step,
        posture=[float(angle) for angle in arm.posture_deg],
        mass=[float(mass) for mass in arm.mass],
        length=[float(length) for length in arm.length],
        centre=[float(value) for value in centre],
        spin=[float(value) for value in spin],
        fixed=FIXED.format(at=float(arm.length[1]), mass=load[0]) if rigid else "",
        loose="" if rigid else LOOSE.format(mass=load[0]),
    )
    return mujoco.MjModel.from_xml_string(text)


class Activation:
    """Second-order filter and delay of one joint, stepped with the simulation by its exact response to ramps."""

    def __init__(self, cutoff, zeta, delay, step):
        omega = 2 * np.pi * cutoff
        # States: activation, its derivative, drive, slope of the drive.
        a = np.zeros((4, 4))
        a[0, 1] = a[2, 3] = 1.0
        a[1] = [-(omega**2), -2 * zeta * omega, omega**2, 0.0]
        self._step, self._delay, self._filter = step, float(delay / step), expm(a * step)[:2].tolist()
        self._state, self._last, self._past = [0.0, 0.0], 0.0, []

    def advance(self, drive):
        now = (*self._state, self._last, (drive - self._last) / self._step)
        self._state = [sum(map(mul, row, now)) for row in self._filter]
        self._last = drive
        self._past.append(self._state[0])

    def torque(self, steps):
        """At a time in steps, of which at most as many as the delay lie ahead; cubic between samples."""
        at = steps - self._delay
        n = floor(at)
        if n < 1:
            return 0.0
        u, past = at - n, self._past
        a, b, c, d = past[n - 1], past[n], past[n + 1], past[n + 2]
        return b + 0.5 * u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))


def simulate(arm, load, d, n, step, every, linear=False):
    """As `foreign_arms.simulate`."""
    if linear:
        raise ValueError("MuJoCo's arm moves in circles; expected linear=False")
    model = build(arm, load, step)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start_x, start_y, _ = data.site_xpos[0].tolist()
    muscles = [Activation(*own, step) for own in zip(arm.cutoff, (arm.zeta,) * 2, arm.delay, strict=True)]
    (k1, k2, k3), (b1, b2, b3) = (map(float, part) for part in (arm.k, arm.b))
    velocity_gain, position_gain = symmetric(arm.kv), symmetric(arm.kp)
    (mass, damping, stiffness), (grip_k, grip_b) = load, arm.grip or (0.0, 0.0)
    reflexes, rigid = arm.reflex != "none", arm.grip is None
    q, w, where, elbow, applied = data.qpos, data.qvel, data.site_xpos[0], data.xanchor[1], data.qfrc_applied
    pushes, noise = d.tolist(), n.tolist()
    force, path = np.empty((len(d) // (2 * every) + 1, 2)), np.empty((len(d) // (2 * every) + 1, 2))
    active = [[0.0, 0.0]] * 3

    def act(_model, _data):
        """Everything but inertia; MuJoCo has the geometry of this stage at hand."""
        half = round(2 * data.time / step)
        (d1, d2), (n1, n2), (tau1, tau2) = pushes[half], noise[half], active[half - 2 * index]
        (hx, hy, _), (ex, ey, _) = where.tolist(), elbow.tolist()
        (q1, q2, *x), (w1, w2, *v) = q.tolist(), w.tolist()
        dx, dy, away_x, away_y = hx - start_x, hy - start_y, hx - ex, hy - ey
        vx, vy = -hy * w1 - away_y * w2, hx * w1 + away_x * w2
        if rigid:
            fx, fy = d1 - damping * vx - stiffness * dx, d2 - damping * vy - stiffness * dy
        else:
            fx, fy = grip_k * (x[0] - dx) + grip_b * (v[0] - vx), grip_k * (x[1] - dy) + grip_b * (v[1] - vy)
            applied[2] = d1 - fx - damping * v[0] - stiffness * x[0]
            applied[3] = d2 - fy - damping * v[1] - stiffness * x[1]
        applied[0] = n1 - tau1 - k1 * q1 - k2 * q2 - b1 * w1 - b2 * w2 - hy * fx + hx * fy
        applied[1] = n2 - tau2 - k2 * q1 - k3 * q2 - b2 * w1 - b3 * w2 - away_y * fx + away_x * fy
        stage[:] = [fx, fy, dx, dy]

    stage = [0.0] * 4
    jacobian, turning = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.set_mjcb_control(act)
    try:
        for index in range((len(d) - 1) // 2 + 1):
            if reflexes:
                for muscle, drive in zip(muscles, velocity_gain @ w[:2] + position_gain @ q[:2], strict=True):
                    muscle.advance(float(drive))
                active[:] = [[muscle.torque(index + half) for muscle in muscles] for half in (0.0, 0.5, 1.0)]
            if index % every == 0:
                mujoco.mj_forward(model, data)
                force[index // every], path[index // every] = stage[:2], stage[2:] if rigid else q[2:]
                if rigid:  # what moves the handle's mass is not the hand's
                    mujoco.mj_jacSite(model, data, jacobian, turning, 0)
                    centripetal = w[0] ** 2 * elbow[:2] + (w[0] + w[1]) ** 2 * (where - elbow)[:2]
                    force[index // every] -= mass * (jacobian[:2] @ data.qacc - centripetal)
            if index < (len(d) - 1) // 2:
                mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    return force, path
