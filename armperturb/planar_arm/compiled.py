"""Compiled simulation of planar arms on their manipulators, each independent of the others (thesis eq. 2.17, B.1).

The arm is that of the MJCF model: two rigid segments that turn about a fixed shoulder, linear intrinsic muscle, and a
grip that is a spring and damper between hand and handle. Muscle law and reflexes are those of `controllers.compiled`.
MuJoCo is the reference in tests: at the same step, displacements agree within 2e-4 of the largest.
"""

import math

import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.compiled import Lane, Memory, act, delayed
from armperturb.controllers.lanes import PARTS, Table
from armperturb.jit import compiled
from armperturb.planar_arm.lanes import GROUP, Start
from armperturb.planar_arm.muscles import add_yielding, put_reflexes
from armperturb.planar_arm.rows import (
    B_E,
    B_ENV,
    B_H,
    B_S,
    B_SE,
    BOND,
    COUPLING,
    DAMPING,
    DENOMINATOR,
    DIRECTION,
    ELEMENT,
    EXCITATION,
    FILTER,
    HAND_X,
    HAND_Y,
    INERTIA_E,
    INERTIA_S,
    INTACT,
    K_E,
    K_ENV,
    K_H,
    K_S,
    K_SE,
    KP,
    KV,
    KV_GROUP,
    L_F,
    L_H,
    LAST,
    LATE,
    LAW,
    LIMIT,
    LIMIT_SLOPE,
    LOSS,
    LOWER,
    M_ENV,
    NUMERATOR,
    PERSISTENCE,
    POSTURE,
    PUSH,
    Q_E,
    Q_S,
    RING,
    SATURATION,
    SHARE,
    SHORT_RANGE,
    SLOWER,
    STEPS,
    STIFFNESS,
    THINNING,
    THRESHOLD,
    TORQUE,
    UPPER,
    V_BEFORE,
    V_X,
    V_Y,
    W_E,
    W_S,
    X,
    Y,
)

State = tuple[float, ...]

PI_REMAINDER = 1.2246467991473532e-16
"""What pi has beyond its nearest number."""


@compiled(forceinline=True)
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


@compiled(forceinline=True)
def _turned(sine: float, cosine: float, by: float) -> tuple[float, float]:
    """Sine and cosine of an angle that has grown by less than 0.1 rad, to rounding."""
    z = by * by
    grown = by * (1.0 - z * (1.0 / 6.0) * (1.0 - z * (1.0 / 20.0) * (1.0 - z * (1.0 / 42.0))))
    left = 1.0 - 0.5 * z * (1.0 - z * (1.0 / 12.0) * (1.0 - z * (1.0 / 30.0) * (1.0 - z * (1.0 / 56.0))))
    return sine * left + cosine * grown, cosine * left - sine * grown


@compiled(forceinline=True)
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


