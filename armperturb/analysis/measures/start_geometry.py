"""Trials as an arm would have given them whose Jacobian stays that of its start posture.

An arm with linear muscles is not linear from force to displacement: when it moves by some centimetres, the moments of
a force about its joints change, and the hand moves on circles. Both are known from segment lengths and posture. With q
= rotations of the joints, J = Jacobian at each instant, J_0 = that at the start, x = displacement of the handle, f =
force on the hand, d = disturbance and E = m s^2 + b s + k of the manipulator,

    x' = J_0 q,      f' = J_0^-T J^T f,      d' = d + (f' - f) + E (x' - x).

The torque J^T f of the muscles and q are those that were recorded, so that stiffness, damping and reflexes are exactly
those of a linear arm from f' to x', and d' - f' moves the manipulator by x'. Of a constant force f_0, the linear part
(d(J^T f_0)/dq) q of what its moments change by is subtracted from the torque, so that the stiffness is that under this
force, as it is of trials as recorded (`measures.endpoint`).

Two more things are known once the arm has been estimated. Its grip G gives way by G (f - f_0), where f_0 is the
constant force that is held in the start posture, so that the hand is at x - G (f - f_0) and x' = J_0 q + G (f' - f_0).
And the inertia of its joints depends on the elbow angle theta, by the coupling c of the segments: what the torque of
the start posture's inertia lacks,

    tau = c (cos theta - cos theta_0) [2 q_s'' + q_e'', q_s''] + c sin theta [-(2 q_s' + q_e') q_e', q_s'^2],

is subtracted from J^T f. c is the difference of the inertia's off-diagonal and the elbow's over cos theta_0. Near a
right angle, where that says nothing, it is what anthropometric tables make of the elbow's inertia.

d' depends on the person's noise, as f' - f and x' - x do. What is to be free of that noise is regressed on d, which is
kept beside d'.
"""

from dataclasses import replace

import numpy as np
from scipy import signal

from armperturb.analysis.arm.geometry import COUPLING, force_stiffness, hand_jacobian, mass_matrix
from armperturb.analysis.manipulator import manipulator_covariance
from armperturb.analysis.measures.kinematics import CUTOFF, hand_path, joint_rotations, joint_velocities
from armperturb.analysis.start import HELD, constant_force
from armperturb.analysis.trials import ConditionTrials, Trials, prepared
from armperturb.arrays import Array
from armperturb.subject import Subject

APPLIED = "applied_perturbation"
"""Variable of a recording in the start geometry that holds d."""

LEAST_LAG = 1e-6
"""Time constant of a grip without damping, as a share of a sample [-]."""

COUPLING_ERROR, INERTIA_ERROR = 0.15, 0.003
"""How far people are from that, and the difference of estimated inertias from the truth over the elbow's [-]."""


def in_start_geometry(trials: Trials, arm: Subject | None = None) -> ConditionTrials:
    """Trials of one person in one condition without what the geometry of the moving arm makes nonlinear.

    Args:
      trials: of an arm whose segments turn, as those of people do. A simulated linear arm's would get worse.
      arm: an estimate of it, whose grip and joint inertia are used; None for a rigid grip and an inertia that does not
        depend on the posture.

    Returns:
      Trials with manipulator and instruments' noise of the given ones.

    Raises:
      ValueError: a handle is out of the arm's reach, or as `ConditionTrials.instruments`.
    """
    ready = prepared(trials)
    start, environment, rate = hand_jacobian(ready.body), ready.environment, ready.rate
    at_rest = constant_force(ready.force[:, : ready.first_onset])  # with an offset of the gauge, which turns as well
    of_hand = ready.recorded_displacement - _deflection(arm, ready.force - at_rest, rate)
    moved = ready.recording.assign(displacement=ready.recording["displacement"].copy(data=of_hand))
    hand, rotations = hand_path(moved), joint_rotations(moved)
    shoulder = ready.body.posture[0] + rotations[..., 0]
    elbow = ready.body.l_h * np.stack([np.cos(shoulder), np.sin(shoulder)], axis=-1)
    torque = np.stack([_moment(part, ready.force) for part in (hand, hand - elbow)], axis=-1)
    torque -= rotations @ force_stiffness(ready.body, at_rest).T
    if arm is not None:
        torque -= _inertial_torque(coupling(arm), rotations, ready.body.posture[1], rate)
    force = torque @ np.linalg.inv(start)
    displacement = rotations @ start.T + _deflection(arm, force - at_rest, rate)
    excess = displacement - ready.recorded_displacement
    velocity, acceleration = _derivatives(excess, rate)
    balance = environment.m_env * acceleration + environment.b_env * velocity + environment.k_env * excess
    signals = {
        "perturbation": ready.perturbation + force - ready.force + balance,
        "force": force,
        "displacement": displacement,
    }
    changed = {name: ready.recording[name].copy(data=values) for name, values in signals.items()}
    changed[APPLIED] = ready.recording["perturbation"]
    recording = ready.recording.assign(changed)
    return replace(ready, recording=recording, given=ready.instruments, given_covariance=manipulator_covariance(ready))


