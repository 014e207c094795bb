"""Arms of the compiled engine, to be driven as those of MuJoCo are."""

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl, Strength
from armperturb.environment import Environment
from armperturb.envs.lab.stepping import ANGLE, SHOULDER
from armperturb.models.rig import AHEAD, KNOWN
from armperturb.planar_arm.compiled import log_lanes
from armperturb.planar_arm.lanes import GROUP, Start, lane_columns
from armperturb.subject import Subject


class CompiledSimulation:
    """One arm on its manipulator per trial, by the equations of motion of `planar_arm`; as `Simulation`, which see.

    The arm neither ends at the workspace limit nor on an elastic strap, and its rope only carries it.
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
        self.control = ArmControl(subjects, timestep, n_history, columns)
        self.timestep, self.n_history = timestep, self.control.memory["sent"].shape[1]
        self.log = np.zeros((len(subjects), 1, SHOULDER.start))
        self.log[:, 0, ANGLE] = self.control.table["posture"]
        self.diverged = np.zeros(len(subjects), dtype=bool)
        self._state = np.zeros((len(subjects), 8))
        self._recent = np.zeros((len(subjects), AHEAD + 1, len(KNOWN)))
        n_blocks = min(n_threads or os.cpu_count() or 1, -(-len(subjects) // GROUP))
        size = GROUP * -(-len(subjects) // (GROUP * n_blocks))
        self._blocks = [slice(first, first + size) for first in range(0, len(subjects), size)]
        self._pool = ThreadPoolExecutor(n_blocks) if n_blocks > 1 else None

    def start(self, trials: Indices, known: Array) -> None:
        """Tell what acts at the beginning, see `Simulation.start`."""
        self._recent[trials] = known

    def advance(self, known: Array) -> None:
        """Take some steps, see `Simulation.advance`."""
        n_trials, n_steps = known.shape[:2]
        if self.log.shape[1] != n_steps + 1:
            self.log = np.zeros((n_trials, n_steps + 1, SHOULDER.start))
        samples = np.concatenate([self._recent, known], axis=1)
        self._recent = samples[:, n_steps:].copy()
        before, older, newer, after = (samples[:, first : first + n_steps] for first in range(4))
        halved = np.empty((n_trials, 2 * n_steps + 1, len(KNOWN)))
        halved[:, ::2] = samples[:, 1 : n_steps + 2]
        halved[:, 1::2] = (9.0 * (older + newer) - (before + after)) / 16.0  # the cubic of MuJoCo's motors, half-way

        def run(part: slice) -> None:
            start = Start(self._state[part], self.control.memory[part])
            log_lanes(self.control.table[part], start, halved[part], self.timestep, self.log[part])

        if self._pool is None:
            run(slice(None))
        else:
            list(self._pool.map(run, self._blocks))
        self.diverged[:] = np.isnan(self._state.sum(axis=1))

    def set_strength(self, trials: Indices, strength: Strength) -> None:
        """Change muscles and reflexes of some trials, see `Simulation.set_strength`."""
        self.control.set_strength(trials, strength)

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest, in the place of some trials, see `Simulation.replace`."""
        self.control.replace(trials, subjects)
        self._state[trials] = self._recent[trials] = self.log[trials] = 0.0
        self.log[trials, -1, ANGLE] = self.control.table["posture"][trials]
        self.diverged[trials] = False