@compiled(forceinline=True)
def _slope(w: Array, i: int, z: State, upper: State, lower: State, torque: State, push: State) -> State:
    """Derivative of (q_s, q_e, x, y, their velocities), q from the posture and x from the start.

    Args:
      w: work, see `RING`.
      i: lane.
      z: the state.
      upper: sine and cosine of the upper arm's angle.
      lower: of the forearm's.
      torque: on the joints beside that of springs and dampers [Nm], at this moment of the step.
      push: on the handle [N], likewise.
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
    t_s = torque[0] + s_x * f_x + s_y * f_y + swirl * w_e * (2.0 * w_s + w_e)
    t_s -= w[K_S, i] * q_s + w[K_SE, i] * q_e + w[B_S, i] * w_s + w[B_SE, i] * w_e
    t_e = torque[1] + e_x * f_x + e_y * f_y - swirl * w_s * w_s
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
        (push[0] - f_x - w[B_ENV, i] * v_x - w[K_ENV, i] * x) / w[M_ENV, i],
        (push[1] - f_y - w[B_ENV, i] * v_y - w[K_ENV, i] * y) / w[M_ENV, i],
    )


@compiled(forceinline=True)
def _advance(w: Array, timestep: float) -> None:
    """One step of Runge-Kutta 4 of all lanes of a group; NaN where an arm diverges.

    The compiler makes one vector instruction of the lanes' scalar ones, as long as all that they touch is one array.
    """
    half = 0.5 * timestep
    for i in range(GROUP):
        z: State = (w[Q_S, i], w[Q_E, i], w[X, i], w[Y, i], w[W_S, i], w[W_E, i], w[V_X, i], w[V_Y, i])
        torque, push = (w[TORQUE, i], w[TORQUE + 1, i]), (w[PUSH, i], w[PUSH + 1, i])
        upper = _sine_and_cosine(w[UPPER, i] + z[0])
        lower = _sine_and_cosine(w[LOWER, i] + z[0] + z[1])
        first = _slope(w, i, z, upper, lower, torque, push)
        torque, push = (w[TORQUE + 2, i], w[TORQUE + 3, i]), (w[PUSH + 2, i], w[PUSH + 3, i])
        d_u, d_l = half * z[4], half * (z[4] + z[5])
        there = _moved(z, first, half)
        turned = _turned(upper[0], upper[1], d_u), _turned(lower[0], lower[1], d_l)
        second = _slope(w, i, there, turned[0], turned[1], torque, push)
        d_u, d_l = half * there[4], half * (there[4] + there[5])
        there = _moved(z, second, half)
        turned = _turned(upper[0], upper[1], d_u), _turned(lower[0], lower[1], d_l)
        third = _slope(w, i, there, turned[0], turned[1], torque, push)
        torque, push = (w[TORQUE + 4, i], w[TORQUE + 5, i]), (w[PUSH + 4, i], w[PUSH + 5, i])
        d_u, d_l = timestep * there[4], timestep * (there[4] + there[5])
        there = _moved(z, third, timestep)
        turned = _turned(upper[0], upper[1], d_u), _turned(lower[0], lower[1], d_l)
        fourth = _slope(w, i, there, turned[0], turned[1], torque, push)
        z = _moved(z, first, timestep / 6.0)
        z = _moved(z, second, timestep / 3.0)
        z = _moved(z, third, timestep / 3.0)
        z = _moved(z, fourth, timestep / 6.0)
        finite = 1.0 if abs(z[0]) + abs(z[1]) < 1e3 else np.nan
        w[Q_S, i], w[Q_E, i], w[X, i], w[Y, i] = finite * z[0], finite * z[1], finite * z[2], finite * z[3]
        w[W_S, i], w[W_E, i], w[V_X, i], w[V_Y, i] = finite * z[4], finite * z[5], finite * z[6], finite * z[7]


@compiled(forceinline=True)
def _is_grouped(p: Lane) -> bool:
    """Whether a lane's reflexes are computed in its group: not with what the rest of `act` does for it alone."""
    return p.reflexive != 0.0 and p.remembering == 0.0 and p.lawful == 0.0 and p.commanded == 0.0


