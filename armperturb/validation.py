"""Checks of values; each message names the owner, the field, its value, and what was expected."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from numbers import Integral, Real
from typing import Any

from armperturb.files import packaged_table

RANGES: dict[str, dict[str, dict[str, Any]]] = packaged_table(__package__, "ranges.toml")
"""Class to field to the bounds of its number, as arguments of `require_number`."""


LONGEST_NAME = 100
"""Of a person, a condition or a structure [characters]."""


def require_number(
    owner: str,
    field: str,
    value: object,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    below: float = math.inf,
    at_most: float = math.inf,
    whole: bool = False,
    optional: bool = False,
    finite: bool = True,
) -> None:
    """Refuse anything but a number within bounds, which is finite unless that is said otherwise.

    Args:
      owner: what the field belongs to, for the message.
      field: name of the field, for the message.
      value: the value to check.
      above: exclusive lower bound.
      at_least: inclusive lower bound.
      below: exclusive upper bound.
      at_most: inclusive upper bound.
      whole: whether it must be an integer.
      optional: whether None is good as well.
      finite: whether infinity is refused, without which it is good whatever the bounds.

    Raises:
      TypeError: value is not a number.
      ValueError: value is not finite or out of bounds.
    """
    if (optional and value is None) or (not finite and value == math.inf):
        return
    # Asking for a float first is many times faster.
    if isinstance(value, bool) or not isinstance(value, Integral if whole else (float, Real)):
        raise TypeError(f"{owner}: {field} = {value!r}; expected a {'whole ' if whole else ''}number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if math.isfinite(number) and above < number < below and at_least <= number <= at_most:
        return
    expected = [
        f"{word} {bound:g}"
        for word, bound in (("above", above), ("at least", at_least), ("below", below), ("at most", at_most))
        if math.isfinite(bound)
    ]
    raise ValueError(f"{owner}: {field} = {value!r}; expected a finite number {' and '.join(expected)}".rstrip())


def require_ranges(owner: str, settings: object) -> None:
    """Refuse settings of which a number is out of the range that `ranges.toml` has for their class.

    Args:
      owner: what they are, for the message.
      settings: instance of a class in `RANGES`.

    Raises:
      TypeError: a field is not a number.
      ValueError: it is not finite or out of its range.
    """
    for field, bounds in RANGES[type(settings).__name__].items():
        require_number(owner, field, getattr(settings, field), **bounds)


def require_name(owner: str, field: str, value: object) -> None:
    """Refuse anything but a name: text on one line that a terminal, a figure and a table show as it is.

    Raises:
      TypeError: it is no text, or empty.
      ValueError: it holds a character that is not printable, or is longer than `LONGEST_NAME`.
    """
    if not isinstance(value, str) or not value.strip():
        raise TypeError(f"{owner}: {field} = {value!r}; expected a text that is not empty")
    if not value.isprintable() or len(value) > LONGEST_NAME:
        expected = f"a text of at most {LONGEST_NAME} printable characters"
        raise ValueError(f"{owner}: {field} = {value!r:.80}; expected {expected}")


def require_whole(owner: str, field: str, value: object, *, at_least: int) -> None:
    """Refuse anything but a whole number from a bound on.

    Args:
      owner: what the field belongs to, for the message.
      field: name of the field, for the message.
      value: the value to check.
      at_least: inclusive lower bound.

    Raises:
      TypeError: value is not a whole number.
      ValueError: value is out of bounds.
    """
    require_number(owner, field, value, at_least=at_least, whole=True)


def require_type(what: str, value: object, kinds: type | tuple[type, ...], expected: str) -> None:
    """Refuse anything but an instance of some classes.

    Args:
      what: owner and field, for the message, e.g. "Trial: subject".
      value: the value to check.
      kinds: one class, or several.
      expected: what it should be, for the message.

    Raises:
      TypeError: value is something else.
    """
    if not isinstance(value, kinds):
        raise TypeError(f"{what} = {_on_one_line(value)}; expected {expected}")


def as_list(
    what: str, value: Any, single: type | tuple[type, ...], expected: str, *, or_none: bool = False
) -> list[Any]:
    """What was given for one thing or several, as a list.

    Args:
      what: owner and field, for the message.
      value: a single thing, or any iterable; what it holds is not checked.
      single: classes of a single thing, which stands for itself.
      expected: what it should be, for the message.
      or_none: whether an iterable of nothing is good.

    Raises:
      TypeError: value is neither.
      ValueError: it holds nothing.
    """
    if isinstance(value, single):
        return [value]
    # A text, a table and a named tuple are iterable, but are one thing.
    is_one = isinstance(value, (str, bytes, Mapping)) or hasattr(value, "_fields")
    require_type(what, value, () if is_one else Iterable, expected)
    several = list(value)
    if not several and not or_none:
        raise ValueError(f"{what} is empty; expected at least one")
    return several


def as_list_of(what: str, each: str, value: Any, kind: type, expected: str, *, or_none: bool = False) -> list[Any]:
    """What was given for one thing of a class or several, as a list in which nothing else is.

    Args:
      what: owner and field, for the message.
      each: what one of them is, for the message.
      value: see `as_list`.
      kind: their class.
      expected: see `as_list`.
      or_none: see `as_list`.

    Raises:
      TypeError: value or one in it is something else.
      ValueError: it holds nothing.
    """
    several = as_list(what, value, kind, expected, or_none=or_none)
    for item in several:
        require_type(each, item, kind, f"a {kind.__name__}")
    return several


def _on_one_line(value: object) -> str:
    """The start of a value's representation, whatever it is."""
    return f"{' '.join(repr(value).split()):.60}"


def require_one_of(owner: str, field: str, value: object, known: Sequence[str | None]) -> None:
    """Refuse anything but one of a few texts (or None, where that is among them).

    Args:
      owner: what the field belongs to, for the message.
      field: name of the field, for the message.
      value: the value to check.
      known: what it may be.

    Raises:
      ValueError: value is something else.
    """
    # Not by `in` alone: an array has no single answer to that.
    if not (value is None or isinstance(value, str)) or value not in known:
        raise ValueError(f"{owner}: {field} = {value!r:.60}; expected one of {', '.join(map(str, known))}")


def require_keys(owner: str, keys: Collection[str], known: Sequence[str], required: Collection[str] = ()) -> None:
    """Refuse a table with a key that is not known, or without one that is required.

    Args:
      owner: what the table is, for the message.
      keys: of the table.
      known: all that it may have.
      required: those that it must have.

    Raises:
      ValueError: a key is unknown or missing.
    """
    unknown, missing = [key for key in keys if key not in known], [key for key in required if key not in keys]
    for problem, key in [("unknown", key) for key in unknown] + [("missing", key) for key in missing]:
        raise ValueError(f"{owner}: {problem} key {key!r}; expected keys are {', '.join(known)}")
