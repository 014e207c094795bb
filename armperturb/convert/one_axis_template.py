"""Guesses for the sidecar of one axis: columns of angle and torque, their units, the servo, who exerts the torque."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np

from armperturb.analysis.joint_balance import INERTIAS, limb_inertia
from armperturb.convert.columns import WORD, Column, axis_of
from armperturb.convert.fields import MEANINGS
from armperturb.convert.importer import import_trials
from armperturb.convert.reading import read_trials
from armperturb.convert.sidecar import BODIES, Sidecar
from armperturb.convert.tables import TABLES, Repair
from armperturb.convert.units import UNITS

ROLES: Mapping[str, str] = TABLES["roles_of_one_axis"]
"""Signal to words of names that stand for it, in the order in which they decide."""

MOTOR = {"motor", "mot", "drive", "actuator"}
"""Words of a force or torque that the device exerts as it is told to."""

LENGTHS, ANGLES = ("m", "mm", "cm"), ("rad", "deg", "mrad")
"""Units that a movement may have, the most usual first."""


def is_one_axis(columns: Sequence[Column]) -> bool:
    """Whether columns without a second axis hold a movement and a force or torque."""
    roles = _columns_by_role(columns)
    return "force" in roles and "displacement" in roles


def pairs_of_one_axis(columns: Sequence[Column]) -> dict[str, tuple[Column, Column]]:
    """Signal to two columns that may hold it, where perturbation, movement and force have two each; else empty.

    They are in the order of the file, which is most often that of the axes. A joint has no second axis.
    """
    roles = _columns_by_role(columns)
    named = ("perturbation", "force", "displacement")
    if any(len(roles.get(name, ())) != 2 for name in named) or _is_angular(roles):
        return {}
    return {name: (roles[name][0], roles[name][1]) for name in named}


def _columns_by_role(columns: Sequence[Column]) -> dict[str, list[Column]]:
    """Signal to the columns that may hold it, in the order of the file."""
    longest = max((len(column.values) for column in columns), default=0)
    roles: dict[str, list[Column]] = {}
    motors: list[Column] = []
    for column in columns:
        words, unit = column.words()
        stem, axis = axis_of(words)
        role = next((name for name, known in ROLES.items() if {*words, *stem} & {*known.split()}), None)
        if role is None and axis == "x" and stem == ("",):
            role = "displacement"
        is_torque = unit in (*UNITS["Nm"], *UNITS["N"]) or bool({*words} & {"tau", *ROLES["force"].split()})
        is_motor = is_torque and bool({*words} & MOTOR)
        if role is None and is_motor:
            role = "force"
        if role is not None and len(column.values) == longest:
            roles.setdefault(role, []).append(column)
            if role == "force" and is_motor:
                motors.append(column)
    # Beside what is measured, the torque of the motor is what perturbs; alone, it is what is measured.
    measured = [column for column in roles.get("force", ()) if not any(column is each for each in motors)]
    if motors and measured and "perturbation" not in roles:
        roles |= {"perturbation": motors, "force": measured}
    return roles


def one_axis_fields(path: Path, columns: Sequence[Column], guessed: dict[str, str]) -> dict[str, Any]:
    """Servo, signals and the joint's label as far as names and sizes show them.

    Args:
      path: of the file.
      columns: without those of time, rate, trial and labels.
      guessed: field to what to check in it, to which guesses are added.
    """
    roles = _columns_by_role(columns)
    angular = _is_angular(roles)
    ours = {"displacement": "rad" if angular else "m", "scheduling": "rad" if angular else "m"}
    content: dict[str, Any] = {"servo": "force" if "perturbation" in roles else "position", "signals": {}}
    guessed["servo"] = f"{MEANINGS['servo']} ({TABLES['origins']['servo']})"
    for name in ("perturbation", "displacement", "force", "scheduling"):
        if name not in roles:
            continue
        column, *others = roles[name]
        field, unit = f"signals.{name}", ours.get(name, "Nm" if angular else "N")
        signal: dict[str, Any] = {"channels": {"x": column.channel}, "unit": column.words()[1]}
        if name == "perturbation" and {*column.words()[0]} & MOTOR:
            guessed[f"{field}.channels.x"] = "what the motor exerts; no perturbation where it holds a position (servo)"
        if others:
            rest = ", ".join(other.channel for other in others)
            guessed[f"{field}.channels.x"] = f"one axis is taken; or {rest}, or two axes in place of servo"[:190]
        if "trial" in column.channel.rpartition("(")[2]:
            guessed.setdefault(f"{field}.channels.x", "columns are taken for trials; of several joints, choose one")
        if signal["unit"] not in UNITS[unit]:
            signal["unit"] = _movement_units(column, angular=angular)[0] if unit in ("m", "rad") else unit
            guessed[f"{field}.unit"] = "from the size of its values" if unit in ("m", "rad") else "the usual one"
        if name == "force":
            signal["exerted_by"] = "handle"
        content["signals"][name] = signal
    words = {word.lower() for text in (path.stem, *(column.label for column in columns)) for word in WORD.findall(text)}
    joint = next((name for name in INERTIAS if name in words - {"any", "mass"}), None)
    content["labels"] = {} if joint is None else {"joint": joint}
    return content


def _is_angular(roles: Mapping[str, Sequence[Column]]) -> bool:
    """Whether a name or a unit says that it is a joint and not a single direction."""
    (moved, unit), (forced, of_force) = (roles[name][0].words() for name in ("displacement", "force"))
    if unit in UNITS["m"] or of_force in UNITS["N"]:
        return False
    known = {*TABLES["words"]["angle"], *TABLES["words"]["torque"]}
    return unit in UNITS["rad"] or of_force in UNITS["Nm"] or bool({*moved, *forced} & known)


def _movement_units(column: Column, *, angular: bool) -> list[str]:
    """Units in which a movement is as large as movements are, the most usual first."""
    values = column.values[np.isfinite(column.values)]
    size = float(np.ptp(values)) if len(values) else 0.0
    low, high = (1e-3, 2.5) if angular else (3e-4, 0.5)
    units, factor = (ANGLES, UNITS["rad"]) if angular else (LENGTHS, UNITS["m"])
    return [unit for unit in units if low <= size * factor[unit] <= high] or [units[0]]


def settled_one_axis(
    path: Path, target: Path, content: dict[str, Any], guessed: dict[str, str], columns: Sequence[Column]
) -> list[str]:
    """Servo, unit of the movement and sign of the force with which the file obeys physics, put into the sidecar.

    Args:
      path: of the file.
      target: of the sidecar.
      content: of the sidecar, which is changed.
      guessed: field to what to check in it, which is changed.
      columns: of the file.

    Returns:
      Notes for the reader, one sentence each.
    """
    signals = content["signals"]
    force, displacement = signals["force"], signals["displacement"]
    perturbation = signals.get("perturbation")
    units = [displacement["unit"]]
    if "signals.displacement.unit" in guessed:
        column = next(each for each in columns if each.channel == displacement["channels"]["x"])
        units = _movement_units(column, angular=displacement["unit"] in ANGLES)
    servos = ["position"] if perturbation is None else ["force", "position"]
    refused, passed = [], []
    for servo, unit, body in product(servos, units, BODIES):
        displacement["unit"], force["exerted_by"], content["servo"] = unit, body, servo
        if servo == "position":
            signals.pop("perturbation", None)
        try:
            meaning = Sidecar.of(content, target)
            raw = read_trials(path, meaning)
            recording, _ = import_trials([(path, meaning, raw)], get_args(Repair), None)
        except (TypeError, ValueError) as error:
            refused.append(f"{error}")
            continue
        inertia = limb_inertia(recording)
        if inertia is not None:
            low, high = INERTIAS[content["labels"].get("joint", "any") if unit in ANGLES else "mass"]
            note = f"physics agrees: {servo} servo, the force of the {body} and movement in {unit} move {inertia:.3g} "
            note += "kg m^2" if unit in ANGLES else "kg"
            passed.append((servos.index(servo), abs(math.log(inertia**2 / (low * high))), unit, body, servo, note))
    best = min(passed, default=None)
    if best is None:
        best = (
            0,
            0.0,
            units[0],
            "handle",
            servos[0],
            ": ".join(("units and signs are unchecked", *refused[:1])),
        )
        guessed["signals.force.exerted_by"] = f"{MEANINGS['exerted_by']} ({TABLES['origins']['exerted_by']})"
    _, _, displacement["unit"], force["exerted_by"], content["servo"], note = best
    if content["servo"] == "force":
        content["signals"] = {"perturbation": perturbation, **signals}
    elif perturbation is not None:
        guessed.pop("signals.perturbation.unit", None)
        guessed.pop("signals.perturbation.channels.x", None)
        note += f"; {perturbation['channels']['x']} moves no virtual environment and was left out"
    return [note]
