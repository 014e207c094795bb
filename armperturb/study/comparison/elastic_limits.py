"""Which perturbations take joints beyond their elastic limit (thesis F.2, F.3)."""

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.study.published import tables as published
from armperturb.study.results.quantities import JOINT_LETTERS, PULSE_LEVELS, Cell
from armperturb.validation import require_number

Row = dict[str, Any]

NAMES = {"s": "shoulder", "e": "elbow"}
"""A joint's letter in a cell to its name in table F.1."""

PAIRS = (
    *(("multisine", "F.4", f"{kind}_rotation", "F.2", f"{kind}_velocity") for kind in ("rms", "max")),
    *((f"pulse, {level}", "F.5", f"peak_rotation_{level}", "F.3", f"peak_velocity_{level}") for level in PULSE_LEVELS),
)
"""Perturbation, table and quantity of a rotation, and of the velocity that goes with it."""


def elastic_rows(cells: Mapping[Cell, float]) -> list[Row]:
    """A row for each rotation of tables F.4 and F.5 whose velocity is there too, in the order of table 2.1.

    Args:
      cells: of the published tables to values [rad, rad/s], means over people or those of one person, as
        `quantities.measured_cells` gives; others do not count.

    Returns:
      Columns: condition; perturbation, "multisine", or "pulse, min" or "pulse, max" by its level; quantity, "rms",
      "max" or "peak" of rotation [rad] and velocity [rad/s]; joint, "s" or "e"; limit, the elastic limit at this
      velocity [rad]; velocity_is, "within" the velocities at which the wrist's limit was measured, or "below" or
      "above" them, where the limit is that of the nearest; exceeds_limit, whether the rotation does.
    """
    arms = published.moment_arms()
    rows = []
    for condition, (perturbation, table, rotation, beside, velocity), joint in itertools.product(
        published.conditions(), PAIRS, JOINT_LETTERS
    ):
        pair = Cell(table, condition, f"{rotation}_{joint}"), Cell(beside, condition, f"{velocity}_{joint}")
        angle, speed = (cells.get(cell, math.nan) for cell in pair)
        if not (math.isnan(angle) or math.isnan(speed)):
            limit = float(elastic_limit(NAMES[joint], speed, arms))
            rows.append(
                {
                    "condition": condition,
                    "perturbation": perturbation,
                    "quantity": rotation.split("_")[0],
                    "joint": joint,
                    "rotation": angle,
                    "velocity": speed,
                    "limit": limit,
                    "velocity_is": "below" if speed < VELOCITY[0] else "above" if speed > VELOCITY[1] else "within",
                    "exceeds_limit": angle > limit,
                }
            )
    return rows


WRIST = "wrist"
"""Joint that the others are compared with."""

VELOCITY = (math.radians(74.5), math.radians(186.2))
"""Lowest and highest velocity of the experiments on the wrist [rad/s] (thesis F.1)."""

WRIST_LIMIT = (math.radians(1.4), math.radians(3.8))
"""Elastic limit of the wrist at these velocities, linear in between [rad] (thesis F.1)."""


def elastic_limit(joint: str, velocity: ArrayLike, moment_arms: Mapping[str, float]) -> Array:
    """Rotation up to which the muscles of a joint are elastic [rad], of the shape of velocity.

    Args:
      joint: one of `moment_arms`.
      velocity: of the joint in either direction [rad/s]; outside of `VELOCITY` the limit is that at its nearer end.
      moment_arms: joint to the mean moment arm of its muscles [m], > 0, with "wrist" among them.

    Raises:
      ValueError: there is no moment arm of the joint or the wrist, or one is not above 0.
    """
    for name in (joint, WRIST):
        if name not in moment_arms:
            raise ValueError(f"elastic_limit: joint = {name!r}; expected one of {', '.join(moment_arms)}")
        require_number("elastic_limit", f"moment arm of the {name}", moment_arms[name], above=0.0)
    of_wrist = np.interp(np.abs(np.asarray(velocity, dtype=float)), VELOCITY, WRIST_LIMIT)
    return np.asarray(of_wrist * moment_arms[WRIST] / moment_arms[joint])
