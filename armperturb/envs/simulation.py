"""Many arms on their manipulators, stepped in lockstep by MuJoCo's batch; what drives them comes from outside."""

import copy
import ctypes
import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from armperturb.controllers.layout import trials_adjacent
from armperturb.controllers.muscle import Indices
from armperturb.environment import Environment, Strap
from armperturb.models import BIARTICULAR, JOINTS, REFLEXES, SLIDES, STRAIN_GAUGE, STRAP, build_model, history_length
from armperturb.subject import RELAX, Subject

Array = NDArray[np.float64]

DIVERGED = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC")]


@functools.cache
def _warning_handler() -> tuple[ctypes.c_void_p, int | None]:
    """Where MuJoCo keeps its handler, and the address of one that does nothing."""
    library = next(Path(mujoco.__file__).parent.glob("libmujoco.*"))
    handler = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mju_user_warning")
    return handler, ctypes.cast(ctypes.CDLL(None).strlen, ctypes.c_void_p).value


@contextmanager
def silent_simulator() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to the terminal and to MUJOCO_LOG.TXT; `Batch.warning` counts them anyway.

    The batch calls its threads' handler without Python, so it must be a C function: any that takes a text and does
    nothing with it.
    """
    handler, nothing = _warning_handler()
    before = handler.value
    handler.value = nothing
    try:
        yield
    finally:
        handler.value = before


_ANY_MUSCLES: dict[str, Any] = {
    **{name: getattr(RELAX, name) for name in ("b_s", "b_se", "b_e", "k_s", "k_se", "k_e")},
    **{f"{quantity}_{entry}": 0.0 for quantity in ("kv", "kp", "ka", "kf") for entry in ("s", "se", "e")},
    "muscle": None,
}
"""What is replaced in a subject to tell whose compiled models differ in their muscles alone."""


MUSCLE_FIELDS = ("jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
"""Fields of a model that the springs and dampers of the muscles are in."""


class Simulation:
    """One arm on its manipulator per trial, stepped side by side; a trial has the same bits alone and beside others.

    Attributes:
      angle: of the joints at the start of the next step [rad], (trial, joint).
      velocity: of the joints [rad/s], (trial, joint).
      handle: displacement of the handle [m], (trial, axis).
      shoulder: its displacement [m], (trial, axis); without a strap, (trial, 0).
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
        self._environment, self._rope, self._strap, self._n_threads = environment, rope, strap, n_threads
        self._compiled: dict[Subject, mujoco.MjModel] = {}
        self._bodies = [_body(subject) for subject in subjects]
        model = self._compile(self._bodies[0])
        self._hinge, self._slide = _columns(model, JOINTS), _columns(model, SLIDES)
        self._tendon = model.tendon(BIARTICULAR).id
        self._position = trials_adjacent(np.zeros((len(subjects), model.nq)), 0)
        self._speed = trials_adjacent(np.zeros((len(subjects), model.nv)), 0)
        self.angle, self.velocity = self._position[:, self._hinge], self._speed[:, self._hinge]
        self.handle = self._position[:, self._slide]
        self.shoulder = self._position[:, _columns(model, STRAP) if strap is not None else slice(0)]
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
            self._rows: list[Any] = [[getattr(model, field) for model in self._models] for field in MUSCLE_FIELDS]
            batch.set_models(self._models)
        else:
            self._rows = [batch.expand(field) for field in MUSCLE_FIELDS]
        self._stale = False
        self._qpos, self._qvel, applied = (batch.bind(name) for name in ("qpos", "qvel", "qfrc_applied"))
        self._torque, self._push = applied[:, self._hinge], applied[:, self._slide]
        motor, gauge = models[0].actuator(REFLEXES[0]).id, models[0].sensor(STRAIN_GAUGE).adr[0]
        self._control = batch.bind("ctrl")[:, motor : motor + len(REFLEXES)]
        self._force = batch.bind("sensordata")[:, gauge : gauge + 2]

    @property
    def force(self) -> Array:
        """What the handle exerted on the hand at the start of the last step [N], (trial, axis)."""
        return self._force

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
        joints_k, joints_b, tendons_k, tendons_b = self._rows
        for joints, tendons, groups in ((joints_k, tendons_k, stiffness), (joints_b, tendons_b, damping)):
            if self._models:
                for trial, own in zip(trials.tolist(), groups.tolist(), strict=True):
                    joints[trial][self._hinge], tendons[trial][self._tendon] = own[::2], own[1]
            else:
                joints[trials, self._hinge], tendons[trials, self._tendon] = groups[:, ::2], groups[:, 1]
        self._stale = bool(self._models)  # the batch reads models again when it is told to

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
        bodies = [_body(subject) for subject in subjects]
        others = [trial for trial, body in zip(trials.tolist(), bodies, strict=True) if body != self._bodies[trial]]
        for trial, body in zip(trials.tolist(), bodies, strict=True):
            self._bodies[trial] = body
        if others and self._models:
            for trial in others:
                model = self._models[trial] = copy.copy(self._compile(self._bodies[trial]))
                for rows, field in zip(self._rows, MUSCLE_FIELDS, strict=True):
                    rows[trial] = getattr(model, field)
        elif others:
            state, rows = self._batch.state.copy(), self._rows
            self._load()
            self._batch.state[:] = state
            for into, values in zip(self._rows, rows, strict=True):
                for trial, own in enumerate(values):
                    into[trial][:] = own
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

    def _compile(self, body: Subject) -> mujoco.MjModel:
        if body not in self._compiled:
            self._compiled[body] = build_model(
                body,
                self._environment,
                timestep=self.timestep,
                rope=self._rope,
                strap=self._strap,
                n_history=self.n_history,
                visual=False,
            )
        return self._compiled[body]


def _body(subject: Subject) -> Subject:
    """The person but for the muscles, which a compiled model takes without being compiled again."""
    return replace(subject, **_ANY_MUSCLES)


def _columns(model: mujoco.MjModel, names: Sequence[str]) -> slice:
    """Where neighbouring joints are; each is one position, one velocity."""
    first = model.joint(names[0]).qposadr[0]
    return slice(first, first + len(names))
