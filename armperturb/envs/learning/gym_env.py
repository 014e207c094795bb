"""The gymnasium environment: one person in trials of a task, whose nervous system is the agent."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from numbers import Integral
from types import NoneType
from typing import Any, ClassVar, SupportsInt, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array
from armperturb.envs.learning.participants import ONLY, action_bounds, observation_bounds, own_action
from armperturb.envs.learning.session import Session
from armperturb.envs.learning.state import Saved, Turn, Types, in_turn, require_open
from armperturb.envs.learning.task import TaskSettings, task_settings
from armperturb.envs.render.camera import TRAIL
from armperturb.envs.render.clip import LARGEST
from armperturb.envs.render.gl import has_display
from armperturb.envs.render.live_view import LiveView, Moment
from armperturb.envs.render.viewer import require_display
from armperturb.subject import Subject
from armperturb.validation import require_number, require_one_of

VIEWS = ("oblique", "top")
"""Cameras of the rig."""

LONGEST_ARROW = 0.25
"""What the largest force of a task looks like [m]."""

WATCHED = ("joint_angle", "displacement", "perturbation", "force")
"""Parts of the truth that show."""


def spaces(settings: TaskSettings) -> tuple[Box, Box]:
    """Observation and action space of one person; the latter is normalised, as learning algorithms expect."""
    bounds, (low, high) = observation_bounds(settings), action_bounds(settings)
    return (
        Box(-bounds.astype(np.float32), bounds.astype(np.float32), dtype=np.float32),
        Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32),
    )


class KnownLength:
    """An environment whose `spec` has the number of decisions in a trial, or a lower limit that was given."""

    settings: TaskSettings
    max_episode_steps: int | None = None
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How gymnasium made it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            length = round(self.settings.duration * self.settings.control_rate)
            given = spec.max_episode_steps or self.max_episode_steps or length
            spec = replace(spec, max_episode_steps=min(given, length))
        self._spec = spec


class ArmPerturbEnv(KnownLength, Saved, gym.Env):
    """A person holds a handle that is perturbed; docs/environments.md says what is sensed, set and rewarded.

    `ArmPerturb/Position-v1`, `ArmPerturb/Relax-v1` and `ArmPerturb/Pulse-v1` are this with different `TaskSettings`.

    Attributes:
      settings: the task.
      own_action: by which the person does the task as in the study, (action,).
    """

    STATE: ClassVar[Types] = {
        "_session": Session,
        "_running": bool,
        "_np_random": (np.random.Generator, NoneType),
        "_np_random_seed": (int, NoneType),
        "_subject": (Subject, NoneType),
        "_watched": deque,
    }
    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 50}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        render_mode: str | None = None,
        view: str = "oblique",
        width: int = 640,
        height: int = 480,
        **settings: Any,
    ) -> None:
        """Make the environment; `reset` begins a trial.

        Args:
          render_mode: "rgb_array" for pictures, "human" for a window, None for neither.
          view: of pictures, "oblique" or "top".
          width: of pictures [pixel], up to 1920.
          height: of pictures [pixel], up to 1440.
          **settings: of `TaskSettings`.

        Raises:
          TypeError: a setting is unknown or has the wrong type.
          ValueError: a setting or the picture's size is out of its range, or render_mode or view unknown.
          RuntimeError: render_mode is "human", and there is no display.
        """
        self.settings = task_settings(settings)
        require_one_of("ArmPerturbEnv", "render_mode", render_mode, (None, *ArmPerturbEnv.metadata["render_modes"]))
        if render_mode == "human":
            require_display()
        self.render_mode = render_mode
        # Only modes that work on this machine, as some tools try all of them.
        modes = [mode for mode in ArmPerturbEnv.metadata["render_modes"] if mode != "human" or has_display()]
        self.metadata = {"render_modes": modes, "render_fps": self.settings.control_rate}
        self._live_view, self._closed = live_view(self.settings), False
        self._picture = checked_picture(view, width, height)
        self.observation_space, self.action_space = spaces(self.settings)
        self.own_action = own_action(self.settings).astype(np.float32)
        self._session = Session(self.settings, 1, n_threads=1)
        self._running, self._turn = False, Turn()
        self._subject: Subject | None = None
        # What was to be seen lately, (8,) as in `WATCHED`: in any mode, as a state may go where pictures are drawn.
        self._watched: deque[Array] = deque(maxlen=round(TRAIL * self.settings.control_rate) + 1)

    @in_turn
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next trial, at rest.

        Args:
          seed: of this trial and those that follow; None goes on with what there is.
          options: what differs from the settings in this trial, see `armperturb.envs.learning.task.OPTIONS`.

        Returns:
          Observation and info, see `Session.truth`.

        Raises:
          TypeError: the seed is no whole number, or an option has the wrong type.
          ValueError: an option is unknown or out of its range.
          RuntimeError: another thread is in here, or the window that shows the trials was closed.
        """
        self._require_window("reset")
        if seed is not None and not is_whole(seed):
            raise TypeError(f"reset: seed = {seed!r}; expected a whole number")
        draw = self.settings.drawing(options)  # first, so that refused options change nothing
        super().reset(seed=None if seed is None else int(seed))  # gymnasium knows Python's numbers only
        trial = draw(self.np_random)
        self._session.start(ONLY, [trial])
        self._running, self._subject = True, trial.subject
        self._watched.clear()
        return self._session.people.observe()[0], self._watched_info()

    @in_turn
    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One decision.

        Args:
          action: (action,), see `armperturb.envs.learning.participants.action_names`.

        Returns:
          Observation, reward, whether the handle reached the limit of the workspace, whether the trial is over, info.

        Raises:
          RuntimeError: there is no trial, or it is over; another thread is in here; or the window was closed.
          TypeError: the action is no array of numbers.
          ValueError: it has the wrong shape, or part of it is not finite, or out of its bounds where these are refused.
        """
        self._require_window("step")
        if not self._running:
            raise RuntimeError("step: the trial is over, or none has begun; expected reset first")
        (reward,), (terminated,), (truncated,) = self._session.step(self._session.people.lone(action))
        self._running = not (terminated or truncated)
        observation, info = self._session.people.observe()[0], self._watched_info()
        return observation, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> NDArray[np.uint8] | None:
        """A picture of this moment, (height, width, 3), in the mode "rgb_array"; a window shows each by itself.

        Raises:
          RuntimeError: no trial has begun, the environment is closed, or this machine cannot draw; the message then
            names what to install.
        """
        if self.render_mode != "rgb_array":
            return None
        require_open(self._closed, "render")
        return self._live_view.picture(self._moment(), *self._picture)

    def close(self) -> None:
        """Close what rendering opened; a second time does nothing."""
        self._closed = True
        self._live_view.close()

    def _require_window(self, doing: str) -> None:
        require_open(self._closed and self.render_mode == "human", doing)

    def _watched_info(self) -> dict[str, Any]:
        truth = self._session.truth()
        self._watched.append(np.concatenate([truth[name][0] for name in WATCHED]))
        if self.render_mode == "human":
            self._live_view.show(self._moment())
        return {name: values[0] if values.ndim > 1 else values.item() for name, values in truth.items()}

    def _moment(self) -> Moment:
        (largest,) = self._session.people.largest_forces()
        return moment(self.settings, self._subject, list(self._watched), float(largest))


def moment(settings: TaskSettings, subject: Subject | None, watched: Sequence[Array], largest: float) -> Moment:
    """What shows of a person now, with arrows to the scale of the task's forces, or of the trial's if these are larger.

    Args:
      settings: the task.
      subject: the person; None before the first trial.
      watched: what was to be seen up to now, the oldest first, (8,) each, as in `WATCHED`.
      largest: force of the trial's perturbation [N].

    Raises:
      RuntimeError: no trial has begun.
    """
    if subject is None:
        raise RuntimeError("render: no trial has begun; expected reset first")
    of_task = np.max(settings.peak) if "pulse" in settings.perturbation else 0.0
    highest = max(of_task, 3.0 * np.max(settings.rms), largest)
    now = Moment(1.0 / settings.control_rate, LONGEST_ARROW / highest)
    now.begin(subject)
    now.trail.extend(row[2:4] for row in watched[:-1])
    now.update(*watched[-1].reshape(len(WATCHED), 2))
    return now


def is_whole(seed: object) -> TypeGuard[SupportsInt]:
    """Whether a seed is a whole number, Python's or NumPy's."""
    return isinstance(seed, Integral) and not isinstance(seed, bool)


def live_view(settings: TaskSettings) -> LiveView:
    """Pictures of a task."""
    return LiveView(settings.environment, 1.0 / settings.control_rate)


def checked_picture(view: str, width: int, height: int) -> tuple[str, int, int]:
    """The arguments.

    Raises:
      TypeError: width or height is no whole number.
      ValueError: the view is unknown, or width or height is below 1 or above `LARGEST`.
    """
    require_one_of("render", "view", view, VIEWS)
    for name, value, largest in zip(("width", "height"), (width, height), LARGEST, strict=True):
        require_number("render", name, value, at_least=1, at_most=largest, whole=True)
    return view, int(width), int(height)
