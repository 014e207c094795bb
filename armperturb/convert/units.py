"""Units of laboratories and their conversion to SI."""

import math
from collections.abc import Mapping

from armperturb.convert.tables import TABLES
from armperturb.validation import require_number

UNITS: Mapping[str, Mapping[str, float]] = TABLES["units"]
"""Our unit to the units that can be converted into it, with the factor."""


LONGEST_NUMBER = 50
"""Characters of a number with its unit, and digits of one without."""


def factor_to(ours: str, unit: object, where: str) -> float:
    """By what to multiply a value to have it in our unit.

    Args:
      ours: unit of the result, a key of `UNITS`.
      unit: of the value.
      where: file and field, for the message.

    Raises:
      ValueError: the unit is none of this quantity.
    """
    if not isinstance(unit, str) or unit not in UNITS[ours]:
        raise ValueError(f"{where} = {unit!r:.60}; expected a unit: {', '.join(UNITS[ours])}")
    return UNITS[ours][unit]


def parsed_number(text: str) -> float | None:
    """The number that a text is, without Python's separators of digits; None if it is none."""
    try:
        return float(text) if "_" not in text else None
    except ValueError:
        return None


def quantity(value: object, ours: str, where: str) -> float:
    """A number in our unit, from a number or from text such as "31 cm".

    Args:
      value: as the file has it.
      ours: unit of the result, and of a number without one.
      where: file and field, for the message.

    Raises:
      TypeError: it is neither a number nor text.
      ValueError: it is not finite, or the unit is none of this quantity.
    """
    owner, _, field = where.rpartition(": ")
    if not isinstance(value, str):
        if isinstance(value, int) and abs(value) > 10**LONGEST_NUMBER:
            raise ValueError(f"{where} has more than {LONGEST_NUMBER} digits; expected a number of a signal")
        require_number(owner, field, value)
        return float(value)  # type: ignore[arg-type]
    text, _, unit = value.strip().partition(" ")
    number = parsed_number(text) if len(value) <= LONGEST_NUMBER else None
    if number is None or not math.isfinite(number):
        raise ValueError(f"{where} = {value!r:.60}; expected a finite number, or one with its unit, e.g. '12 {ours}'")
    if unit.strip() not in UNITS[ours]:
        raise ValueError(f"{where} = {value!r}; expected a number with a unit: {', '.join(UNITS[ours])}")
    return number * UNITS[ours][unit.strip()]
