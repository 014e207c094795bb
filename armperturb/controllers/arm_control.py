"""All that muscles and reflexes add to the springs and dampers of the model, once per step, for many arms at once."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.compiled import act_all, stretch_all
from armperturb.controllers.lanes import Table, control_columns, control_memory, doubled, history_of, table_of
from armperturb.subject import Subject

Strength = dict[str, Array]
"""How much muscle and reflex there is in some trials, (trial, 3) each.

Stiffness `k` [Nm/rad], damping `b` [Nms/rad], and feedback of velocity `kv` [Nms/rad] and of position `kp` [Nm/rad] are
the entries (s, se, e) of a joint matrix (eq. 2.9). Names ending in `_groups` have the values of the muscle groups
(single-joint shoulder, two-joint, single-joint elbow, eq. 2.10) that make these, and `short_range_groups` has their
short-range stiffness [Nm/rad].
"""


class ArmControl:
    """Reflexes, muscle law and their memory, of one arm per trial; a trial has the same bits alone and beside others.

    Attributes:
      table: people as they are now, (trial,), see `lanes.control_columns`.
      memory: what they remember, (trial,), see `lanes.control_memory`.
      timestep: of the simulation [s].
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        timestep: float,
        n_history: int = 0,
        columns: Callable[..., dict[str, Any]] = control_columns,
    ) -> None:
        """Begin at rest.

        Args:
          subjects: the person in each trial.
          timestep: of the simulation [s].
          n_history: steps that reflexes remember, if more than these people need.
          columns: makes the columns of the table of subjects, step and parts: those of `control_columns`, at least.
        """
        self.timestep, self._columns = timestep, columns
        self.table = table_of(columns(subjects, timestep))
        n_parts = self.table["limit"].shape[2]
        self.memory = control_memory(len(subjects), n_parts, doubled(max(n_history, history_of(self.table, timestep))))

    def torque(self, angle: Array, velocity: Array) -> tuple[Array, Array]:
        """What acts on the joints over a step, which all memories then go on by.

        Args:
          angle: of the joints at its start [rad], (trial, joint).
          velocity: of the joints [rad/s], (trial, joint).

        Returns:
          The torque to hold over the step [Nm], (trial, joint), and the controls of the reflex motors [Nm], (trial,
          joint), which the model delays.
        """
        held, sent = np.zeros((2, len(self.table), 2))
        act_all(self.table, self.memory, angle, velocity, self.timestep, held, sent)
        return held, sent

    def set_strength(self, trials: Indices, strength: Strength) -> None:
        """Change muscles and reflexes of some trials; springs and dampers are the model's, see `envs.lab.simulation`.

        Bonds that come in are unstrained, and bonds that go take their torque along: neither gives energy.

        Args:
          trials: indices of those trials.
          strength: of as many.
        """
        table = self.table
        for name in ("k", "b", "kv", "kp", "kv_groups"):
            table[name][trials] = strength[name]
        table["damping_groups"][trials] = strength["b_groups"]
        table["short_range"][trials] = strength["short_range_groups"]
        before = table["part_stiffness"][trials]
        stiffness = strength["short_range_groups"] / table["parts"][trials, None]
        share = np.divide(before, stiffness, out=np.ones_like(stiffness), where=stiffness > 0.0)
        self.memory["bond"][trials] *= np.minimum(share, 1.0)[..., None]
        table["part_stiffness"][trials] = stiffness
        table["reflexive"][trials] = 1.0

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest, in the place of some trials.

        Args:
          trials: indices of those trials.
          subjects: as many people.

        Raises:
          ValueError: a delay reaches further back than what is remembered.
        """
        n_parts, n_history = self.table["limit"].shape[2], self.memory["sent"].shape[1]
        columns = self._columns(subjects, self.timestep, n_parts)
        longest = (n_history - 3) * self.timestep
        if columns["delay"].max() > longest:
            raise ValueError(
                f"delay = {columns['delay'].max():g} s; expected at most {longest:g} s, what this simulation remembers"
            )
        if columns["limit"].shape[2] > n_parts:
            self._widen(columns["limit"].shape[2])
        for name, values in columns.items():
            self.table[name][trials] = values
        self.memory[trials] = control_memory(len(subjects), self.table["limit"].shape[2], n_history)

    def _widen(self, n_parts: int) -> None:
        """Have room for more elasto-plastic parts; those that a person does not have yield at once."""

        def wider(table: Table, names: Sequence[str], into: Table) -> Table:
            for name in into.dtype.names or ():
                narrow = (..., slice(table[name].shape[2])) if name in names else ...
                into[name][narrow] = table[name]
            return into

        shapes = {name: self.table[name].shape for name in self.table.dtype.names or ()}
        shapes |= {name: (*shapes[name][:2], n_parts) for name in ("limit", "limit_slope")}
        empty = table_of({name: np.zeros(shape) for name, shape in shapes.items()})
        self.table = wider(self.table, ("limit", "limit_slope"), empty)
        fresh = control_memory(len(self.table), n_parts, self.memory["sent"].shape[1])
        self.memory = wider(self.memory, ("bond",), fresh)


def stretched(subjects: Sequence[Subject], stretch: Array, velocity: Array, timestep: float) -> tuple[Array, Table]:
    """What the muscle law does while elements are moved by hand, without an arm around them.

    Args:
      subjects: whose muscles.
      stretch: of the elements [rad], (step, subject, element).
      velocity: of the elements [rad/s], likewise.
      timestep: between steps [s].

    Returns:
      The torque with which elements oppose stretch, beside the linear spring and damper [Nm], (step, subject, element),
      and the memory after the last step.
    """
    control = ArmControl(subjects, timestep)
    torque = np.zeros(np.shape(stretch))
    stretch_all(control.table, control.memory, np.ascontiguousarray(stretch), np.ascontiguousarray(velocity), torque)
    return torque, control.memory
