"""Three tasks by name, for gymnasium and dm_control. This module imports neither, nor MuJoCo."""

import sys
import warnings
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from armperturb.extras import naming_the_extra
from armperturb.files import packaged_table
from armperturb.validation import require_one_of

if TYPE_CHECKING:
    import numpy as np
    from dm_control import composer

ENTRY_POINT = "armperturb.envs.learning.gym_env:ArmPerturbEnv"
VECTOR_ENTRY_POINT = "armperturb.envs.learning.gym_vector_env:ArmPerturbVectorEnv"

NEWEST = "v1"
"""Version of the environments to use; the others are there for what was trained in them."""

_TABLE = packaged_table(__package__, "environments.toml")
TASKS: dict[str, dict[str, Any]] = {
    f"ArmPerturb/{task}-{version}": {**common, **settings}
    for version, common in _TABLE["versions"].items()
    for task, settings in _TABLE["tasks"].items()
}
"""Name to the settings in which a task differs from `TaskSettings`; forces are the thesis's of PT7.5, RT7.5 and PT0.

Versions have the same trials. In v0 the reward is minus a cost without bounds and observations are physical; gymnasium
says on `make` that it is out of date.
"""


def register_environments() -> None:
    """Register the tasks with gymnasium: now if it is imported already, and otherwise as soon as it is."""
    gymnasium = sys.modules.get("gymnasium")
    if gymnasium is not None:
        _register(gymnasium)
    elif not any(isinstance(finder, _GymnasiumFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _GymnasiumFinder())


def _register(gymnasium: ModuleType) -> None:
    for name, settings in TASKS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, ENTRY_POINT, vector_entry_point=VECTOR_ENTRY_POINT, kwargs=settings)


class _GymnasiumFinder(MetaPathFinder):
    """Adds the registration to the import of gymnasium, which loads no plugins by itself."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's spec, as the other finders give it."""
        if fullname != "gymnasium":
            return None
        specs = (finder.find_spec(fullname, path, target) for finder in sys.meta_path if finder is not self)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                sys.meta_path.remove(self)
                _register(module)

            spec.loader.exec_module = execute_and_register  # type: ignore[method-assign]
        return spec


def load_dm_env(
    name: str, *, random_state: "int | np.random.RandomState | None" = None, **settings: Any
) -> "composer.Environment":
    """A task as dm_control's composer has it: `dm_control.viewer` and all that knows dm_env take it.

    Its `task` is an `armperturb.envs.learning.dm_task.ArmPerturbTask`.

    Args:
      name: as gymnasium knows it, e.g. "ArmPerturb/Position-v1".
      random_state: seed of all episodes, or what they are drawn from; None is another each time.
      **settings: of `TaskSettings` that differ from those of the name.

    Raises:
      TypeError: a setting is unknown or has the wrong type.
      ValueError: the name is unknown, or a setting out of its range.

    Warns:
      DeprecationWarning: there is a newer version.
    """
    require_one_of("load_dm_env", "name", name, tuple(TASKS))
    if not name.endswith(NEWEST):
        warnings.warn(f"{name} is out of date; expected version {NEWEST}", DeprecationWarning, stacklevel=2)
    with naming_the_extra("load_dm_env"):
        from armperturb.envs.learning.dm_task import compose

    return compose({**TASKS[name], **settings}, random_state)
