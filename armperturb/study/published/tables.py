"""The thesis's own numbers, as its tables print them, in SI units."""

import csv
import functools
import math
from collections.abc import Mapping
from importlib import resources
from typing import NamedTuple

from armperturb.files import packaged_table

SI = {"kN/m": 1e3, "ms": 1e-3, "mm": 1e-3, "deg": math.radians(1.0), "deg/s": math.radians(1.0)}
"""Factors from the printed units that are not SI."""

PARAMETER_TABLES: dict[str, dict[str, str]] = packaged_table(__package__, "fitted.toml")
"""Which table holds the parameters of a condition for the model that the thesis settled on; PT2.5 and PT22.5 were not
fitted with model 3b."""


class MeanSD(NamedTuple):
    """Mean and standard deviation over the thesis's subjects, SI."""

    mean: float
    sd: float


@functools.cache
def _rows(name: str) -> tuple[dict[str, str], ...]:
    text = resources.files(__package__).joinpath(f"{name}.csv").read_text(encoding="utf-8")
    return tuple(csv.DictReader(text.splitlines()))


@functools.cache
def _first_rows(csv_name: str, columns: tuple[str, ...]) -> dict[tuple[str, ...], dict[str, str]]:
    """Entries of some columns to the first row that has them."""
    return {tuple(row[column] for column in columns): row for row in reversed(_rows(csv_name))}


def _row(csv_name: str, missing: str, /, **wanted: str) -> dict[str, str]:
    """The first row whose columns have the wanted entries; KeyError with the words of `missing` if there is none."""
    try:
        return _first_rows(csv_name, tuple(wanted))[tuple(wanted.values())]
    except KeyError:
        raise KeyError(missing) from None


def _mean_sd(row: Mapping[str, str], factor: float, column: str = "") -> MeanSD:
    mean, sd = (row[f"{column}{name}"] for name in ("mean", "sd"))
    return MeanSD(factor * float(mean), factor * float(sd or "nan"))


def parameter(condition: str, name: str) -> MeanSD:
    """Published estimate of a parameter in a condition.

    Raises:
      KeyError: the thesis prints none.
    """
    if condition not in PARAMETER_TABLES:
        raise KeyError(f"no published parameters in {condition}; there are some in {', '.join(PARAMETER_TABLES)}")
    return estimate(name, **PARAMETER_TABLES[condition])


def estimate(name: str, table: str, *, model: str, start: str = "", quantity: str = "parameter") -> MeanSD:
    """An entry of one of the tables of appendices C to E.

    Args:
      name: of the parameter.
      table: as printed, e.g. "E.3".
      model: number of the structure.
      start: "theta_i1" to "theta_i6" in appendix D, "vartheta_i1" to "vartheta_i6" in appendix E.
      quantity: "parameter", its "SEM", or where the fit started, "initial", whose SD is NaN.

    Raises:
      KeyError: there is none.
    """
    missing = f"table {table} has no {quantity} of {name} for model {model} {start}".rstrip()
    row = _row("parameters", missing, parameter=name, table=table, model=model, start=start, quantity=quantity)
    return _mean_sd(row, SI.get(row["unit"], 1.0))


def bounds(name: str, table: str) -> tuple[float, float]:
    """Lower and upper bound of a parameter in table "C.2", "D.2" or "E.2", SI.

    Raises:
      KeyError: there are none.
    """
    missing = f"table {table} has no bounds of {name}"
    row = _row("bounds", missing, table=table, parameter=name)
    if not row["lower"]:
        raise KeyError(missing)
    factor = SI.get(row["unit"], 1.0)
    return factor * float(row["lower"]), factor * float(row["upper"])


def goodness_of_fit(quantity: str, table: str, *, model: str, start: str = "", condition: str = "PT7.5") -> float:
    """Mean over trials of how well a structure fits (tables C.5 to E.5).

    Args:
      quantity: "criterion" [-], "VAF_x" or "VAF_y" [%], or the number of trials "N_pos" or "N_stab".
      table: as printed, e.g. "E.5".
      model: number of the structure.
      start: as in `estimate`.
      condition: of the trials.

    Raises:
      KeyError: there is none.
    """
    wanted = {"quantity": quantity, "table": table, "model": model, "start": start, "condition": condition}
    missing = f"table {table} has no {quantity} for model {model} {start} in {condition}"
    return float(_row("goodness_of_fit", missing, **wanted)["mean"])


def applied_force(condition: str) -> MeanSD:
    """RMS force of the multisine, per axis [N] (table 2.1).

    Raises:
      KeyError: the thesis prints none.
    """
    return _condition(condition, "applied_force_rms_N", 1.0)


def rms_displacement(condition: str) -> MeanSD:
    """RMS displacement during the multisine, per axis [m] (table 2.1).

    Raises:
      KeyError: the thesis prints none.
    """
    return _condition(condition, "displacement_rms_mm", 1e-3)


def pulse_unit() -> MeanSD:
    """Peak force of pulse level 1 [N]: ten times the RMS force of PT7.5 (table 2.1)."""
    return _condition("PT7.5", "pulse_peak_force_unit_N", 1.0)


