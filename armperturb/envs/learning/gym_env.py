"""The gymnasium environment: one person in trials of a task, whose nervous system is the agent."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from armperturb.envs.learning.participants import ONLY, action_bounds, observation_bounds, own_action
from armperturb.envs.learning.session import Session
from armperturb.envs.learning.state import Saved
from armperturb.envs.learning.task import TaskSettings, task_settings
from armperturb.envs.render.gl import has_display
from armperturb.envs.render.live_view import LiveView, Moment
from armperturb.envs.render.viewer import require_display
from armperturb.validation import require_one_of, require_whole

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
    """An environment whose `spec` has the number of decisions in a trial, where no other limit was given."""

    settings: TaskSettings
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How gymnasium made it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None and spec.max_episode_steps is None:
            spec = replace(spec, max_episode_steps=round(self.settings.duration * self.settings.control_rate))
        self._spec = spec


class ArmPerturbEnv(KnownLength, Saved, gym.Env):
    """A person holds a handle that is perturbed; docs/environments.md says what is sensed, set and rewarded.

    `ArmPerturb/Position-v1`, `ArmPerturb/Relax-v1` and `ArmPerturb/Pulse-v1` are this with different `TaskSettings`.

    Attributes:
      settings: the task.
      own_action: by which the person does the task as in the study, (action,).
    """

    STATE = ("_session", "_running", "_np_random", "_np_random_seed", "_moment")
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
          width: of pictures [pixel].
          height: of pictures [pixel].
          **settings: of `TaskSettings`.

        Raises:
          TypeError: a setting is unknown or has the wrong type.
          ValueError: a setting is out of its range, or render_mode or view unknown.
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
        self._live_view, self._moment = live_view(self.settings), Moment(1.0 / self.settings.control_rate)
        self._picture = checked_picture(view, width, height)
        self.observation_space, self.action_space = spaces(self.settings)
        self.own_action = own_action(self.settings).astype(np.float32)
        self._session = Session(self.settings, 1, n_threads=1)
        self._running = False

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
          TypeError: an option has the wrong type.
          ValueError: an option is unknown or out of its range.
        """
        draw = self.settings.drawing(options)  # first, so that refused options change nothing
        super().reset(seed=seed)
        trial = draw(self.np_random)
        self._session.start(ONLY, [trial])
        self._running = True
        self._moment.begin(trial.subject)
        return self._session.people.observe()[0], self._watched_info()

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One decision.

        Args:
          action: (action,), see `armperturb.envs.learning.participants.action_names`.

        Returns:
          Observation, reward, whether the handle reached the limit of the workspace, whether the trial is over, info.

        Raises:
          RuntimeError: there is no trial, or it is over.
          TypeError: the action is no array of numbers.
          ValueError: it has the wrong shape, or part of it is not finite, or out of its bounds where these are refused.
        """
        if not self._running:
            raise RuntimeError("step: the trial is over, or none has begun; expected reset first")
        (reward,), (terminated,), (truncated,) = self._session.step(np.asarray(action)[np.newaxis])
        self._running = not (terminated or truncated)
        observation, info = self._session.people.observe()[0], self._watched_info()
        return observation, float(reward), bool(terminated), bool(truncated), info

    def render(self) -> NDArray[np.uint8] | None:
        """A picture of this moment, (height, width, 3), in the mode "rgb_array"; a window shows each by itself.

        Raises:
          RuntimeError: no trial has begun, or this machine cannot draw; the message names what to install.
        """
        if self.render_mode != "rgb_array":
            return None
        if self._moment.subject is None:
            raise RuntimeError("render: no trial has begun; expected reset first")
        return self._live_view.picture(self._moment, *self._picture)

    def close(self) -> None:
        """Close what rendering opened; a second time does nothing."""
        self._live_view.close()

    def _watched_info(self) -> dict[str, Any]:
        info: dict[str, Any] = {name: values[0] for name, values in self._session.truth().items()}
        if self.render_mode is not None:
            self._moment.update(*(info[name].copy() for name in WATCHED))
            if self.render_mode == "human":
                self._live_view.show(self._moment)
        return {name: value if value.ndim else value.item() for name, value in info.items()}


def live_view(settings: TaskSettings) -> LiveView:
    """Pictures of a task, with arrows to the scale of its forces."""
    highest = max(np.max(settings.peak) if "pulse" in settings.perturbation else 0.0, 3.0 * np.max(settings.rms))
    return LiveView(settings.environment, 1.0 / settings.control_rate, LONGEST_ARROW / highest)


def checked_picture(view: str, width: int, height: int) -> tuple[str, int, int]:
    """The arguments.

    Raises:
      TypeError: width or height is no whole number.
      ValueError: the view is unknown, or width or height is below 1.
    """
    require_one_of("render", "view", view, VIEWS)
    for name, value in (("width", width), ("height", height)):
        require_whole("render", name, value, at_least=1)
    return view, int(width), int(height)