@compiled()
def _load(lanes: Table, start: Start, first: int, timestep: float, w: Array) -> tuple[int, int]:
    """Put a group's states and constants where `_advance` wants them; the last group is filled with its last lane.

    Returns:
      How many lanes have reflexes, and how many a muscle law, that the group computes.
    """
    n_reflexive, n_lawful = 0, 0
    for i in range(GROUP):
        lane = min(first + i, len(lanes) - 1)
        p = lanes[lane]
        for j in range(3):
            w[K_S + j, i], w[B_S + j, i] = p.k[j] + p.short_range[1], p.b[j]
        # Before anything yields, the short-range stiffness of a muscle law is a spring.
        w[K_S, i] += p.short_range[0]
        w[K_E, i] += p.short_range[2]
        lower = p.posture[0] + p.posture[1]
        w[UPPER, i], w[LOWER, i] = p.posture[0], lower
        w[L_H, i], w[L_F, i], w[K_H, i], w[B_H, i] = p.l_h, p.l_f, p.k_h, p.b_h
        w[INERTIA_S, i], w[INERTIA_E, i], w[COUPLING, i] = p.inertia[0], p.inertia[1], p.inertia[2]
        w[M_ENV, i], w[B_ENV, i], w[K_ENV, i] = p.m_env, p.b_env, p.k_env
        # The shoulder's column of the Jacobian has (-y, x) of the hand: so the grip is at rest at the start.
        w[HAND_X, i] = p.l_h * math.cos(p.posture[0]) + p.l_f * math.cos(lower)
        w[HAND_Y, i] = p.l_h * math.sin(p.posture[0]) + p.l_f * math.sin(lower)
        for row in range(V_Y + 1):
            w[row, i] = start.state[lane, row]
        for row in range(V_BEFORE, len(w)):
            w[row, i] = 0.0
        if p.grouped != 0.0:
            n_lawful += 1
            m = start.memory[lane]
            w[V_BEFORE, i], w[V_BEFORE + 1, i] = m.velocity[0, 0], m.velocity[0, 1]
            for j in range(3):
                e = LAW + j * ELEMENT
                w[e + LAST, i], w[e + INTACT, i], w[e + LOSS, i] = m.stretch[j], m.intact[j], p.loss[j]
                w[e + PERSISTENCE, i], w[e + STIFFNESS, i] = p.persistence[j], p.part_stiffness[j]
                w[e + DAMPING, i], w[e + THINNING, i] = p.damping_groups[j], p.thinning[j]
                w[e + SHORT_RANGE, i] = p.short_range[j]
                for part in range(min(PARTS, p.limit.shape[1])):
                    w[e + BOND + part, i], w[e + LIMIT + part, i] = m.bond[j, part], p.limit[j, part]
                    w[e + LIMIT_SLOPE + part, i] = p.limit_slope[j, part]
        for j in range(3):
            w[SATURATION + j, i] = 1.0
        if _is_grouped(p):
            n_reflexive += 1
            m = start.memory[lane]
            for j in range(3):
                w[KV + j, i], w[KP + j, i], w[KV_GROUP + j, i] = p.kv[j], p.kp[j], p.kv_groups[j]
                w[SATURATION + j, i], w[DIRECTION + j, i] = p.saturation[j], p.direction[j]
                w[THRESHOLD + j, i] = p.threshold[j]
            newest = m.next - 1 if m.next > 0 else len(m.sent) - 1
            for joint in range(2):
                w[POSTURE + joint, i] = p.posture[joint]
                w[FILTER + joint, i], w[SLOWER + joint, i] = m.filters[0, joint], m.filters[1, joint]
                for j in range(3):
                    w[NUMERATOR + 2 * j + joint, i] = p.numerator[j, joint]
                    w[DENOMINATOR + 2 * j + joint, i] = p.denominator[j, joint]
                steps = p.delay[joint] / timestep
                w[LATE + 2 + joint, i] = delayed(m.sent, joint, newest, steps - 1.0)
                for half in range(2):
                    back = steps - 0.5 - 0.5 * half
                    whole = math.floor(back + 1e-6)
                    share = 1.0 - (back - whole)
                    if back - whole < 1e-6:  # a sample itself: the older one of two, so that nothing is rounded
                        whole, share = whole - 1, 0.0
                    w[STEPS + 2 * half + joint, i], w[SHARE + 2 * half + joint, i] = whole, share
                for step in range(len(m.sent)):
                    w[RING + 2 * step + joint, i] = m.sent[(m.next + step) % len(m.sent), joint]
    return n_reflexive, n_lawful


