"""What is calibrated: the unknowns of each muscle law, and the average person that their values make."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from armperturb.analysis.nonlinear.model import ELEMENTS
from armperturb.cohort import Person, average_body
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import POSITION, RELAX, TASKS, Subject

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

_TYPICAL: dict[str, tuple[Unknown, ...]] = {
    "RT": (
        Unknown("k.shoulder", 2.0, 2.0, start=2.38),
        Unknown("k.two-joint", 1.0, 2.0, start=0.772),
        Unknown("k.elbow", 2.0, 2.0, start=1.38),
        Unknown("b.shoulder", 0.75, 2.0, start=0.885),
        Unknown("b.two-joint", 1.4, 2.0, start=1.33),
        Unknown("b.elbow", 0.5, 2.0, start=0.46),
        Unknown("short_range_stiffness.shoulder", 11.0, 2.5, start=15.9),
        Unknown("short_range_stiffness.two-joint", 11.0, 2.5, start=15.7),
        Unknown("short_range_stiffness.elbow", 11.0, 2.5, start=9.83),
        Unknown("elastic_limit_deg", 0.7, 2.5, start=0.805),
        Unknown("elastic_limit_spread", 0.5, 2.0, start=0.463),
        Unknown("loss_angle_deg", 30.0, 2.7, start=29.1),
        Unknown("recovery_time", 1.7, 3.3, start=1.39),
        Unknown("thinning_velocity", 0.13, 2.2, start=0.115),
    ),
    "PT": (
        Unknown("k.shoulder", 30.0, 2.2, start=44.6),
        Unknown("k.two-joint", 60.0, 2.2, start=23.7),
        Unknown("k.elbow", 50.0, 2.2, start=37.2),
        Unknown("b.shoulder", 2.5, 2.7, start=2.33),
        Unknown("b.two-joint", 3.0, 2.7, start=1.38),
        Unknown("b.elbow", 4.0, 2.7, start=4.95),
        Unknown("kv.shoulder", 5.0, 2.2, start=2.95),
        Unknown("kv.two-joint", 12.0, 2.2, start=12.5),
        Unknown("kv.elbow", 10.0, 2.2, start=4.03),
        Unknown("kp.shoulder", 5.0, 2.7, start=5.92),
        Unknown("kp.two-joint", 15.0, 2.7, start=19.3),
        Unknown("kp.elbow", 15.0, 2.7, start=10.4),
        Unknown("short_range_stiffness.shoulder", 40.0, 2.2, start=41.9),
        Unknown("short_range_stiffness.two-joint", 60.0, 2.2, start=75.2),
        Unknown("short_range_stiffness.elbow", 40.0, 2.2, start=29.6),
        Unknown("elastic_limit_deg", 0.8, 1.8, start=1.47),
        Unknown("elastic_limit_spread", 0.5, 2.0, start=0.43),
        Unknown("loss_angle_deg", 40.0, 2.7, start=42.5),
        Unknown("recovery_time", 1.7, 2.7, start=1.82),
        Unknown("thinning_velocity", 1.5, 2.7, start=1.24),
        Unknown("spindle_saturation", 1.5, 2.7, start=1.1),
        Unknown("level.PT0", 0.5, 1.6, start=0.395, slope_down=True),
        Unknown("level.PT2.5", 0.5, 1.6, start=0.628, slope_down=True),
        Unknown("level.PT22.5", 1.5, 1.4, start=1.61, slope_down=True),
    ),
}


def unknowns(task: str, law: str) -> tuple[Unknown, ...]:
    """What is calibrated of a law in a task.

    Raises:
      ValueError: the task or the law is unknown.
    """
    if task not in TASKS:
        raise ValueError(f"calibrate: task = {task!r}; expected one of {', '.join(TASKS)}")
    if law not in LAWS:
        raise ValueError(f"calibrate: law = {law!r}; expected one of {', '.join(LAWS)}")
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
        return Person(
            name=self.subject.name,
            height=1.0,
            mass=1.0,
            subjects={self.subject.task: self.subject},
            levels=dict(self.levels),
        )
