"""Geometry of the arm at its start posture: Jacobians and the joint mass matrix (thesis appendix B)."""

from dataclasses import replace

import numpy as np

from armperturb.arrays import Array
from armperturb.subject import Subject

COUPLING = 1.25
"""Coupling of the segments over l_h / l_f times the elbow's inertia [-], which is centre / (centre^2 + gyration^2) of
the forearm with hand in shares of l_f: 1.29 to 1.32 by the tables of `anthropometry`, 1.15 to 1.19 with 0.5 kg of cuff
and handle at the hand."""

RIGHT_DEG = 1.0
"""An elbow that is closer than this to a right angle does not show the coupling of its segments [deg]."""

ALIKE = 0.1
"""Difference of i_se from that of rigid segments at a right angle, over i_e, up to which it may be an error [-]."""

NEAR = 0.05
"""Share of the range of centres of mass that `with_rigid_segments` keeps away from a humerus without mass [-]."""


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


def force_stiffness(arm: Subject, force: Array) -> Array:
    """Derivative of J^T f by the joint angles at a force on the hand [Nm/rad], (joint, joint)."""
    jacobian = hand_jacobian(arm)
    # Each column is a vector from its joint to the hand, turned by 90 deg; so is its derivative once more.
    both, fore = -(np.array([[0.0, -1.0], [1.0, 0.0]]).T @ jacobian).T @ force
    return np.array([[both, fore], [fore, fore]])


def segment_jacobians(subject: Subject) -> tuple[Array, Array]:
    """Jacobians from joint angles to the centres of mass of humerus and forearm [m/rad], (axis, joint) each."""
    humerus, forearm = _segment_velocities(subject)
    t_h = np.column_stack([subject.c_h * humerus, np.zeros(2)])
    t_f = np.column_stack([humerus + subject.c_f * forearm, subject.c_f * forearm])
    return t_h, t_f


def segment_inertias(subject: Subject) -> tuple[Array, Array]:
    """Derivatives of the joint mass matrix with respect to m_h and m_f [m^2], (joint, joint) each."""
    t_h, t_f = segment_jacobians(subject)
    turned_h, turned_f = (subject.r_h * subject.l_h) ** 2, (subject.r_f * subject.l_f) ** 2
    return t_h.T @ t_h + turned_h * np.array([[1, 0], [0, 0]]), t_f.T @ t_f + turned_f


def mass_matrix(subject: Subject) -> Array:
    """Joint mass matrix at the start posture [kg m^2], (joint, joint).

    Source: T_q^T M T_q of eqs B.2, B.7, with what the segments' own turning and the joint inertia beyond them add.
    """
    inertia_h, inertia_f = segment_inertias(subject)
    return subject.m_h * inertia_h + subject.m_f * inertia_f + subject.joint_matrix("i")


def with_rigid_segments(subject: Subject) -> Subject:
    """The subject whose whole joint inertia at the start posture is that of rigid segments, as simulators want it.

    Three numbers do not determine six: c_h, c_f and r_h stay as they are where they can. c_f moves no further than
    masses and radii that are not negative ask; m_f, r_f and m_h follow. Near a right angle the inertia does not show
    the coupling of the segments: it is what anthropometric tables make of the elbow's inertia, and i_se follows.

    Raises:
      ValueError: no rigid segments have this joint inertia in this posture.
    """
    if not subject.has_extra_inertia:
        return subject
    (i_s, i_se), (_, b) = mass_matrix(subject).tolist()
    cosine, l_h, l_f = np.cos(subject.posture[1]), subject.l_h, subject.l_f
    is_right = abs(abs(subject.theta_e_deg) - 90.0) < RIGHT_DEG
    c = COUPLING * l_h / l_f * b if is_right else (i_se - b) / cosine
    a = i_s - b - 2.0 * c * cosine  # of the humerus, and of the forearm's mass at the elbow
    # The forearm's mass is c / (c_f l_f l_h): less than leaves the humerus any, at least what b holds without turning.
    is_alike = abs(i_se - b - c * cosine) <= ALIKE * b or not is_right
    refusal = ValueError(
        f"subject {subject.name!r}: joint inertia = [[{i_s:.4g}, {i_se:.4g}], [{i_se:.4g}, {b:.4g}]] kg m^2; "
        f"expected one that rigid segments can have at an elbow angle of {subject.theta_e_deg:g} deg"
    )
    if not (is_alike and c > 0.0 and c * l_h < a * l_f and c * c < a * b):
        raise refusal
    least, most = c * l_h / (a * l_f), min(b * l_h / (c * l_f), 1.0)
    c_f = min(max(subject.c_f, least + NEAR * (most - least)), most)
    m_f = c / (c_f * l_f * l_h)
    try:
        return replace(
            subject,
            m_h=(a - m_f * l_h**2) / ((subject.c_h**2 + subject.r_h**2) * l_h**2),
            m_f=m_f,
            c_f=c_f,
            r_f=float(np.sqrt(max(b / (m_f * l_f**2) - c_f**2, 0.0))),
            i_s=0.0,
            i_se=0.0,
            i_e=0.0,
        )
    except ValueError:  # a radius or a mass that no segment has
        raise refusal from None
