"""The thesis's own numbers, as its tables print them, in SI units."""

import csv
import functools
from importlib import resources
from typing import NamedTuple

SI = {"kN/m": 1e3, "ms": 1e-3}
"""Factors from the printed units that are not SI."""

PARAMETER_TABLES = {
    "PT7.5": {"table": "E.3", "model": "3b", "start": "vartheta_i5"},
    "RT7.5": {"table": "C.18", "model": "1", "start": ""},
}
"""Which table holds the parameters of a condition for the model that the thesis settled on."""


class MeanSD(NamedTuple):
    """Mean and standard deviation over the thesis's subjects, SI."""

    mean: float
    sd: float


@functools.cache
def _rows(name: str) -> tuple[dict[str, str], ...]:
    text = resources.files("armperturb.study").joinpath("published", f"{name}.csv").read_text(encoding="utf-8")
    return tuple(csv.DictReader(text.splitlines()))


def parameter(condition: str, name: str) -> MeanSD:
    """Published estimate of a parameter in a condition.

    Raises:
      KeyError: the thesis prints none.
    """
    wanted = PARAMETER_TABLES[condition]
    for row in _rows("parameters"):
        if row["parameter"] == name and row["quantity"] == "parameter" and all(row[k] == v for k, v in wanted.items()):
            factor = SI.get(row["unit"], 1.0)
            return MeanSD(factor * float(row["mean"]), factor * float(row["sd"]))
    raise KeyError(f"table {wanted['table']} has no {name}")


def applied_force(condition: str) -> MeanSD:
    """RMS force of the multisine, per axis [N] (table 2.1)."""
    return _condition(condition, "applied_force_rms_N", 1.0)


def rms_displacement(condition: str) -> MeanSD:
    """RMS displacement during the multisine, per axis [m] (table 2.1)."""
    return _condition(condition, "displacement_rms_mm", 1e-3)


def headline(name: str) -> float:
    """A number of the running text by its name in `headline.csv`, in the unit that stands there.

    Raises:
      KeyError: there is none of that name.
    """
    for row in _rows("headline"):
        if row["name"] == name:
            return float(row["value"])
    raise KeyError(f"no headline number {name!r}")


def _condition(condition: str, column: str, factor: float) -> MeanSD:
    row = next(row for row in _rows("conditions") if row["condition"] == condition)
    return MeanSD(factor * float(row[f"{column}_mean"]), factor * float(row[f"{column}_sd"]))
