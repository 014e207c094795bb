"""What amplitude does to people: the thesis's tests (2.9) on a study, beside the p values that it prints."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.measures import statistics
from armperturb.analysis.measures.statistics import ALPHA, FEWEST, Effect
from armperturb.arrays import Array
from armperturb.study.comparison.headlines import POST_HOC, PULSED
from armperturb.study.protocol import Condition
from armperturb.study.published import tables as published
from armperturb.study.results.mean_admittance import at_usual_frequencies, by_task, perturbed_conditions
from armperturb.study.results.quantities import level_name
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import PersonMeasures, muscle_parameter, stable_mean
from armperturb.subject import TASKS

Row = dict[str, Any]

PREDICTED = {task: pulses[1:] for task, pulses in PULSED.items()}
"""Task to the pulses whose prediction the thesis tests (3.3): those after a multisine."""

AMPLITUDES = {task: tuple(condition for condition, _ in pulses) for task, pulses in PREDICTED.items()}
"""Task to the thesis's conditions whose multisines differ, the smallest first."""

TRIPLES = {"PT": ("b", "k", "kv", "kp"), "RT": ("b", "k")}
"""Task to the matrices whose parameters are tested."""

PLACES = ("s", "se", "e", "s*", "e*")
"""Of joints, and with a star of one-joint muscles (eq. 2.10)."""

PRINTED_PARAMETERS = {"k_s": "p_k_s_pt", "kv_se": "p_kv_se_pt", "kp_s": "p_kp_s_pt"}
"""Joint parameters with a significant effect of amplitude in PT, to the printed p; the others are "ns" there (3.2)."""

STARRED_MUSCLES = ("k_s*", "kv_s*", "kp_s*")
"""Parameters of one-joint muscles with such an effect, marked as p < 0.01 (3.2, figure 3.14).

Of other muscles the thesis tells nothing.
"""


PRINTED_TESTS = {
    ("pulse admittance", "PT"): "p_pulse_admittance_anova_pt",
    ("pulse admittance", "RT"): "p_pulse_admittance_anova_rt",
    ("pulse prediction", "PT"): "p_pulse_prediction_pt",
    ("pulse prediction", "RT"): "p_pulse_prediction_anova_rt",
}
"""Quantity and task to the printed p of an effect of the conditions."""


