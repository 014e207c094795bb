"""How co-contraction changes with amplitude, task and perturbation: tests within people."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from armperturb.analysis.measures.statistics import FEWEST, effect_of_condition
from armperturb.arrays import Array
from armperturb.study.protocol import Condition
from armperturb.study.results.emg import PersonEmg
from armperturb.study.results.mean_admittance import differ_in_amplitude

DURING, BEFORE = "during", "before"


class CocontractionTest(NamedTuple):
    """One test.

    Attributes:
      question: "amplitude" ("condition" where conditions differ in more, or not in it), "task" or "perturbation".
      joint: name.
      conditions: that are compared.
      n: people.
      test: its name.
      statistic: [-].
      p: [-].
      ratio: index in the last of the conditions over that in the first, geometric mean over people [-]; NaN where
        somebody does not co-contract at all in one of them.
    """

    question: str
    joint: str
    conditions: str
    n: int
    test: str
    statistic: float
    p: float
    ratio: float


def index_of(person: PersonEmg, joint: str) -> dict[str, float]:
    """Condition to a person's index of co-contraction at a joint, during the perturbation or, without, before it."""
    chosen: dict[str, tuple[str, float]] = {}
    for row in person.cocontraction:
        if row.joint == joint and chosen.get(row.condition, (BEFORE, 0.0))[0] == BEFORE:
            chosen[row.condition] = row.part, row.lesser
    return {condition: value for condition, (_, value) in chosen.items()}


def cocontraction_tests(people: Sequence[PersonEmg], conditions: Sequence[Condition]) -> list[CocontractionTest]:
    """Whether the index changes with the amplitude in each task, with the task, and as soon as anything perturbs.

    The last compares the condition without a multisine with the mean over those with one. Means over the conditions of
    a task are compared between tasks. All tests are within people who have the index everywhere; there is none where
    nobody co-contracts in any of the conditions.

    Args:
      people: in any order.
      conditions: of the protocol, in order of amplitude within a task.
    """
    tests = []
    for joint in ("shoulder", "elbow"):
        by_person = {person.name: index_of(person, joint) for person in people}
        moved = {
            task: [c.name for c in conditions if c.task == task and c.has_multisine and _known(by_person, [c.name])]
            for task in ("PT", "RT")
        }
        for names in moved.values():
            values = _table(by_person, names)
            if len(names) > 1 and len(values) >= FEWEST and values.any():
                effect = effect_of_condition(values)
                of_amplitude = differ_in_amplitude([c for c in conditions if c.name in names])
                question = "amplitude" if of_amplitude else "condition"
                tests.append(_row(question, joint, names, values, effect.test, effect.statistic, effect.p))
        both = [*moved["PT"], *moved["RT"]]
        values = _table(by_person, both)
        if all(moved.values()) and len(values) >= FEWEST and values.any():
            split = len(moved["PT"])
            means = np.stack([values[:, :split].mean(axis=1), values[:, split:].mean(axis=1)], axis=1)
            tests.append(_paired("task", joint, ["PT", "RT"], means))
        for task, names in moved.items():
            still = [c.name for c in conditions if c.task == task and not c.has_multisine and c.contraction is None]
            values = _table(by_person, [*still[:1], *names])
            if still and names and len(values) >= FEWEST and values.any():
                means = np.stack([values[:, 0], values[:, 1:].mean(axis=1)], axis=1)
                tests.append(_paired("perturbation", joint, [still[0], f"{task} perturbed"], means))
    return tests


def left_out_of_tests(people: Sequence[PersonEmg], conditions: Sequence[Condition]) -> list[str]:
    """Who is left out of which tests, one line each; nothing where people are too few for any test.

    Args:
      people: as for `cocontraction_tests`.
      conditions: likewise.
    """
    said = []
    for joint in ("shoulder", "elbow") if len(people) >= FEWEST else ():
        by_person = {person.name: index_of(person, joint) for person in people}
        names = [each.name for each in conditions if _known(by_person, [each.name])]
        for name, of in by_person.items():
            if lacking := [each for each in names if not math.isfinite(of.get(each, math.nan))]:
                said.append(
                    f"co-contraction of the {joint}: {name} has no index in {', '.join(lacking)}, and no part in tests "
                    "over these conditions"
                )
    return said


def _known(by_person: Mapping[str, Mapping[str, float]], names: Sequence[str]) -> int:
    return len(_table(by_person, names))


def _table(by_person: Mapping[str, Mapping[str, float]], names: Sequence[str]) -> Array:
    """Index of those who have it in all conditions, (person, condition)."""
    rows = [[of[name] for name in names] for of in by_person.values() if all(name in of for name in names)]
    values = np.array(rows, dtype=float).reshape(len(rows), len(names))
    return np.asarray(values[np.isfinite(values).all(axis=1)])


def _paired(question: str, joint: str, names: Sequence[str], values: Array) -> CocontractionTest:
    result = stats.ttest_rel(values[:, 1], values[:, 0])
    return _row(question, joint, names, values, "dependent t", float(result.statistic), float(result.pvalue))


def _row(
    question: str, joint: str, names: Sequence[str], values: Array, test: str, statistic: float, p: float
) -> CocontractionTest:
    ends = values[:, [0, -1]]
    ratio = float(np.exp(np.mean(np.log(ends[:, 1] / ends[:, 0])))) if (ends > 0.0).all() else math.nan
    return CocontractionTest(question, joint, ", ".join(names), len(values), test, float(statistic), float(p), ratio)