@compiled()
def _store(lanes: Table, start: Start, first: int, steps: int, w: Array) -> None:
    """Put where a group ends after so many steps into the start of what may follow."""
    for i in range(min(GROUP, len(lanes) - first)):
        for row in range(V_Y + 1):
            start.state[first + i, row] = w[row, i]
        if lanes[first + i].grouped != 0.0:
            m = start.memory[first + i]
            m.velocity[0, 0], m.velocity[0, 1] = w[V_BEFORE, i], w[V_BEFORE + 1, i]
            for j in range(3):
                e = LAW + j * ELEMENT
                m.stretch[j], m.intact[j] = w[e + LAST, i], w[e + INTACT, i]
                for part in range(min(PARTS, m.bond.shape[1])):
                    m.bond[j, part] = w[e + BOND + part, i]
        if _is_grouped(lanes[first + i]):
            m = start.memory[first + i]
            m.next = 0
            for joint in range(2):
                m.excitation[joint] = w[EXCITATION + joint, i]
                m.filters[0, joint], m.filters[1, joint] = w[FILTER + joint, i], w[SLOWER + joint, i]
                for step in range(len(m.sent)):
                    m.sent[step, joint] = w[RING + 2 * ((steps + step) % len(m.sent)) + joint, i]


@compiled(forceinline=True)
def _acts_alone(p: Lane) -> bool:
    """Whether a lane has anything that its group does not compute."""
    return (p.reflexive != 0.0 or p.lawful != 0.0 or p.commanded != 0.0) and not _is_grouped(p)


@compiled()
def _act(p: Lane, m: Memory, w: Array, i: int, timestep: float, room: Array) -> None:
    """Put what a group does not compute of muscles and reflexes into a lane; `room` is (8, 3) for what is between."""
    angle, velocity, held, sent = room[4], room[5], room[6], room[7]
    for joint in range(2):
        angle[joint], velocity[joint] = p.posture[joint] + w[Q_S + joint, i], w[W_S + joint, i]
    act(p, m, angle, velocity, timestep, room, held, sent)
    newest = m.next - 1 if m.next > 0 else len(m.sent) - 1
    for joint in range(2):
        for stage in range(3):
            torque = held[joint]
            if p.reflexive != 0.0:
                torque -= delayed(m.sent, joint, newest, p.delay[joint] / timestep - 0.5 * stage)
            w[TORQUE + 2 * stage + joint, i] = torque
        w[EXCITATION + joint, i] = m.excitation[joint]


@compiled(nogil=True)
def simulate_lanes(
    lanes: Table,
    start: Start,
    force: Array,
    torque: Array,
    of_lane: Indices,
    n_samples: Indices,
    decimation: int,
    timestep: float,
    displacement: Array,
) -> None:
    """Displacement of the handles from rest [m]; compiled, so types are as said and nothing is checked.

    Args:
      lanes: from `lanes.lane_table`.
      start: of each lane; where they end, too.
      force: on the handle at the start and middle of each step [N], (trial, 2 step + 1, axis).
      torque: on the joints likewise [Nm], (trial, 2 step + 1, joint); of no trials where there is none.
      of_lane: which trial each lane is of, (lane,).
      n_samples: how many samples each lane wants, (lane,).
      decimation: steps per sample.
      timestep: of the simulation [s].
      displacement: to fill, (lane, time, axis); NaN from where a lane diverges.
    """
    n_history = start.memory[0].sent.shape[0]
    w, room = np.zeros((RING + 2 * n_history, GROUP)), np.zeros((8, 3))
    for first in range(0, len(lanes), GROUP):
        n = min(GROUP, len(lanes) - first)
        n_reflexive, n_lawful = _load(lanes, start, first, timestep, w)
        for i in range(n):
            displacement[first + i, 0, 0], displacement[first + i, 0, 1] = w[X, i], w[Y, i]
        steps = (n_samples[first : first + n].max() - 1) * decimation
        for step in range(steps):
            if n_reflexive:
                put_reflexes(w, step & (n_history - 1))
            else:
                w[TORQUE : TORQUE + 6] = 0.0
            for i in range(n):
                if _acts_alone(lanes[first + i]):
                    _act(lanes[first + i], start.memory[first + i], w, i, timestep, room)
                trial = of_lane[first + i]
                for stage in range(3):
                    for axis in range(2):
                        w[PUSH + 2 * stage + axis, i] = force[trial, 2 * step + stage, axis]
                if len(torque):
                    for stage in range(3):
                        for joint in range(2):
                            w[TORQUE + 2 * stage + joint, i] += torque[trial, 2 * step + stage, joint]
            if n_lawful:
                add_yielding(w, timestep)
            _advance(w, timestep)
            if (step + 1) % decimation == 0:
                sample = (step + 1) // decimation
                for i in range(n):
                    if sample < n_samples[first + i]:
                        displacement[first + i, sample, 0], displacement[first + i, sample, 1] = w[X, i], w[Y, i]
        _store(lanes, start, first, steps, w)


