"""The vectorised gymnasium environment: many people on one batch, each the same to the last bit as alone."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array, Flags, Indices
from armperturb.envs.lab.trial import Trial
from armperturb.envs.learning.gym_env import (
    WATCHED,
    ArmPerturbEnv,
    KnownLength,
    checked_picture,
    is_whole,
    live_view,
    moment,
    spaces,
)
from armperturb.envs.learning.participants import as_array, own_action
from armperturb.envs.learning.session import Session
from armperturb.envs.learning.state import Saved, Turn, Types, in_turn, require_open
from armperturb.envs.learning.task import task_settings
from armperturb.validation import require_number, require_one_of, require_whole


class ArmPerturbVectorEnv(KnownLength, Saved, VectorEnv):
    """`num_envs` of `ArmPerturbEnv`, as `gymnasium.vector.SyncVectorEnv` would run them, but side by side.

    `gymnasium.make_vec("ArmPerturb/Position-v1", num_envs=256)` makes one.

    Attributes:
      settings: the task.
      own_action: by which the person does the task as in the study, (action,).
    """

    FIXED = ("settings", "num_envs", "autoreset_mode", "max_episode_steps")
    STATE: ClassVar[Types] = {
        "_session": Session,
        "_subjects": list,
        "_streams": list,
        "_over": np.ndarray,
        "_decisions": np.ndarray,
    }
    metadata: dict[str, Any] = dict(ArmPerturbEnv.metadata)  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        view: str = "oblique",
        width: int = 640,
        height: int = 480,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        n_threads: int = 0,
        **settings: Any,
    ) -> None:
        """Make the environment; `reset` begins trials.

        Args:
          num_envs: number of people.
          render_mode: "rgb_array" or None.
          view: of pictures, "oblique" or "top".
          width: of pictures [pixel], up to 1920.
          height: of pictures [pixel], up to 1440.
          autoreset_mode: when the next trial begins after one that is over: "NextStep", "SameStep", or "Disabled".
          max_episode_steps: decisions after which a trial is truncated, if it is not over before.
          n_threads: of the simulation; 0 takes all cores.
          **settings: of `TaskSettings`.

        Raises:
          TypeError: a setting is unknown or has the wrong type.
          ValueError: a setting is out of its range.
        """
        owner = "ArmPerturbVectorEnv"
        require_whole(owner, "num_envs", num_envs, at_least=1)
        require_number(owner, "max_episode_steps", max_episode_steps, at_least=1, whole=True, optional=True)
        require_whole(owner, "n_threads", n_threads, at_least=0)
        self.settings = task_settings(settings)
        self.num_envs, self.max_episode_steps = num_envs, max_episode_steps
        require_one_of(owner, "render_mode", render_mode, (None, "rgb_array"))
        self.render_mode = render_mode
        if not isinstance(autoreset_mode, AutoresetMode):
            require_one_of(owner, "autoreset_mode", autoreset_mode, tuple(mode.value for mode in AutoresetMode))
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": self.settings.control_rate,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = spaces(self.settings)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.own_action = own_action(self.settings).astype(np.float32)
        self._session = Session(self.settings, num_envs, n_threads)
        self._live_view = live_view(self.settings)
        self._subjects = [self.settings.subject] * num_envs
        self._picture = checked_picture(view, width, height)
        self._streams: list[np.random.Generator | None] = [None] * num_envs
        self._over = np.ones(num_envs, dtype=bool)  # no trial has begun
        self._decisions = np.zeros(num_envs, dtype=int)
        self._turn = Turn()

    @in_turn
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin the next trials, at rest.

        Args:
          seed: of the first person, the others have the following ones; or one for each; None goes on with what there
            is.
          options: as of `ArmPerturbEnv.reset`, for all; `reset_mask` (num_envs,) selects the people to reset, by
            default all.

        Returns:
          Observations, (num_envs, sense), and infos: names of `Session.truth` to arrays, and each with an underscore to
          whom it belongs.

        Raises:
          TypeError: an option has the wrong type.
          ValueError: an option is unknown or out of its range, or there are not as many seeds as people.
          RuntimeError: another thread is in here.
        """
        seeds = self._seeds(seed)
        everybody = np.ones(self.num_envs, dtype=bool)
        mask = everybody
        if isinstance(options, Mapping):
            mask = as_array("reset: reset_mask", options.get("reset_mask", everybody))
            options = {key: value for key, value in options.items() if key != "reset_mask"}
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset: reset_mask of type {mask.dtype} and shape {mask.shape}; expected True or False for each of "
                f"{self.num_envs} environments, at least one True"
            )
        beginning = np.flatnonzero(mask)
        # All checks come first, so that refused arguments change nothing.
        draw = self.settings.drawing(options)
        streams = {
            i: stream if stream is not None and seeds[i] is None else seeding.np_random(seeds[i])[0]
            for i, stream in enumerate(self._streams)
            if mask[i]
        }
        self._start(beginning, [draw(stream) for stream in streams.values()])
        for i, stream in streams.items():
            self._streams[i] = stream
        return self._session.people.observe(), self._infos(mask)

    @in_turn
    def step(self, actions: ArrayLike) -> tuple[NDArray[np.float32], Array, Flags, Flags, dict[str, Any]]:
        """One decision of everybody.

        Args:
          actions: (num_envs, action), see `armperturb.envs.learning.participants.action_names`.

        Returns:
          Observations, rewards, terminations, truncations and infos, (num_envs, ...) each. Who begins a trial in this
          step, in the mode NEXT_STEP, gets its first observation and no reward.

        Raises:
          RuntimeError: a person has no trial, or one that is over in the mode DISABLED; or another thread is in here.
          TypeError: actions are no numbers.
          ValueError: they have the wrong shape, or one of them is not finite, or refused.
        """
        waiting = self._over
        if waiting.any() and (self.autoreset_mode is not AutoresetMode.NEXT_STEP or None in self._streams):
            raise RuntimeError(f"step: environment {np.argmax(waiting)} has no trial; expected reset first")
        rewards, terminated, truncated = self._session.step(actions)
        self._decisions += 1
        if self.max_episode_steps is not None:
            truncated |= self._decisions >= self.max_episode_steps
        # The arms of people who wait for a new trial were simulated too; their results are discarded.
        rewards[waiting], terminated[waiting], truncated[waiting] = 0.0, False, False
        over = terminated | truncated
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            infos = self._final_infos(over)
            self._start_next(np.flatnonzero(over))
            over = np.zeros_like(over)
        elif waiting.any():
            self._start_next(np.flatnonzero(waiting))
        self._over = over
        return self._session.people.observe(), rewards, terminated, truncated, {**infos, **self._infos()}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of everybody at this moment, (height, width, 3) each, in the mode "rgb_array"; without the path.

        Raises:
          RuntimeError: no trial has begun, the environment is closed, or this machine cannot draw; the message then
            names what to install.
        """
        if self.render_mode is None:
            return None
        require_open(self.closed, "render")
        begun = None not in self._streams
        truth = self._session.truth()
        watched = np.concatenate([truth[name] for name in WATCHED], axis=1)
        largest = self._session.people.largest_forces().tolist()
        moments = [
            moment(self.settings, subject if begun else None, [now], force)
            for subject, now, force in zip(self._subjects, watched, largest, strict=True)
        ]
        return tuple(self._live_view.picture(moment, *self._picture) for moment in moments)

    def close_extras(self, **_: Any) -> None:
        """Close what rendering opened."""
        self._live_view.close()

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        """One seed for each person; None goes on with what there is."""
        if seed is None:
            return [None] * self.num_envs
        if is_whole(seed):
            return [int(seed) + i for i in range(self.num_envs)]
        if isinstance(seed, np.ndarray):
            seed = seed.tolist()
        if not isinstance(seed, list | tuple) or not all(number is None or is_whole(number) for number in seed):
            raise TypeError(f"reset: seed = {seed!r}; expected a whole number, or one (or None) for each environment")
        if len(seed) != self.num_envs:
            raise ValueError(f"reset: {len(seed)} seeds; expected {self.num_envs}, one for each environment")
        return [None if number is None else int(number) for number in seed]

    def _start_next(self, people: Indices) -> None:
        draw, streams = self.settings.drawing(), [self._streams[i] for i in people.tolist()]
        self._start(people, [draw(stream) for stream in streams if stream is not None])

    def _start(self, people: Indices, trials: Sequence[Trial]) -> None:
        self._session.start(people, trials)
        for i, trial in zip(people.tolist(), trials, strict=True):
            self._subjects[i] = trial.subject
        self._decisions[people] = 0
        self._over[people] = False

    def _infos(self, whose: Flags | None = None) -> dict[str, Any]:
        whose = np.ones(self.num_envs, dtype=bool) if whose is None else whose
        infos: dict[str, Any] = dict(self._session.truth())
        for values in infos.values():
            values[~whose] = 0
        return infos | {f"_{name}": whose.copy() for name in infos}

    def _final_infos(self, over: Flags) -> dict[str, Any]:
        """What those saw and did not know at the end of their trials, as gymnasium hands it on."""
        observations, truth = self._session.people.observe(), self._session.truth()
        infos: dict[str, Any] = {}
        for i in np.flatnonzero(over).tolist():
            values = {name: of_all[i] for name, of_all in truth.items()}
            final = {name: value if value.ndim else value.item() for name, value in values.items()}
            infos = self._add_info(infos, {"final_obs": observations[i], "final_info": final}, i)
        return infos