def joint_motion(condition: str, joint: str, quantity: str, pulse: str = "none") -> MeanSD:
    """Rotation [rad] or velocity [rad/s] of a joint (tables F.2 to F.6).

    Args:
      condition: e.g. "PT7.5".
      joint: "s" or "e".
      quantity: "rms_rotation", "max_rotation", "rms_velocity" or "max_velocity" during the multisine;
        "peak_rotation" or "peak_velocity" after a pulse.
      pulse: "none" for the multisine; "min", "max" (level), "left" or "right" (direction).

    Raises:
      KeyError: the thesis prints none.
    """
    missing = f"tables F.2 to F.6 have no {quantity} of joint {joint} in {condition} with pulse {pulse}"
    row = _row("joint_kinematics", missing, condition=condition, joint=joint, quantity=quantity, pulse=pulse)
    return _mean_sd(row, SI[row["unit"]])


class FitEntry(NamedTuple):
    """An entry of tables C.3 to C.22, D.3 to D.5 or E.3 to E.5.

    Attributes:
      table: as printed, e.g. "C.8".
      condition: whose trials were fitted.
      model: number of the structure.
      start: where the fit started, in appendices D and E, e.g. "theta_i1"; empty in C.
      quantity: "parameter", "SEM", "criterion" [-], "VAF_x" or "VAF_y" [%], or as shares of the trials [-] "N_pos" or
        "N_stab".
      parameter: name of the parameter; empty for the others.
      value: mean (SD), SI; a share has no SD.
    """

    table: str
    condition: str
    model: str
    start: str
    quantity: str
    parameter: str
    value: MeanSD


@functools.cache
def fit_entries() -> tuple[FitEntry, ...]:
    """All results in tables C.3 to C.22, D.3 to D.5 and E.3 to E.5, in the order of the tables."""
    entries = []
    for row in (*_rows("parameters"), *_rows("goodness_of_fit")):
        if row["quantity"] == "initial":  # where a fit started is no result
            continue
        factor = 1.0 / float(row["max_count"]) if row.get("max_count") else SI.get(row["unit"], 1.0)
        names = {name: row.get(name) or "" for name in FitEntry._fields[:-1]}
        entries.append(FitEntry(**names, value=_mean_sd(row, factor)))

    return tuple(sorted(entries, key=lambda entry: place_of(entry.table)))


def place_of(table: str) -> tuple[str, int]:
    """Where a table stands in the thesis: appendix or chapter, and number in it."""
    appendix, _, number = table.partition(".")
    return appendix, int(number)


def headline_text(name: str) -> str:
    """An entry of `headline.csv` as it stands there: a number, or "ns" for not significant.

    Raises:
      KeyError: there is none of that name.
    """
    return _row("headline", f"no headline number {name!r}", name=name)["value"]


def headline(name: str) -> float:
    """A number of the running text by its name in `headline.csv`, in the unit that stands there.

    Raises:
      KeyError: there is none of that name.
    """
    return float(headline_text(name))


def conditions() -> tuple[str, ...]:
    """Names of the thesis's conditions, in the order of table 2.1."""
    return tuple(dict.fromkeys(row["condition"] for row in _rows("conditions")))


def has_multisine(condition: str) -> bool:
    """Whether table 2.1 has a multisine in a condition."""
    return any(row["condition"] == condition and float(row["intended_rms_mm"]) > 0.0 for row in _rows("conditions"))


def pulse_levels(condition: str) -> tuple[str, ...]:
    """Names of a condition's pulse levels, "min" (1) and "max" (2); empty for no condition of the thesis."""
    return tuple(row["pulse_level_name"] for row in _rows("conditions") if row["condition"] == condition)


def peak_displacement(condition: str, level: str) -> MeanSD:
    """Peak displacement after a pulse, both directions pooled [m] (table 2.1).

    Args:
      condition: e.g. "PT7.5".
      level: of the pulse, "min" or "max".

    Raises:
      KeyError: the thesis prints none.
    """
    missing = f"table 2.1 has no peak displacement of level {level} in {condition}"
    row = _row("conditions", missing, condition=condition, pulse_level_name=level)
    return _mean_sd(row, 1e-2, "pulse_peak_displacement_cm_")


class JointMotion(NamedTuple):
    """An entry of tables F.2 to F.6; its fields are as the arguments of `joint_motion`.

    Attributes:
      table: as printed, e.g. "F.2".
      condition: e.g. "PT7.5".
      pulse: "none", "min", "max", "left" or "right".
      joint: "s" or "e".
      quantity: e.g. "rms_rotation".
    """

    table: str
    condition: str
    pulse: str
    joint: str
    quantity: str


def joint_motions() -> tuple[JointMotion, ...]:
    """All entries of tables F.2 to F.6, as printed."""
    return tuple(JointMotion(*(row[name] for name in JointMotion._fields)) for row in _rows("joint_kinematics"))


def moment_arms() -> dict[str, float]:
    """Joint ("wrist", "shoulder", "elbow") to the mean moment arm of its muscles [m] (table F.1).

    The mean is over the muscles that the printed one holds: it leaves out the second of two equal rows of the shoulder.
    """
    arms: dict[str, list[float]] = {}
    for row in _rows("moment_arms"):
        if row["in_printed_mean"] == "yes":
            arms.setdefault(row["joint"], []).append(SI[row["unit"]] * float(row["moment_arm"]))
    return {joint: sum(values) / len(values) for joint, values in arms.items()}


def _condition(condition: str, column: str, factor: float) -> MeanSD:
    missing = f"table 2.1 has no {column} in {condition}"
    row = _row("conditions", missing, condition=condition)
    if not (row[f"{column}_mean"] and row[f"{column}_sd"]):
        raise KeyError(missing)
    return _mean_sd(row, factor, f"{column}_")
