"""Arms on their manipulators in MuJoCo, each in its own model and data; what drives them comes from outside."""

import copy
import ctypes
import functools
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import mujoco
import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl, Strength
from armperturb.environment import Environment, Strap
from armperturb.envs.lab.stepping import (
    ANGLE,
    SHOULDER,
    advance,
    arm_table,
    library,
    set_muscles,
    step_address,
)
from armperturb.models.rig import REFLEXES, build_model, history_length, start_motors
from armperturb.subject import RELAX, Subject


@functools.cache
def warning_handler() -> tuple[ctypes.c_void_p, int | None]:
    """Where MuJoCo keeps its handler, and the address of one that does nothing."""
    handler = ctypes.c_void_p.in_dll(library(), "mju_user_warning")
    return handler, ctypes.cast(ctypes.CDLL(None).strlen, ctypes.c_void_p).value


_HANDLERS: list[int | None] = []
"""What was MuJoCo's handler when each of those began who keep it silent now: its own first, then what does nothing."""

_HANDLERS_LOCK = threading.Lock()


@contextmanager
def silent_simulator() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to the terminal and to MUJOCO_LOG.TXT; `MjData.warning` counts them anyway.

    Steps call the handler from compiled code, without Python. Until the last thread that asks for silence ends
    it, the handler is therefore a C function that takes a text and does nothing with it.
    """
    handler, nothing = warning_handler()
    with _HANDLERS_LOCK:
        _HANDLERS.append(handler.value)
        handler.value = nothing
    try:
        yield
    finally:
        with _HANDLERS_LOCK:
            handler.value = _HANDLERS.pop()


COMPILED = (
    *("m_h", "m_f", "l_h", "l_f", "c_h", "c_f", "r_h", "r_f", "theta_s_deg", "theta_e_deg"),
    *("b_h", "k_h", "Td_s", "Td_e"),
)
"""Fields of a subject that only a new compilation changes in a model."""


def body_of(subject: Subject) -> Subject:
    """The preset RELAX with this body: equal for people who can share a compiled model.

    Their muscles' springs and dampers are written into it, and it knows nothing of their reflexes.
    """
    return replace(RELAX, **{name: getattr(subject, name) for name in COMPILED})


@functools.lru_cache(maxsize=256)
def _compiled(
    body: Subject, environment: Environment, timestep: float, rope: str, strap: Strap | None, n_history: int
) -> mujoco.MjModel:
    """The rig without what only draws, to be copied."""
    return build_model(body, environment, timestep=timestep, rope=rope, strap=strap, n_history=n_history, visual=False)


class Simulation:
    """One arm on its manipulator per trial; a trial has the same bits alone and beside others, on any thread.

    Attributes:
      control: muscles and reflexes.
      log: what was at the start of each of the last steps, and is now, (trial, step + 1, column), see `stepping`.
      diverged: whether MuJoCo has put a trial back because it could not integrate it, (trial,).
      timestep: of the simulation [s].
      n_history: past steps that the delays of reflexes can reach.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        environment: Environment,
        *,
        timestep: float,
        rope: str = "ideal",
        strap: Strap | None = None,
        n_history: int = 0,
        n_threads: int = 1,
    ) -> None:
        """Begin at rest, without perturbation.

        Args:
          subjects: whose arms, one per trial.
          environment: what the hands hold.
          timestep: of the simulation [s].
          rope: see `build_model`.
          strap: see `build_model`.
          n_history: past steps that the delays of reflexes can reach, if more than these people need.
          n_threads: 0 takes all cores.
        """
        self.timestep = timestep
        self.n_history = max(n_history, *(history_length(subject, timestep) for subject in subjects))
        self.control = ArmControl(subjects, timestep, self.n_history)
        self.log = np.zeros((len(subjects), 1, SHOULDER.stop if strap is not None else SHOULDER.start))
        self.log[:, 0, ANGLE] = self.control.table["posture"]
        self.diverged = np.zeros(len(subjects), dtype=bool)
        self._laboratory = environment, timestep, rope, strap, self.n_history
        self._bodies = [body_of(subject) for subject in subjects]
        self._models = [copy.copy(self._model(body)) for body in self._bodies]
        self._datas = [mujoco.MjData(model) for model in self._models]
        self._arms = arm_table(self._models, self._datas)
        everybody = np.arange(len(subjects))
        self._set_muscles(everybody, *(np.array([s.muscle_groups(name) for s in subjects]) for name in ("k", "b")))
        n_blocks = min(n_threads or os.cpu_count() or 1, len(subjects))
        self._blocks = [slice(int(part[0]), int(part[-1]) + 1) for part in np.array_split(everybody, n_blocks)]
        self._pool = ThreadPoolExecutor(n_blocks) if n_blocks > 1 else None

    def _model(self, body: Subject) -> mujoco.MjModel:
        return _compiled(body, *self._laboratory)

    def start(self, trials: Indices, known: Array) -> None:
        """Tell what acts at the beginning.

        Args:
          trials: indices of trials that have taken no step.
          known: torque on the joints [Nm] and force on the handle [N] from one step before the first one to two steps
            after it, (trial, 4, motor).
        """
        for trial, values in zip(trials.tolist(), known, strict=True):
            start_motors(self._models[trial], self._datas[trial], self._arms["motor"][trial] + len(REFLEXES), values)

    def advance(self, known: Array) -> None:
        """Take some steps.

        Args:
          known: torque on the joints [Nm] and force on the handle [N], `AHEAD` steps after the first of these steps and
            on, (trial, step, motor).
        """
        n_steps = known.shape[1]
        if self.log.shape[1] != n_steps + 1:
            self.log = np.zeros((len(known), n_steps + 1, self.log.shape[2]))

        def run(part: slice) -> None:
            advance(
                step_address(),
                self._arms[part],
                self.control.table[part],
                self.control.memory[part],
                known[part],
                self.timestep,
                self.log[part],
                self.diverged[part],
            )

        if self._pool is None:
            run(slice(None))
        else:
            list(self._pool.map(run, self._blocks))

    def set_strength(self, trials: Indices, strength: Strength) -> None:
        """Change muscles and reflexes of some trials.

        Args:
          trials: indices of those trials.
          strength: of as many.
        """
        self.control.set_strength(trials, strength)
        self._set_muscles(trials, strength["k_groups"], strength["b_groups"])

    def _set_muscles(self, trials: Indices, stiffness: Array, damping: Array) -> None:
        set_muscles(self._arms, trials, stiffness + self.control.table["short_range"][trials], damping)

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest and without perturbation, in the place of some trials.

        Args:
          trials: indices of those trials, rising.
          subjects: as many people.

        Raises:
          ValueError: a delay reaches further back than `n_history` steps.
        """
        for subject in subjects:
            if history_length(subject, self.timestep) > self.n_history:
                raise ValueError(
                    f"subject {subject.name!r}: delay = {max(subject.Td_s, subject.Td_e):g} s; expected at most "
                    f"{(self.n_history - 2) * self.timestep:g} s, what this simulation remembers"
                )
        for trial, subject in zip(trials.tolist(), subjects, strict=True):
            body = body_of(subject)
            if body != self._bodies[trial]:
                self._bodies[trial], self._models[trial] = body, copy.copy(self._model(body))
                self._datas[trial] = mujoco.MjData(self._models[trial])
                self._arms[trial] = arm_table([self._models[trial]], [self._datas[trial]])[0]
            mujoco.mj_resetData(self._models[trial], self._datas[trial])
        self.control.replace(trials, subjects)
        self.log[trials], self.diverged[trials] = 0.0, False
        self.log[trials, -1, ANGLE] = self.control.table["posture"][trials]
        self._set_muscles(trials, *(np.array([s.muscle_groups(name) for s in subjects]) for name in ("k", "b")))
