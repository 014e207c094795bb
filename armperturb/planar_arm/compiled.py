"""Compiled simulation of planar arms on their manipulators, each independent of the others (thesis eq. 2.17, B.1).

The arm is that of the MJCF model: two point masses in the middle of rigid segments that turn about a fixed shoulder,
linear intrinsic muscle, and a grip that is a spring and damper between hand and handle. Muscle law and reflexes are
those of `controllers`, written out for one lane. MuJoCo is the reference in tests: at the same step, displacements
agree within 2e-4 of the largest.
"""

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from armperturb.arrays import Array, Indices
from armperturb.planar_arm.lanes import Start

Lane = Any
"""A row of `lanes.lane_table`: compiled code knows its fields, type checkers do not."""


@njit(cache=True, inline="always", error_model="numpy")
def _slope(p: Lane, z: Array, push: Array, active: Array, law: Array, origin: Array, out: Array) -> None:
    """Derivative of (q_s, q_e, x, y, their velocities), q from the posture and x from the start."""
    q_s, q_e, x, y, w_s, w_e, v_x, v_y = z[0], z[1], z[2], z[3], z[4], z[5], z[6], z[7]
    upper, lower = p.posture[0] + q_s, p.posture[0] + p.posture[1] + q_s + q_e
    sin_u, cos_u, sin_l, cos_l = math.sin(upper), math.cos(upper), math.sin(lower), math.cos(lower)
    # Columns of the hand's Jacobian; turned by a right angle, that of the shoulder is the hand's position.
    e_x, e_y = -p.l_f * sin_l, p.l_f * cos_l
    s_x, s_y = e_x - p.l_h * sin_u, e_y + p.l_h * cos_u
    f_x = p.k_h * (x + origin[0] - s_y) + p.b_h * (v_x - s_x * w_s - e_x * w_e)
    f_y = p.k_h * (y + origin[1] + s_x) + p.b_h * (v_y - s_y * w_s - e_y * w_e)
    couple = p.inertia[2] * (cos_u * cos_l + sin_u * sin_l)
    swirl = p.inertia[2] * (cos_u * sin_l - sin_u * cos_l)
    t_s = active[0] - law[0] + s_x * f_x + s_y * f_y + swirl * w_e * (2.0 * w_s + w_e)
    t_s -= p.k[0] * q_s + p.k[1] * q_e + p.b[0] * w_s + p.b[1] * w_e
    t_e = active[1] - law[1] + e_x * f_x + e_y * f_y - swirl * w_s * w_s
    t_e -= p.k[1] * q_s + p.k[2] * q_e + p.b[1] * w_s + p.b[2] * w_e
    m_s, m_se, m_e = p.inertia[0] + 2.0 * couple, p.inertia[1] + couple, p.inertia[1]
    determinant = m_s * m_e - m_se * m_se
    out[0], out[1], out[2], out[3] = w_s, w_e, v_x, v_y
    out[4] = (m_e * t_s - m_se * t_e) / determinant
    out[5] = (m_s * t_e - m_se * t_s) / determinant
    out[6] = (push[0] - f_x - p.b_env * v_x - p.k_env * x) / p.m_env
    out[7] = (push[1] - f_y - p.b_env * v_y - p.k_env * y) / p.m_env


@njit(cache=True, inline="always", error_model="numpy")
def _muscles(p: Lane, bond: Array, intact: Array, last: Array, stretch: Array, velocity: Array, out: Array) -> None:
    """Torque of the law on both joints, see `controllers.muscle.muscle_torque`."""
    out[0] = out[1] = 0.0
    for element in range(3):
        move = stretch[element] - last[element]
        last[element] = stretch[element]
        speed = abs(velocity[element])
        survival = 1.0 / (1.0 + abs(move) * p.loss[element])
        whole = intact[element] * survival
        total = 0.0
        for part in range(bond.shape[1]):
            limit = whole * (p.limit[element, part] + p.limit_slope[element, part] * speed)
            strain = min(max(bond[element, part] * survival + whole * move, -limit), limit)
            bond[element, part] = strain
            total += strain
        intact[element] = 1.0 - (1.0 - whole) * p.persistence[element]
        thinned = speed * p.thinning[element]
        torque = total * p.part_stiffness[element]
        torque -= p.damping_groups[element] * velocity[element] * (thinned / (1.0 + thinned))
        if element < 2:
            out[0] += torque
        if element > 0:
            out[1] += torque


@njit(cache=True, inline="always", error_model="numpy")
def _excitation(p: Lane, q_s: float, q_e: float, w_s: float, w_e: float, out: Array) -> None:
    """Reflexive excitation of both joints, see `controllers.reflex`."""
    out[0] = p.kv[0] * w_s + p.kv[1] * w_e + p.kp[0] * q_s + p.kp[1] * q_e
    out[1] = p.kv[1] * w_s + p.kv[2] * w_e + p.kp[1] * q_s + p.kp[2] * q_e
    for element in range(3):
        velocity = (w_s, w_s + w_e, w_e)[element]
        answered = velocity / (1.0 + abs(velocity) / p.saturation[element])
        if velocity * p.direction[element] < 0.0:
            answered *= 1.0 - abs(p.direction[element])
        missing = p.kv_groups[element] * (answered - velocity)
        if element < 2:
            out[0] += missing
        if element > 0:
            out[1] += missing


