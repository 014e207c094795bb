"""The findings of a study: ratios within people, means over people with 95 % intervals, and which fits are flagged."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from armperturb.analysis.fit.maximum_likelihood import SUSPICIOUS
from armperturb.arrays import Array
from armperturb.study.experiments.mechanisms import AMPLITUDES, ONE_LEVEL, Yielding
from armperturb.study.protocol import Condition
from armperturb.study.report.tables import Row
from armperturb.study.results.cases import Case
from armperturb.study.results.mean_admittance import by_task, main_conditions, movement, perturbed_conditions
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import N_LOW
from armperturb.subject import TASKS

CONFIDENCE = 0.95
"""Probability of the intervals of means over people [-]."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A positive quantity of people: its geometric mean, and the t interval of the mean logarithm.

    Attributes:
      name: which, as tables have it.
      above: condition of the numerator, or what is divided.
      below: condition of the denominator.
      mean: over people [-].
      lower: end of the interval of the mean [-]; NaN for one person.
      upper: likewise.
      values: person to their own value [-].
      frequency: at which gains were compared [Hz]; none of pulses.
    """

    name: str
    above: str
    below: str
    mean: float
    lower: float
    upper: float
    values: dict[str, float]
    frequency: tuple[float, ...] = ()

    @classmethod
    def of(
        cls, name: str, above: str, below: str, values: dict[str, float], frequency: Sequence[float] = ()
    ) -> "Finding | None":
        """That of values per person; None without any."""
        if not values:
            return None
        mean, lower, upper = geometric_mean(list(values.values()))
        return cls(
            name=name,
            above=above,
            below=below,
            mean=mean,
            lower=lower,
            upper=upper,
            values=values,
            frequency=tuple(frequency),
        )

    @property
    def rises(self) -> bool:
        """Whether the whole interval lies above 1, or the mean where there is none."""
        return (self.mean if math.isnan(self.lower) else self.lower) > 1.0

    @property
    def is_settled(self) -> bool:
        """Whether the interval leaves 1 out; never without one."""
        return self.lower > 1.0 or self.upper < 1.0


def geometric_mean(values: Sequence[float]) -> tuple[float, float, float]:
    """Geometric mean over people and its 95 % interval, from Student's t of the mean logarithm; NaN ends for one."""
    mean, lower, upper = map(math.exp, arithmetic_mean(np.log(values)))
    return mean, lower, upper


def arithmetic_mean(values: Sequence[float] | Array) -> tuple[float, float, float]:
    """Mean over people and its 95 % interval, from Student's t; NaN ends for one."""
    n, mean = len(values), float(np.mean(values))
    if n < 2:
        return mean, math.nan, math.nan
    half = float(stats.t.ppf(0.5 * (1.0 + CONFIDENCE), n - 1) * np.std(values, ddof=1) / math.sqrt(n))
    return mean, mean - half, mean + half


def low_gain(case: Case) -> float:
    """Gain of the admittance at low frequencies [m/N]: geometric mean of the lowest two and of the diagonal."""
    diagonal: Array = np.abs(np.diagonal(case.identified.spectra.arm[:N_LOW], axis1=1, axis2=2))
    return float(np.exp(np.mean(np.log(diagonal))))


def low_gains(study: StudyResult, condition: str) -> dict[str, float]:
    """Person to `low_gain` in a condition."""
    return {case.name: low_gain(case) for case in study.of(condition)}


class Excess(NamedTuple):
    """Recorded over predicted peak displacement after a pulse, of the linear arm.

    Attributes:
      condition: of the protocol.
      level: of the pulse, as tables call it.
      values: person to their own [-].
    """

    condition: Condition
    level: str
    values: dict[str, float]


def excesses(study: StudyResult) -> list[Excess]:
    """One for each pulse that is predicted of somebody, those of PT first."""
    results = []
    for task in TASKS:
        for condition in perturbed_conditions(study, task):
            for level in (level for name, level in study.pulses if name == condition.name):
                of_pulse = {person.name: person.pulses.get((condition.name, level)) for person in study.people}
                values = {name: its.excess for name, its in of_pulse.items() if its is not None and its.excess > 0.0}
                if values:
                    results.append(Excess(condition, level, values))
    return results


def excess_rows(study: StudyResult) -> list[Row]:
    """Recorded over predicted peak of each pulse that is predicted: geometric mean over people with its interval."""
    rows = []
    for condition, level, values in excesses(study):
        mean, lower, upper = geometric_mean(list(values.values()))
        interval = {"mean": mean, "lower_95": lower, "upper_95": upper}
        rows.append({"condition": condition.name, "level": level, **interval, "people": len(values)})
    return rows


def _ratio(study: StudyResult, name: str, above: str, below: str) -> Finding | None:
    under = {case.name: case for case in study.of(below)}
    pairs = [(case, under[case.name]) for case in study.of(above) if case.name in under]
    # Gains fall with frequency: those of other frequencies tell nothing of the person.
    alike = [(over, each) for over, each in pairs if _are_alike(over, each)]
    values = {over.name: low_gain(over) / low_gain(each) for over, each in alike}
    frequency = alike[0][0].identified.spectra.frequency[:N_LOW].tolist() if alike else ()
    return Finding.of(name, above, below, values, frequency)


def _are_alike(first: Case, second: Case) -> bool:
    """Whether the frequencies of `low_gain` are the same."""
    lowest, others = (case.identified.spectra.frequency[:N_LOW] for case in (first, second))
    return lowest.shape == others.shape and np.allclose(lowest, others, rtol=0.02)


