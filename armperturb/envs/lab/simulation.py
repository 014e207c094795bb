"""Arms on their manipulators in MuJoCo, each in its own model and data; what drives them comes from outside."""

import copy
import ctypes
import functools
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl, Strength
from armperturb.environment import Environment, Strap
from armperturb.envs.lab.arms import Arms
from armperturb.envs.lab.stepping import (
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
def callbacks() -> tuple[tuple[ctypes.c_void_p, int | None], ...]:
    """Where MuJoCo keeps its handler of warnings and its clock, each with the address of what stands in for it.

    A C function that takes a text and does nothing with it stands in for the handler, nothing for the clock: MuJoCo
    reads it dozens of times a step for `MjData.timer` alone, which takes a quarter of the step.
    """
    handler, clock = (ctypes.c_void_p.in_dll(library(), name) for name in ("mju_user_warning", "mjcb_time"))
    return (handler, ctypes.cast(ctypes.CDLL(None).strlen, ctypes.c_void_p).value), (clock, None)


_REPLACED: list[tuple[int | None, ...]] = []
"""What the callbacks were when each of those began who keep MuJoCo silent now: its own first, then what stands in."""

_REPLACED_LOCK = threading.Lock()


def _forget_replaced() -> None:
    """Begin anew in a forked child, which has none of the threads that asked for silence."""
    global _REPLACED_LOCK
    _REPLACED_LOCK = threading.Lock()
    if _REPLACED:
        _put_back(_REPLACED[0])
        _REPLACED.clear()


def _put_back(addresses: tuple[int | None, ...]) -> None:
    for (callback, _), address in zip(callbacks(), addresses, strict=True):
        callback.value = address


os.register_at_fork(after_in_child=_forget_replaced)


@contextmanager
def silent_simulator() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to the terminal and to MUJOCO_LOG.TXT, and from timing its steps.

    `MjData.warning` counts warnings anyway. Steps call these callbacks from compiled code, without Python; until the
    last thread that asks for silence ends it, others stand in for them, see `callbacks`.
    """
    with _REPLACED_LOCK:
        _REPLACED.append(tuple(callback.value for callback, _ in callbacks()))
        _put_back(tuple(address for _, address in callbacks()))
    try:
        yield
    finally:
        with _REPLACED_LOCK:
            if _REPLACED:  # none in a child that was forked within the block, which has begun anew
                _put_back(_REPLACED.pop())


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


class Simulation(Arms):
    """Arms in MuJoCo; `diverged` tells which trials it has put back because it could not integrate them."""

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
        self._n_history = max(n_history, *(history_length(subject, timestep) for subject in subjects))
        n_columns = SHOULDER.stop if strap is not None else SHOULDER.start
        super().__init__(ArmControl(subjects, timestep, self._n_history), n_columns, n_threads)
        self._laboratory = environment, timestep, rope, strap, self._n_history
        self._bodies = [body_of(subject) for subject in subjects]
        self._models = [copy.copy(self._model(body)) for body in self._bodies]
        self._datas = [mujoco.MjData(model) for model in self._models]
        self._arms = arm_table(self._models, self._datas)
        everybody = np.arange(len(subjects))
        self._set_muscles(everybody, *(np.array([s.muscle_groups(name) for s in subjects]) for name in ("k", "b")))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__getstate__().items() if name != "_arms"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._arms = arm_table(self._models, self._datas)  # addresses of this process

    def _model(self, body: Subject) -> mujoco.MjModel:
        return _compiled(body, *self._laboratory)

    def start(self, trials: Indices, known: Array) -> None:
        """Tell what acts at the beginning, see `Arms.start`."""
        for trial, values in zip(trials.tolist(), known, strict=True):
            start_motors(self._models[trial], self._datas[trial], self._arms["motor"][trial] + len(REFLEXES), values)

    def _advance(self, block: slice, known: Array) -> None:
        control = self.control
        people, memory = control.table[block], control.memory[block]
        arms, log, diverged = self._arms[block], self.log[block], self.diverged[block]
        advance(step_address(), arms, people, memory, known[block], control.timestep, log, diverged)

    def set_strength(self, trials: Indices, strength: Strength) -> None:
        """Change muscles and reflexes of some trials, see `Arms.set_strength`."""
        super().set_strength(trials, strength)
        self._set_muscles(trials, strength["k_groups"], strength["b_groups"])

    def _set_muscles(self, trials: Indices, stiffness: Array, damping: Array) -> None:
        set_muscles(self._arms, trials, stiffness + self.control.table["short_range"][trials], damping)

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest and without perturbation, in the place of some trials, see `Arms.replace`."""
        timestep = self.control.timestep
        for subject in subjects:
            if history_length(subject, timestep) > self._n_history:
                raise ValueError(
                    f"subject {subject.name!r}: delay = {max(subject.Td_s, subject.Td_e):g} s; expected at most "
                    f"{(self._n_history - 2) * timestep:g} s, what this simulation remembers"
                )
        for trial, subject in zip(trials.tolist(), subjects, strict=True):
            body = body_of(subject)
            if body != self._bodies[trial]:
                self._bodies[trial], self._models[trial] = body, copy.copy(self._model(body))
                self._datas[trial] = mujoco.MjData(self._models[trial])
                self._arms[trial] = arm_table([self._models[trial]], [self._datas[trial]])[0]
            mujoco.mj_resetData(self._models[trial], self._datas[trial])
        super().replace(trials, subjects)
        self._set_muscles(trials, *(np.array([s.muscle_groups(name) for s in subjects]) for name in ("k", "b")))
