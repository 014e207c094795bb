"""Figures of the responses to pulses: peaks and their prediction (thesis figures 3.15, 3.16, 3.19)."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from armperturb.plots.panels import legend
from armperturb.plots.style import COLOURS, PUBLISHED, in_style
from armperturb.study.comparison.effects import pulse_values
from armperturb.study.published import tables as published
from armperturb.study.published.tables import MeanSD
from armperturb.study.report.figures import groups as groups_of_people
from armperturb.study.report.figures.groups import MARKERS, MODEL_LOOKS, NOTHING_PRINTED, Series
from armperturb.study.report.figures.people import fit_labels
from armperturb.study.report.tables import published_or_nan
from armperturb.study.results.mean_admittance import perturbed_conditions
from armperturb.study.results.quantities import PULSE_LEVELS, level_name
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import PulseMeans
from armperturb.subject import TASKS

Levels = dict[str, dict[float, dict[str, float]]]
"""Condition and level to person to value."""

DARKER = 0.45
"""Share of its brightness that a colour loses from a level of pulses to the next whole one [-]."""

LEVEL_MARKERS = {1.0: "o", 2.0: "^"}
"""Of the thesis's levels; smaller ones point down, those between are squares, larger ones stars."""


@in_style()
def peak_displacement(study: StudyResult) -> Figure:
    """Peak displacement after pulses: means over trials of people, and over people (thesis fig. 3.15, table 2.1)."""
    by_task = pulsed_people(study, lambda means: means.displacement)
    figure, _ = _draw_levels(by_task, "peak displacement [cm]", 100.0, published.peak_displacement)
    return figure


@in_style()
def pulse_admittance(study: StudyResult, p: Mapping[str, float] | None = None) -> Figure:
    """Peak displacement over peak hand reaction force: people's means over trials, and their means (thesis fig. 3.16).

    Above conditions with several levels stands the ratio of the means of the largest and the smallest over the people
    who have both in a direction, over such directions, and what the thesis has, if these are its levels.

    Args:
      study: with trials that have pulses.
      p: condition with several levels to the p of the level's effect.
    """
    by_task = pulsed_people(study, lambda means: means.admittance)
    figure, panels = _draw_levels(by_task, "pulse admittance [mm/N]", 1000.0, shared=False)
    for task, (ax, tops) in panels.items():
        if any(len(levels) > 1 for levels in by_task[task].values()):
            ax.set_ylim(top=1.2 * max(tops.values()))
            ax.set_xlim(left=-0.75)  # room for the words above the first
        for group, (condition, levels) in enumerate(by_task[task].items()):
            ends = [(condition, level_name(condition, end)) for end in (min(levels), max(levels))]
            of_people = np.array([pulse_values(person, "admittance", ends)[0] for person in study.people])
            both = of_people[np.isfinite(of_people).all(axis=1)]
            if len(levels) < 2 or not len(both):
                continue
            smallest, largest = both.mean(axis=0)
            stars = groups_of_people.stars((p or {}).get(condition, 1.0))
            place: dict[str, Any] = {
                "xy": (group, tops[condition]),
                "textcoords": "offset points",
                "ha": "center",
                "va": "bottom",
            }
            ax.annotate(f"× {largest / smallest:.2f} {stars}".strip(), xytext=(0, 15), **place)
            if ratio_is_published(condition, levels):
                printed = published.headline(f"pulse_admittance_ratio_max_min_{condition.lower()}")
                ax.annotate(f"× {printed:g} published", xytext=(0, 4), **place, color=PUBLISHED["color"], fontsize=8)
    return figure


def ratio_is_published(condition: str, levels: Collection[float]) -> bool:
    """Whether the thesis prints the ratio of the largest and the smallest of these levels of pulses in a condition."""
    return set(published.pulse_levels(condition)) == set(PULSE_LEVELS) and set(levels) == set(PULSE_LEVELS.values())


