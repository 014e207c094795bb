"""Compiled simulation of planar arms on their manipulators, each independent of the others (thesis eq. 2.17, B.1).

The arm is that of the MJCF model: two point masses in the middle of rigid segments that turn about a fixed shoulder,
linear intrinsic muscle, and a grip that is a spring and damper between hand and handle. Muscle law and reflexes are
those of `controllers.compiled`. MuJoCo is the reference in tests: at the same step, displacements agree within 2e-4 of
the largest.
"""

import math

import numpy as np
from numba import njit

from armperturb.arrays import Array, Indices
from armperturb.controllers.compiled import Lane, Memory, act, delayed
from armperturb.controllers.lanes import Table
from armperturb.planar_arm.lanes import Start


@njit(cache=True, inline="always", error_model="numpy")
def _slope(p: Lane, z: Array, push: Array, torque: Array, held: Array, origin: Array, out: Array) -> None:
    """Derivative of (q_s, q_e, x, y, their velocities), q from the posture and x from the start.

    Args:
      p: the person and what the hand holds.
      z: where to take it.
      push: force on the handle [N], (axis,).
      torque: of reflexes and noise on the joints [Nm], (joint,).
      held: torque that is held over the step [Nm], (joint,).
      origin: where the hand is at the start [m], (axis,).
      out: to fill.
    """
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
    t_s = torque[0] + held[0] + s_x * f_x + s_y * f_y + swirl * w_e * (2.0 * w_s + w_e)
    t_s -= p.spring[0] * q_s + p.spring[1] * q_e + p.b[0] * w_s + p.b[1] * w_e
    t_e = torque[1] + held[1] + e_x * f_x + e_y * f_y - swirl * w_s * w_s
    t_e -= p.spring[1] * q_s + p.spring[2] * q_e + p.b[1] * w_s + p.b[2] * w_e
    m_s, m_se, m_e = p.inertia[0] + 2.0 * couple, p.inertia[1] + couple, p.inertia[1]
    determinant = m_s * m_e - m_se * m_se
    out[0], out[1], out[2], out[3] = w_s, w_e, v_x, v_y
    out[4] = (m_e * t_s - m_se * t_e) / determinant
    out[5] = (m_s * t_e - m_se * t_s) / determinant
    out[6] = (push[0] - f_x - p.b_env * v_x - p.k_env * x) / p.m_env
    out[7] = (push[1] - f_y - p.b_env * v_y - p.k_env * y) / p.m_env


@njit(cache=True, inline="always", error_model="numpy")
def _grip(p: Lane, z: Array, origin: Array, out: Array) -> None:
    """Force that the handle exerts on the hand [N], (axis,)."""
    upper, lower = p.posture[0] + z[0], p.posture[0] + p.posture[1] + z[0] + z[1]
    e_x, e_y = -p.l_f * math.sin(lower), p.l_f * math.cos(lower)
    s_x, s_y = e_x - p.l_h * math.sin(upper), e_y + p.l_h * math.cos(upper)
    out[0] = p.k_h * (z[2] + origin[0] - s_y) + p.b_h * (z[6] - s_x * z[4] - e_x * z[5])
    out[1] = p.k_h * (z[3] + origin[1] + s_x) + p.b_h * (z[7] - s_y * z[4] - e_y * z[5])


@njit(cache=True, inline="always", error_model="numpy")
def _arrive(p: Lane, m: Memory, timestep: float, torque: Array) -> None:
    """Torque of the reflexes at the start, middle and end of a step, (3, joint), added to what is there."""
    for joint in range(2):
        back = p.delay[joint] / timestep
        for stage in range(3):
            torque[stage, joint] -= delayed(m.sent, joint, m.step - 1, back - 0.5 * stage)


@njit(cache=True, inline="always", error_model="numpy")
def _advance(
    p: Lane, state: Array, work: Array, push: Array, torque: Array, held: Array, origin: Array, timestep: float
) -> None:
    """One step of Runge-Kutta 4; NaN if the arm diverges.

    Args:
      p: the person and what the hand holds.
      state: to change.
      work: room for intermediate results, (3, 8).
      push: force on the handle at the start, middle and end of the step [N], (3, axis).
      torque: of reflexes and noise on the joints, likewise [Nm], (3, joint).
      held: torque that is held over the step [Nm], (joint,).
      origin: where the hand is at the start [m], (axis,).
      timestep: of the simulation [s].
    """
    moved, slope, total = work[0], work[1], work[2]
    for stage in range(4):
        half = (stage + 1) // 2
        part = 0.5 * timestep if stage < 3 else timestep
        for i in range(8):
            moved[i] = state[i] if stage == 0 else state[i] + part * slope[i]
        _slope(p, moved, push[half], torque[half], held, origin, slope)
        weight = timestep / 6.0 if stage == 0 or stage == 3 else timestep / 3.0
        for i in range(8):
            total[i] = weight * slope[i] if stage == 0 else total[i] + weight * slope[i]
    for i in range(8):
        state[i] += total[i]
    if not abs(state[0]) + abs(state[1]) < 1e3:
        state[:] = np.nan