@compiled()
def _write(p: Lane, w: Array, i: int, row: Array) -> None:
    """Velocities, displacement, joint angles and force on the hand of a lane, into a row of a log."""
    for j in range(2):
        row[2 + j], row[4 + j], row[6 + j] = w[W_S + j, i], w[X + j, i], p.posture[j] + w[Q_S + j, i]
    upper, lower = w[UPPER, i] + w[Q_S, i], w[LOWER, i] + w[Q_S, i] + w[Q_E, i]
    e_x, e_y = -p.l_f * math.sin(lower), p.l_f * math.cos(lower)
    s_x, s_y = e_x - p.l_h * math.sin(upper), e_y + p.l_h * math.cos(upper)
    slip_x, slip_y = w[X, i] + w[HAND_X, i] - s_y, w[Y, i] + w[HAND_Y, i] + s_x
    row[8] = p.k_h * slip_x + p.b_h * (w[V_X, i] - s_x * w[W_S, i] - e_x * w[W_E, i])
    row[9] = p.k_h * slip_y + p.b_h * (w[V_Y, i] - s_y * w[W_S, i] - e_y * w[W_E, i])


@compiled(nogil=True)
def log_lanes(lanes: Table, start: Start, known: Array, timestep: float, log: Array) -> None:
    """All signals at the start of each step, as `envs.lab.stepping.advance` logs them of MuJoCo's arms.

    Args:
      lanes: from `lanes.lane_table`.
      start: of each lane; where they end, too.
      known: torque on the joints [Nm] and force on the handle [N] at the start and middle of each step, (lane, 2 step +
        1, motor).
      timestep: of the simulation [s].
      log: reflexive excitation, joint velocity, displacement of the handle, joint angle, and force of the handle on the
        hand, to fill, (lane, step + 1, 10); the last row is that of the end of the last step, but for excitation and
        force, which are those of a step before.
    """
    n_history = start.memory[0].sent.shape[0]
    w, room = np.zeros((RING + 2 * n_history, GROUP)), np.zeros((8, 3))
    for first in range(0, len(lanes), GROUP):
        n = min(GROUP, len(lanes) - first)
        n_reflexive, n_lawful = _load(lanes, start, first, timestep, w)
        for step in range(log.shape[1]):
            for i in range(n):
                _write(lanes[first + i], w, i, log[first + i, step])
            if step == log.shape[1] - 1:
                for i in range(n):
                    for j in (0, 1, 8, 9):
                        log[first + i, step, j] = log[first + i, step - 1, j]
                break
            if n_reflexive:
                put_reflexes(w, step & (n_history - 1))
            else:
                w[TORQUE : TORQUE + 6] = 0.0
            for i in range(n):
                if _acts_alone(lanes[first + i]):
                    _act(lanes[first + i], start.memory[first + i], w, i, timestep, room)
                for j in range(2):
                    log[first + i, step, j] = w[EXCITATION + j, i]
                    for stage in range(3):
                        w[TORQUE + 2 * stage + j, i] += known[first + i, 2 * step + stage, j]
                        w[PUSH + 2 * stage + j, i] = known[first + i, 2 * step + stage, 2 + j]
            if n_lawful:
                add_yielding(w, timestep)
            _advance(w, timestep)
        _store(lanes, start, first, log.shape[1] - 1, w)
