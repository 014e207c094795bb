"""The thesis's headline numbers beside those of a study."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armperturb.analysis.measures.statistics import FEWEST, effect_of_condition, post_hoc
from armperturb.arrays import Array
from armperturb.study.comparison.ceiling import contradictions
from armperturb.study.published import tables as published
from armperturb.study.results.quantities import JOINT_LETTERS, PULSE_LEVELS, Cell
from armperturb.study.results.trial_measures import PersonMeasures, PulseMeans

PULSED = {
    "PT": (("PT0", "max"), ("PT2.5", "max"), ("PT7.5", "max"), ("PT22.5", "max")),
    "RT": (("RT0", "min"), ("RT2.5", "min"), ("RT7.5", "min"), ("RT22.5", "min")),
}
"""Task to the pulses that show what a multisine before them does, the smallest first (figure 3.16)."""

PREDICTED = (
    *(("PT2.5", "max"), ("PT7.5", "min"), ("PT7.5", "max"), ("PT22.5", "max")),
    *(("RT2.5", "min"), ("RT7.5", "min"), ("RT22.5", "min")),
)
"""Pulses that a linear model predicts (figure 3.19)."""

_COMPARED = {"PT": ((0, 1), (0, 2)), "RT": ((0, 1), (0, 2), (0, 3), (1, 2), (2, 3))}

POST_HOC = {
    task: {f"p_pulse_admittance_{PULSED[task][i][0]}_{PULSED[task][j][0]}".lower(): (i, j) for i, j in pairs}
    for task, pairs in _COMPARED.items()
}
"""Task to the printed post-hoc comparisons, pairs in `PULSED`; those of PT that the text garbles are not among them."""


TOO_FEW = f"fewer than {FEWEST} people"


@dataclass(frozen=True, kw_only=True)
class Headline:
    """A number of the running text.

    Attributes:
      name: as in `headline.csv`, or of a number that the thesis shows in a figure or tells in words.
      published: as printed, or in words.
      ours: the study's; NaN if it cannot be computed.
      unit: of both.
      remark: how it was computed, or why it was not.
      contradiction: what other printed numbers say against the published one; else empty.
    """

    name: str
    published: str
    ours: float
    unit: str = "-"
    remark: str = ""
    contradiction: str = ""


def headlines(people: Sequence[PersonMeasures]) -> tuple[Headline, ...]:
    """All headline numbers; what the people's recordings do not tell is NaN, with the reason.

    Args:
      people: at least one.
    """
    return (
        _gain_ratio(people, "admittance_ratio_rt7.5_pt7.5", "RT7.5", "PT7.5"),
        _gain_ratio(people, "admittance_amplitude_factor_pt", "PT2.5", "PT22.5"),
        _gain_ratio(people, "admittance_amplitude_factor_rt", "RT22.5", "RT2.5"),
        *_predictions(people),
        *_levels(people),
        *(headline for task in PULSED for headline in _before(people, task)),
        _task_ratio(people),
        _largest_displacement(people),
        _rotation_ratio(people),
    )


def _gain_ratio(people: Sequence[PersonMeasures], name: str, above: str, below: str) -> Headline:
    """Mean over the lowest two frequencies and the diagonal of the ratio of gains, geometric means over people."""
    gains = []
    for condition in (above, below):
        low_gains = [person.low_gain[condition] for person in people if condition in person.low_gain]
        if not low_gains:
            return _headline(name, f"nobody's admittance in {condition}")
        gains.append(np.exp(np.mean(np.log(low_gains), axis=0)))
    ratio = float(np.mean(gains[0] / gains[1]))
    return _headline(name, ratio, f"{above} over {below}, lowest two frequencies, diagonal")


def _predictions(people: Sequence[PersonMeasures]) -> list[Headline]:
    """Figure 3.19, and what the text says of it."""
    pulses = {pulse: [its for its in _of(people, *pulse) if math.isfinite(its.prediction)] for pulse in PREDICTED}
    means = {
        pulse: float(np.mean([its.prediction for its in of_pulse])) for pulse, of_pulse in pulses.items() if of_pulse
    }
    excess = [float(np.mean([its.excess for its in of_pulse])) for of_pulse in pulses.values() if of_pulse] or [
        math.nan
    ]
    smallest, largest = min(means.values(), default=math.nan), max(means.values(), default=math.nan)
    nobody, missing = "nobody's pulse is predicted", len(PREDICTED) - len(means)
    more = f"; {missing} of {len(PREDICTED)} pulses are missing" if missing else ""
    reasons = {
        (condition, level): nobody
        if _of(people, condition, level)
        else f"no pulse of level {PULSE_LEVELS[level]:g} was measured in {condition}"
        for condition, level in PREDICTED
    }
    printed = " to ".join(published.headline_text(f"pulse_prediction_{end}") for end in ("low", "high"))
    lines = [
        _headline("_".join(("pulse_prediction", *pulse)), means.get(pulse, reasons[pulse]), unit="%", text=printed)
        for pulse in PREDICTED
    ]
    for name, value, unit, remark in (
        ("pulse_prediction_low", smallest, "%", "smallest of the conditions"),
        ("pulse_prediction_high", largest, "%", "largest of the conditions"),
        (
            *("pulse_underprediction_factor", float(np.mean(excess)), "-"),
            "recorded over predicted, mean over trials, people and conditions",
        ),
        ("pulse_excess_max", 100.0 / smallest, "-", "inverse of the smallest"),
    ):
        lines.append(_headline(name, value if means else nobody, remark + more, unit=unit))
    for name, after, before in (
        ("pulse_prediction_increase_pt2.5_pt22.5_max", ("PT22.5", "max"), ("PT2.5", "max")),
        ("pulse_prediction_increase_pt7.5_max_min", ("PT7.5", "min"), ("PT7.5", "max")),
        ("pulse_prediction_increase_rt2.5_rt22.5_min", ("RT22.5", "min"), ("RT2.5", "min")),
    ):
        both = {after, before} <= means.keys()
        increase = means[after] - means[before] if both else "a condition has no prediction"
        lines.append(_headline(name, increase, "difference in percentage points", unit="%"))
    return lines


def _levels(people: Sequence[PersonMeasures]) -> list[Headline]:
    """Pulse admittance at the maximum over that at the minimum level, and a dependent t-test."""
    lines = []
    for condition in ("PT0", "PT7.5"):
        values = _table(people, ((condition, "max"), (condition, "min")))
        ratio: float | str = f"nobody has both levels in {condition}"
        p = ratio
        if len(values):
            ratio = float(values[:, 0].mean() / values[:, 1].mean())
            p = TOO_FEW if len(values) < FEWEST else post_hoc(values)[0, 1].p
        lines.append(_headline(f"pulse_admittance_ratio_max_min_{condition.lower()}", ratio))
        lines.append(_headline(f"p_pulse_admittance_level_{condition.lower()}", p, "dependent t-test"))
    return lines


def _before(people: Sequence[PersonMeasures], task: str) -> list[Headline]:
    """What a multisine before the pulse does to the pulse admittance."""
    values, pulses = _table(people, PULSED[task]), PULSED[task]
    nobody = "" if len(values) else f"nobody has all of {', '.join(condition for condition, _ in pulses)}"
    words = {"PT": "falls: below 1", "RT": "rises: above 1"}[task]
    mean = values.mean(axis=0) if len(values) else np.full(len(pulses), math.nan)
    (first, level), *others = pulses
    lines = [
        _headline(
            f"pulse_admittance_{condition}_over_{first}", nobody or float(its / mean[0]), f"level {level}", text=words
        )
        for (condition, _), its in zip(others, mean[1:], strict=True)
    ]
    anova = f"p_pulse_admittance_anova_{task.lower()}"
    if len(values) < FEWEST:
        return lines + [_headline(test, nobody or TOO_FEW) for test in (anova, *POST_HOC[task])]
    effect, pairs = effect_of_condition(values), post_hoc(values)
    lines.append(_headline(anova, effect.p, effect.test))
    for name, pair in POST_HOC[task].items():
        lines.append(_headline(name, pairs[pair].p_bonferroni, "dependent t-test, Bonferroni"))
    return lines


def _task_ratio(people: Sequence[PersonMeasures]) -> Headline:
    """Peak displacement when relaxing over that when keeping position, at the minimum level."""
    name, ratios = "peak_displacement_ratio_rt_pt_min_level", []
    for relax, position in (("RT0", "PT0"), ("RT7.5", "PT7.5")):
        means = [[pulse.displacement for pulse in _of(people, condition, "min")] for condition in (relax, position)]
        if not all(means):
            return _headline(name, f"no pulses of level 1 in {relax} or {position}")
        ratios.append(np.mean(means[0]) / np.mean(means[1]))
    return _headline(name, float(np.mean(ratios)), "mean of RT0 over PT0 and RT7.5 over PT7.5; table 2.1 gives 3.7")


def _largest_displacement(people: Sequence[PersonMeasures]) -> Headline:
    """Peak displacement at each condition's largest level, mean over conditions."""
    pulses = [pulse for of_task in PULSED.values() for pulse in of_task]
    values = [[its.displacement for its in _of(people, *pulse)] for pulse in pulses]
    ours: float | str = "a condition has no pulses of its largest level"
    if all(values):
        ours = 100.0 * float(np.mean([np.mean(of_pulse) for of_pulse in values]))
    return _headline("pulse_mean_displacement", ours, "mean of the largest levels of all conditions", unit="cm")


