"""One step of muscle law and reflexes of one arm, compiled: the one form in which all simulations have them.

The linear part of the muscles, and the short-range stiffness as it is before it yields, are springs and dampers of the
model: what is held over a step is only what yielding takes from them. Functions take a row of `lanes.control_columns`
and a row of its memory, which they change. docs/muscle.md has the equations, symbols and literature of the muscle law.
"""

import math
from typing import Any

import numpy as np

from armperturb.arrays import Array
from armperturb.controllers.lanes import Table
from armperturb.jit import compiled

Lane = Any
"""A row of `lanes.control_columns`: compiled code knows its fields, type checkers do not."""

Memory = Any
"""A row of `lanes.control_memory`, likewise."""


@compiled(forceinline=True)
def bond_after(bond: float, survival: float, move: float, limit: float) -> float:
    """Strain of a part's bonds after a step [rad]: some let go, the others are stretched, up to the elastic limit."""
    return min(max(bond * survival + move, -limit), limit)


@compiled(forceinline=True)
def thinned_torque(velocity: float, damping: float, thinning: float) -> float:
    """What shear thinning takes from the torque of a linear damper [Nm]."""
    thinned = abs(velocity) * thinning
    return damping * velocity * (thinned / (1.0 + thinned))


@compiled(forceinline=True)
def law_torque(p: Lane, m: Memory, stretch: Array, velocity: Array, out: Array) -> None:
    """One step of the muscle law: the torque with which elements oppose stretch, beside the linear spring and damper.

    Bonds that movement breaks let go of their torque; bonds that rest forms are unstrained, so that recovery changes
    no torque. The stored energy, the sum over parts of stiffness x bond^2 / (2 x intact), never grows by more than the
    work that is done on the element and its linear damper.

    Args:
      p: the person.
      m: memory; `bond`, `intact` and `stretch` change.
      stretch: of the elements at this step [rad], (element,).
      velocity: of the elements at this step [rad/s], (element,).
      out: torque of the elements [Nm], (element,), to fill.

    Source: Iwan (1966) for the parallel elasto-plastic parts, thesis F.1 for limits that grow with speed; the rest in
    docs/muscle.md.
    """
    for element in range(3):
        move = stretch[element] - m.stretch[element]
        m.stretch[element] = stretch[element]
        speed = abs(velocity[element])
        survival = 1.0 / (1.0 + abs(move) * p.loss[element])
        intact = m.intact[element] * survival
        total = 0.0
        for part in range(p.limit.shape[1]):
            limit = intact * (p.limit[element, part] + p.limit_slope[element, part] * speed)
            bond = bond_after(m.bond[element, part], survival, intact * move, limit)
            m.bond[element, part] = bond
            total += bond
        m.intact[element] = 1.0 - (1.0 - intact) * p.persistence[element]
        out[element] = total * p.part_stiffness[element]
        out[element] -= thinned_torque(velocity[element], p.damping_groups[element], p.thinning[element])


@compiled(forceinline=True)
def spindle_velocity(velocity: float, saturation: float, direction: float, threshold: float) -> float:
    """Velocity that linear spindles would have to see to fire as these do [rad/s].

    An element is a pair of antagonists, one of which lengthens. The reflex of either is half-wave rectified.

    Args:
      velocity: of the element [rad/s].
      saturation: speed above the threshold at which the response is half of the linear one [rad/s]; inf is linear.
      direction: -1 to 1; the muscle that lengthens in movement against its sign has 1 - |direction| of the response.
      threshold: speed of lengthening at which a muscle's response begins [rad/s]. Below zero the muscle fires at rest,
        and shortening that is faster silences it.

    Source: Kearney, Stein & Parameswaran (1997).
    """
    rest = max(threshold, 0.0)
    up, down = max(velocity, threshold) - rest, max(-velocity, threshold) - rest
    up, down = up / (1.0 + abs(up) / saturation), down / (1.0 + abs(down) / saturation)
    return min(1.0 + direction, 1.0) * up - min(1.0 - direction, 1.0) * down


