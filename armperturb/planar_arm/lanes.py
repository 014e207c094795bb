"""People and what they hold as rows of a table that compiled code can read: one lane per person and trial."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from armperturb.arrays import Array
from armperturb.controllers.lanes import (
    PARTS,
    Table,
    control_columns,
    control_memory,
    elastic_limit_shape,
    history_of,
    table_of,
)
from armperturb.environment import Environment
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import Subject

GROUP = 8
"""Lanes that are simulated side by side, as the vector instructions of processors have it."""


class Start(NamedTuple):
    """Where each lane is before the first step; a simulation goes on in these arrays.

    Attributes:
      state: (q_s, q_e, x, y) from rest [rad, m], and their velocities, (lane, 8).
      memory: of muscles and reflexes, (lane,), see `controllers.lanes.control_memory`.
    """

    state: Array
    memory: Table

    def part(self, lanes: slice) -> "Start":
        """Some of the lanes."""
        return Start(self.state[lanes], self.memory[lanes])


def at_rest(lanes: Table, timestep: float) -> Start:
    """Arms at rest in their postures, whose reflexes have sent nothing.

    Args:
      lanes: from `lane_table`.
      timestep: of the simulation [s].
    """
    n_lanes, _, n_parts = lanes["limit"].shape
    return Start(np.zeros((n_lanes, 8)), control_memory(n_lanes, n_parts, history_of(lanes, timestep)))


def require_lane(subject: Subject, timestep: float) -> None:
    """Refuse an arm that no lane has.

    Args:
      subject: the arm.
      timestep: of the simulation [s].

    Raises:
      ValueError: a delay is shorter than three steps, or the arm has what `Subject.require_simulable` refuses.
    """
    subject.require_simulable()
    if min(subject.Td_s, subject.Td_e) < 3 * timestep * (1 - 1e-12):
        raise ValueError(
            f"subject {subject.name!r}: delay = {min(subject.Td_s, subject.Td_e):g} s; expected at least three "
            f"steps of {timestep:g} s"
        )


def lane_table(subjects: Sequence[Subject], environments: Sequence[Environment], timestep: float) -> Table:
    """One row per subject and environment, (lane,); arguments and errors as in `lane_columns`."""
    return table_of(lane_columns(subjects, timestep, environments=environments))


def lane_columns(
    subjects: Sequence[Subject], timestep: float, n_parts: int = 0, *, environments: Sequence[Environment]
) -> dict[str, Any]:
    """Name to values, (lane, ...); names are those of `Subject`, `Environment`, and `control_columns`.

    People whose muscle law is computed in groups are `grouped`; `controllers.compiled.act` finds no law of theirs.

    Args:
      subjects: one per lane.
      timestep: of the simulation [s].
      n_parts: see `control_columns`.
      environments: what the hands hold, one per lane, or one for all.

    Raises:
      ValueError: a delay is shorter than three steps, or an arm has what `Subject.require_simulable` refuses.
    """
    for subject in subjects:
        require_lane(subject, timestep)
    if len(environments) == 1:
        environments = [*environments] * len(subjects)
    # What an arm is comes first: rows that begin as those of `control_columns` would pass for them in compiled code.
    columns = {
        **{name: np.array([getattr(subject, name) for subject in subjects]) for name in ("l_h", "l_f", "k_h", "b_h")},
        "inertia": np.array([subject.segment_inertia for subject in subjects]),
        **{name: np.array([getattr(held, name) for held in environments]) for name in ("m_env", "b_env", "k_env")},
        **control_columns(subjects, timestep, n_parts),
    }
    # Force feedback needs the torque of the law at once.
    grouped = (columns["parts"] <= PARTS) & (columns["remembering"] == 0.0)
    columns["grouped"] = columns["lawful"] * grouped
    columns["lawful"] = columns["lawful"] * ~grouped
    return columns


def divisions(lanes: Table, laws: Sequence[MuscleLaw | None], n: int, numbers: Iterable[int]) -> Iterator[Table]:
    """Tables of the same people, each with every n-th elastic limit of muscles that have `n` times as many parts.

    All `n` tables together have all of these limits; those of a pair, 0 and 1, 2 and 3 and so on, mirror each other.

    Args:
      lanes: people whose muscles have equally many parts.
      laws: of their muscles, whose elements have one spread of the elastic limits.
      n: how many tables there are.
      numbers: which of them are wanted.
    """
    spreads = np.array([law.of_elements("elastic_limit_spread")[0] if law else 0.0 for law in laws])
    parts = next((law.parts for law in laws if law), 1)
    known, kind = np.unique(spreads, return_inverse=True)
    shapes = np.array([elastic_limit_shape(spread, parts * n).reshape(parts, n) for spread in known])
    for number in numbers:
        first = number // 2 if number % 2 == 0 else n - 1 - number // 2
        table = lanes.copy()
        for name in ("limit", "limit_slope"):
            mean = lanes[name][:, :, :parts].mean(axis=2, keepdims=True)
            table[name][:, :, :parts] = mean * shapes[kind, None, :, first]
        yield table
