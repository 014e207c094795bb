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
from armperturb.planar_arm.lanes import GROUP, Start

Lane = Any
"""A row of `lanes.lane_table`: compiled code knows its fields, type checkers do not."""

State = tuple[float, ...]

(Q_S, Q_E, X, Y, W_S, W_E, V_X, V_Y) = range(8)
(PUSH_X, PUSH_Y, START_S, START_E, MIDDLE_S, MIDDLE_E, END_S, END_E) = range(8, 16)
(UPPER, LOWER, L_H, L_F, K_H, B_H, HAND_X, HAND_Y, INERTIA_S, INERTIA_E, COUPLING) = range(16, 27)
(K_S, K_SE, K_E, B_S, B_SE, B_E, M_ENV, B_ENV, K_ENV) = range(27, 36)
ROWS = 36
"""Rows of a group's numbers: state, inputs of a step (torques at its start, middle and end), constants."""

PI_REMAINDER = 1.2246467991473532e-16
"""What pi has beyond its nearest number."""


@njit(cache=True, inline="always", error_model="numpy")
def _sine_and_cosine(angle: float) -> tuple[float, float]:
    """Both by their series about the nearest multiple of pi, to rounding: library calls are not vectorised."""
    turns = np.floor(angle * (1.0 / math.pi) + 0.5)
    x = (angle - turns * math.pi) - turns * PI_REMAINDER
    sign = 1.0 - 2.0 * (turns - 2.0 * np.floor(0.5 * turns))
    z = x * x
    sine = 1.0 - z * (1.0 / 272.0) * (1.0 - z * (1.0 / 342.0))
    sine = 1.0 - z * (1.0 / 110.0) * (1.0 - z * (1.0 / 156.0) * (1.0 - z * (1.0 / 210.0) * sine))
    sine = 1.0 - z * (1.0 / 6.0) * (1.0 - z * (1.0 / 20.0) * (1.0 - z * (1.0 / 42.0) * (1.0 - z * (1.0 / 72.0) * sine)))
    cosine = 1.0 - z * (1.0 / 240.0) * (1.0 - z * (1.0 / 306.0))
    cosine = 1.0 - z * (1.0 / 90.0) * (1.0 - z * (1.0 / 132.0) * (1.0 - z * (1.0 / 182.0) * cosine))
    cosine = 1.0 - z * (1.0 / 12.0) * (1.0 - z * (1.0 / 30.0) * (1.0 - z * (1.0 / 56.0) * cosine))
    return sign * x * sine, sign * (1.0 - 0.5 * z * cosine)


@njit(cache=True, inline="always", error_model="numpy")
def _turned(sine: float, cosine: float, by: float) -> tuple[float, float]:
    """Sine and cosine of an angle that has grown by less than 0.1 rad, to rounding."""
    z = by * by
    grown = by * (1.0 - z * (1.0 / 6.0) * (1.0 - z * (1.0 / 20.0) * (1.0 - z * (1.0 / 42.0))))
    left = 1.0 - 0.5 * z * (1.0 - z * (1.0 / 12.0) * (1.0 - z * (1.0 / 30.0) * (1.0 - z * (1.0 / 56.0))))
    return sine * left + cosine * grown, cosine * left - sine * grown


@njit(cache=True, inline="always", error_model="numpy")
def _moved(z: State, slope: State, time: float) -> State:
    """The state after a time with that slope."""
    return (
        z[0] + time * slope[0],
        z[1] + time * slope[1],
        z[2] + time * slope[2],
        z[3] + time * slope[3],
        z[4] + time * slope[4],
        z[5] + time * slope[5],
        z[6] + time * slope[6],
        z[7] + time * slope[7],
    )


