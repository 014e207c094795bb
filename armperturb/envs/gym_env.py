"""The gymnasium environment: one person in trials of a task, whose nervous system is the agent."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from armperturb.envs.participants import action_bounds, observation_bounds, own_action
from armperturb.envs.session import Session
from armperturb.envs.task import TaskSettings

ONLY = np.zeros(1, dtype=int)
"""Index of the one person."""


def spaces(settings: TaskSettings) -> tuple[Box, Box]:
    """Observation and action space of one person; the latter is normalised, as learning algorithms expect."""
    bounds, (low, high) = observation_bounds(settings), action_bounds(settings)
    return (
        Box(-bounds.astype(np.float32), bounds.astype(np.float32), dtype=np.float32),
        Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32),
    )


class ArmPerturbEnv(gym.Env):
    """A person holds a handle that is perturbed; docs/environments.md tells what is sensed, set and rewarded.

    `ArmPerturb/Position-v0`, `ArmPerturb/Relax-v0` and `ArmPerturb/Pulse-v0` are this with different `TaskSettings`.

    Attributes:
      settings: the task.
      own_action: by which the person does the task as in the study, (action,).
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 50}  # noqa: RUF012 - as gymnasium declares it

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        """Get ready.

        Args:
          render_mode: "rgb_array" for pictures, "human" for a window, None for neither.
          **settings: of `TaskSettings`.

        Raises:
          TypeError: a setting is unknown or has the wrong type.
          ValueError: a setting is out of its range, or render_mode unknown.
        """
        self.settings = task_settings(settings)
        self.render_mode = checked_render_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": self.settings.control_rate}
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
          options: what differs from the settings in this trial, see `armperturb.envs.task.OPTIONS`.

        Returns:
          Observation and info, see `Session.truth`.

        Raises:
          TypeError: an option has the wrong type.
          ValueError: an option is unknown or out of its range.
        """
        super().reset(seed=seed)
        self._session.start(ONLY, [self.settings.trial(self.np_random, options)])
        self._running = True
        return self._session.people.observe()[0], self._info()

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One decision.

        Args:
          action: (action,), see `armperturb.envs.participants.action_names`.

        Returns:
          Observation, reward, whether the handle reached the limit of the workspace, whether the trial is over, info.

        Raises:
          RuntimeError: there is no trial, or it is over.
          TypeError: the action is no array of numbers.
          ValueError: it has the wrong shape, or part of it is not finite or out of its bounds.
        """
        if not self._running:
            raise RuntimeError("step: the trial is over, or none has begun; expected reset first")
        (reward,), (terminated,), (truncated,) = self._session.step(np.asarray(action)[np.newaxis])
        self._running = not (terminated or truncated)
        return self._session.people.observe()[0], float(reward), bool(terminated), bool(truncated), self._info()

    def _info(self) -> dict[str, Any]:
        truth = {name: values[0] for name, values in self._session.truth().items()}
        return {**truth, "time": float(truth["time"])}


def task_settings(settings: dict[str, Any]) -> TaskSettings:
    """Settings by name.

    Raises:
      TypeError: a name is unknown; otherwise as `TaskSettings`.
    """
    known = TaskSettings.__dataclass_fields__
    for name in settings:
        if name not in known:
            raise TypeError(f"unknown setting {name!r}; expected some of {', '.join(known)}")
    return TaskSettings(**settings)


def checked_render_mode(render_mode: str | None) -> str | None:
    """The render mode.

    Raises:
      ValueError: it is unknown.
    """
    known = ArmPerturbEnv.metadata["render_modes"]
    if render_mode is not None and render_mode not in known:
        raise ValueError(f"render_mode = {render_mode!r}; expected None or one of {', '.join(known)}")
    return render_mode
