"""How much muscle and reflex a person has at levels between being relaxed and the position task, and beyond."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.controllers.arm_control import Strength
from armperturb.envs.learning.task import TaskSettings
from armperturb.subject import Subject
from armperturb.validation import require_number

GROUPS = ("shoulder", "two-joint", "elbow")
"""Muscle groups (eq. 2.10)."""


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
    if values.shape != (3, len(GROUPS)):
        raise ValueError(f"subject_at: levels of shape {values.shape}; expected (3, {len(GROUPS)})")
    for kind, row in zip(("co-contraction", "velocity feedback", "position feedback"), values.tolist(), strict=True):
        for group, level in zip(GROUPS, row, strict=True):
            require_number("subject_at", f"level of {kind}, {group}", level, at_least=0.0)
    relaxed, position = (strength_of([subject]) for subject in settings.people)
    strength = strength_between(relaxed, position, values.astype(float)[None])
    changes: dict[str, Any] = {
        f"{quantity}_{joint}": float(entry)
        for quantity in ("b", "k", "kv", "kp")
        for joint, entry in zip(("s", "se", "e"), getattr(strength, quantity)[0], strict=True)
    }
    subject = settings.subject
    if subject.muscle is not None:
        short_range = tuple(strength.short_range_groups[0].tolist())
        changes["muscle"] = replace(subject.muscle, short_range_stiffness=short_range)
    return replace(subject, **changes)


def strength_of(subjects: Sequence[Subject]) -> Strength:
    """Muscles and reflexes of people as they are."""

    def triples(quantity: str) -> Array:
        return np.array([subject.joint_triple(quantity) for subject in subjects])

    def groups(quantity: str) -> Array:
        return np.array([subject.muscle_groups(quantity) for subject in subjects])

    short_range = [s.muscle.of_elements("short_range_stiffness") if s.muscle else (0.0, 0.0, 0.0) for s in subjects]
    return Strength(
        k=triples("k"),
        k_groups=groups("k"),
        b=triples("b"),
        b_groups=groups("b"),
        short_range_groups=np.array(short_range),
        kv=triples("kv"),
        kv_groups=groups("kv"),
        kp=triples("kp"),
    )


def strength_between(relaxed: Strength, position: Strength, levels: Array) -> Strength:
    """Muscles and reflexes at levels, (person, 3, element): between two up to 1, in proportion beyond, as `at_level`.

    Exact at levels of 0 and of 1.
    """
    level = dict(zip(("muscle", "velocity", "position"), levels.swapaxes(0, 1), strict=True))

    def groups(low: Array, high: Array, level: Array) -> Array:
        return (1.0 - np.minimum(level, 1.0)) * low + level * high

    def triples(low: Array, high: Array, level: Array) -> Array:
        mixed = groups(low, high, level)
        # An entry of the diagonal has the two-joint group in it, whose level may be another.
        two_joint = low[:, 1:2], high[:, 1:2]
        mixed[:, ::2] += groups(*two_joint, level[:, 1:2]) - groups(*two_joint, level[:, ::2])
        return mixed

    parts = {
        "k": (triples, "muscle"),
        "k_groups": (groups, "muscle"),
        "b": (triples, "muscle"),
        "b_groups": (groups, "muscle"),
        "short_range_groups": (groups, "muscle"),
        "kv": (triples, "velocity"),
        "kv_groups": (groups, "velocity"),
        "kp": (triples, "position"),
    }
    return Strength(
        **{name: mix(getattr(relaxed, name), getattr(position, name), level[of]) for name, (mix, of) in parts.items()}
    )
