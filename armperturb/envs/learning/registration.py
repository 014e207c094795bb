"""Three tasks by name, for gymnasium and dm_control. To import this loads no MuJoCo."""

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

if TYPE_CHECKING:
    from dm_control import composer

ENTRY_POINT = "armperturb.envs.learning.gym_env:ArmPerturbEnv"
VECTOR_ENTRY_POINT = "armperturb.envs.learning.gym_vector_env:ArmPerturbVectorEnv"

TASKS: dict[str, dict[str, Any]] = {
    "ArmPerturb/Position-v0": {"task": "PT", "perturbation": "multisine", "rms": 5.4},
    "ArmPerturb/Relax-v0": {"task": "RT", "perturbation": "multisine", "rms": 0.9, "displacement_weight": 100.0},
    "ArmPerturb/Pulse-v0": {"task": "PT", "perturbation": "pulse", "peak": (53.9, 107.8)},
}
"""Name to the settings in which a task differs from `TaskSettings`; forces are the thesis's of PT7.5, RT7.5 and PT0."""


def register_environments() -> None:
    """Tell gymnasium; a second time does nothing."""
    for name, settings in TASKS.items():
        if name not in gym.registry:
            gym.register(name, ENTRY_POINT, vector_entry_point=VECTOR_ENTRY_POINT, kwargs=settings)


def load_dm_env(
    name: str, *, random_state: int | np.random.RandomState | None = None, **settings: Any
) -> "composer.Environment":
    """A task as dm_control's composer has it: `dm_control.viewer` and all that knows dm_env take it.

    Its `task` is an `armperturb.envs.learning.dm_task.ArmPerturbTask`.

    Args:
      name: as gymnasium knows it, e.g. "ArmPerturb/Position-v0".
      random_state: seed of all episodes, or what they are drawn from; None is another each time.
      **settings: of `TaskSettings` that differ from those of the name.

    Raises:
      TypeError: a setting is unknown or has the wrong type.
      ValueError: the name is unknown, or a setting out of its range.
    """
    if name not in TASKS:
        raise ValueError(f"load_dm_env: name = {name!r}; expected one of {', '.join(TASKS)}")
    from armperturb.envs.learning.dm_task import compose

    return compose({**TASKS[name], **settings}, random_state)
