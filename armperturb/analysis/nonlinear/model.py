"""Which parameters of a person with a muscle law are estimated, and the person that their values describe."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from armperturb.analysis.fit import structures
from armperturb.arrays import Array
from armperturb.files import packaged_table
from armperturb.muscle_law import ELEMENTS, MAX_PARTS, MuscleLaw
from armperturb.subject import Subject, at_level
from armperturb.validation import require_number

Law = Literal["linear", "short-range", "full", "half-wave"]
"""No muscle law; short-range stiffness with yielding; also thixotropy, shear-thinning damping, spindle saturation; and,
in the position task, half-wave rectified spindles with a threshold.
"""

QUANTITIES = ("k", "b", "kv", "kp")
"""Quantities of which each muscle group has its own."""

EFFECTS: Mapping[str, tuple[str, ...]] = {"PT": QUANTITIES, "RT": QUANTITIES[:2]}
"""Task to the quantities that differ from trial to trial, each by one factor on all muscle groups."""

BODY, GRIP = ("m_h", "m_f"), ("k_h", "b_h")
SHORT_RANGE = ("short_range_stiffness", "elastic_limit_deg")
HALF_WAVE = ("spindle_direction", "spindle_threshold")
COMMON = (
    "elastic_limit_spread",
    "loss_angle_deg",
    "recovery_time",
    "thinning_velocity",
    "spindle_saturation",
    *HALF_WAVE,
)

FIXED: Mapping[str, float] = {"Td": 0.030, "fact": 3.5}
"""Delay [s] and cut-off of the activation [Hz] of both joints, unless they are set free (thesis 2.7)."""

_TABLES = packaged_table(__package__, "parameters.toml")

BOUNDS: Mapping[str, tuple[float, float]] = {name: (low, high) for name, (low, high) in _TABLES["bounds"].items()}
"""Of each parameter, in its `unit`; a group's stands for its three elements."""

ROUNDING = 1e-12
"""Share of a value that the coordinates may round it by [-]."""

LEAST_THINNING = 0.02
"""Least damping of a group that is shear-thinning [Nms/rad]."""

SIGNED: Mapping[str, float] = {
    **{"k": 0.2, "b": 0.1, "kv": 0.5, "kp": 2.0},
    **{"spindle_direction": 0.5, "spindle_threshold": 0.1},
}
"""Quantities that may be negative, to the size above which their coordinate is nearly the logarithm, in their `unit`.

A single-joint group has what the joint has beyond the two-joint group (eq. 2.10): it is negative at the shoulder of the
thesis's people in the position task.
"""


def stem(name: str) -> str:
    """Quantity that a parameter is of: "k.elbow [RT]" is of k."""
    return name.partition(" ")[0].partition(".")[0]


def leveled_condition(name: str) -> str:
    """Condition of which a parameter is the level, which only the position task has; "" if it is no level."""
    return name.removeprefix("level.").removesuffix(" [PT]") if stem(name) == "level" else ""


def unit(name: str) -> str:
    """Unit of a parameter; "-" if it has none."""
    return _TABLES["units"].get(stem(name)) or structures.unit(stem(name))


def bounds(name: str, law: Law) -> tuple[float, float]:
    """Least and greatest value of a parameter; shear-thinning damping must be positive."""
    low, high = BOUNDS[stem(name)]
    return (LEAST_THINNING, high) if law in ("full", "half-wave") and stem(name) == "b" else (low, high)


def coordinate(name: str, value: float) -> float:
    """What is estimated of a parameter: its logarithm, or asinh(value / size) + log(size / 2) if it may be negative."""
    size = SIGNED.get(stem(name))
    return math.log(value) if size is None else math.asinh(value / size) + math.log(size / 2.0)


def value_at(name: str, coordinate: float) -> float:
    """The parameter with a `coordinate`; infinite if that is very large."""
    size = SIGNED.get(stem(name))
    with np.errstate(over="ignore"):
        return float(np.exp(coordinate) if size is None else size * np.sinh(coordinate - math.log(size / 2.0)))


def value_per_coordinate(name: str, value: float) -> float:
    """Derivative of a parameter with respect to its `coordinate`, in its `unit`."""
    return math.hypot(value, SIGNED.get(stem(name), 0.0))