@njit(cache=True, inline="always", error_model="numpy")
def _slope(w: Array, i: int, z: State, upper: State, lower: State, t_s: float, t_e: float) -> State:
    """Derivative of (q_s, q_e, x, y, their velocities), q from the posture and x from the start.

    Args:
      w: work, see `ROWS`.
      i: lane.
      z: the state.
      upper: sine and cosine of the upper arm's angle.
      lower: of the forearm's.
      t_s: torque on the shoulder beside spring, damper and grip [Nm].
      t_e: on the elbow.
    """
    q_s, q_e, x, y, w_s, w_e, v_x, v_y = z
    (sin_u, cos_u), (sin_l, cos_l) = upper, lower
    # Columns of the hand's Jacobian; turned by a right angle, that of the shoulder is the hand's position.
    e_x, e_y = -w[L_F, i] * sin_l, w[L_F, i] * cos_l
    s_x, s_y = e_x - w[L_H, i] * sin_u, e_y + w[L_H, i] * cos_u
    f_x = w[K_H, i] * (x + w[HAND_X, i] - s_y) + w[B_H, i] * (v_x - s_x * w_s - e_x * w_e)
    f_y = w[K_H, i] * (y + w[HAND_Y, i] + s_x) + w[B_H, i] * (v_y - s_y * w_s - e_y * w_e)
    couple = w[COUPLING, i] * (cos_u * cos_l + sin_u * sin_l)
    swirl = w[COUPLING, i] * (cos_u * sin_l - sin_u * cos_l)
    t_s += s_x * f_x + s_y * f_y + swirl * w_e * (2.0 * w_s + w_e)
    t_s -= w[K_S, i] * q_s + w[K_SE, i] * q_e + w[B_S, i] * w_s + w[B_SE, i] * w_e
    t_e += e_x * f_x + e_y * f_y - swirl * w_s * w_s
    t_e -= w[K_SE, i] * q_s + w[K_E, i] * q_e + w[B_SE, i] * w_s + w[B_E, i] * w_e
    m_e = w[INERTIA_E, i]
    m_s, m_se = w[INERTIA_S, i] + 2.0 * couple, m_e + couple
    share = 1.0 / (m_s * m_e - m_se * m_se)
    return (
        w_s,
        w_e,
        v_x,
        v_y,
        (m_e * t_s - m_se * t_e) * share,
        (m_s * t_e - m_se * t_s) * share,
        (w[PUSH_X, i] - f_x - w[B_ENV, i] * v_x - w[K_ENV, i] * x) / w[M_ENV, i],
        (w[PUSH_Y, i] - f_y - w[B_ENV, i] * v_y - w[K_ENV, i] * y) / w[M_ENV, i],
    )


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
    newest = step % n_history
    for joint in range(2):
        u = excitation[joint]
        sent = p.numerator[0, joint] * u + filters[0, joint]
        filters[0, joint] = p.numerator[1, joint] * u - p.denominator[1, joint] * sent + filters[1, joint]
        filters[1, joint] = p.numerator[2, joint] * u - p.denominator[2, joint] * sent
        motor[newest, joint] = -sent
        delay = p.delay[joint] / timestep
        for stage in range(3):
            back = delay - 0.5 * stage
            whole = math.floor(back)
            place = newest - whole if newest >= whole else newest - whole + n_history  # a remainder takes far longer
            newer, older = motor[place, joint], motor[place - 1 if place > 0 else n_history - 1, joint]
            out[stage, joint] = newer + (back - whole) * (older - newer)


