"""Many arms on their manipulators, stepped in lockstep by MuJoCo's batch; what drives them comes from outside."""

import copy
import ctypes
import functools
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from armperturb.arrays import Array, Indices
from armperturb.controllers.layout import trials_adjacent
from armperturb.environment import Environment, Strap
from armperturb.models.rig import (
    BIARTICULAR,
    JOINTS,
    REFLEXES,
    SLIDES,
    STRAIN_GAUGE,
    STRAP,
    build_model,
    history_length,
)
from armperturb.subject import RELAX, Subject

DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC")]


@functools.cache
def warning_handler() -> tuple[ctypes.c_void_p, int | None]:
    """Where MuJoCo keeps its handler, and the address of one that does nothing."""
    library = next(Path(mujoco.__file__).parent.glob("libmujoco.*"))
    handler = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mju_user_warning")
    return handler, ctypes.cast(ctypes.CDLL(None).strlen, ctypes.c_void_p).value


_HANDLERS: list[int | None] = []
"""What was MuJoCo's handler when each of those began who keep it silent now: its own first, then what does nothing."""

_HANDLERS_LOCK = threading.Lock()


@contextmanager
def silent_simulator() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to the terminal and to MUJOCO_LOG.TXT; `Batch.warning` counts them anyway.

    The batch calls the handler from its own threads, without Python. Until the last thread that asks for silence ends
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


COMPILED = ("m_h", "m_f", "l_h", "l_f", "theta_s_deg", "theta_e_deg", "b_h", "k_h", "Td_s", "Td_e")
"""Fields of a subject that only a new compilation changes in a model."""

