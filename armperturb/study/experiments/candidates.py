"""What is calibrated: the unknowns of each muscle law, and the average person that their values make."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from armperturb.cohort import Person, average_body
from armperturb.files import packaged_table
from armperturb.muscle_law import ELEMENTS, MuscleLaw
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from armperturb.validation import require_one_of

PARTS = 8
"""Elasto-plastic parts per element."""


class Unknown(NamedTuple):
    """What is calibrated.

    Attributes:
      name: of the parameter, as in `analysis.nonlinear.model`.
      typical: value that the literature makes likely.
      factor: one standard deviation of it, as a factor.
      start: where the search starts; people with typical values of everything may be unstable.
      slope_down: whether slopes are taken towards smaller values, as larger ones may be unstable.
    """

    name: str
    typical: float
    factor: float
    start: float
    slope_down: bool = False


_SHORT_RANGE = ("short_range_stiffness", "elastic_limit_deg", "elastic_limit_spread")
_REST = ("loss_angle_deg", "recovery_time", "thinning_velocity", "spindle_saturation")

LAWS: dict[str, tuple[str, ...]] = {
    "linear": (),
    "short-range": _SHORT_RANGE,
    "full": _SHORT_RANGE + _REST,
}
"""Laws to compare: name to the fields of `MuscleLaw` that are unknown, beside the parameters of the linear arm."""

_TABLES = packaged_table(__package__, "unknowns.toml")
_TYPICAL = {task: tuple(Unknown(name, **numbers) for name, numbers in table.items()) for task, table in _TABLES.items()}


def unknowns(task: str, law: str) -> tuple[Unknown, ...]:
    """What is calibrated of a law in a task.

    Raises:
      ValueError: the task or the law is unknown.
    """
    require_one_of("calibrate", "task", task, TASKS)
    require_one_of("calibrate", "law", law, tuple(LAWS))
    left_out = set(LAWS["full"]) - set(LAWS[law])
    return tuple(unknown for unknown in _TYPICAL[task] if unknown.name.partition(".")[0] not in left_out)


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An average person in one task.

    Attributes:
      subject: at level 1.
      levels: condition to the level of co-contraction [-]; 1 where it is not named.
    """

    subject: Subject
    levels: Mapping[str, float]

    @classmethod
    def of(cls, task: str, values: Mapping[str, float]) -> "Candidate":
        """The candidate with these values of the unknowns (by name)."""

        def joints(quantity: str) -> dict[str, float]:
            s, se, e = (values[f"{quantity}.{element}"] for element in ELEMENTS)
            return {f"{quantity}_s": s + se, f"{quantity}_se": se, f"{quantity}_e": e + se}

        changes: dict[str, Any] = dict(average_body())
        for quantity in ("k", "b", "kv", "kp") if task == "PT" else ("k", "b"):
            changes |= joints(quantity)
        law: dict[str, Any] = {name: values[name] for name in _SHORT_RANGE[1:] + _REST if name in values}
        if law:
            stiffness = tuple(values[f"short_range_stiffness.{element}"] for element in ELEMENTS)
            law |= {"short_range_stiffness": stiffness, "parts": PARTS}
        start = POSITION if task == "PT" else RELAX
        subject = replace(start, **changes, muscle=MuscleLaw(**law) if law else None)
        levels = {name.removeprefix("level."): level for name, level in values.items() if name.startswith("level.")}
        return cls(subject=subject, levels=levels)

    @property
    def person(self) -> Person:
        """The candidate as somebody who can go through a protocol."""
        subjects = {self.subject.task: self.subject}
        return Person(name=self.subject.name, height=1.0, mass=1.0, subjects=subjects, levels=dict(self.levels))
