"""How muscle departs from a linear spring, damper and reflex: its parameters and their ranges.

Equations, symbols and literature: docs/muscle.md.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from armperturb.validation import RANGES, require_keys, require_number

PerElement = float | tuple[float, float, float]
"""One number for all muscle elements, or three: single-joint shoulder, two-joint, single-joint elbow."""

MAX_PARTS = 64
"""Most parts of a distribution: more cost time and change nothing."""

_MAY_BE_INFINITE = ("elastic_limit_deg", "loss_angle_deg", "recovery_time", "thinning_velocity", "spindle_saturation")

ELEMENTS = ("shoulder", "two-joint", "elbow")
"""Muscle groups of eq. 2.10, in the order of all triples."""


@dataclass(frozen=True, kw_only=True)
class MuscleLaw:
    """What three muscle elements add to the linear muscle of a `Subject`; by default nothing.

    The elements are the muscle groups of eq. 2.10: single-joint shoulder, two-joint, single-joint elbow, each stretched
    by its own angle: q_s, q_s + q_e, q_e. A number stands for all three and is kept as three equal ones. Each mechanism
    is off, exactly, at its default.

    Attributes:
      short_range_stiffness: of each element, beside the long-range stiffness of the subject [Nm/rad], >= 0.
      elastic_limit_deg: mean over the parts of the stretch at which they yield [deg], >= 0; inf never yields.
      elastic_limit_spread: SD over mean of the elastic limits, which are distributed log-normally [-], 0 to 3.
      elastic_limit_slope: growth of the mean elastic limit with speed [rad per rad/s], 0 to 10 (thesis F.1).
      parts: elasto-plastic parts by which the distribution is represented, 1 to 64.
      loss_angle_deg: movement that leaves 1 / e of the short-range stiffness, were there no recovery [deg], > 0; inf
        loses none.
      recovery_time: time constant with which rest brings back what was lost [s], > 0; inf brings back nothing.
      thinning_velocity: speed at which damping has fallen to half of the subject's [rad/s], > 0; inf is linear.
      spindle_saturation: speed above the threshold at which the velocity response of the spindles has fallen to half of
        the linear one [rad/s], > 0; inf is linear. The response itself approaches the gain times this.
      spindle_direction: -1 to 1 [-]. Movement towards its sign has the subject's velocity feedback, movement the other
        way 1 - |spindle_direction| of it: 0 responds both ways, 1 to increasing angles only.
      spindle_threshold: speed of lengthening above which a muscle's velocity feedback acts [rad/s]; 0 is off. A muscle
        with a negative threshold is active at rest, and answers shortening too until that is as fast.
      spindle_threshold_slope: change of the threshold per unit of co-contraction [rad/s], negative in people whose
        active muscles respond earlier. `subject.at_level` moves the threshold; 0 keeps it.

    Raises:
      TypeError: a value is no number (or three), or parts is no whole number.
      ValueError: a value is out of its range.
    """

    short_range_stiffness: PerElement = 0.0
    elastic_limit_deg: PerElement = math.inf
    elastic_limit_spread: PerElement = 0.0
    elastic_limit_slope: PerElement = 0.0
    parts: int = 8
    loss_angle_deg: PerElement = math.inf
    recovery_time: PerElement = 1.0
    thinning_velocity: PerElement = math.inf
    spindle_saturation: PerElement = math.inf
    spindle_direction: PerElement = 0.0
    spindle_threshold: PerElement = 0.0
    spindle_threshold_slope: PerElement = 0.0

    def __post_init__(self) -> None:
        require_number("MuscleLaw", "parts", self.parts, at_least=1, at_most=MAX_PARTS, whole=True)
        for field, bounds in RANGES["MuscleLaw"].items():
            value = getattr(self, field)
            value = value.tolist() if isinstance(value, np.ndarray) else value
            values = tuple(value) if isinstance(value, tuple | list) else (value,) * 3
            if len(values) != 3:
                raise TypeError(
                    f"MuscleLaw: {field} = {value!r}; expected a number, or three for {', '.join(ELEMENTS)}"
                )
            for element in values:
                if not (field in _MAY_BE_INFINITE and element == math.inf):
                    require_number("MuscleLaw", field, element, **bounds)
            object.__setattr__(self, field, tuple(float(element) for element in values))

    def scaled(self, factor: float) -> Self:
        """The law with `factor` times the short-range stiffness; limits, times and speeds stay."""
        s, se, e = self.of_elements("short_range_stiffness")
        return replace(self, short_range_stiffness=(factor * s, factor * se, factor * e))

    def at_level(self, level: float) -> Self:
        """The law at `level` times the co-contraction: more short-range stiffness, and spindles with another threshold.

        Levels multiply: twice at a level of 2 is once at 4.
        """
        (v_s, v_se, v_e), (g_s, g_se, g_e) = map(self.of_elements, ("spindle_threshold", "spindle_threshold_slope"))
        more = level - 1.0
        return replace(
            self.scaled(level),
            spindle_threshold=(v_s + g_s * more, v_se + g_se * more, v_e + g_e * more),
            spindle_threshold_slope=(g_s * level, g_se * level, g_e * level),
        )

    def of_elements(self, field: str) -> tuple[float, float, float]:
        """Values (shoulder, two-joint, elbow) of a field."""
        return getattr(self, field)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """A law from its parameters by name; what is left out is off.

        Raises:
          ValueError: a key is unknown, or a value is refused.
          TypeError: `values` is no table, or a value has the wrong type.
        """
        if not isinstance(values, Mapping):
            raise TypeError(f"MuscleLaw = {values!r}; expected a table of parameters by name")
        require_keys("MuscleLaw", values, [field.name for field in fields(cls)])
        return cls(**values)
