"""What acts on an arm at each step beside its springs and constant activations."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from armperturb.controllers.arm_control import ArmControl
from armperturb.envs.lab.posture import muscles_of
from armperturb.models.rig import JOINTS, REFLEXES
from armperturb.subject import Subject
from armperturb.validation import require_number

Step = Callable[[], None]
"""Called at the start of each step: reads the state and writes `ctrl` and `qfrc_applied`."""

Controller = Callable[[mujoco.MjModel, mujoco.MjData], Step]
"""Called with an arm at rest at the beginning of each trial."""


@dataclass(frozen=True, kw_only=True)
class StretchReflex:
    """Delayed stretch reflexes: each muscle's excitation rises with its own stretch and speed of stretch,

        u(t) = u_0 + (length (l(t - delay) - l_0) + velocity l'(t - delay)) / L_0,    0 <= u <= 1,

    with l the length of muscle and tendon, l_0 that at rest, L_0 the optimal length and u_0 the excitation that holds
    the posture. The muscle's own activation dynamics follow.

    Attributes:
      length: excitation per relative stretch [-], >= 0.
      velocity: excitation per relative speed of stretch [s], >= 0.
      delay: of the nerves [s], > 0; rounded to whole steps.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is not finite or out of its range.
    """

    length: float = 0.0
    velocity: float = 0.0
    delay: float = 0.03

    def __post_init__(self) -> None:
        for name in ("length", "velocity"):
            require_number("StretchReflex", name, getattr(self, name), at_least=0.0)
        require_number("StretchReflex", "delay", self.delay, above=0.0, at_most=1.0)

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> Step:
        """Begin at rest, see `Controller`.

        Raises:
          ValueError: the model has no muscles.
        """
        muscles = muscles_of(model)
        if not len(muscles):
            raise ValueError("StretchReflex: the model has no muscles; expected actuators of type muscle")
        at_rest, excitation = data.actuator_length[muscles].copy(), data.ctrl[muscles].copy()
        # MuJoCo gives the range of a muscle's length in metres and in optimal lengths.
        optimal = np.ptp(model.actuator_lengthrange[muscles], axis=1) / np.ptp(
            model.actuator_gainprm[muscles, :2], axis=1
        )
        n_delay = max(round(self.delay / model.opt.timestep), 1)
        past = np.zeros((n_delay, len(muscles)))
        now = 0

        def step() -> None:
            nonlocal now
            # Of the state in `data` the model has derived lengths at the start of the step before only.
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            stretch = data.actuator_length[muscles] - at_rest
            drive = (self.length * stretch + self.velocity * data.actuator_velocity[muscles]) / optimal
            data.ctrl[muscles] = np.clip(excitation + past[now], 0.0, 1.0)
            past[now] = drive
            now = (now + 1) % n_delay

        return step


@dataclass(frozen=True)
class PlanarReflexes:
    """Reflexes and muscle law of a person, for the arm of `rig.build_arm`.

    Attributes:
      subject: the person.
    """

    subject: Subject

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> Step:
        """Begin at rest, see `Controller`."""
        control = ArmControl([self.subject], model.opt.timestep)
        first_angle, first_velocity = (getattr(model.joint(JOINTS[0]), name)[0] for name in ("qposadr", "dofadr"))
        first_motor = model.actuator(REFLEXES[0]).id
        angle, velocity = data.qpos[first_angle : first_angle + 2], data.qvel[first_velocity : first_velocity + 2]
        applied = data.qfrc_applied[first_velocity : first_velocity + 2]
        sent = data.ctrl[first_motor : first_motor + 2]

        def step() -> None:
            torque, command = control.torque(angle[None], velocity[None])
            applied[:], sent[:] = torque[0], command[0]

        return step
