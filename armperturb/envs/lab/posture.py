"""Where an arm starts: the posture that is asked for, and the activations that hold it."""

import fnmatch
from collections.abc import Collection, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space
from scipy.optimize import lsq_linear

from armperturb.arrays import Array, Indices

REACHED = 1e-6
"""Distance within which a hand is at the handle, and a constraint of the model holds [m, rad]."""

POSE_STEPS = 300
"""Newton steps that a posture may take; each moves no joint by more than `LONGEST_STEP`."""

LONGEST_STEP = 0.2
"""[rad, m]"""

SHORT = 1e-4
"""Weight of a joint's movement beside the hand's distance from the handle, where joints are at the end of their range
[m/rad]."""

SCALAR = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
"""Kinds of joints that have one coordinate."""

IDLE = 1e-9
"""Moment arm at or below which a muscle does not move a joint [m]."""

MUSCLE_WEIGHT = 1e-2
"""Torque [Nm] that counts as much as one muscle's deviation by 1 from the activation that is asked for."""


def lock_joints(spec: mujoco.MjSpec, patterns: Sequence[str], posture: Mapping[str, ArrayLike]) -> mujoco.MjSpec:
    """A copy of a model without some of its joints, which stay where they are in a posture.

    Args:
      spec: the model.
      patterns: names of joints, with "*" for any text.
      posture: joint to angle [rad] or displacement [m], or to all coordinates of a ball or a free joint; the others
        are as the model has them.

    Raises:
      ValueError: a pattern matches no joint, only some of those between two bodies, or one over which a fixed tendon
        goes.
    """
    spec = spec.copy()
    for key in list(spec.keys):  # it would have too many positions
        spec.delete(key)
    model = spec.compile()
    data = mujoco.MjData(model)
    names = [model.joint(j).name for j in range(model.njnt)]
    locked: set[str] = set()
    for pattern in patterns:
        matched = fnmatch.filter(names, pattern)
        if not matched:
            raise ValueError(f"lock = {pattern!r}; expected some of the model's joints: {listed(names)}")
        locked |= set(matched)
    for tendon in spec.tendons:
        for wrap in tendon.path:
            if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT and wrap.target.name in locked:
                raise ValueError(
                    f"lock: fixed tendon {tendon.name!r} goes over joint {wrap.target.name!r}; expected joints over "
                    "which only spatial tendons go"
                )
    for name, value in posture.items():
        data.joint(name).qpos = value
    mujoco.mj_kinematics(model, data)
    for body in {spec.joint(name).parent.id: spec.joint(name).parent for name in sorted(locked)}.values():
        left = [joint.name for joint in body.joints if joint.name not in locked]
        if left:
            raise ValueError(
                f"lock: body {body.name!r} would keep {listed(left)}; expected all joints of a body or none of them"
            )
        if body.frame is not None:  # what follows is in the frame of the parent
            body.set_frame(body.parent.add_frame())
        parent = model.body_parentid[body.id]
        back, turned, shifted = np.empty(4), np.empty(4), np.empty(3)
        mujoco.mju_negQuat(back, data.xquat[parent])
        mujoco.mju_mulQuat(turned, back, data.xquat[body.id])
        mujoco.mju_rotVecQuat(shifted, data.xpos[body.id] - data.xpos[parent], back)
        for joint in list(body.joints):
            spec.delete(joint)
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        body.pos, body.quat = shifted, turned
    for equality in list(spec.equalities):
        if {equality.name1, equality.name2} & locked:
            spec.delete(equality)
    return _without_idle_muscles(spec)