@dataclass(frozen=True, kw_only=True)
class Model:
    """A structure: which law, and what is free in it.

    Parameters have the names of fields of `Subject` and `MuscleLaw`. Those of muscle groups are "k.shoulder",
    "k.two-joint" and "k.elbow" (eq. 2.10). "Td" and "fact" hold for both joints. "level.PT22.5" multiplies all muscle
    torques in that condition; the first condition of a task has 1.

    Attributes:
      law: of the muscles.
      fixed: parameter to the value that it has; "k" fixes that of all three groups.
      free: what is free besides the default: "Td", "fact".
      tied: parameter to the other one whose value it has, e.g. "elastic_limit_deg.elbow": "elastic_limit_deg.shoulder".
      shared: parameters that are the same in both tasks.
      parts: elasto-plastic parts of each muscle group. With few, the likelihood has several maxima; more take longer.

    Raises:
      ValueError: the law or a name is unknown, or parts is not from 1 to 64.
      TypeError: parts is no whole number.
    """

    law: Law = "full"
    fixed: Mapping[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    tied: Mapping[str, str] = field(default_factory=dict)
    shared: tuple[str, ...] = BODY
    parts: int = MuscleLaw.parts

    def __post_init__(self) -> None:
        require_number("Model", "parts", self.parts, at_least=1, at_most=MAX_PARTS, whole=True)
        if self.law not in get_args(Law):
            raise ValueError(f"Model: law = {self.law!r}; expected one of {', '.join(get_args(Law))}")
        for name in self.free:
            if name not in FIXED:
                raise ValueError(
                    f"Model: free: {name!r}; expected some of {', '.join(FIXED)}, as all else is free or off"
                )
        for attribute in ("fixed", "tied", "shared"):
            for name in getattr(self, attribute):
                if stem(name) not in BOUNDS:
                    raise ValueError(f"Model: {attribute}: unknown parameter {name!r}; expected {', '.join(BOUNDS)}")

    def names(self, task: str, conditions: Sequence[str]) -> tuple[str, ...]:
        """All parameters of a person in one task that are not the same for everyone, fixed and tied ones too."""
        groups = EFFECTS[task]
        names = [*BODY, *GRIP, *(f"{group}.{element}" for group in groups for element in ELEMENTS)]
        if task == "PT":
            names += FIXED
        if self.law != "linear":
            names += [f"{name}.{element}" for name in SHORT_RANGE for element in ELEMENTS]
            names.append("elastic_limit_spread")
        if self.law in ("full", "half-wave"):
            names += ["loss_angle_deg", "recovery_time", "thinning_velocity"]
            if task == "PT":
                names += ["spindle_saturation", *(HALF_WAVE if self.law == "half-wave" else ())]
        if task == "PT":
            names += [f"level.{condition}" for condition in conditions[1:]]
        return tuple(names)

    def fixed_value(self, name: str) -> float | None:
        """Value of a parameter that is fixed; None if it is not."""
        if name in self.fixed:
            return self.fixed[name]
        if stem(name) in self.fixed:
            return self.fixed[stem(name)]
        return None if name in self.free else FIXED.get(name)


def person(
    body: Subject,
    law: Law,
    values: Mapping[str, float],
    condition: str,
    effects: Mapping[str, float],
    parts: int = MuscleLaw.parts,
) -> Subject:
    """The person in one trial.

    Args:
      body: task, lengths and posture.
      law: of the muscles.
      values: parameter to value.
      condition: of the trial.
      effects: quantity ("k", "b", "kv", "kp") to the logarithm of the trial's own factor on it; that on k is on the
        short-range stiffness too.
      parts: elasto-plastic parts of each muscle group.

    Raises:
      ValueError: the values make no person, as when a damping group is so large that the sum overflows.
    """
    changes: dict[str, Any] = {name: values[name] for name in (*BODY, *GRIP)}
    for group in EFFECTS[body.task]:
        factor = math.exp(effects.get(group, 0.0))
        s, se, e = (factor * values[f"{group}.{element}"] for element in ELEMENTS)
        changes |= {f"{group}_s": _sum(s, se), f"{group}_se": se, f"{group}_e": _sum(e, se)}
    for name, default in FIXED.items():
        changes |= dict.fromkeys((f"{name}_s", f"{name}_e"), values.get(name, default))
    for quantity in ("ka", "kf") if body.task == "PT" else ("kv", "kp", "ka", "kf"):
        changes |= {f"{quantity}_{entry}": 0.0 for entry in ("s", "se", "e")}
    changes["muscle"] = None
    if law != "linear":
        law_values: dict[str, Any] = {
            name: tuple(values[f"{name}.{element}"] for element in ELEMENTS) for name in SHORT_RANGE
        } | {name: values[name] for name in COMMON if name in values}
        factor = math.exp(effects.get("k", 0.0))
        law_values["short_range_stiffness"] = tuple(factor * k for k in law_values["short_range_stiffness"])
        changes["muscle"] = MuscleLaw(**law_values, parts=parts)
    subject = replace(body, **changes)
    level = values.get(f"level.{condition}", 1.0)
    return subject if level == 1.0 else at_level(subject, level)


def _sum(single: float, both: float) -> float:
    """What a joint has of single-joint and two-joint muscles; zero where rounding alone keeps it from that."""
    joint = single + both
    return 0.0 if abs(joint) < ROUNDING * abs(both) else joint


def true_values(subject: Subject, levels: Mapping[str, float]) -> dict[str, float]:
    """Parameters of a known person, by the names of `Model`; those of `COMMON` must be the same in all elements."""
    values: dict[str, float] = {name: getattr(subject, name) for name in (*BODY, *GRIP)}
    values |= {"Td": subject.Td_s, "fact": subject.fact_s}
    for group in QUANTITIES:
        values |= {f"{group}.{e}": v for e, v in zip(ELEMENTS, subject.muscle_groups(group), strict=True)}
    if subject.muscle is not None:
        for name in SHORT_RANGE:
            elements = subject.muscle.of_elements(name)
            values |= {f"{name}.{element}": value for element, value in zip(ELEMENTS, elements, strict=True)}
        values |= {name: subject.muscle.of_elements(name)[0] for name in COMMON}
    return values | {f"level.{condition}": level for condition, level in levels.items()}


class Parameters:
    """All free parameters of one person in one or both tasks, as one vector of coordinates (see `coordinate`).

    Attributes:
      names: of the free parameters; one that differs between tasks is "k.elbow [RT]".
      lower: bounds, (parameter,).
      upper: bounds, (parameter,).
    """

    def __init__(self, model: Model, bodies: Mapping[str, Subject], conditions: Mapping[str, Sequence[str]]) -> None:
        """Set out what is free.

        Args:
          model: the structure.
          bodies: task to segment lengths and posture.
          conditions: task to its conditions, that of level 1 first.

        Raises:
          ValueError: a tied parameter's other one does not exist, or a name is of no parameter here.
        """
        self.model, self.bodies = model, dict(bodies)
        self.names: list[str] = []
        self._of_task: dict[str, list[tuple[str, int | float]]] = {}
        known: set[str] = set()
        for task in bodies:
            names = model.names(task, conditions[task])
            known |= {*names, *(stem(name) for name in names)}
            places: dict[str, int | float] = {}
            for name in names:
                value = model.fixed_value(name)
                if value is not None:
                    places[name] = float(value)
                elif name not in model.tied:
                    label = name if len(bodies) == 1 or name in model.shared else f"{name} [{task}]"
                    if label not in self.names:
                        self.names.append(label)
                    places[name] = self.names.index(label)
            for name in names:
                if name in model.tied and name not in places:
                    other = model.tied[name]
                    if other not in places:
                        raise ValueError(f"Model: tied: {name!r} to {other!r}; expected a parameter that is not tied")
                    places[name] = places[other]
            self._of_task[task] = list(places.items())
        for attribute in ("fixed", "free", "tied"):
            for name in getattr(model, attribute):
                if name not in known:
                    raise ValueError(
                        f"Model: {attribute}: {name!r} is no parameter of the law {model.law!r} in these trials"
                    )
        limits = [[coordinate(name, end) for end in bounds(name, model.law)] for name in self.names]
        self.lower, self.upper = np.array(limits).reshape(-1, 2).T

    def fixed_at(self, point: Array) -> "Parameters":
        """These parameters with nothing free, fixed at the values of a point."""
        fixed = copy.copy(self)
        fixed.names, fixed.lower, fixed.upper = [], np.empty(0), np.empty(0)
        fixed._of_task = {task: list(self.values(task, point).items()) for task in self._of_task}
        return fixed

    def values(self, task: str, point: Array) -> dict[str, float]:
        """Parameter of one task to its value, fixed and tied ones too."""
        return {
            name: value_at(name, point[place]) if isinstance(place, int) else place
            for name, place in self._of_task[task]
        }

    def along_effects(self, point: Array) -> dict[str, list[Array | None]]:
        """Task to the changes of coordinates that move a person as each effect does, per change, (parameter,).

        None where there are none: a value that the effect multiplies is fixed, or tied to one that it does not.
        """
        return {task: [self._along(task, effect, point) for effect in EFFECTS[task]] for task in self.bodies}

    def _along(self, task: str, effect: str, point: Array) -> Array | None:
        multiplied = ("k", SHORT_RANGE[0]) if effect == "k" else (effect,)
        along = np.full(len(point), np.nan)
        for name, place in self._of_task[task]:
            is_multiplied = stem(name) in multiplied
            if isinstance(place, int):
                value = value_at(name, point[place])
                change = value / value_per_coordinate(name, value) if is_multiplied else 0.0
                if not np.isnan(along[place]) and along[place] != change:
                    return None
                along[place] = change
            elif is_multiplied and place:
                return None
        return np.nan_to_num(along)

    def person(self, task: str, point: Array, condition: str) -> Subject:
        """The person in a condition, see `person`."""
        return person(self.bodies[task], self.model.law, self.values(task, point), condition, {}, self.model.parts)
