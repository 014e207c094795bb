"""Saved states of environments, and one thread at a time in each."""

import copy
import functools
import pickle
import threading
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Concatenate, ParamSpec, Self, TypeVar

from armperturb.envs.learning.task import TaskSettings

Types = Mapping[str, type | tuple[type, ...]]
"""Names of values and their types."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class Turn:
    """A context that one thread at a time may be in, as often as it likes; copies are free."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                "another thread is using this environment; expected one thread at a time (copy.deepcopy gives each "
                "thread an environment of its own)"
            )

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def in_turn(
    method: Callable[Concatenate[Any, Arguments], Result],
) -> Callable[Concatenate[Any, Arguments], Result]:
    """A method during which no other thread may be in a method like this; its object has a `Turn` named `_turn`."""

    @functools.wraps(method)
    def taken(self: Any, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with self._turn:
            return method(self, *args, **kwargs)

    return taken


def require_open(closed: bool, doing: str) -> None:
    """Refuse what a closed environment cannot do.

    Args:
      closed: whether the environment is.
      doing: what was asked for, for the message.

    Raises:
      RuntimeError: it is closed.
    """
    if closed:
        raise RuntimeError(f"{doing}: the environment is closed; expected one that is open")


def require_state(kind: str, state: object, fixed: Mapping[str, object], types: Types) -> None:
    """Refuse what `get_state` of such an environment would not give.

    Args:
      kind: of the environment, for the message.
      state: what to check.
      fixed: name to what must be the same in it.
      types: name to the type of what may differ, or several types.

    Raises:
      ValueError: it is no state, or of an environment of another kind or with other settings.
    """
    if not isinstance(state, dict) or set(state) != {*fixed, *types} or state["settings"] != fixed["settings"]:
        raise ValueError(f"set_state: state of another environment; expected one of {kind} with these settings")
    for name, value in fixed.items():
        if state[name] != value:
            raise ValueError(f"set_state: state of an environment with {name} = {state[name]}; expected {value}")
    for name, expected in types.items():
        if not isinstance(state[name], expected):
            raise ValueError(
                f"set_state: state with {name} of type {type(state[name]).__name__}; expected one from get_state"
            )


class Saved:
    """What can return to a saved state; `copy.deepcopy` and `pickle` keep all of it, too.

    Where another thread is in the midst of a step or a reset, all of these are refused with a RuntimeError.
    """

    FIXED: ClassVar[tuple[str, ...]] = ("settings",)
    """Names of the attributes in which environments that share states are the same."""

    STATE: ClassVar[Types]
    """Names of the attributes that change after the beginning, and their types."""

    settings: TaskSettings
    _turn: Turn

    @in_turn
    def get_state(self) -> dict[str, Any]:
        """All that trials to come depend on, and the rest of this one; it can be pickled.

        Raises:
          RuntimeError: another thread is in here.
        """
        return copy.deepcopy({name: getattr(self, name) for name in (*self.FIXED, *self.STATE)})

    @in_turn
    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a state, to the last bit as where it was saved.

        Args:
          state: from `get_state` of an environment with the same settings, of this process or another.

        Raises:
          ValueError: it is of an environment of another kind or with other settings.
          RuntimeError: another thread is in here.
        """
        require_state(type(self).__name__, state, {name: getattr(self, name) for name in self.FIXED}, self.STATE)
        for name, value in copy.deepcopy({name: state[name] for name in self.STATE}).items():
            setattr(self, name, value)

    @in_turn
    def __getstate__(self) -> dict[str, Any]:
        # Pickle does its work when the turn is over, hence it finds what another thread may change pickled already.
        changing = pickle.dumps({name: getattr(self, name) for name in self.STATE})
        rest = {name: value for name, value in self.__dict__.items() if name not in self.STATE}
        return {**rest, "_turn": Turn(), "_changing": changing}

    def __setstate__(self, state: dict[str, Any]) -> None:
        changing = pickle.loads(state.pop("_changing"))
        self.__dict__.update(state, **changing)

    @in_turn
    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        # Faster than by way of `__getstate__`.
        made = type(self).__new__(type(self))
        memo[id(self)] = made
        made.__dict__.update(copy.deepcopy(self.__dict__, memo))
        return made