def findings(study: StudyResult) -> dict[str, Finding]:
    """Those that a study allows, by name.

    `tasks` is the low-frequency gain in the relax over that in the position task, of the conditions with most trials;
    `amplitude_PT` and `amplitude_RT` that of the largest over that of the smallest movement of a task, or, if all are
    to be as large, `condition_PT` and `condition_RT` that of the highest over that of the lowest co-contraction;
    `excess` the recorded over the predicted peak after a pulse, geometric mean over the conditions that a person has.
    """
    ratios: list[Finding | None] = []
    main = main_conditions(study)
    if len(main) == len(TASKS):
        ratios.append(_ratio(study, "tasks", main["RT"].name, main["PT"].name))
    for task, conditions in by_task(study).items():
        if len(conditions) > 1:
            below, *_, above = conditions
            kind = "amplitude" if movement(above) > movement(below) else "condition"
            ratios.append(_ratio(study, f"{kind}_{task}", above.name, below.name))
    of_pulses = [excess.values for excess in excesses(study)]
    values = {}
    for person in study.people:
        if logs := [math.log(of_people[person.name]) for of_people in of_pulses if person.name in of_people]:
            values[person.name] = math.exp(np.mean(logs))
    ratios.append(Finding.of("excess", "recorded", "predicted", values))
    return {finding.name: finding for finding in ratios if finding is not None}


def fall_is_given(study: StudyResult, finding: Finding | None) -> bool:
    """Whether admittance falls between conditions in which only people's calibrated levels of co-contraction differ.

    Args:
      study: of which it is.
      finding: `amplitude_PT`, if there is one.
    """
    if finding is None or finding.mean >= 1.0 or set_levels(study, finding):
        return False
    return any(
        person.levels.get(finding.above, 1.0) != person.levels.get(finding.below, 1.0) for person in study.cohort
    )


def set_levels(study: StudyResult, finding: Finding | None) -> tuple[float, float] | tuple[()]:
    """Co-contraction that the protocol sets below and above [multiple of people's own]; nothing where it is the same.

    Args:
      study: of which it is.
      finding: `amplitude_PT` or `condition_PT`, if there is one.
    """
    if finding is None:
        return ()
    levels = {condition.name: condition.co_contraction for condition in study.protocol.conditions}
    below, above = levels.get(finding.below, 1.0), levels.get(finding.above, 1.0)
    return () if below == above else (below, above)


def finding_rows(results: dict[str, Finding]) -> list[Row]:
    """A row per finding and person, and of the mean with its interval, for a table."""
    rows = []
    for finding in results.values():
        shared = {"finding": finding.name, "above": finding.above, "below": finding.below}
        mean = {"value": finding.mean, "lower_95": finding.lower, "upper_95": finding.upper}
        rows.append({**shared, "subject": "geometric mean", **mean})
        for name, value in finding.values.items():
            rows.append({**shared, "subject": name, "value": value, "lower_95": math.nan, "upper_95": math.nan})
    return rows


FLAGS: dict[str, Callable[[Row], bool]] = {
    "rejected by the lack-of-fit test": lambda row: row["p_value"] < SUSPICIOUS,
    "with a parameter at its bound": lambda row: bool(row["at_bound"]),
    "not converged": lambda row: not row["converged"],
    "unstable on the manipulator": lambda row: not row["stable"],
}
"""Why a fit is not to be trusted as it stands, to whether a row of the table of fits says so."""


def flags(fits: Sequence[Row]) -> dict[str, int]:
    """Reason to the number of maximum likelihood fits that it flags, reasons that flag none left out."""
    counts = {reason: sum(map(says, fits)) for reason, says in FLAGS.items()}
    return {reason: count for reason, count in counts.items() if count}


def n_flagged(fits: Sequence[Row]) -> int:
    """Number of fits that are flagged for one reason or more."""
    return sum(any(says(row) for says in FLAGS.values()) for row in fits)


def estimators_differ(rows: Sequence[Row]) -> float:
    """Median over people, conditions and parameters of how far the thesis's estimate is from maximum likelihood [%]."""
    ratios = [row["thesis_estimated"] / row["estimated"] for row in rows if row["estimated"] > 0.0]
    known = [abs(ratio - 1.0) for ratio in ratios if math.isfinite(ratio)]
    return 100.0 * float(np.median(known)) if known else math.nan


class LawAlone(NamedTuple):
    """What movements that grow do to the first person's admittance in the position task.

    Attributes:
      above: condition of the larger movement.
      below: that of the smaller one.
      with_levels: gain in the one over that in the other, with the person's levels of co-contraction [-].
      alone: the same with one level of co-contraction in all conditions [-].
      unstable: whether the arm with one level does not last in the condition of the largest movement.
    """

    above: str
    below: str
    with_levels: float
    alone: float
    unstable: bool


def law_alone(yielding: Yielding | None) -> LawAlone | None:
    """Gain in the largest movement in which both arms last over that in the smallest.

    None where that was not simulated, or the person co-contracts equally in all conditions.
    """
    if yielding is None or ONE_LEVEL not in yielding.variants:
        return None
    below, *larger = AMPLITUDES["PT"]
    for above in reversed(larger):
        with_levels, alone = (yielding.rise(name, above, below) for name in (yielding.variants[0], ONE_LEVEL))
        if math.isfinite(with_levels) and math.isfinite(alone):
            return LawAlone(above, below, with_levels, alone, (ONE_LEVEL, larger[-1]) in yielding.unstable)
    return None
