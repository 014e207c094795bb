"""Pictures of a running trial, and a window that shows it."""

import time
from collections import deque
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.envs.render.camera import TRAIL, Camera, force_arrows, simplify
from armperturb.envs.render.viewer import open_window
from armperturb.models.rig import build_model
from armperturb.subject import Subject


class Moment:
    """What shows of one person in a running trial: the arm, disturbance and reaction force, and the handle's path.

    Attributes:
      subject: the person; None before the first trial.
      pose: joint angles [rad] and displacement of the handle [m], (4,).
      forces: disturbance and reaction force [N], (2, axis).
      trail: displacements up to now [m], the oldest first.
      scale: length of an arrow per force [m/N].
    """

    def __init__(self, period: float, scale: float) -> None:
        """Begin with nothing to show.

        Args:
          period: between moments [s].
          scale: length of an arrow per force [m/N].
        """
        self.scale = scale
        self.subject: Subject | None = None
        self.pose, self.forces = np.zeros(4), np.zeros((2, 2))
        self.trail: deque[Array] = deque(maxlen=round(TRAIL / period) + 1)

    def begin(self, subject: Subject) -> None:
        """Begin a trial, of this subject."""
        self.subject = subject
        self.trail.clear()

    def update(self, angle: Array, handle: Array, disturbance: Array, reaction: Array) -> None:
        """Set the next instant: joint angles [rad], displacement [m], and forces [N], two numbers each."""
        self.pose = np.concatenate([angle, handle])
        self.forces = np.array([disturbance, reaction])
        self.trail.append(self.pose[2:])


class LiveView:
    """Shows moments of trials in pictures or in a window, which the first one opens and `close` closes."""

    def __init__(self, environment: Environment, period: float) -> None:
        """Begin with nothing open.

        Args:
          environment: what the hand holds.
          period: between moments [s].
        """
        self._environment, self._period = environment, period
        self._size: tuple[float, ...] | None = None
        self._camera: Camera | None = None
        self._window: Any = None
        self._next = 0.0

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_size": None, "_camera": None, "_window": None}

    def picture(self, moment: Moment, view: str, width: int, height: int) -> NDArray[np.uint8]:
        """A moment as a picture, (height, width, 3); arguments and errors as in `Camera`."""
        self._close_others(moment)
        if self._camera is None:
            model = self._model(moment)
            simplify(model, height)
            self._camera = Camera(model, width=width, height=height)
        arrows = force_arrows(moment.forces[0], moment.forces[1], moment.scale)
        return self._camera.draw(moment.pose, view, arrows=arrows, trail=np.array(moment.trail))

    def show(self, moment: Moment) -> None:
        """Show a moment in a window, in real time: wait until it is due.

        Raises:
          RuntimeError: no window can be opened.
        """
        self._close_others(moment)
        if self._window is None:
            data = mujoco.MjData(self._model(moment))
            self._window = open_window(data.model, data), data
            self._next = time.monotonic()
        window, data = self._window
        time.sleep(max(0.0, self._next - time.monotonic()))
        self._next = max(self._next, time.monotonic() - self._period) + self._period
        with window.lock():
            data.qpos[:] = moment.pose
            mujoco.mj_forward(data.model, data)
        window.sync()

    def close(self) -> None:
        """Close what was opened; a second time does nothing."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        if self._window is not None:
            self._window[0].close()
            self._window = None

    def _close_others(self, moment: Moment) -> None:
        """Close what shows a person of another size."""
        assert moment.subject is not None, "begin comes first"
        size = moment.subject.l_h, moment.subject.l_f, moment.subject.theta_s_deg, moment.subject.theta_e_deg
        if size != self._size:
            self.close()
            self._size = size

    def _model(self, moment: Moment) -> mujoco.MjModel:
        assert moment.subject is not None, "begin comes first"
        return build_model(moment.subject, self._environment)
