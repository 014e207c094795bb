"""Geometry of the arm at its start posture: Jacobians and the joint mass matrix (thesis appendix B)."""

import numpy as np

from armperturb.arrays import Array
from armperturb.subject import Subject


def _segment_velocities(subject: Subject) -> tuple[Array, Array]:
    """Velocity of each segment's end about its start per rad/s of its own turning [m/rad], (axis,) each."""
    shoulder, elbow = subject.posture
    humerus = subject.l_h * np.array([-np.sin(shoulder), np.cos(shoulder)])
    forearm = subject.l_f * np.array([-np.sin(shoulder + elbow), np.cos(shoulder + elbow)])
    return humerus, forearm


def hand_jacobian(subject: Subject) -> Array:
    """Jacobian from joint angles to hand position at the start posture [m/rad], (axis, joint). Source: eq. B.28."""
    humerus, forearm = _segment_velocities(subject)
    return np.column_stack([humerus + forearm, forearm])


def segment_jacobians(subject: Subject) -> tuple[Array, Array]:
    """Jacobians from joint angles to the middles of humerus and forearm [m/rad], (axis, joint) each."""
    humerus, forearm = _segment_velocities(subject)
    t_h = np.column_stack([0.5 * humerus, np.zeros(2)])
    t_f = np.column_stack([humerus + 0.5 * forearm, 0.5 * forearm])
    return t_h, t_f


def segment_inertias(subject: Subject) -> tuple[Array, Array]:
    """Derivatives of the joint mass matrix with respect to m_h and m_f [m^2], (joint, joint) each."""
    t_h, t_f = segment_jacobians(subject)
    return t_h.T @ t_h, t_f.T @ t_f


def mass_matrix(subject: Subject) -> Array:
    """Joint mass matrix T_q^T M T_q at the start posture [kg m^2], (joint, joint).

    Source: eqs B.2, B.7 with point masses in the middle of the segments.
    """
    inertia_h, inertia_f = segment_inertias(subject)
    return subject.m_h * inertia_h + subject.m_f * inertia_f
