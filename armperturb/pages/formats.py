"""How numbers and symbols are written on pages."""

import math
import re

from markupsafe import Markup

MISSING = "–"

GREEK = {"zeta": "ζ"}
"""Quantities whose symbol is a Greek letter."""


def digits(value: float | None, n: int = 3) -> str:
    """A number with n significant digits, never in powers of ten; a dash if there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    decimals = _decimals(value, n)
    return fixed(round(value, decimals), max(decimals, 0))


def fixed(value: float | None, decimals: int) -> str:
    """A number with so many decimals; a dash if there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:.{decimals}f}".replace("-", "−")


def signed(value: float | None, decimals: int = 1) -> str:
    """A difference: with its sign, if any of it is left."""
    text = fixed(value, decimals)
    if not any(digit in text for digit in "123456789"):
        return text.removeprefix("−")
    return text if text.startswith("−") else f"+{text}"


def chance(p_value: float | None) -> str:
    """A p value; what is small is said to be."""
    return "< 0.001" if p_value is not None and p_value < 1e-3 else fixed(p_value, 3)


def mean_sd(mean: float, sd: float) -> str:
    """Mean and standard deviation, both to the second digit of the latter; the mean alone if there is no spread."""
    if not math.isfinite(sd) or sd <= 1e-9 * abs(mean):
        return digits(mean)
    decimals = max(0, _decimals(sd, 2))
    return f"{fixed(mean, decimals)} ± {fixed(sd, decimals)}"


def words(name: str) -> str:
    """A name with words and conditions as they are written, e.g. PT2.5."""
    return re.sub(r"\b(pt|rt)(?=[\d ]|$)", lambda task: task.group().upper(), name.replace("_", " "))


def letter_and_subscript(parameter: str) -> tuple[str, str]:
    """The two parts of a parameter's symbol, e.g. k and "v,se" of kv_se."""
    quantity, _, place = parameter.partition("_")
    quantity = GREEK.get(quantity, quantity)
    return quantity[0], ",".join(filter(None, (quantity[1:], place)))


def symbol(parameter: str) -> Markup:
    """A parameter as its symbol, e.g. kv_se as k with the subscript v,se."""
    return Markup("<i>{}</i><sub>{}</sub>").format(*letter_and_subscript(parameter))


def _decimals(value: float, n: int) -> int:
    """Decimals that show n significant digits; negative where digits before the point are to be rounded."""
    # The exponent after rounding: 99.96 has three digits before the point.
    return n - 1 - int(f"{value:.{n - 1}e}".partition("e")[2])
