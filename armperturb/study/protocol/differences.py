"""Where two settings of a study differ, for messages that say it and decisions that depend on it."""

import json
from collections.abc import Iterator
from typing import Any, NamedTuple

MAX_SHOWN = 60
"""Characters of a value that are shown."""


class Difference(NamedTuple):
    """A value in which two settings differ.

    Attributes:
      keys: that lead to it. Entries of a list go by their name, such as conditions, or their place, in brackets.
      says: what it is there, and now.
    """

    keys: tuple[str, ...]
    says: str

    def __str__(self) -> str:
        return f"{'.'.join(self.keys).replace('.[', '[')} {self.says}"

    @property
    def setting(self) -> str:
        """Key of the setting that differs, whichever entry of a list it belongs to."""
        last = max((place for place, key in enumerate(self.keys[:-1]) if key.startswith("[")), default=-1)
        return self.keys[last + 1]


def differences(before: Any, wanted: Any, keys: tuple[str, ...] = ()) -> Iterator[Difference]:
    """Values in which two settings differ, as JSON has them.

    Args:
      before: settings that were read.
      wanted: settings of now.
      keys: that lead to the settings.
    """
    if isinstance(before, dict) and isinstance(wanted, dict):
        for key in dict.fromkeys([*before, *wanted]):
            inner = (*keys, key)
            if key not in before:
                yield Difference(inner, f"is missing there and {_shown(wanted[key])} now")
            elif key not in wanted:
                yield Difference(inner, f"is {_shown(before[key])} there and missing now")
            else:
                yield from differences(before[key], wanted[key], inner)
    elif before != wanted:
        then, now = _by_label(before), _by_label(wanted)
        # Else they are no lists, lists of numbers that differ in length, or the same entries in another order.
        if then and now and then != now and (len(before) == len(wanted) or "[0]" not in then):
            yield from differences(then, now, keys)
        else:
            yield Difference(keys, f"is {_shown(before)} there and {_shown(wanted)} now")


def _by_label(values: Any) -> dict[str, Any]:
    """The entries of a list by their name, else by their place, in brackets; nothing if it is no list."""
    if not isinstance(values, list):
        return {}
    return {
        f"[{value.get('name', place) if isinstance(value, dict) else place}]": value
        for place, value in enumerate(values)
    }


def _shown(value: Any) -> str:
    """A value as JSON, cut short if it is long."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}..."