@njit(cache=True, inline="always", error_model="numpy")
def _advance(w: Array, timestep: float) -> None:
    """One step of Runge-Kutta 4 of all lanes of a group, under forces and laws that are held; NaN if an arm diverges.

    The compiler makes one vector instruction of the lanes' scalar ones, as long as all that they touch is one array.
    """
    half = 0.5 * timestep
    for i in range(GROUP):
        z: State = (w[Q_S, i], w[Q_E, i], w[X, i], w[Y, i], w[W_S, i], w[W_E, i], w[V_X, i], w[V_Y, i])
        upper = _sine_and_cosine(w[UPPER, i] + z[0])
        lower = _sine_and_cosine(w[LOWER, i] + z[0] + z[1])
        first = _slope(w, i, z, upper, lower, w[START_S, i], w[START_E, i])
        d_u, d_l = half * z[4], half * (z[4] + z[5])
        there = _moved(z, first, half)
        turned = _turned(upper[0], upper[1], d_u), _turned(lower[0], lower[1], d_l)
        second = _slope(w, i, there, turned[0], turned[1], w[MIDDLE_S, i], w[MIDDLE_E, i])
        d_u, d_l = half * there[4], half * (there[4] + there[5])
        there = _moved(z, second, half)
        turned = _turned(upper[0], upper[1], d_u), _turned(lower[0], lower[1], d_l)
        third = _slope(w, i, there, turned[0], turned[1], w[MIDDLE_S, i], w[MIDDLE_E, i])
        d_u, d_l = timestep * there[4], timestep * (there[4] + there[5])
        there = _moved(z, third, timestep)
        turned = _turned(upper[0], upper[1], d_u), _turned(lower[0], lower[1], d_l)
        fourth = _slope(w, i, there, turned[0], turned[1], w[END_S, i], w[END_E, i])
        z = _moved(z, first, timestep / 6.0)
        z = _moved(z, second, timestep / 3.0)
        z = _moved(z, third, timestep / 3.0)
        z = _moved(z, fourth, timestep / 6.0)
        finite = 1.0 if abs(z[0]) + abs(z[1]) < 1e3 else np.nan
        w[Q_S, i], w[Q_E, i], w[X, i], w[Y, i] = finite * z[0], finite * z[1], finite * z[2], finite * z[3]
        w[W_S, i], w[W_E, i], w[V_X, i], w[V_Y, i] = finite * z[4], finite * z[5], finite * z[6], finite * z[7]


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
    law, stretch, middle = np.zeros(2), np.zeros(3), np.zeros(3)
    excitation, active, reflexive = np.zeros(2), np.zeros((3, 2)), np.zeros(GROUP, np.bool_)
    for first in range(0, len(lanes), GROUP):
        n = min(GROUP, len(lanes) - first)
        w = np.zeros((ROWS, GROUP))
        bond, intact = np.zeros((GROUP, 3, lanes[first].limit.shape[1])), np.ones((GROUP, 3))
        last, before = np.zeros((GROUP, 3)), np.zeros((GROUP, 2))
        for i in range(GROUP):  # what is missing in the last group is simulated too, and forgotten
            lane = min(first + i, len(lanes) - 1)
            p = lanes[lane]
            reflexive[i] = False
            for j in range(3):
                reflexive[i] |= p.kv[j] != 0.0 or p.kp[j] != 0.0
                w[K_S + j, i], w[B_S + j, i] = p.k[j], p.b[j]
            lower = p.posture[0] + p.posture[1]
            w[UPPER, i], w[LOWER, i] = p.posture[0], lower
            w[L_H, i], w[L_F, i], w[K_H, i], w[B_H, i] = p.l_h, p.l_f, p.k_h, p.b_h
            w[INERTIA_S, i], w[INERTIA_E, i], w[COUPLING, i] = p.inertia[0], p.inertia[1], p.inertia[2]
            w[M_ENV, i], w[B_ENV, i], w[K_ENV, i] = p.m_env, p.b_env, p.k_env
            # The shoulder's column of the Jacobian has (-y, x) of the hand: so the grip is at rest at the start.
            w[HAND_X, i] = p.l_h * math.cos(p.posture[0]) + p.l_f * math.cos(lower)
            w[HAND_Y, i] = p.l_h * math.sin(p.posture[0]) + p.l_f * math.sin(lower)
            w[: V_Y + 1, i] = start.state[lane]
            displacement[lane, 0] = start.state[lane, 2:4]
        for step in range((n_samples[first : first + n].max() - 1) * decimation):
            for i in range(n):
                lane = first + i
                p, q_s, q_e, w_s, w_e = lanes[lane], w[Q_S, i], w[Q_E, i], w[W_S, i], w[W_E, i]
                stretch[0], stretch[2] = q_s + 0.5 * timestep * w_s, q_e + 0.5 * timestep * w_e
                stretch[1] = stretch[0] + stretch[2]
                middle[0], middle[2] = 1.5 * w_s - 0.5 * before[i, 0], 1.5 * w_e - 0.5 * before[i, 1]
                middle[1] = middle[0] + middle[2]
                before[i, 0], before[i, 1] = w_s, w_e
                _muscles(p, bond[i], intact[i], last[i], stretch, middle, law)
                if reflexive[i]:
                    _excitation(p, q_s, q_e, w_s, w_e, excitation)
                    _reflexes(p, excitation, start.filters[lane], start.motor[lane], step, timestep, active)
                else:
                    active[:] = 0.0
                for j in range(2):
                    w[PUSH_X + j, i] = held[of_lane[lane], step, j]
                    for stage in range(3):
                        w[START_S + 2 * stage + j, i] = active[stage, j] - law[j]
            _advance(w, timestep)
            if (step + 1) % decimation == 0:
                sample = (step + 1) // decimation
                for i in range(n):
                    if sample < n_samples[first + i]:
                        displacement[first + i, sample, 0], displacement[first + i, sample, 1] = w[X, i], w[Y, i]
        for i in range(n):
            start.state[first + i] = w[: V_Y + 1, i]
