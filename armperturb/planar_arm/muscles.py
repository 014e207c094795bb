"""Muscle law and reflexes of eight arms, in vector instructions: what `controllers.compiled.act` does for one."""

from armperturb.arrays import Array
from armperturb.controllers.compiled import between, bond_after, spindle_velocity, thinned_torque
from armperturb.jit import compiled
from armperturb.planar_arm.lanes import GROUP
from armperturb.planar_arm.rows import (
    ACTIVE,
    AFTER,
    BEFORE,
    BOND,
    DAMPING,
    DENOMINATOR,
    DIRECTION,
    ELEMENT,
    EXCITATION,
    FILTER,
    INTACT,
    KP,
    KV,
    KV_GROUP,
    LAST,
    LATE,
    LAW,
    LIMIT,
    LIMIT_SLOPE,
    LOSS,
    NEWER,
    NUMERATOR,
    OLDER,
    PERSISTENCE,
    POSTURE,
    Q_E,
    Q_S,
    REFLEX,
    RING,
    SATURATION,
    SHARE,
    SHORT_RANGE,
    SLOWER,
    STEPS,
    STIFFNESS,
    STRETCH,
    TAKEN,
    THINNING,
    THRESHOLD,
    TORQUE,
    V_BEFORE,
    VELOCITY,
    W_E,
    W_S,
)


@compiled(forceinline=True)
def add_yielding(w: Array, timestep: float) -> None:
    """Add to a group's torques what muscle laws take from springs and dampers over a step; `law_torque` of all lanes.

    Parts are written out and an element's rows lie together, because only innermost loops are vectorised whose rows
    have fixed distances.
    """
    both = LAW + ELEMENT
    for i in range(GROUP):
        for joint in range(2):
            e = LAW + 2 * joint * ELEMENT
            w[e + STRETCH, i] = w[Q_S + joint, i] + 0.5 * timestep * w[W_S + joint, i]
            w[e + VELOCITY, i] = 1.5 * w[W_S + joint, i] - 0.5 * w[V_BEFORE + joint, i]
            w[V_BEFORE + joint, i] = w[W_S + joint, i]
        w[both + STRETCH, i] = w[LAW + STRETCH, i] + w[both + ELEMENT + STRETCH, i]
        w[both + VELOCITY, i] = w[LAW + VELOCITY, i] + w[both + ELEMENT + VELOCITY, i]
    for e in range(LAW, REFLEX, ELEMENT):
        for i in range(GROUP):
            move, speed = w[e + STRETCH, i] - w[e + LAST, i], abs(w[e + VELOCITY, i])
            w[e + LAST, i] = w[e + STRETCH, i]
            survival = 1.0 / (1.0 + abs(move) * w[e + LOSS, i])
            intact, total = w[e + INTACT, i] * survival, 0.0
            w[e + INTACT, i] = 1.0 - (1.0 - intact) * w[e + PERSISTENCE, i]
            move *= intact
            limit = intact * (w[e + LIMIT + 0, i] + w[e + LIMIT_SLOPE + 0, i] * speed)
            w[e + BOND + 0, i] = bond_after(w[e + BOND + 0, i], survival, move, limit)
            total += w[e + BOND + 0, i]
            limit = intact * (w[e + LIMIT + 1, i] + w[e + LIMIT_SLOPE + 1, i] * speed)
            w[e + BOND + 1, i] = bond_after(w[e + BOND + 1, i], survival, move, limit)
            total += w[e + BOND + 1, i]
            limit = intact * (w[e + LIMIT + 2, i] + w[e + LIMIT_SLOPE + 2, i] * speed)
            w[e + BOND + 2, i] = bond_after(w[e + BOND + 2, i], survival, move, limit)
            total += w[e + BOND + 2, i]
            limit = intact * (w[e + LIMIT + 3, i] + w[e + LIMIT_SLOPE + 3, i] * speed)
            w[e + BOND + 3, i] = bond_after(w[e + BOND + 3, i], survival, move, limit)
            total += w[e + BOND + 3, i]
            limit = intact * (w[e + LIMIT + 4, i] + w[e + LIMIT_SLOPE + 4, i] * speed)
            w[e + BOND + 4, i] = bond_after(w[e + BOND + 4, i], survival, move, limit)
            total += w[e + BOND + 4, i]
            limit = intact * (w[e + LIMIT + 5, i] + w[e + LIMIT_SLOPE + 5, i] * speed)
            w[e + BOND + 5, i] = bond_after(w[e + BOND + 5, i], survival, move, limit)
            total += w[e + BOND + 5, i]
            limit = intact * (w[e + LIMIT + 6, i] + w[e + LIMIT_SLOPE + 6, i] * speed)
            w[e + BOND + 6, i] = bond_after(w[e + BOND + 6, i], survival, move, limit)
            total += w[e + BOND + 6, i]
            limit = intact * (w[e + LIMIT + 7, i] + w[e + LIMIT_SLOPE + 7, i] * speed)
            w[e + BOND + 7, i] = bond_after(w[e + BOND + 7, i], survival, move, limit)
            total += w[e + BOND + 7, i]
            thinned = thinned_torque(w[e + VELOCITY, i], w[e + DAMPING, i], w[e + THINNING, i])
            w[e + TAKEN, i] = w[e + SHORT_RANGE, i] * w[e + STRETCH, i] - total * w[e + STIFFNESS, i] + thinned
    for stage in range(3):
        for joint in range(2):
            for i in range(GROUP):
                taken = w[LAW + 2 * joint * ELEMENT + TAKEN, i] + w[both + TAKEN, i]
                w[TORQUE + 2 * stage + joint, i] += taken