@compiled(forceinline=True)
def spindle_excitation(p: Lane, q_s: float, q_e: float, w_s: float, w_e: float, out: Array) -> None:
    """Reflexive excitation u_r of both joints by the spindles [Nm], (joint,) (eq. 2.8).

    Each muscle element answers its own velocity, with the velocity feedback of its muscle group (eq. 2.10).

    Args:
      p: the person.
      q_s: angle of the shoulder from the posture [rad].
      q_e: of the elbow [rad].
      w_s: velocity of the shoulder [rad/s].
      w_e: of the elbow [rad/s].
      out: to fill.
    """
    out[0] = p.kv[0] * w_s + p.kv[1] * w_e + p.kp[0] * q_s + p.kp[1] * q_e
    out[1] = p.kv[1] * w_s + p.kv[2] * w_e + p.kp[1] * q_s + p.kp[2] * q_e
    for element in range(3):
        velocity = (w_s, w_s + w_e, w_e)[element]
        missing = p.kv_groups[element] * (
            spindle_velocity(velocity, p.saturation[element], p.direction[element], p.threshold[element]) - velocity
        )
        if element < 2:
            out[0] += missing
        if element > 0:
            out[1] += missing


@compiled(forceinline=True)
def between(before: float, older: float, newer: float, after: float, t: float) -> float:
    """The cubic of MuJoCo's delayed motors, at a share t of the way from the older to the newer of four samples."""
    first, last, rise = 0.5 * (newer - before), 0.5 * (after - older), newer - older
    return older + t * (first + t * (3.0 * rise - 2.0 * first - last + t * (first + last - 2.0 * rise)))


@compiled(forceinline=True)
def delayed(sent: Array, joint: int, newest: int, back: float) -> float:
    """What was sent some steps before the newest sample of a ring, see `between`.

    Args:
      sent: the last samples, (step, joint); one later than wanted, and two earlier, must be among them.
      joint: of which joint.
      newest: where it is in the ring.
      back: how many steps ago, >= 1.
    """
    n, whole = len(sent), math.floor(back + 1e-6)
    place = newest - whole if newest >= whole else newest - whole + n  # a remainder takes far longer
    newer = sent[place, joint]
    if back - whole < 1e-6:
        return newer
    older = sent[place - 1 if place > 0 else n - 1, joint]
    before = sent[place - 2 if place > 1 else place + n - 2, joint]
    after = sent[place + 1 if place + 1 < n else 0, joint]
    return between(before, older, newer, after, 1.0 - (back - whole))


@compiled(forceinline=True)
def _add_memory_reflexes(p: Lane, m: Memory, q: Array, w: Array, muscle: Array, timestep: float) -> None:
    """Add Ka q'' + Kf tau to the excitation (the law of `analysis.arm.linear_arm`).

    The acceleration is the backward difference of fourth order of the velocities. The torque that acts now left the
    activation filter one neural delay ago.

    Args:
      p: the person.
      m: memory.
      q: joint angles from the posture [rad].
      w: joint velocities [rad/s].
      muscle: torque of the muscle law at the start of this step [Nm], (joint,); overwritten by that of all muscles.
      timestep: of the simulation [s].
    """
    for joint in range(2):
        muscle[joint] += delayed(m.sent, joint, m.next, p.delay[joint] / timestep)
        muscle[joint] += p.b[joint] * w[0] + p.b[joint + 1] * w[1] + p.k[joint] * q[0] + p.k[joint + 1] * q[1]
    for other in range(2):
        v = m.velocity[:, other]
        acceleration = (25.0 * w[other] - 48.0 * v[0] + 36.0 * v[1] - 16.0 * v[2] + 3.0 * v[3]) / (12.0 * timestep)
        for joint in range(2):
            m.excitation[joint] += p.ka[joint + other] * acceleration + p.kf[joint + other] * muscle[other]