@njit(cache=True, inline="always", error_model="numpy")
def _hand(p: Lane) -> Array:
    """Where the hand is at the start posture [m], (axis,), so that the grip is at rest there."""
    lower = p.posture[0] + p.posture[1]
    origin = np.zeros(2)
    origin[0] = p.l_h * math.cos(p.posture[0]) + p.l_f * math.cos(lower)
    origin[1] = p.l_h * math.sin(p.posture[0]) + p.l_f * math.sin(lower)
    return origin


@njit(cache=True, nogil=True, error_model="numpy")
def simulate_lanes(
    lanes: Table,
    start: Start,
    force: Array,
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
      force: on the handle at the start and middle of each step [N], (trial, 2 step + 1, axis).
      of_lane: which trial each lane is of, (lane,).
      n_samples: how many samples each lane wants, (lane,).
      decimation: steps per sample.
      timestep: of the simulation [s].
      displacement: to fill, (lane, time, axis); NaN from where a lane diverges.
    """
    work, room, torque = np.zeros((3, 8)), np.zeros((4, 3)), np.zeros((3, 2))
    held, sent, angle = np.zeros(2), np.zeros(2), np.zeros(2)
    for lane in range(len(lanes)):
        p, m, state = lanes[lane], start.memory[lane], start.state[lane]
        push, origin = force[of_lane[lane]], _hand(p)
        displacement[lane, 0, 0], displacement[lane, 0, 1] = state[2], state[3]
        for step in range((n_samples[lane] - 1) * decimation):
            angle[0], angle[1] = p.posture[0] + state[0], p.posture[1] + state[1]
            act(p, m, angle, state[4:6], timestep, room, held, sent)
            if p.reflexive != 0.0:
                torque[:] = 0.0
                _arrive(p, m, timestep, torque)
            _advance(p, state, work, push[2 * step : 2 * step + 3], torque, held, origin, timestep)
            if (step + 1) % decimation == 0:
                sample = (step + 1) // decimation
                displacement[lane, sample, 0], displacement[lane, sample, 1] = state[2], state[3]


@njit(cache=True, nogil=True, error_model="numpy")
def log_lanes(lanes: Table, start: Start, known: Array, timestep: float, log: Array) -> None:
    """All signals at the start of each step, as `envs.lab.stepping.advance` logs them of MuJoCo's arms.

    Args:
      lanes: from `lanes.lane_table`.
      start: of each lane.
      known: torque on the joints [Nm] and force on the handle [N] at the start and middle of each step, (lane, 2 step +
        1, motor).
      timestep: of the simulation [s].
      log: reflexive excitation, joint velocity, displacement of the handle, joint angle, and force of the handle on the
        hand, to fill, (lane, step, 10).
    """
    work, room, torque = np.zeros((3, 8)), np.zeros((4, 3)), np.zeros((3, 2))
    held, sent, angle = np.zeros(2), np.zeros(2), np.zeros(2)
    for lane in range(len(lanes)):
        p, m, state, origin = lanes[lane], start.memory[lane], start.state[lane], _hand(lanes[lane])
        for step in range(log.shape[1]):
            row, now = log[lane, step], known[lane, 2 * step : 2 * step + 3]
            angle[0], angle[1] = p.posture[0] + state[0], p.posture[1] + state[1]
            act(p, m, angle, state[4:6], timestep, room, held, sent)
            for i in range(2):
                row[i], row[2 + i], row[4 + i], row[6 + i] = m.excitation[i], state[4 + i], state[2 + i], angle[i]
            _grip(p, state, origin, row[8:10])
            torque[:] = now[:, :2]
            if p.reflexive != 0.0:
                _arrive(p, m, timestep, torque)
            _advance(p, state, work, now[:, 2:], torque, held, origin, timestep)
