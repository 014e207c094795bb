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


_ANYBODY: dict[str, Any] = {
    **{name: getattr(RELAX, name) for name in ("b_s", "b_se", "b_e", "k_s", "k_se", "k_e")},
    **{f"{quantity}_{entry}": 0.0 for quantity in ("kv", "kp", "ka", "kf") for entry in ("s", "se", "e")},
    **{name: getattr(RELAX, name) for name in ("task", "name", "fact_s", "fact_e", "zeta_act", "muscle")},
}
"""What is replaced in a subject to tell whose compiled models differ in their muscles alone."""


def body_of(subject: Subject) -> Subject:
    """The person but for what a compiled model takes without being compiled again, or knows nothing of."""
    return replace(subject, **_ANYBODY)


def columns(model: mujoco.MjModel, names: Sequence[str]) -> slice:
    """Where neighbouring joints are; each is one position, one velocity."""
    first = model.joint(names[0]).qposadr[0]
    return slice(first, first + len(names))


class MuscleFields:
    """Where a compiled model has springs and dampers of the muscle groups."""

    def __init__(self, model: mujoco.MjModel, hinges: slice, two_joint: int) -> None:
        """Find them.

        Args:
          model: the model.
          hinges: where shoulder and elbow are, from `columns`.
          two_joint: index of the tendon of the two-joint muscles.
        """
        self._hinges = model.jnt_stiffness[hinges], model.dof_damping[hinges]
        self._tendons = model.tendon_stiffness, model.tendon_damping
        self._two_joint = two_joint

    def write(self, stiffness: Sequence[float], damping: Sequence[float]) -> None:
        """Change the muscles.

        Args:
          stiffness: of the groups (shoulder, two-joint, elbow) [Nm/rad].
          damping: of the groups [Nms/rad].
        """
        for hinge, tendon, values in zip(self._hinges, self._tendons, (stiffness, damping), strict=True):
            hinge[0], tendon[self._two_joint], hinge[1] = values


class Simulation:
    """One arm on its manipulator per trial, stepped side by side; a trial has the same bits alone and beside others.

    Arrays are live: they hold the state at the start of the next step.

    Attributes:
      angle: of the joints [rad], (trial, joint).
      velocity: of the joints [rad/s], (trial, joint).
      handle: displacement of the handle [m], (trial, axis).
      force: that the handle exerted on the hand at the start of the last step [N], (trial, axis).
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
        self._environment, self._rope, self._strap = environment, rope, strap
        self._compiled: dict[Subject, mujoco.MjModel] = {}
        self._bodies = [body_of(subject) for subject in subjects]
        self._models = [copy.copy(self._compile(body)) for body in self._bodies]
        model = self._models[0]
        self._hinge, self._slide = columns(model, JOINTS), columns(model, SLIDES)
        self._tendon = model.tendon(BIARTICULAR).id
        self._muscles = [MuscleFields(one, self._hinge, self._tendon) for one in self._models]
        self._batch = Batch(model, len(subjects), n_threads)
        self._changed = False
        self.set_muscles(
            np.arange(len(subjects)),
            np.array([subject.muscle_groups("k") for subject in subjects]),
            np.array([subject.muscle_groups("b") for subject in subjects]),
        )
        self._batch.set_models(self._models)
        self._batch.reset()

        qpos, qvel, applied = (self._batch.bind(name) for name in ("qpos", "qvel", "qfrc_applied"))
        motor = model.actuator(REFLEXES[0]).id
        gauge = model.sensor(STRAIN_GAUGE).adr[0]
        self.angle, self.velocity, self.handle = qpos[:, self._hinge], qvel[:, self._hinge], qpos[:, self._slide]
        self.shoulder = qpos[:, columns(model, STRAP) if strap is not None else slice(0)]
        self.force = self._batch.bind("sensordata")[:, gauge : gauge + 2]
        self._torque, self._push = applied[:, self._hinge], applied[:, self._slide]
        self._control = self._batch.bind("ctrl")[:, motor : motor + len(REFLEXES)]

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
        if self._changed:
            self._batch.set_models(self._models)
            self._changed = False
        self._push[:], self._torque[:], self._control[:] = push, torque, control
        self._batch.step()

    def set_muscles(self, trials: Indices, stiffness: Array, damping: Array) -> None:
        """Change springs and dampers of the joints in some trials.

        Args:
          trials: indices of those trials.
          stiffness: of their muscle groups (shoulder, two-joint, elbow) [Nm/rad], (trial, element).
          damping: of the groups [Nms/rad], (trial, element).
        """
        for trial, k, b in zip(trials.tolist(), stiffness.tolist(), damping.tolist(), strict=True):
            self._muscles[trial].write(k, b)
        self._changed = True  # the batch reads models again when it is told to

    def replace(self, trials: Indices, subjects: Sequence[Subject]) -> None:
        """Put other people, at rest, in the place of some trials.

        Args:
          trials: indices of those trials, rising.
          subjects: as many people.

        Raises:
          ValueError: a delay reaches further back than `n_history` steps.
        """
        for subject in subjects:
            longest = max(subject.Td_s, subject.Td_e)
            if history_length(subject, self.timestep) > self.n_history:
                raise ValueError(
                    f"subject {subject.name!r}: delay = {longest:g} s; expected at most "
                    f"{(self.n_history - 1) * self.timestep:g} s, what this simulation remembers"
                )
        for trial, subject in zip(trials.tolist(), subjects, strict=True):
            body = body_of(subject)
            if body != self._bodies[trial]:
                self._bodies[trial] = body
                self._models[trial] = copy.copy(self._compile(body))
                self._muscles[trial] = MuscleFields(self._models[trial], self._hinge, self._tendon)
        self.set_muscles(
            trials,
            np.array([subject.muscle_groups("k") for subject in subjects]),
            np.array([subject.muscle_groups("b") for subject in subjects]),
        )
        self._batch.set_models(self._models)
        self._changed = False
        self._batch.reset(trials)
        self._batch.warning[trials] = 0

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