@in_style()
def pulse_prediction(study: StudyResult) -> Figure:
    """Predicted over recorded peak displacement of both models: people's means over trials (thesis fig. 3.19)."""
    looks = dict(zip(MODEL_LOOKS, MARKERS, strict=False))
    shares: dict[str, Callable[[PulseMeans], float]] = {
        "linear": lambda means: means.prediction,
        "skeletal": lambda means: means.prediction_skeletal,
    }
    by_model = {model: pulsed_people(study, shares[model]) for model in MODEL_LOOKS}
    groups = {
        task: {
            f"{condition}\n{level_name(condition, level)}": [
                Series(
                    by_model[model].get(task, {}).get(condition, {}).get(level, {}), MODEL_LOOKS[model]["color"], marker
                )
                for model, marker in looks.items()
            ]
            for condition, levels in conditions.items()
            for level in levels
        }
        for task, conditions in by_model["linear"].items()
    }
    return groups_of_people.draw_predictions(3.6, groups, groups_of_people.model_handles(), 4)


def pulsed_people(study: StudyResult, quantity: Callable[[PulseMeans], float]) -> dict[str, Levels]:
    """Task, condition and level to each person's mean over trials; only those that have any.

    Args:
      study: with measured people.
      quantity: of the means of a person, condition and level; NaN if there is none.
    """
    by_task: dict[str, Levels] = {}
    for task in TASKS:
        for condition in perturbed_conditions(study, task):
            for level in sorted(condition.pulse_levels):
                pulse = condition.name, level_name(condition.name, level)
                means = {
                    person.name: quantity(person.pulses[pulse]) for person in study.people if pulse in person.pulses
                }
                values = {name: value for name, value in means.items() if np.isfinite(value)}
                if values:
                    by_task.setdefault(task, {}).setdefault(condition.name, {})[level] = values
    return by_task


def _draw_levels(
    by_task: Mapping[str, Levels],
    label: str,
    scale: float,
    source: Callable[..., MeanSD] | None = None,
    *,
    shared: bool = True,
) -> tuple[Figure, dict[str, tuple[Axes, dict[str, float]]]]:
    """People at both pulse levels in each condition, a panel per task; and the panels with where each group ends."""

    def series(task: str, condition: str, level: float, values: Mapping[str, float]) -> Series:
        printed = published_or_nan(source, condition, level_name(condition, level)) if source else NOTHING_PRINTED
        return Series(values, *_look(task, level), printed)

    groups = {
        task: {
            condition: [series(task, condition, level, values) for level, values in levels.items()]
            for condition, levels in conditions.items()
        }
        for task, conditions in by_task.items()
    }
    figure, panels = groups_of_people.task_panels(3.5, groups, shared=shared)
    tops = {task: (ax, groups_of_people.draw_groups(ax, groups[task], scale)) for task, ax in panels.items()}
    for ax in panels.values():
        fit_labels(ax)
    drawn = {
        task: sorted({level for of in conditions.values() for level in of}) for task, conditions in by_task.items()
    }
    shown = [level_name(name, level) for of in by_task.values() for name, levels in of.items() for level in levels]
    of_thesis = set(shown) <= PULSE_LEVELS.keys()
    handles = [
        groups_of_people.people_handle(f"people, {task}, {_level_words(level, of_thesis)}", *_look(task, level))
        for task, levels in drawn.items()
        for level in levels
    ]
    mean = groups_of_people.mean_label(groups.values())
    handles += [groups_of_people.mean_handle(mean), *groups_of_people.printed_handles(groups.values())]
    legend(figure, *handles, n_columns=3)
    for number, ax in enumerate(panels.values()):
        ax.set_ylim(bottom=0)
        if number == 0 or not shared:
            ax.set_ylabel(label)
    return figure, tops


def _level_words(level: float, of_thesis: bool) -> str:
    """For a legend: the thesis's names where all levels are its own, as they mislead beside others."""
    words = {value: f"{name}imum level" for name, value in PULSE_LEVELS.items()} if of_thesis else {}
    return words.get(level, f"level {level:g}")


def _look(task: str, level: float) -> tuple[str, str]:
    """Colour and marker; darker for the larger pulse."""
    brightness = max(0.0, 1.0 - DARKER * (level - 1.0))
    red, green, blue = (min(1.0, brightness * part) for part in to_rgb(COLOURS[task]))
    return to_hex((red, green, blue)), LEVEL_MARKERS.get(level, "v" if level < 1.0 else "s" if level < 2.0 else "*")
