"""People as rows of a table that compiled code can read: one lane per person and trial."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array
from armperturb.controllers.muscle import muscle_parameters
from armperturb.controllers.reflex import reflex_gains
from armperturb.environment import Environment
from armperturb.subject import Subject

MATRICES = ("k", "b", "kv", "kp")
ELEMENTS = 3

_SCALARS = ("l_h", "l_f", "k_h", "b_h")


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


def lane_type(parts: int) -> np.dtype:
    """Row of the table; names are those of `Subject`, `Environment`, `MuscleParameters` and `ReflexGains`."""
    triple = (np.float64, (3,))
    return np.dtype(
        [
            *((name, np.float64) for name in _SCALARS),
            ("posture", np.float64, (2,)),
            ("inertia", *triple),
            *((name, *triple) for name in MATRICES),
            ("kv_groups", *triple),
            ("delay", np.float64, (2,)),
            ("numerator", np.float64, (3, 2)),
            ("denominator", np.float64, (3, 2)),
            *((name, *triple) for name in ("part_stiffness", "loss", "persistence", "damping_groups", "thinning")),
            ("limit", np.float64, (3, parts)),
            ("limit_slope", np.float64, (3, parts)),
            ("saturation", *triple),
            ("direction", *triple),
            *((name, np.float64) for name in ("m_env", "b_env", "k_env")),
        ]
    )


def lane_table(subjects: Sequence[Subject], environments: Sequence[Environment], timestep: float) -> NDArray[np.void]:
    """One row per subject and environment, (lane,).

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
    table = np.zeros(len(subjects), dtype=lane_type(len(muscles.limit)))
    for name in _SCALARS:
        table[name] = [getattr(subject, name) for subject in subjects]
    for name in MATRICES:
        table[name] = [subject.joint_triple(name) for subject in subjects]
    for name in ("m_env", "b_env", "k_env"):
        table[name] = [getattr(environment, name) for environment in environments]
    table["posture"], table["delay"] = gains.posture, [(subject.Td_s, subject.Td_e) for subject in subjects]
    m_h, m_f = (np.array([getattr(subject, name) for subject in subjects]) for name in ("m_h", "m_f"))
    l_h, l_f = table["l_h"], table["l_f"]
    # Of both segments about the shoulder, of the forearm about the elbow, and what couples them (point masses).
    table["inertia"] = np.stack(
        [m_h * l_h**2 / 4 + m_f * (l_h**2 + l_f**2 / 4), m_f * l_f**2 / 4, m_f * l_h * l_f / 2], axis=1
    )
    table["numerator"], table["denominator"] = gains.numerator.swapaxes(0, 1), gains.denominator.swapaxes(0, 1)
    table["kv_groups"] = [subject.muscle_groups("kv") for subject in subjects]
    for name in ("loss", "persistence", "thinning"):
        table[name] = getattr(muscles, name)
    table["part_stiffness"], table["damping_groups"] = muscles.stiffness, muscles.damping
    table["limit"] = muscles.limit.transpose(1, 2, 0)
    if muscles.limit_slope is not None:
        table["limit_slope"] = muscles.limit_slope.transpose(1, 2, 0)
    table["saturation"], table["direction"] = np.inf, 0.0
    for lane, subject in enumerate(subjects):
        if subject.muscle is not None:
            table["saturation"][lane] = subject.muscle.of_elements("spindle_saturation")
            table["direction"][lane] = subject.muscle.of_elements("spindle_direction")
    return table
