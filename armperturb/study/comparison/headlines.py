"""The thesis's headline numbers beside those of a study."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armperturb.analysis.measures.statistics import FEWEST, effect_of_condition, paired_t, post_hoc
from armperturb.arrays import Array
from armperturb.study.published import tables as published
from armperturb.study.results.quantities import JOINTS, Cell
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

POST_HOC = {
    "PT": {"p_pulse_admittance_pt0_pt2.5": (0, 1), "p_pulse_admittance_pt0_pt7.5": (0, 2)},
    "RT": {
        "p_pulse_admittance_rt0_rt2.5": (0, 1),
        "p_pulse_admittance_rt0_rt7.5": (0, 2),
        "p_pulse_admittance_rt0_rt22.5": (0, 3),
        "p_pulse_admittance_rt2.5_rt7.5": (1, 2),
        "p_pulse_admittance_rt7.5_rt22.5": (2, 3),
    },
}
"""Task to the printed post-hoc comparisons, pairs in `PULSED`; those of PT that the text garbles are not among them."""


@dataclass(frozen=True, kw_only=True)
class Headline:
    """A number of the running text.

    Attributes:
      name: as in `headline.csv`, or of a number that the thesis shows in a figure or tells in words.
      published: as printed, or in words.
      ours: the study's; NaN if it cannot be computed.
      unit: of both.
      remark: how it was computed, or why it was not.
    """

    name: str
    published: str
    ours: float
    unit: str = "-"
    remark: str = ""


def headlines(people: Sequence[PersonMeasures]) -> tuple[Headline, ...]:
    """All headline numbers; what the people's recordings do not tell is NaN, with the reason.

    Args:
      people: at least one.
    """
    return (
        *(
            _gain_ratio(people, name, *pair)
            for name, pair in {
                "admittance_ratio_rt7.5_pt7.5": ("RT7.5", "PT7.5"),
                "admittance_amplitude_factor_pt": ("PT2.5", "PT22.5"),
                "admittance_amplitude_factor_rt": ("RT22.5", "RT2.5"),
            }.items()
        ),
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
            return _missing(name, published.headline_text(name), f"nobody's admittance in {condition}")
        gains.append(np.exp(np.mean(np.log(low_gains), axis=0)))
    return Headline(
        name=name,
        published=published.headline_text(name),
        ours=float(np.mean(gains[0] / gains[1])),
        remark=f"{above} over {below}, lowest two frequencies, diagonal",
    )


def _predictions(people: Sequence[PersonMeasures]) -> list[Headline]:
    """Figure 3.19, and what the text says of it."""
    low, high = (published.headline_text(f"pulse_prediction_{end}") for end in ("low", "high"))
    means, excess, lines = {}, [], []
    for condition, level in PREDICTED:
        values = [pulse for pulse in _of(people, condition, level) if math.isfinite(pulse.prediction)]
        name = f"pulse_prediction_{condition}_{level}"
        if not values:
            lines.append(_missing(name, f"{low} to {high}", "nobody's pulse is predicted", "%"))
            continue
        means[condition, level] = float(np.mean([pulse.prediction for pulse in values]))
        excess.append(float(np.mean([pulse.excess for pulse in values])))
        lines.append(Headline(name=name, published=f"{low} to {high}", ours=means[condition, level], unit="%"))
    summaries = {
        "pulse_prediction_low": (lambda: min(means.values()), "%", "smallest of the conditions"),
        "pulse_prediction_high": (lambda: max(means.values()), "%", "largest of the conditions"),
        "pulse_underprediction_factor": (
            lambda: float(np.mean(excess)),
            "-",
            "recorded over predicted, mean over trials, people and conditions",
        ),
        "pulse_excess_max": (lambda: 100.0 / min(means.values()), "-", "inverse of the smallest"),
    }
    for name, (value, unit, remark) in summaries.items():
        text = published.headline_text(name)
        if means:
            missing = len(PREDICTED) - len(means)
            remark += f"; {missing} of {len(PREDICTED)} conditions are missing" if missing else ""
            lines.append(Headline(name=name, published=text, ours=value(), unit=unit, remark=remark))
        else:
            lines.append(_missing(name, text, "nobody's pulse is predicted", unit))
    for name, after, before in (
        ("pulse_prediction_increase_pt2.5_pt22.5_max", ("PT22.5", "max"), ("PT2.5", "max")),
        ("pulse_prediction_increase_pt7.5_max_min", ("PT7.5", "min"), ("PT7.5", "max")),
        ("pulse_prediction_increase_rt2.5_rt22.5_min", ("RT22.5", "min"), ("RT2.5", "min")),
    ):
        text = published.headline_text(name)
        if after in means and before in means:
            remark = "difference in percentage points"
            lines.append(
                Headline(name=name, published=text, ours=means[after] - means[before], unit="%", remark=remark)
            )
        else:
            lines.append(_missing(name, text, "a condition has no prediction", "%"))
    return lines


def _levels(people: Sequence[PersonMeasures]) -> list[Headline]:
    """Pulse admittance at the maximum over that at the minimum level, and a dependent t-test."""
    lines = []
    for condition in ("PT0", "PT7.5"):
        values = _table(people, ((condition, "max"), (condition, "min")))
        key = condition.lower()
        name, test = f"pulse_admittance_ratio_max_min_{key}", f"p_pulse_admittance_level_{key}"
        if not len(values):
            lines += [
                _missing(missing, published.headline_text(missing), f"nobody has both levels in {condition}")
                for missing in (name, test)
            ]
            continue
        ratio = float(values[:, 0].mean() / values[:, 1].mean())
        lines.append(Headline(name=name, published=published.headline_text(name), ours=ratio))
        if len(values) < FEWEST:
            lines.append(_missing(test, published.headline_text(test), f"fewer than {FEWEST} people"))
        else:
            p = paired_t(values[:, 0], values[:, 1]).p
            lines.append(
                Headline(name=test, published=published.headline_text(test), ours=p, remark="dependent t-test")
            )
    return lines


def _before(people: Sequence[PersonMeasures], task: str) -> list[Headline]:
    """What a multisine before the pulse does to the pulse admittance."""
    values, pulses = _table(people, PULSED[task]), PULSED[task]
    words = {"PT": "falls: below 1", "RT": "rises: above 1"}[task]
    tests = [f"p_pulse_admittance_anova_{task.lower()}", *POST_HOC[task]]
    names = [f"pulse_admittance_{condition}_over_{pulses[0][0]}" for condition, _ in pulses[1:]]
    if not len(values):
        why = f"nobody has all of {', '.join(condition for condition, _ in pulses)}"
        return [
            *(_missing(name, words, why) for name in names),
            *(_missing(test, published.headline_text(test), why) for test in tests),
        ]
    mean = values.mean(axis=0)
    lines = [
        Headline(name=name, published=words, ours=float(ratio / mean[0]), remark=f"level {pulses[0][1]}")
        for name, ratio in zip(names, mean[1:], strict=True)
    ]
    if len(values) < FEWEST:
        return lines + [_missing(test, published.headline_text(test), f"fewer than {FEWEST} people") for test in tests]
    effect, pairs = effect_of_condition(values), post_hoc(values)
    lines.append(
        Headline(name=tests[0], published=published.headline_text(tests[0]), ours=effect.p, remark=effect.test)
    )
    for name, pair in POST_HOC[task].items():
        text = published.headline_text(name)
        lines.append(
            Headline(name=name, published=text, ours=pairs[pair].p_bonferroni, remark="dependent t-test, Bonferroni")
        )
    return lines


def _task_ratio(people: Sequence[PersonMeasures]) -> Headline:
    """Peak displacement when relaxing over that when keeping position, at the minimum level."""
    name = "peak_displacement_ratio_rt_pt_min_level"
    ratios = []
    for relax, position in (("RT0", "PT0"), ("RT7.5", "PT7.5")):
        means = [[pulse.displacement for pulse in _of(people, condition, "min")] for condition in (relax, position)]
        if not all(means):
            return _missing(name, published.headline_text(name), f"no pulses of level 1 in {relax} or {position}")
        ratios.append(np.mean(means[0]) / np.mean(means[1]))
    return Headline(
        name=name,
        published=published.headline_text(name),
        ours=float(np.mean(ratios)),
        remark="mean of RT0 over PT0 and RT7.5 over PT7.5; table 2.1 gives 3.7",
    )


def _largest_displacement(people: Sequence[PersonMeasures]) -> Headline:
    """Peak displacement at each condition's largest level, mean over conditions."""
    name, pulses = "pulse_mean_displacement", [pulse for of_task in PULSED.values() for pulse in of_task]
    means = [[pulse.displacement for pulse in _of(people, *pulse)] for pulse in pulses]
    text = published.headline_text(name)
    if not all(means):
        return _missing(name, text, "a condition has no pulses of its largest level", "cm")
    ours = 100.0 * float(np.mean([np.mean(values) for values in means]))
    return Headline(
        name=name, published=text, ours=ours, unit="cm", remark="mean of the largest levels of all conditions"
    )


def _rotation_ratio(people: Sequence[PersonMeasures]) -> Headline:
    """Peak rotation of a joint at the maximum over that at the minimum level (appendix F.3)."""
    name, ratios = "peak_rotation_ratio_max_min", []
    text = published.headline_text(name)
    for condition in ("PT0", "PT7.5"):
        for joint in JOINTS:
            cells = [Cell("F.5", condition, f"peak_rotation_{level}_{joint}") for level in ("max", "min")]
            means = [[person.cells[cell] for person in people if cell in person.cells] for cell in cells]
            if not all(means):
                return _missing(name, text, f"nobody has both levels in {condition}")
            ratios.append(np.mean(means[0]) / np.mean(means[1]))
    remark = "mean of both joints in PT0 and PT7.5"
    return Headline(name=name, published=text, ours=float(np.mean(ratios)), remark=remark)


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


def _missing(name: str, text: str, why: str, unit: str = "-") -> Headline:
    return Headline(name=name, published=text, ours=math.nan, unit=unit, remark=why)
