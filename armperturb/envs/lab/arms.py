"""What the engines share: arms side by side, a log of their steps, and threads that take blocks of them."""

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl, Strength
from armperturb.envs.lab.stepping import ANGLE
from armperturb.subject import Subject


class Arms(ABC):
    """One arm on its manipulator per trial; a trial has the same bits alone and beside others, on any thread.

    Attributes:
      control: muscles and reflexes.
      log: what was at the start of each of the last steps, and is now, (trial, step + 1, column), see `stepping`.
      diverged: whether a trial could not be integrated, (trial,).
    """

    def __init__(self, control: ArmControl, n_columns: int, n_threads: int, group: int = 1) -> None:
        """Begin at rest, without perturbation.

        Args:
          control: of these arms.
          n_columns: of the log.
          n_threads: 0 takes all cores.
          group: arms that are simulated best by the same thread.
        """
        self.control = control
        n_arms = len(control.table)
        self.log = np.zeros((n_arms, 1, n_columns))
        self.log[:, 0, ANGLE] = control.table["posture"]
        self.diverged = np.zeros(n_arms, dtype=bool)
        n_groups = -(-n_arms // group)
        n_blocks = min(n_threads or os.cpu_count() or 1, n_groups)
        size = group * -(-n_groups // n_blocks)
        self._blocks = [slice(first, first + size) for first in range(0, n_arms, size)]
        self._pool: tuple[int, ThreadPoolExecutor] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pool": None}

    def _threads(self) -> ThreadPoolExecutor:
        """Threads of this process: a child that was forked has none of its parent's."""
        if self._pool is None or self._pool[0] != os.getpid():
            self._pool = os.getpid(), ThreadPoolExecutor(len(self._blocks))
        return self._pool[1]

    @abstractmethod
    def start(self, trials: Indices, known: Array) -> None:
        """Tell what acts at the beginning.

        Args:
          trials: indices of trials that have taken no step.
          known: torque on the joints [Nm] and force on the handle [N] from one step before the first one to two steps
            after it, (trial, 4, motor).
        """

    def advance(self, known: Array) -> None:
        """Take some steps.

        Args:
          known: torque on the joints [Nm] and force on the handle [N], `AHEAD` steps after the first of these steps and
            on, (trial, step, motor).
        """
        n_arms, n_rows = len(known), known.shape[1] + 1
        if self.log.shape[1] != n_rows:
            self.log = np.zeros((n_arms, n_rows, self.log.shape[2]))
        known = self._prepared(known)
        if len(self._blocks) == 1:
            self._advance(slice(None), known)
        else:
            list(self._threads().map(self._advance, self._blocks, [known] * len(self._blocks)))

    def _prepared(self, known: Array) -> Array:
        """What `_advance` wants to know."""
        return known

    @abstractmethod
    def _advance(self, block: slice, known: Array) -> None:
        """Take steps with a block of the arms; `known` is of all."""

    def set_strength(self, trials: Indices, strength: Strength) -> None:
        """Change muscles and reflexes of some trials.

        Args:
          trials: indices of those trials.
          strength: of as many.
        """
        self.control.set_strength(trials, strength)

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest and without perturbation, in the place of some trials.

        Args:
          trials: indices of those trials, rising.
          subjects: as many people.

        Raises:
          ValueError: a delay reaches further back than the arms remember.
        """
        self.control.replace(trials, subjects)
        self.log[trials], self.diverged[trials] = 0.0, False
        self.log[trials, -1, ANGLE] = self.control.table["posture"][trials]