def _rotation_ratio(people: Sequence[PersonMeasures]) -> Headline:
    """Peak rotation of a joint at the maximum over that at the minimum level (appendix F.3)."""
    name, ratios = "peak_rotation_ratio_max_min", []
    for condition, joint in itertools.product(("PT0", "PT7.5"), JOINT_LETTERS):
        cells = [Cell("F.5", condition, f"peak_rotation_{level}_{joint}") for level in ("max", "min")]
        means = [[person.cells[cell] for person in people if cell in person.cells] for cell in cells]
        if not all(means):
            return _headline(name, f"nobody has both levels in {condition}")
        ratios.append(np.mean(means[0]) / np.mean(means[1]))
    return _headline(name, float(np.mean(ratios)), "mean of both joints in PT0 and PT7.5")


def _of(people: Sequence[PersonMeasures], condition: str, level: str) -> list[PulseMeans]:
    return [person.pulses[condition, level] for person in people if (condition, level) in person.pulses]


def _table(people: Sequence[PersonMeasures], pulses: Sequence[tuple[str, str]]) -> Array:
    """Pulse admittances of those who have all of these [m/N], (subject, pulse)."""
    return np.array(
        [
            [person.pulses[pulse].admittance for pulse in pulses]
            for person in people
            if all(pulse in person.pulses for pulse in pulses)
        ]
    )


def _headline(name: str, ours: float | str, remark: str = "", *, unit: str = "-", text: str = "") -> Headline:
    """A number beside the printed one, or beside a text; a number in words is the reason why there is none."""
    value, why = (math.nan, ours) if isinstance(ours, str) else (ours, remark)
    return Headline(
        name=name,
        published=text or published.headline_text(name),
        ours=value,
        unit=unit,
        remark=why,
        contradiction=contradictions().get(name, ""),
    )