@compiled(forceinline=True)
def put_reflexes(w: Array, newest: int) -> None:
    """Put the torques of a group's reflexes in the place of all torques; the reflexes of `act` of all lanes.

    Samples are gathered lane by lane, as delays differ, so that the rest is vectorised.

    Args:
      w: work, see `RING`.
      newest: where the active torque of this step comes into the ring.
    """
    last = (len(w) - RING) // 2 - 1
    for i in range(GROUP):
        w_s, w_e, both = w[W_S, i], w[W_E, i], w[W_S, i] + w[W_E, i]
        # Angles from the posture are rounded as those of MuJoCo's joints.
        q_s = w[POSTURE, i] + w[Q_S, i] - w[POSTURE, i]
        q_e = w[POSTURE + 1, i] + w[Q_E, i] - w[POSTURE + 1, i]
        shoulder = w[KV, i] * w_s + w[KV + 1, i] * w_e + w[KP, i] * q_s + w[KP + 1, i] * q_e
        elbow = w[KV + 1, i] * w_s + w[KV + 2, i] * w_e + w[KP + 1, i] * q_s + w[KP + 2, i] * q_e
        answered = spindle_velocity(w_s, w[SATURATION, i], w[DIRECTION, i], w[THRESHOLD, i])
        shoulder += w[KV_GROUP, i] * (answered - w_s)
        answered = spindle_velocity(both, w[SATURATION + 1, i], w[DIRECTION + 1, i], w[THRESHOLD + 1, i])
        missing = w[KV_GROUP + 1, i] * (answered - both)
        elbow += missing
        answered = spindle_velocity(w_e, w[SATURATION + 2, i], w[DIRECTION + 2, i], w[THRESHOLD + 2, i])
        elbow += w[KV_GROUP + 2, i] * (answered - w_e)
        w[EXCITATION, i], w[EXCITATION + 1, i] = shoulder + missing, elbow
    for joint in range(2):
        for i in range(GROUP):
            excitation = w[EXCITATION + joint, i]
            active = w[NUMERATOR + joint, i] * excitation + w[FILTER + joint, i]
            w[ACTIVE + joint, i] = active
            faster = w[NUMERATOR + 2 + joint, i] * excitation - w[DENOMINATOR + 2 + joint, i] * active
            w[FILTER + joint, i] = faster + w[SLOWER + joint, i]
            w[SLOWER + joint, i] = w[NUMERATOR + 4 + joint, i] * excitation - w[DENOMINATOR + 4 + joint, i] * active
    for joint in range(2):
        for i in range(GROUP):
            w[RING + 2 * newest + joint, i] = w[ACTIVE + joint, i]
            w[TORQUE + joint, i] = -w[LATE + 2 + joint, i]
    for motor in range(4):
        for i in range(GROUP):
            first = newest - int(w[STEPS + motor, i]) - 2
            for sample in range(4):
                w[BEFORE + 4 * sample + motor, i] = w[RING + 2 * ((first + sample) & last) + motor % 2, i]
    for motor in range(4):
        for i in range(GROUP):
            before, older = w[BEFORE + motor, i], w[OLDER + motor, i]
            newer, after = w[NEWER + motor, i], w[AFTER + motor, i]
            w[LATE + motor, i] = between(before, older, newer, after, w[SHARE + motor, i])
            w[TORQUE + 2 + motor, i] = -w[LATE + motor, i]