MUSCLE_FIELDS = ("jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
"""Fields of a model that the springs and dampers of the muscles are in."""


def body_of(subject: Subject) -> Subject:
    """The preset RELAX with this body: equal for people who can share a compiled model.

    Their muscles' springs and dampers are written into it, and it knows nothing of their reflexes.
    """
    return replace(RELAX, **{name: getattr(subject, name) for name in COMPILED})


def columns(model: mujoco.MjModel, names: Sequence[str]) -> slice:
    """Where neighbouring joints are; each is one position, one velocity."""
    first = model.joint(names[0]).qposadr[0]
    return slice(first, first + len(names))


class MuscleFields:
    """Where a compiled model, or a batch of them, has springs and dampers of the muscle groups."""

    def __init__(self, fields: Sequence[Array], hinges: slice, two_joint: int) -> None:
        """Find them.

        Args:
          fields: of `MUSCLE_FIELDS`, (joint or tendon,), or of several trials with the trial first.
          hinges: where shoulder and elbow are, from `columns`.
          two_joint: index of the tendon of the two-joint muscles.
        """
        self._joints, self._tendons = fields[:2], fields[2:]
        self._hinges, self._two_joint = hinges, two_joint

    def write(self, stiffness: Array, damping: Array, trials: Any = ...) -> None:
        """Change the muscles.

        Args:
          stiffness: of the groups (shoulder, two-joint, elbow) [Nm/rad], (element,) or (trial, element).
          damping: of the groups [Nms/rad], likewise.
          trials: indices of those that change, by default all.
        """
        for joints, tendons, groups in zip(self._joints, self._tendons, (stiffness, damping), strict=True):
            joints[trials, self._hinges], tendons[trials, self._two_joint] = groups[..., ::2], groups[..., 1]


class Simulation:
    """One arm on its manipulator per trial, stepped side by side; a trial has the same bits alone and beside others.

    Attributes:
      angle: of the joints at the start of the next step [rad], (trial, joint).
      velocity: of the joints [rad/s], (trial, joint).
      handle: displacement of the handle [m], (trial, axis).
      shoulder: its displacement [m], (trial, axis); without a strap, (trial, 0).
      force: what the handle exerted on the hand at the start of the last step [N], (trial, axis).
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
        n_threads: int = 0,
    ) -> None:
        """Begin at rest.

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
        self._n_threads = n_threads
        compile_body = functools.partial(
            build_model,
            environment=environment,
            timestep=timestep,
            rope=rope,
            strap=strap,
            n_history=self.n_history,
            visual=False,
        )
        # Room for everybody here and some who have been replaced.
        self._compile = functools.lru_cache(2 * len(subjects) + 8)(compile_body)
        self._bodies = [body_of(subject) for subject in subjects]
        model = self._compile(self._bodies[0])
        self._hinge, self._slide = columns(model, JOINTS), columns(model, SLIDES)
        self._tendon = model.tendon(BIARTICULAR).id
        self._position = trials_adjacent(np.zeros((len(subjects), model.nq)), 0)
        self._speed = trials_adjacent(np.zeros((len(subjects), model.nv)), 0)
        self.angle, self.velocity = self._position[:, self._hinge], self._speed[:, self._hinge]
        self.handle = self._position[:, self._slide]
        self.shoulder = self._position[:, columns(model, STRAP) if strap is not None else slice(0)]
        self._strength = np.zeros((2, len(subjects), 3))
        self._load()
        everybody = np.arange(len(subjects))
        self._set_muscles_of(everybody, subjects)
        self._reset(everybody)

    def _load(self) -> None:
        """Make the batch.

        People with one body share a model, which then stays in the processor's cache, and have rows of its fields for
        their muscles; people with several have a model each.
        """
        models = [self._compile(body) for body in self._bodies]
        batch = self._batch = Batch(models[0], len(models), self._n_threads)
        self._models = [copy.copy(model) for model in models] if len(set(self._bodies)) > 1 else []
        if self._models:
            self._muscles = [self._fields(model) for model in self._models]
        else:
            shared = [batch.expand(field) for field in MUSCLE_FIELDS]
            self._muscles = [MuscleFields(shared, self._hinge, self._tendon)]
        self._stale = False
        self._qpos, self._qvel, applied = (batch.bind(name) for name in ("qpos", "qvel", "qfrc_applied"))
        self._torque, self._push = applied[:, self._hinge], applied[:, self._slide]
        motor, gauge = models[0].actuator(REFLEXES[0]).id, models[0].sensor(STRAIN_GAUGE).adr[0]
        self._control = batch.bind("ctrl")[:, motor : motor + len(REFLEXES)]
        self.force = batch.bind("sensordata")[:, gauge : gauge + 2]

    @property
    def diverged(self) -> NDArray[np.bool_]:
        """Whether MuJoCo has put a trial back because it could not integrate it, (trial,)."""
        return (self._batch.warning[:, DIVERGED, 1] > 0).any(axis=1)

    def step(self, push: Array, torque: Array | float, control: Array) -> None:
        """One step of all trials.

        Args:
          push: force on the handle [N], (trial, axis).
          torque: on the joints [Nm], (trial, joint), or the same for all.
          control: of the reflex motors [Nm], (trial, joint).
        """
        if self._stale:
            self._batch.set_models(self._models)
            self._stale = False
        self._push[:], self._torque[:], self._control[:] = push, torque, control
        self._batch.step()
        self._position[:], self._speed[:] = self._qpos, self._qvel

    def set_muscles(self, trials: Indices, stiffness: Array, damping: Array) -> None:
        """Change springs and dampers of the joints in some trials.

        Args:
          trials: indices of those trials.
          stiffness: of their muscle groups (shoulder, two-joint, elbow) [Nm/rad], (trial, element).
          damping: of the groups [Nms/rad], (trial, element).
        """
        self._strength[:, trials] = stiffness, damping
        if self._models:
            for trial in trials.tolist():
                self._muscles[trial].write(*self._strength[:, trial])
            self._stale = True  # the batch reads models again when it is told to
        else:
            self._muscles[0].write(stiffness, damping, trials)

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest, in the place of some trials.

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
                    f"{(self.n_history - 1) * self.timestep:g} s, what this simulation remembers"
                )
        bodies = [body_of(subject) for subject in subjects]
        others = [trial for trial, body in zip(trials.tolist(), bodies, strict=True) if body != self._bodies[trial]]
        for trial, body in zip(trials.tolist(), bodies, strict=True):
            self._bodies[trial] = body
        if others and self._models:
            for trial in others:
                self._models[trial] = copy.copy(self._compile(self._bodies[trial]))
                self._muscles[trial] = self._fields(self._models[trial])
        elif others:
            state = self._batch.state.copy()
            self._load()
            self._batch.state[:] = state
            self.set_muscles(np.arange(len(self._bodies)), *self._strength)
        self._set_muscles_of(trials, subjects)
        self._reset(trials)

    def _set_muscles_of(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        stiffness, damping = (np.array([subject.muscle_groups(name) for subject in subjects]) for name in ("k", "b"))
        self.set_muscles(trials, stiffness, damping)

    def _reset(self, trials: Indices) -> None:
        if self._models:
            self._batch.set_models(self._models)
        self._batch.reset(trials)
        self._batch.warning[trials] = 0
        self._position[trials], self._speed[trials] = self._qpos[trials], self._qvel[trials]

    def _fields(self, model: mujoco.MjModel) -> MuscleFields:
        return MuscleFields([getattr(model, field) for field in MUSCLE_FIELDS], self._hinge, self._tendon)
