"""Trials as an arm would have given them whose Jacobian stays that of its start posture.

An arm with linear muscles is not linear from force to displacement: when it moves by some centimetres, the moments of
a force about its joints change, and the hand moves on circles. Both are known from segment lengths and posture. With q
= rotations of the joints, J = Jacobian at each instant, J_0 = that at the start, x = displacement of the handle, f =
force on the hand, d = disturbance and E = m s^2 + b s + k of the manipulator,

    x' = J_0 q,      f' = J_0^-T J^T f,      d' = d + (f' - f) + E (x' - x).

The torque J^T f of the muscles and q are those that were recorded, so that stiffness, damping and reflexes are exactly
those of a linear arm from f' to x', and d' - f' moves the manipulator by x'. What is left is that the inertia of the
joints depends on the elbow, and centripetal torques. The hand is taken to be where the handle is: the grip gives way by
less than a millimetre.
"""

from dataclasses import replace

import numpy as np

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.measures.kinematics import CUTOFF, hand_path, joint_rotations, joint_velocities
from armperturb.analysis.trials import ConditionTrials, Trials, prepared
from armperturb.arrays import Array


def in_start_geometry(trials: Trials) -> ConditionTrials:
    """Trials of one person in one condition without what the geometry of the moving arm makes nonlinear.

    Args:
      trials: of an arm whose segments turn, as those of people do. A simulated linear arm's would get worse.

    Returns:
      Trials with manipulator and instruments' noise of the given ones.

    Raises:
      ValueError: a handle is out of the arm's reach, or as `ConditionTrials.instruments`.
    """
    ready = prepared(trials)
    start, environment, rate = hand_jacobian(ready.body), ready.environment, ready.rate
    hand, rotations = hand_path(ready.recording), joint_rotations(ready.recording)
    shoulder = ready.body.posture[0] + rotations[..., 0]
    elbow = ready.body.l_h * np.stack([np.cos(shoulder), np.sin(shoulder)], axis=-1)
    torque = np.stack([_moment(arm, ready.force) for arm in (hand, hand - elbow)], axis=-1)
    force, displacement = torque @ np.linalg.inv(start), rotations @ start.T
    excess = displacement - ready.recorded_displacement
    velocity = joint_velocities(excess, rate, cutoff=CUTOFF if rate / 2 > CUTOFF else None)
    acceleration = joint_velocities(velocity, rate, cutoff=None)
    balance = environment.m_env * acceleration + environment.b_env * velocity + environment.k_env * excess
    signals = {
        "perturbation": ready.perturbation + force - ready.force + balance,
        "force": force,
        "displacement": displacement,
    }
    changed = {name: ready.recording[name].copy(data=values) for name, values in signals.items()}
    return replace(ready, recording=ready.recording.assign(changed), given=ready.instruments)


def _moment(arm: Array, force: Array) -> Array:
    return np.asarray(arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0])
