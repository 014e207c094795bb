"""Arms of the compiled engine, to be driven as those of MuJoCo are."""

import functools
from collections.abc import Sequence

import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl
from armperturb.environment import Environment
from armperturb.envs.lab.arms import Arms
from armperturb.envs.lab.stepping import SHOULDER
from armperturb.models.rig import AHEAD, KNOWN
from armperturb.planar_arm.compiled import log_lanes
from armperturb.planar_arm.lanes import GROUP, Start, lane_columns
from armperturb.subject import Subject


class CompiledSimulation(Arms):
    """Arms by the equations of motion of `planar_arm`.

    They neither end at the workspace limit nor on an elastic strap, and their rope only carries them.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        environment: Environment,
        *,
        timestep: float,
        n_history: int = 0,
        n_threads: int = 1,
    ) -> None:
        """Begin at rest, without perturbation; arguments as of `Simulation`.

        Raises:
          ValueError: a delay is shorter than three steps.
        """
        columns = functools.partial(lane_columns, environments=[environment])
        super().__init__(ArmControl(subjects, timestep, n_history, columns), SHOULDER.start, n_threads, GROUP)
        self._state = np.zeros((len(subjects), 8))
        self._recent = np.zeros((len(subjects), AHEAD + 1, len(KNOWN)))

    def start(self, trials: Indices, known: Array) -> None:
        """Tell what acts at the beginning, see `Arms.start`."""
        self._recent[trials] = known

    def _prepared(self, known: Array) -> Array:
        n_steps = known.shape[1]
        samples = np.concatenate([self._recent, known], axis=1)
        self._recent = samples[:, n_steps:].copy()
        before, older, newer, after = (samples[:, first : first + n_steps] for first in range(4))
        halved = np.empty((len(known), 2 * n_steps + 1, len(KNOWN)))
        halved[:, ::2] = samples[:, 1 : n_steps + 2]
        halved[:, 1::2] = (9.0 * (older + newer) - (before + after)) / 16.0  # the cubic of MuJoCo's motors, half-way
        return halved

    def _advance(self, block: slice, known: Array) -> None:
        start = Start(self._state[block], self.control.memory[block])
        log_lanes(self.control.table[block], start, known[block], self.control.timestep, self.log[block])
        self.diverged[block] = np.isnan(self._state[block].sum(axis=1))

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest, in the place of some trials, see `Arms.replace`."""
        super().replace(trials, subjects)
        self._state[trials] = self._recent[trials] = 0.0
