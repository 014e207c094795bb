"""Pictures of a running trial, and a window that shows it."""

import time
from collections import deque
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.envs.render.camera import TRAIL, Camera, force_arrows
from armperturb.envs.render.viewer import open_window
from armperturb.models.rig import build_model
from armperturb.subject import Subject


class LiveView:
    """One person in a running trial: disturbance and reaction force as arrows, and the handle's path.

    The first picture opens an OpenGL context or a window, and `close` closes it.
    """

    def __init__(self, environment: Environment, period: float, scale: float) -> None:
        """Begin with nothing to show.

        Args:
          environment: what the hand holds.
          period: between moments [s].
          scale: length of an arrow per force [m/N].
        """
        self._environment, self._period, self._scale = environment, period, scale
        self._trail: deque[Array] = deque(maxlen=round(TRAIL / period) + 1)
        self._pose, self._forces = np.zeros(4), np.zeros((2, 2))
        self._subject: Subject | None = None
        self._model: mujoco.MjModel | None = None
        self._camera: Camera | None = None
        self._window: Any = None
        self._next = 0.0

    @property
    def has_picture(self) -> bool:
        """Whether a trial has begun."""
        return bool(self._trail)

    def begin(self, subject: Subject) -> None:
        """Begin a trial, of this subject."""
        self._trail.clear()
        if self._subject is None or _size(subject) != _size(self._subject):
            self.close()
            self._model = None
        self._subject = subject

    def update(self, angle: Array, handle: Array, disturbance: Array, reaction: Array) -> None:
        """Set the next instant: joint angles [rad], displacement [m], and forces [N], two numbers each."""
        self._pose = np.concatenate([angle, handle])
        self._forces = np.array([disturbance, reaction])
        self._trail.append(self._pose[2:])

    def picture(self, view: str, width: int, height: int) -> NDArray[np.uint8]:
        """The instant as a picture, (height, width, 3); arguments and errors as in `Camera`."""
        if self._camera is None:
            self._camera = Camera(self._drawn_model(), width=width, height=height)
        disturbance, reaction = self._forces
        arrows = force_arrows(disturbance, reaction, self._scale)
        return self._camera.draw(self._pose, view, arrows=arrows, trail=np.array(self._trail))

    def show(self) -> None:
        """Show the instant in a window, in real time: wait until it is due.

        Raises:
          RuntimeError: no window can be opened.
        """
        if self._window is None:
            data = mujoco.MjData(self._drawn_model())
            self._window = open_window(self._model, data), data
            self._next = time.monotonic()
        window, data = self._window
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = max(self._next, time.monotonic() - self._period) + self._period
        with window.lock():
            data.qpos[:] = self._pose
            mujoco.mj_forward(self._model, data)
        window.sync()

    def close(self) -> None:
        """Close what was opened; a second time does nothing."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        if self._window is not None:
            self._window[0].close()
            self._window = None

    def _drawn_model(self) -> mujoco.MjModel:
        if self._model is None:
            assert self._subject is not None, "begin comes first"
            self._model = build_model(self._subject, self._environment)
        return self._model


def _size(subject: Subject) -> tuple[float, ...]:
    """What a picture shows of a person."""
    return subject.l_h, subject.l_f, subject.theta_s_deg, subject.theta_e_deg