@compiled(forceinline=True)
def activated(p: Lane, filters: Array, joint: int, excitation: float) -> float:
    """One step of a joint's activation filter: the active torque [Nm] (eq. B.19 as a transposed direct form II).

    Args:
      p: the person.
      filters: state, (2, joint).
      joint: 0 or 1.
      excitation: at this step [Nm].
    """
    active = p.numerator[0, joint] * excitation + filters[0, joint]
    filters[0, joint] = p.numerator[1, joint] * excitation - p.denominator[1, joint] * active + filters[1, joint]
    filters[1, joint] = p.numerator[2, joint] * excitation - p.denominator[2, joint] * active
    return active


@compiled(forceinline=True)
def act(
    p: Lane, m: Memory, angle: Array, velocity: Array, timestep: float, work: Array, held: Array, sent: Array
) -> None:
    """What muscles and reflexes do over a step, beside the springs and dampers of the model.

    A torque that is held over a step acts at its middle: the muscle law sees the motion drawn on to there. Delay and
    activation commute, as both are linear, so the filter comes here and the delay in the motors.

    Args:
      p: the person.
      m: memory, which goes on by a step.
      angle: of the joints at the start of the step [rad], (joint,).
      velocity: of the joints [rad/s], (joint,).
      timestep: of the simulation [s].
      work: room for intermediate results, (4, 3).
      held: torque to hold over the step [Nm], (joint,), to fill.
      sent: what the reflexes send to the motors, which delay it [Nm], (joint,), to fill.
    """
    q, stretch, middle, torque = work[0], work[1], work[2], work[3]
    q[0], q[1] = angle[0] - p.posture[0], angle[1] - p.posture[1]
    held[0] = held[1] = 0.0
    if p.lawful != 0.0:
        stretch[0], stretch[2] = q[0] + 0.5 * timestep * velocity[0], q[1] + 0.5 * timestep * velocity[1]
        middle[0] = 1.5 * velocity[0] - 0.5 * m.velocity[0, 0]
        middle[2] = 1.5 * velocity[1] - 0.5 * m.velocity[0, 1]
        stretch[1], middle[1] = stretch[0] + stretch[2], middle[0] + middle[2]
        law_torque(p, m, stretch, middle, torque)
        for joint in range(2):
            m.law_before[joint] = m.law[joint]
            m.law[joint] = torque[2 * joint] + torque[1]
            held[joint] = p.short_range[2 * joint] * stretch[2 * joint] + p.short_range[1] * stretch[1] - m.law[joint]
    if p.reflexive != 0.0:
        spindle_excitation(p, q[0], q[1], velocity[0], velocity[1], m.excitation)
        if p.remembering != 0.0:
            for joint in range(2):  # halfway between two torques that are held is that at the start of the step
                torque[joint] = 0.5 * (m.law[joint] + m.law_before[joint])
            _add_memory_reflexes(p, m, q, velocity, torque, timestep)
        for joint in range(2):
            active = activated(p, m.filters, joint, m.excitation[joint])
            m.sent[m.next, joint] = active
            sent[joint] = -active
        m.next = m.next + 1 if m.next + 1 < len(m.sent) else 0
    if p.commanded != 0.0:
        for joint in range(2):
            held[joint] += activated(p, m.command_filters, joint, m.command[joint])
    if p.remembering != 0.0:
        for age in range(3, 0, -1):
            for joint in range(2):
                m.velocity[age, joint] = m.velocity[age - 1, joint]
    for joint in range(2):
        m.velocity[0, joint] = velocity[joint]


@compiled(nogil=True)
def act_all(
    table: Table, memory: Table, angle: Array, velocity: Array, timestep: float, held: Array, sent: Array
) -> None:
    """`act` of many arms; arrays have the arm as first axis."""
    work = np.zeros((4, 3))
    for lane in range(len(table)):
        act(table[lane], memory[lane], angle[lane], velocity[lane], timestep, work, held[lane], sent[lane])


@compiled(nogil=True)
def stretch_all(table: Table, memory: Table, stretch: Array, velocity: Array, torque: Array) -> None:
    """`law_torque` of many arms whose elements are moved by hand; arrays are (step, arm, element)."""
    for lane in range(len(table)):
        for step in range(len(stretch)):
            law_torque(table[lane], memory[lane], stretch[step, lane], velocity[step, lane], torque[step, lane])
