"""Saved states of environments, and one thread at a time in each."""

import copy
import threading
from typing import Any, ClassVar, Self

from armperturb.envs.learning.task import TaskSettings


class Turn:
    """A context that one thread at a time may be in. Copies are free, and refused while one is."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        with self:  # or a step is under way
            return type(self), ()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                "another thread is using this environment; expected one thread at a time (copy.deepcopy gives each "
                "thread an environment of its own)"
            )

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class Saved:
    """What can return to a saved state; `copy.deepcopy` and `pickle` keep all of it, too.

    Where another thread is in the midst of a step, all three are refused with a RuntimeError.
    """

    STATE: ClassVar[tuple[str, ...]]
    """Names of the attributes that change after the beginning."""

    settings: TaskSettings

    def get_state(self) -> dict[str, Any]:
        """All that trials to come depend on, and the rest of this one; it can be pickled."""
        return copy.deepcopy({"settings": self.settings, **{name: getattr(self, name) for name in self.STATE}})

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a state, to the last bit as where it was saved.

        Args:
          state: from `get_state` of an environment with the same settings, of this process or another.

        Raises:
          ValueError: it is of an environment of another kind or with other settings.
        """
        if not isinstance(state, dict) or set(state) != {"settings", *self.STATE} or state["settings"] != self.settings:
            raise ValueError(
                f"set_state: state of another environment; expected one of {type(self).__name__} with these settings"
            )
        for name, value in copy.deepcopy({name: state[name] for name in self.STATE}).items():
            setattr(self, name, value)
