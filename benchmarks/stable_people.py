"""Our vector environment as stable-baselines3 wants to have one."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from armperturb.arrays import Array


class StablePeople(VecEnv):
    """People side by side, whose actions go from -1 to 1.

    Attributes:
      middle: of each action's range in the environment.
      half: of its width.
    """

    def __init__(self, envs: gym.vector.VectorEnv, seed: int) -> None:
        """Take over a vector environment.

        Args:
          envs: that begins new trials in the step in which old ones end.
          seed: of the first person; the others have the following ones.
        """
        self._envs, self._seed = envs, seed
        low, high = envs.single_action_space.low, envs.single_action_space.high
        self.middle, self.half = (low + high) / 2.0, (high - low) / 2.0
        super().__init__(envs.num_envs, envs.single_observation_space, gym.spaces.Box(-1.0, 1.0, low.shape))

    def reset(self) -> Array:
        """Begin everybody's first trial."""
        return self._envs.reset(seed=self._seed)[0]

    def step_async(self, actions: Array) -> None:
        """Take everybody's action."""
        self._actions = self.middle + self.half * actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        """What follows from them; who begins a new trial is told how the last one ended."""
        observations, rewards, terminated, truncated, info = self._envs.step(self._actions)
        over = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(over):
            cut = bool(truncated[i] and not terminated[i])
            infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": cut}
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Close the environments."""
        self._envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Everybody has the same."""
        return [getattr(self._envs, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Refused."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Nobody is."""
        return [False] * self.num_envs
