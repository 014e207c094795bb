"""People as rows of a table that compiled code can read: one lane per person and trial."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array
from armperturb.controllers.muscle import muscle_parameters
from armperturb.controllers.reflex import reflex_gains
from armperturb.environment import Environment
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import Subject

GROUP = 8
"""Lanes that are simulated side by side, as the vector instructions of processors have it."""

MATRICES = ("k", "b", "kv", "kp")
_SEGMENTS = ("m_h", "m_f", "l_h", "l_f")


class Start(NamedTuple):
    """Where each lane is before the first step; a simulation goes on in these arrays.

    Attributes:
      state: (q_s, q_e, x, y) from rest [rad, m], and their velocities, (lane, 8).
      filters: of the activation, (lane, 2, joint).
      motor: torque commands of the steps before, oldest first [Nm], (lane, step, joint); for each lane two steps more
        than its delays are long, at least.
    """

    state: Array
    filters: Array
    motor: Array

    def part(self, lanes: slice) -> "Start":
        """Some of the lanes."""
        return Start(self.state[lanes], self.filters[lanes], self.motor[lanes])


def at_rest(n_lanes: int, n_history: int) -> Start:
    """Arms at rest in their postures, whose reflexes have sent nothing."""
    return Start(np.zeros((n_lanes, 8)), np.zeros((n_lanes, 2, 2)), np.zeros((n_lanes, n_history, 2)))


def lane_table(subjects: Sequence[Subject], environments: Sequence[Environment], timestep: float) -> NDArray[np.void]:
    """One row per subject and environment, (lane,); names are those of `Subject`, `Environment`, and their controllers.

    Args:
      subjects: one per lane.
      environments: what the hands hold, one per lane.
      timestep: of the simulation [s].

    Raises:
      ValueError: a subject has acceleration or force feedback, or a delay that is shorter than the step.
    """
    for subject in subjects:
        if any(subject.joint_triple("ka") + subject.joint_triple("kf")):
            raise ValueError(
                f"subject {subject.name!r} has acceleration or force feedback; expected velocity and position "
                "feedback only"
            )
        if min(subject.Td_s, subject.Td_e) < timestep:
            raise ValueError(
                f"subject {subject.name!r}: delay = {min(subject.Td_s, subject.Td_e):g} s; expected at least the "
                f"step of {timestep:g} s"
            )
    muscles, gains = muscle_parameters(subjects, timestep), reflex_gains(subjects, timestep)
    laws = [subject.muscle or MuscleLaw() for subject in subjects]
    m_h, m_f, l_h, l_f = (np.array([getattr(subject, name) for subject in subjects]) for name in _SEGMENTS)
    # Of both segments about the shoulder, of the forearm about the elbow, and what couples them (point masses).
    inertia = m_h * l_h**2 / 4 + m_f * (l_h**2 + l_f**2 / 4), m_f * l_f**2 / 4, m_f * l_h * l_f / 2
    limit = muscles.limit.transpose(1, 2, 0)
    slope = None if muscles.limit_slope is None else muscles.limit_slope.transpose(1, 2, 0)
    columns = {
        **{name: [getattr(subject, name) for subject in subjects] for name in ("l_h", "l_f", "k_h", "b_h")},
        "posture": gains.posture,
        "inertia": np.stack(inertia, axis=1),
        **{name: [subject.joint_triple(name) for subject in subjects] for name in MATRICES},
        "kv_groups": [subject.muscle_groups("kv") for subject in subjects],
        "delay": [(subject.Td_s, subject.Td_e) for subject in subjects],
        "numerator": gains.numerator.swapaxes(0, 1),
        "denominator": gains.denominator.swapaxes(0, 1),
        "part_stiffness": muscles.stiffness,
        **{name: getattr(muscles, name) for name in ("loss", "persistence", "thinning")},
        "damping_groups": muscles.damping,
        "limit": limit,
        "limit_slope": np.zeros_like(limit) if slope is None else slope,
        "saturation": [law.of_elements("spindle_saturation") for law in laws],
        "direction": [law.of_elements("spindle_direction") for law in laws],
        **{name: [getattr(held, name) for held in environments] for name in ("m_env", "b_env", "k_env")},
    }
    table = np.zeros(len(subjects), [(name, float, np.shape(values)[1:]) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table
