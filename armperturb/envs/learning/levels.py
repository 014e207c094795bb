"""How much muscle and reflex a person has at levels between being relaxed and the position task, and beyond."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.controllers.arm_control import Strength
from armperturb.envs.learning.task import TaskSettings
from armperturb.muscle_law import ELEMENTS, MuscleLaw
from armperturb.subject import Subject
from armperturb.validation import require_number

LEVEL_OF = {"kv": 1, "kp": 2}
"""Row of the levels that sets a kind of feedback; the first one, co-contraction, sets what muscles do."""


def subject_at(settings: TaskSettings, levels: ArrayLike) -> Subject:
    """The task's person with a nervous system that stays at some levels, whatever happens.

    In a trial, this person moves as one whose agent keeps to these levels.

    Args:
      settings: of the task.
      levels: of co-contraction, velocity and position feedback of each muscle group, (3, element) [-], >= 0: 0 is the
        person relaxed, 1 the person's position task, and beyond it, torques are in proportion to the level.

    Raises:
      TypeError: levels are no numbers.
      ValueError: they have the wrong shape, or one of them is not finite or negative.
    """
    values = np.asarray(levels)
    if values.dtype.kind not in "fiub":
        raise TypeError(f"subject_at: levels of type {values.dtype}; expected numbers")
    if values.shape != (3, len(ELEMENTS)):
        raise ValueError(f"subject_at: levels of shape {values.shape}; expected (3, {len(ELEMENTS)})")
    for kind, row in zip(("co-contraction", "velocity feedback", "position feedback"), values.tolist(), strict=True):
        for group, level in zip(ELEMENTS, row, strict=True):
            require_number("subject_at", f"level of {kind}, {group}", level, at_least=0.0)
    relaxed, position = (strength_of([subject]) for subject in settings.people)
    strength = strength_between(relaxed, position, values.astype(float)[None])
    changes: dict[str, Any] = {
        f"{quantity}_{joint}": float(entry)
        for quantity in ("b", "k", "kv", "kp")
        for joint, entry in zip(("s", "se", "e"), strength[quantity][0], strict=True)
    }
    subject = settings.subject
    if subject.muscle is not None:
        short_range = tuple(strength["short_range_groups"][0].tolist())
        changes["muscle"] = replace(subject.muscle, short_range_stiffness=short_range)
    return replace(subject, **changes)


def strength_of(subjects: Sequence[Subject]) -> Strength:
    """Muscles and reflexes of people as they are."""

    laws = [subject.muscle or MuscleLaw() for subject in subjects]
    strength = {"short_range_groups": np.array([law.of_elements("short_range_stiffness") for law in laws])}
    for quantity in ("k", "b", "kv", "kp"):
        strength[quantity] = np.array([subject.joint_triple(quantity) for subject in subjects])
        strength[f"{quantity}_groups"] = np.array([subject.muscle_groups(quantity) for subject in subjects])
    return strength


def strength_between(relaxed: Strength, position: Strength, levels: Array) -> Strength:
    """Muscles and reflexes at levels, (person, 3, element): between two up to 1, in proportion beyond, as `at_level`.

    Exact at levels of 0 and of 1.
    """

    def mixed(name: str, columns: slice, level: Array) -> Array:
        return (1.0 - np.minimum(level, 1.0)) * relaxed[name][:, columns] + level * position[name][:, columns]

    strength = {}
    for name in relaxed:
        level = levels[:, LEVEL_OF.get(name.removesuffix("_groups"), 0)]
        strength[name] = mixed(name, slice(None), level)
        if not name.endswith("_groups"):
            # An entry of the diagonal has the two-joint group in it, whose level may be another.
            two_joint = slice(1, 2)
            strength[name][:, ::2] += mixed(name, two_joint, level[:, 1:2]) - mixed(name, two_joint, level[:, ::2])
    return strength