class AdmittanceEffect(NamedTuple):
    """Whether the gain differs between the amplitudes of a task.

    Attributes:
      frequency: [Hz], (frequency,).
      p: of each element on its own [-], (frequency, output, input).
      counts: where four adjacent points or more are significant, likewise.
    """

    frequency: Array
    p: Array
    counts: NDArray[np.bool_]

    def where(self, output: int, input_: int) -> list[str]:
        """Frequencies at which the effect on an element counts, in words."""
        return [f"{frequency:.2g}" for frequency in self.frequency[self.counts[:, output, input_]]]

    def alone(self, output: int, input_: int) -> list[str]:
        """Frequencies at which it is significant, in words, be it alone."""
        return [f"{frequency:.2g}" for frequency in self.frequency[self.p[:, output, input_] < ALPHA]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Effects:
    """All tests of a study.

    Attributes:
      admittance: task to the tests of the gain.
      parameters: task and parameter to p, of the thesis's fits; with a star those of one-joint muscles.
      levels: condition with pulses of several levels to the p of the largest against the smallest.
      rows: one per test, for a table.
      pairs: one per pair of conditions, likewise.
      remarks: tests that were not made, or without some people, and why.
    """

    admittance: Mapping[str, AdmittanceEffect]
    parameters: Mapping[tuple[str, str], float]
    levels: Mapping[str, float]
    rows: tuple[Row, ...]
    pairs: tuple[Row, ...]
    remarks: tuple[str, ...]

    @property
    def agreement(self) -> tuple[int, int]:
        """Tests and pairs of which the thesis tells whether they are significant, and those in which both agree."""
        judged = [(row["p"], row["published_p"]) for row in self.rows if row["published_p"]]
        judged += [(row["p_bonferroni"], row["published_p"]) for row in self.pairs if row["published_p"]]
        # A printed p is always of a difference that is called significant.
        return len(judged), sum((p < ALPHA) == (printed != "ns") for p, printed in judged)


class _Tests:
    """Makes tests, and takes down what each gives or why it cannot be made."""

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.pairs: list[Row] = []
        self.remarks: list[str] = []

    def table(self, what: str, values: Mapping[str, Sequence[float]], conditions: Sequence[str]) -> Array | None:
        """Values of those who have all, (subject, condition); None if they are too few."""
        whole = {name: row for name, row in values.items() if np.isfinite(row).all()}
        for name, row in values.items():
            lacking = [condition for condition, value in zip(conditions, row, strict=True) if not math.isfinite(value)]
            if 0 < len(lacking) < len(row):
                self.remarks.append(f"{what}: without {name}, who has no value in {', '.join(lacking)}")
        if len(whole) < FEWEST:
            self.remarks.append(f"{what}: not tested, as {len(whole)} people have a value in every condition")
            return None
        return np.array(list(whole.values()))

    def effect(
        self,
        what: str,
        task: str,
        values: Mapping[str, Sequence[float]],
        conditions: Sequence[str],
        printed: str = "",
        printed_pairs: Mapping[tuple[int, int], str] | None = None,
        level: str = "",
    ) -> float:
        """Test whether conditions differ, and which; gives p, NaN if it cannot be told.

        The row names the level of the pulses, where one is given.
        """
        table = self.table(f"{what}, {task}", values, conditions)
        if table is None:
            return math.nan
        effect = statistics.effect_of_condition(table, conditions=conditions)
        self.rows.append(_row(what, task, ", ".join(conditions) + f" (level {level})" * bool(level), effect, printed))
        for (i, j), pair in statistics.post_hoc(table, conditions=conditions).items():
            self.pairs.append(
                {
                    "quantity": what,
                    "task": task,
                    "first": conditions[i],
                    "second": conditions[j],
                    "difference": float(np.mean(table[:, i] - table[:, j])),
                    "t": pair.t,
                    "dof": pair.dof,
                    "p_bonferroni": pair.p_bonferroni,
                    "published_p": (printed_pairs or {}).get((i, j), ""),
                }
            )
        return effect.p

    def levels(
        self, condition: Condition, values: Mapping[str, Sequence[float]], levels: tuple[float, float], printed: str
    ) -> float:
        """Dependent t-test of two levels of pulses; gives p, NaN if it cannot be told."""
        words = [f"level {level:g}" for level in levels]
        table = self.table(f"pulse admittance, levels of {condition.name}", values, words)
        if table is None:
            return math.nan
        test, none = statistics.post_hoc(table)[0, 1], math.nan
        effect = Effect("dependent t", test.t, (test.dof,), test.p, none, none, none, (none,), len(table))
        compared = f"{condition.name}, level {levels[0]:g} against {levels[1]:g}"
        self.rows.append(_row("pulse admittance", condition.task, compared, effect, printed))
        return test.p


def _row(what: str, task: str, conditions: str, effect: Effect, printed: str) -> Row:
    return {
        "quantity": what,
        "task": task,
        "conditions": conditions,
        "people": effect.n,
        "test": effect.test,
        "statistic": effect.statistic,
        "dof": ", ".join(f"{dof:.3g}" for dof in effect.dof),
        "p": effect.p,
        "published_p": printed,
        "effect_size": effect.effect_size,
        "mauchly_p": effect.mauchly_p,
        "epsilon": effect.epsilon,
        "shapiro_p_min": min(effect.shapiro_p),
    }


def effects(study: StudyResult) -> Effects:
    """All tests that the people and conditions of a study allow."""
    tests = _Tests()
    admittance = {task: effect for task in TASKS if (effect := admittance_effect(study, task)) is not None}
    tests.remarks += [line for task in admittance for line in _left_out_of_gains(study, task)]
    parameters: dict[tuple[str, str], float] = {}
    for task, of_task in by_task(study).items():
        conditions = tuple(condition.name for condition in of_task)
        for kind, place in itertools.product(TRIPLES[task], PLACES) if len(conditions) > 1 else ():
            name = f"{kind}_{place}"
            values = {person.name: [_parameter(person, c, name) for c in conditions] for person in study.people}
            printed = _printed_parameter(name, task) if conditions == AMPLITUDES[task] else ""
            parameters[task, name] = tests.effect(name, task, values, conditions, printed)

    def pulses(quantity: str, what: str, of: Sequence[tuple[str, str]]) -> dict[str, list[float]]:
        values = {}
        for person in study.people:
            values[person.name], lost = pulse_values(person, quantity, of)
            if lost:
                tests.remarks.append(
                    f"{what}: {person.name} without pulses at {', '.join(f'{each}°' for each in lost)}, which have no "
                    "peak in some of the compared conditions or levels"
                )
        return values

    for quantity, of_thesis in (("displacement", PULSED), ("admittance", PULSED), ("prediction", PREDICTED)):
        what = "peak displacement" if quantity == "displacement" else f"pulse {quantity}"
        for task in TASKS:
            pairs = compared_pulses(study, task, predicted=quantity == "prediction")
            if lost := _lost_pulses(study, task, pairs, predicted=quantity == "prediction"):
                tests.remarks.append(f"{what}, {task}: {lost}")
            if len(pairs) > 1:
                compared, as_printed = tuple(condition for condition, _ in pairs), pairs == of_thesis[task]
                test = PRINTED_TESTS.get((what, task)) if as_printed else None
                text = published.headline_text(test) if test else ""
                printed_pairs = _printed_pairs(what, task) if as_printed else {}
                values = pulses(quantity, f"{what}, {task}", pairs)
                tests.effect(what, task, values, compared, text, printed_pairs, level="" if as_printed else pairs[0][1])
    levels = {}
    for condition in study.protocol.conditions:
        if len(measured := measured_levels(study, condition)) > 1:
            ends = (max(measured), min(measured))
            names = tuple(level_name(condition.name, end) for end in ends)
            printed = f"p_pulse_admittance_level_{condition.name.lower()}" if _prints(condition.name, names) else ""
            what = f"pulse admittance, levels of {condition.name}"
            levels[condition.name] = tests.levels(
                condition,
                pulses("admittance", what, [(condition.name, name) for name in names]),
                ends,
                published.headline_text(printed) if printed else "",
            )
    return Effects(
        admittance=admittance,
        parameters=parameters,
        levels=levels,
        rows=tuple(tests.rows),
        pairs=tuple(tests.pairs),
        remarks=tuple(tests.remarks),
    )


def pulse_values(person: PersonMeasures, quantity: str, of: Sequence[tuple[str, str]]) -> tuple[list[float], list[str]]:
    """A person's means in some pulses, and the directions [deg] that these leave out.

    Peaks differ between directions: all means are over those in which each of the pulses tells something.

    Args:
      person: of the study.
      quantity: a field of `PulseMeans`; of a prediction, a ratio, each mean is over all that was predicted.
      of: conditions and levels.
    """
    means = [person.pulses.get(pulse) for pulse in of]
    values = [getattr(each, quantity, math.nan) for each in means]
    there = [set(each.by_direction) for each in means if each is not None]
    if quantity == "prediction" or not there or all(each == there[0] for each in there):
        return values, []
    common = set.intersection(*there)
    place = ("displacement", "admittance").index(quantity)
    for number, each in enumerate(means):
        if each is not None:
            in_common = [each.by_direction[direction][place] for direction in sorted(common, key=float)]
            values[number] = float(np.mean(in_common)) if in_common else math.nan
    return values, sorted(set.union(*there) - common, key=float)


def measured_levels(study: StudyResult, condition: Condition) -> set[float]:
    """Levels of pulses of which as many people as a test needs have a peak; where none is, those of anybody."""
    n_people = {
        level: sum((condition.name, level_name(condition.name, level)) in person.pulses for person in study.people)
        for level in condition.pulse_levels
    }
    return {level for level, n in n_people.items() if n >= FEWEST} or {level for level, n in n_people.items() if n}


def compared_pulses(study: StudyResult, task: str, *, predicted: bool = False) -> tuple[tuple[str, str], ...]:
    """Condition and level of the pulses that show what the multisine before them does, the smallest movement first.

    They are of the largest level that was measured in all conditions of the task with pulses (`measured_levels`); none
    if there is no such level.

    Args:
      study: with measured people.
      task: "PT" or "RT".
      predicted: leave out conditions without a multisine, in which nothing predicts a pulse.
    """
    measured = _measured(study, task, predicted=predicted)
    common = set.intersection(*measured.values()) if measured else set()
    names = [name for name in measured if common]
    return tuple((name, level_name(name, max(common))) for name in names)


def _comparable(study: StudyResult, task: str, *, predicted: bool) -> list[Condition]:
    """Conditions of a task whose pulses may be compared; predictions are made from a multisine."""
    return [each for each in perturbed_conditions(study, task) if each.has_multisine or not predicted]


def _measured(study: StudyResult, task: str, *, predicted: bool) -> dict[str, set[float]]:
    """Conditions of which a pulse was measured to these levels, the smallest movement first."""
    measured = {each.name: measured_levels(study, each) for each in _comparable(study, task, predicted=predicted)}
    return {name: levels for name, levels in measured.items() if levels}


def _lost_pulses(study: StudyResult, task: str, pairs: Sequence[tuple[str, str]], *, predicted: bool) -> str:
    """What pulses that were not measured do to the comparison of conditions; empty if they do nothing."""
    planned = [each for each in _comparable(study, task, predicted=predicted) if each.pulse_levels]
    if len(planned) < 2 or not study.pulses:
        return ""
    if not pairs:
        return "not tested, as no level of pulses was measured in every condition"
    gone = [each.name for each in planned if each.name not in dict(pairs)]
    return f"without {', '.join(gone)}, in which no pulse was measured" if gone else ""


def admittance_effect(study: StudyResult, task: str) -> AdmittanceEffect | None:
    """Test the gain of each element at each frequency; None with fewer than three people or two amplitudes.

    A condition that the protocol lacks is none of the amplitudes; people who lack one that it has are left out.
    """
    conditions = [condition.name for condition in by_task(study).get(task, ())]
    gains: dict[str, dict[str, Array]] = {}
    alike = at_usual_frequencies(case for condition in conditions for case in study.of(condition))
    for case in alike:
        gains.setdefault(case.name, {})[case.condition.name] = np.abs(case.identified.spectra.arm)
    whole = [[of_person[c] for c in conditions] for of_person in gains.values() if len(of_person) == len(conditions)]
    if len(conditions) < 2 or len(whole) < FEWEST:
        return None
    gain = np.array(whole)  # (subject, condition, frequency, output, input)
    p = np.empty(gain.shape[2:])
    for index in np.ndindex(p.shape):
        p[index] = statistics.effect_of_condition(gain[:, :, *index]).p
    return AdmittanceEffect(alike[0].identified.spectra.frequency, p, statistics.adjacent_effects(p))


def _left_out_of_gains(study: StudyResult, task: str) -> list[str]:
    """Who is left out of `admittance_effect`, and why."""
    conditions = [condition.name for condition in by_task(study).get(task, ())]
    cases = {(case.name, condition): case for condition in conditions for case in study.of(condition)}
    alike = {(case.name, case.condition.name) for case in at_usual_frequencies(cases.values())}
    said = []
    for name in dict.fromkeys(name for name, _ in cases):
        if lacking := [condition for condition in conditions if (name, condition) not in cases]:
            said.append(f"gain, {task}: without {name}, who was not identified in {', '.join(lacking)}")
        elif unlike := [condition for condition in conditions if (name, condition) not in alike]:
            where = "every condition" if len(unlike) == len(conditions) else ", ".join(unlike)
            said.append(f"gain, {task}: without {name}, whose frequencies in {where} are not those of most people")
    return said


def _parameter(person: PersonMeasures, condition: str, name: str) -> float:
    """Mean over the stable trials of what the thesis's estimator gives; NaN without any."""
    estimate = person.estimates.get(condition)
    return math.nan if estimate is None else muscle_parameter(name, partial(stable_mean, estimate))


def _prints(condition: str, levels: Sequence[str]) -> bool:
    """Whether the thesis compares the two levels in a condition."""
    return set(published.pulse_levels(condition)) == set(levels)


def _printed_parameter(name: str, task: str) -> str:
    if name.endswith("*"):
        return "< 0.01" if task == "PT" and name in STARRED_MUSCLES else ""
    if task == "RT":
        return published.headline_text("p_all_parameters_rt")
    return published.headline_text(PRINTED_PARAMETERS[name]) if name in PRINTED_PARAMETERS else "ns"


def _printed_pairs(what: str, task: str) -> dict[tuple[int, int], str]:
    if what == "pulse admittance":
        return {pair: published.headline_text(name) for name, pair in POST_HOC[task].items()}
    if (what, task) == ("pulse prediction", "RT"):
        text = published.headline_text("p_pulse_prediction_posthoc_rt")
        return dict.fromkeys(((0, 1), (0, 2), (1, 2)), text)
    return {}
