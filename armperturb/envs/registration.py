"""What gymnasium knows of this package: three tasks, by name. Nothing here loads MuJoCo."""

from typing import Any

import gymnasium as gym

ENTRY_POINT = "armperturb.envs.gym_env:ArmPerturbEnv"
VECTOR_ENTRY_POINT = "armperturb.envs.gym_vector_env:ArmPerturbVectorEnv"

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