@njit(cache=True, inline="always", error_model="numpy")
def _reflexes(p: Lane, excitation: Array, filters: Array, motor: Array, step: int, timestep: float, out: Array) -> None:
    """Delayed torque of the reflexes at the start, middle and end of a step, (3, joint)."""
    n_history = len(motor)
    for joint in range(2):
        u = excitation[joint]
        sent = p.numerator[0, joint] * u + filters[0, joint]
        filters[0, joint] = p.numerator[1, joint] * u - p.denominator[1, joint] * sent + filters[1, joint]
        filters[1, joint] = p.numerator[2, joint] * u - p.denominator[2, joint] * sent
        motor[step % n_history, joint] = -sent
        for stage in range(3):
            back = p.delay[joint] / timestep - 0.5 * stage
            whole = math.floor(back)
            newer = motor[(step - whole) % n_history, joint]
            older = motor[(step - whole - 1) % n_history, joint]
            out[stage, joint] = newer + (back - whole) * (older - newer)


@njit(cache=True, inline="always", error_model="numpy")
def _advance(
    p: Lane, state: Array, work: Array, push: Array, active: Array, law: Array, origin: Array, timestep: float
) -> None:
    """One step of Runge-Kutta 4 under a force and a law that are held; NaN if the arm diverges."""
    moved, slope, total = work[0], work[1], work[2]
    for stage in range(4):
        half = (stage + 1) // 2
        part = 0.5 * timestep if stage < 3 else timestep
        for i in range(8):
            moved[i] = state[i] if stage == 0 else state[i] + part * slope[i]
        _slope(p, moved, push, active[half], law, origin, slope)
        weight = timestep / 6.0 if stage == 0 or stage == 3 else timestep / 3.0
        for i in range(8):
            total[i] = weight * slope[i] if stage == 0 else total[i] + weight * slope[i]
    for i in range(8):
        state[i] += total[i]
    if not abs(state[0]) + abs(state[1]) < 1e3:
        state[:] = np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def simulate_lanes(
    lanes: NDArray[np.void],
    start: Start,
    held: Array,
    of_lane: Indices,
    n_samples: Indices,
    decimation: int,
    timestep: float,
    displacement: Array,
) -> None:
    """Displacement of the handles from rest [m]; compiled, so types are as said and nothing is checked.

    Args:
      lanes: from `lanes.lane_table`.
      start: of each lane.
      held: force on the handle, held over each step [N], (trial, step, axis).
      of_lane: which trial each lane is of, (lane,).
      n_samples: how many samples each lane wants, (lane,).
      decimation: steps per sample.
      timestep: of the simulation [s].
      displacement: to fill, (lane, time, axis); NaN from where a lane diverges.
    """
    for lane in range(len(lanes)):
        p = lanes[lane]
        force = held[of_lane[lane]]
        reflexes = False
        for i in range(3):
            reflexes = reflexes or p.kv[i] != 0.0 or p.kp[i] != 0.0
        # The shoulder's column of the Jacobian has (-y, x) of the hand: so the grip is at rest at the start.
        lower = p.posture[0] + p.posture[1]
        origin, work = np.zeros(2), np.zeros((3, 8))
        origin[0] = p.l_h * math.cos(p.posture[0]) + p.l_f * math.cos(lower)
        origin[1] = p.l_h * math.sin(p.posture[0]) + p.l_f * math.sin(lower)
        state, filters, motor = start.state[lane], start.filters[lane], start.motor[lane]
        bond, intact, last = np.zeros((3, p.limit.shape[1])), np.ones(3), np.zeros(3)
        stretch, middle, before = np.zeros(3), np.zeros(3), np.zeros(2)
        law, excitation, active = np.zeros(2), np.zeros(2), np.zeros((3, 2))
        displacement[lane, 0, 0], displacement[lane, 0, 1] = state[2], state[3]
        for step in range((n_samples[lane] - 1) * decimation):
            w_s, w_e = state[4], state[5]
            stretch[0], stretch[2] = state[0] + 0.5 * timestep * w_s, state[1] + 0.5 * timestep * w_e
            stretch[1] = stretch[0] + stretch[2]
            middle[0], middle[2] = 1.5 * w_s - 0.5 * before[0], 1.5 * w_e - 0.5 * before[1]
            middle[1] = middle[0] + middle[2]
            before[0], before[1] = w_s, w_e
            _muscles(p, bond, intact, last, stretch, middle, law)
            if reflexes:
                _excitation(p, state[0], state[1], w_s, w_e, excitation)
                _reflexes(p, excitation, filters, motor, step, timestep, active)
            _advance(p, state, work, force[step], active, law, origin, timestep)
            if (step + 1) % decimation == 0:
                sample = (step + 1) // decimation
                displacement[lane, sample, 0], displacement[lane, sample, 1] = state[2], state[3]