def applied_perturbation(trials: ConditionTrials) -> Array:
    """d as it was applied [N], (trial, time, axis), of trials as recorded or in the start geometry."""
    recording = trials.recording
    return np.asarray(recording[APPLIED if APPLIED in recording else "perturbation"].values, dtype=float)


def held_force(trials: ConditionTrials) -> Array:
    """Constant force on the hand before the pulses [N], (axis,), of trials as recorded or in the start geometry.

    Zero where d and f do not agree about it, as one of them then has an offset.
    """
    applied, force = (
        constant_force(part[:, : trials.first_onset]) for part in (applied_perturbation(trials), trials.force)
    )
    return force if np.linalg.norm(applied - force) < HELD * np.linalg.norm(force) else np.zeros_like(force)


def coupling(arm: Subject) -> float:
    """Moment of the forearm's mass about the elbow times the length of the humerus [kg m^2], from the joint inertia.

    The least squares of what the inertia at the start posture and tables tell, see the head of this module.
    """
    (_, between), (_, elbow) = mass_matrix(arm)
    cosine, usual = np.cos(arm.posture[1]), COUPLING * arm.l_h / arm.l_f * elbow
    of_arm, of_tables = 1.0 / (INERTIA_ERROR * elbow) ** 2, 1.0 / (COUPLING_ERROR * usual) ** 2
    return float((of_arm * cosine * (between - elbow) + of_tables * usual) / (of_arm * cosine**2 + of_tables))


def _inertial_torque(coupled: float, rotations: Array, elbow: float, rate: float) -> Array:
    """What the inertia of the start posture lacks [Nm], (..., time, joint)."""
    velocity, acceleration = _derivatives(rotations, rate)
    (w_s, w_e), (a_s, a_e) = (np.moveaxis(part, -1, 0) for part in (velocity, acceleration))
    angle = elbow + rotations[..., 1]
    change, sine = np.cos(angle) - np.cos(elbow), np.sin(angle)
    of_shoulder = change * (2.0 * a_s + a_e) - sine * (2.0 * w_s + w_e) * w_e
    return coupled * np.stack([of_shoulder, change * a_s + sine * w_s**2], axis=-1)


def _deflection(arm: Subject | None, force: Array, rate: float) -> Array:
    """How far the grip gives way [m], (..., time, axis), under a force that runs straight between its samples."""
    if arm is None or np.isinf(arm.k_h):
        return np.zeros_like(force)
    lag = max(arm.b_h * rate / arm.k_h, LEAST_LAG)
    decay = np.exp(-1.0 / lag)
    now, before = (1.0 - lag * (1.0 - decay)) / arm.k_h, (lag * (1.0 - decay) - decay) / arm.k_h
    settled = force[..., :1, :] * (1.0 / arm.k_h - now)
    return np.asarray(signal.lfilter([now, before], [1.0, -decay], force, axis=-2, zi=settled)[0])


def _derivatives(path: Array, rate: float) -> tuple[Array, Array]:
    """First and second derivative in time, of the shape of the path."""
    velocity = joint_velocities(path, rate, cutoff=CUTOFF if rate / 2 > CUTOFF else None)
    return velocity, joint_velocities(velocity, rate, cutoff=None)


def _moment(arm: Array, force: Array) -> Array:
    return np.asarray(arm[..., 0] * force[..., 1] - arm[..., 1] * force[..., 0])