def _without_idle_muscles(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """The model without muscles on tendons that no joint moves, which take time and do nothing."""
    model = spec.compile()
    data = mujoco.MjData(model)
    moved = np.zeros(model.nu, dtype=bool)
    for bend in (0.0, 0.3, -0.3):  # [rad]; some moment arms are zero in one posture
        data.qpos[:] = model.qpos0 + bend
        mujoco.mj_fwdPosition(model, data)
        moved |= np.abs(_moments(model, data)).max(axis=1, initial=0.0) > IDLE
    for muscle in [spec.actuators[i] for i in muscles_of(model) if not moved[i]]:
        tendon = spec.tendon(muscle.target)
        spec.delete(muscle)
        if tendon is not None:
            spec.delete(tendon)
    return spec


def _moments(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Moment arms of actuators [m], (actuator, dof)."""
    moments = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return moments


def take_posture(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    posture: Mapping[str, ArrayLike],
    held: Collection[str],
    hand: int,
    handle: Array | None,
) -> None:
    """Move an arm to where its constraints hold and, if that is asked for, its hand is at the handle.

    Args:
      model: of the arm alone.
      data: whose positions change.
      posture: joint to where it starts, as in `lock_joints`; joints move as little as they must.
      held: joints of the posture that only move for a handle.
      hand: id of its site.
      handle: where the hand has to be [m], (3,); None for wherever the posture puts it.

    Raises:
      ValueError: constraints contradict the posture, or the hand cannot reach the handle.
    """
    for name, value in posture.items():
        data.joint(name).qpos = value
    given = np.array([model.joint(name).dofadr[0] for name in held if handle is None], dtype=int)
    free = np.setdiff1d(np.arange(model.nv), given)
    sparse, model.opt.jacobian = model.opt.jacobian, mujoco.mjtJacobian.mjJAC_DENSE
    error = _approach(model, data, free, hand, handle)
    if len(error) and np.abs(error).max() >= REACHED:
        # A straight arm at the end of its range does not bend by itself.
        joints = _bounded(model, free)
        data.qpos[model.jnt_qposadr[joints]] = model.jnt_range[joints].mean(axis=1)
        error = _approach(model, data, free, hand, handle)
    model.opt.jacobian = sparse
    if len(error) and np.abs(error).max() >= REACHED:
        if handle is not None and np.abs(error[-3:]).max() >= REACHED:
            away = float(np.linalg.norm(error[-3:]))
            raise ValueError(
                f"Laboratory: handle = {np.round(handle, 4).tolist()} m; expected a point that the hand can reach "
                f"(the nearest that it came to is {away:.3g} m away)"
            )
        shown = {name: np.round(np.asarray(value), 4).tolist() for name, value in posture.items()}
        raise ValueError(
            f"Laboratory: posture = {shown}; expected one in which the model's equality constraints hold (they are off "
            f"by {np.abs(error).max():.2g})"
        )
    mujoco.mj_forward(model, data)


def _approach(model: mujoco.MjModel, data: mujoco.MjData, free: Indices, hand: int, handle: Array | None) -> Array:
    """Newton steps to where constraints hold and the hand is at the handle; returns what is left of the way.

    Joints stay within their ranges.

    Args:
      model: of the arm alone, whose Jacobian is dense.
      data: whose positions change.
      free: degrees of freedom that may move.
      hand: id of its site.
      handle: where the hand has to be [m], (3,); None for anywhere.
    """
    error = np.zeros(0)
    bounded = _bounded(model, free)
    limits = model.jnt_range[bounded]
    for _ in range(POSE_STEPS):
        mujoco.mj_fwdPosition(model, data)
        jacobian, error = constraint_rows(model, data)
        if handle is not None:
            of_hand = np.zeros((3, model.nv))
            mujoco.mj_jacSite(model, data, of_hand, None, hand)
            jacobian = np.vstack([jacobian, of_hand])
            error = np.concatenate([error, data.site_xpos[hand] - handle])
        if not len(error) or np.abs(error).max() < REACHED:
            break
        move = np.zeros(model.nv)
        move[free] = -np.linalg.lstsq(jacobian[:, free], error, rcond=1e-6)[0]
        move *= min(1.0, LONGEST_STEP / max(np.abs(move).max(), 1e-300))
        left = limits - data.qpos[model.jnt_qposadr[bounded], None]
        bends = move[model.jnt_dofadr[bounded]]
        if ((bends < left[:, 0]) | (bends > left[:, 1])).any():
            low, high = np.full((2, model.nv), LONGEST_STEP) * [[-1.0], [1.0]]
            low[model.jnt_dofadr[bounded]], high[model.jnt_dofadr[bounded]] = np.clip(
                left, -LONGEST_STEP, LONGEST_STEP
            ).T
            # Of all moves that reach as near, a short one.
            matrix = np.vstack([jacobian[:, free], SHORT * np.eye(len(free))])
            target = np.concatenate([-error, np.zeros(len(free))])
            between = low[free], np.maximum(high, low + 1e-12)[free]
            move[free] = lsq_linear(matrix, target, between).x
        mujoco.mj_integratePos(model, data.qpos, move, 1.0)
    return error


def constraint_rows(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array]:
    """Jacobian (row, dof) and error (row,) of equality constraints, of a model whose Jacobian is dense."""
    rows = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    jacobian = np.reshape(data.efc_J, (-1, model.nv))[: data.nefc]
    return jacobian[rows].copy(), data.efc_pos[: data.nefc][rows].copy()


def scalar_joints(model: mujoco.MjModel) -> Indices:
    """Ids of the joints that have one coordinate: hinges and slides."""
    return np.flatnonzero(np.isin(model.jnt_type, [int(kind) for kind in SCALAR]))


def _bounded(model: mujoco.MjModel, free: Indices) -> Indices:
    """Ids of the joints of one coordinate that have a range and may move, as their degree of freedom is free."""
    joints = scalar_joints(model)
    return joints[model.jnt_limited[joints].astype(bool) & np.isin(model.jnt_dofadr[joints], free)]


def muscles_of(model: mujoco.MjModel) -> Indices:
    """Ids of the actuators that are muscles."""
    return np.flatnonzero(model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE)


def set_activation(model: mujoco.MjModel, data: mujoco.MjData, activation: Array) -> None:
    """Activate muscles, at once and for good [-], (muscle,) in the order of `muscles_of`."""
    for muscle, value in zip(muscles_of(model), activation, strict=True):
        data.ctrl[muscle] = value
        if model.actuator_actnum[muscle]:
            data.act[model.actuator_actadr[muscle] + model.actuator_actnum[muscle] - 1] = value


def holding_activation(model: mujoco.MjModel, data: mujoco.MjData, level: float) -> Array:
    """The activations nearest to a level at which muscles hold the posture as well as they can [-], (muscle,).

    A muscle at rest pulls with a force that is linear in its activation: the torques that constraints do not take are
    least squares, in which a muscle's deviation from the level counts little.

    Args:
      model: of the arm alone.
      data: in its posture.
      level: of co-contraction [-], 0 to 1.
    """
    muscles = muscles_of(model)
    forces = []
    sparse, model.opt.jacobian = model.opt.jacobian, mujoco.mjtJacobian.mjJAC_DENSE
    for value in (0.0, 1.0):
        set_activation(model, data, np.full(len(muscles), value))
        mujoco.mj_forward(model, data)
        forces.append(data.actuator_force[muscles].copy())
    moments = _moments(model, data)
    others = data.qfrc_actuator - forces[1] @ moments[muscles] + data.qfrc_passive - data.qfrc_bias
    constraints = constraint_rows(model, data)[0]
    model.opt.jacobian = sparse
    free = null_space(constraints) if len(constraints) else np.eye(model.nv)
    torque = free.T @ (moments[muscles].T * (forces[1] - forces[0]))
    needed = -free.T @ (others + forces[0] @ moments[muscles])
    matrix = np.vstack([torque, MUSCLE_WEIGHT * np.eye(len(muscles))])
    solution = lsq_linear(matrix, np.concatenate([needed, np.full(len(muscles), MUSCLE_WEIGHT * level)]), (0.0, 1.0))
    activation = np.asarray(solution.x)
    set_activation(model, data, activation)
    return activation


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names for a message, the first ones of many."""
    shown = [name for name in names if name]
    return ", ".join(shown[:most]) + (f" and {len(shown) - most} more" if len(shown) > most else "")
