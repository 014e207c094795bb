"""Figures of the responses to pulses: peaks and their prediction (thesis figures 3.15, 3.16, 3.19)."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from armperturb.plots.panels import legend
from armperturb.plots.style import COLOURS, PUBLISHED, in_style, shades
from armperturb.study.published import tables as published
from armperturb.study.published.tables import MeanSD
from armperturb.study.report.figures import bars
from armperturb.study.report.tables import published_or_nan
from armperturb.study.results.quantities import PULSE_LEVELS
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import TrialMeasures

Levels = dict[str, dict[str, list[float]]]
"""Condition and level ("min", "max") to one value per trial or person."""

NAMES = {"min": "minimum level", "max": "maximum level"}


@in_style()
def peak_displacement(study: StudyResult) -> Figure:
    """Peak displacement after pulses, mean and SD over people of means over trials (thesis fig. 3.15, table 2.1)."""
    by_task = _by_level(
        lambda condition, level: [
            person.pulses[condition, level].displacement
            for person in study.people
            if (condition, level) in person.pulses
        ]
    )
    figure, _ = _draw_levels(by_task, "peak displacement [cm]", 100.0, published.peak_displacement)
    return figure


@in_style()
def pulse_admittance(study: StudyResult, p: Mapping[str, float] | None = None) -> Figure:
    """Peak displacement over peak hand reaction force, mean and SD over trials (thesis fig. 3.16).

    Above conditions with both levels stands the ratio of their means, and what the thesis has.

    Args:
      study: with trials that have pulses.
      p: condition with both levels to the p of the level's effect.
    """
    by_task = pulsed_trials(study, lambda trial: trial.admittance)
    figure, panels = _draw_levels(by_task, "pulse admittance [mm/N]", 1000.0, shared=False)
    for task, (ax, tops) in panels.items():
        if any(len(levels) == len(PULSE_LEVELS) for levels in by_task[task].values()):
            ax.set_ylim(top=1.2 * max(tops.values()))
        for group, (condition, levels) in enumerate(by_task[task].items()):
            if len(levels) < len(PULSE_LEVELS):
                continue
            stars = bars.stars((p or {}).get(condition, 1.0))
            printed = published.headline(f"pulse_admittance_ratio_max_min_{condition.lower()}")
            place: dict[str, Any] = {
                "xy": (group, tops[condition]),
                "textcoords": "offset points",
                "ha": "center",
                "va": "bottom",
            }
            ax.annotate(
                f"× {np.mean(levels['max']) / np.mean(levels['min']):.2f} {stars}".strip(), xytext=(0, 15), **place
            )
            ax.annotate(f"× {printed:g} published", xytext=(0, 4), **place, color=PUBLISHED["color"], fontsize=8)
    return figure


@in_style()
def pulse_prediction(study: StudyResult) -> Figure:
    """Predicted over recorded peak displacement of both models, mean and SD over trials (thesis fig. 3.19)."""
    by_model = {model: pulsed_trials(study, partial(predicted_share, model=model)) for model in bars.MODEL_LOOKS}
    groups = {
        task: {
            f"{condition}\n{level}": [
                bars.Bar.of(by_model[model].get(task, {}).get(condition, {}).get(level, ()), look["color"])
                for model, look in bars.MODEL_LOOKS.items()
            ]
            for condition, levels in conditions.items()
            for level in levels
        }
        for task, conditions in by_model["linear"].items()
    }
    return bars.draw_predictions(3.4, groups, bars.model_handles(), 6)


def predicted_share(trial: TrialMeasures, model: str) -> float:
    """Predicted over recorded peak displacement of a trial [%] (eq. 2.25); NaN without a prediction.

    Args:
      trial: with a pulse.
      model: "linear" or "skeletal".
    """
    return 100.0 * float(getattr(trial, f"predicted_{model}")) / trial.displacement


def pulsed_trials(study: StudyResult, quantity: Callable[[TrialMeasures], float]) -> dict[str, Levels]:
    """Task, condition and level to the finite values of everybody's trials; only those that have any."""
    return _by_level(
        lambda condition, level: [
            quantity(trial)
            for person in study.people
            for trial in person.trials
            if trial.condition == condition and abs(trial.pulse_level) == PULSE_LEVELS[level]
        ]
    )


def _by_level(values_of: Callable[[str, str], list[float]]) -> dict[str, Levels]:
    """Task, condition and level to the finite ones of their values; only those that have any."""
    by_task: dict[str, Levels] = {}
    for task, conditions in bars.CONDITIONS.items():
        for condition in conditions:
            for level in PULSE_LEVELS:
                values = [value for value in values_of(condition, level) if np.isfinite(value)]
                if values:
                    by_task.setdefault(task, {}).setdefault(condition, {})[level] = values
    return by_task


def _draw_levels(
    by_task: Mapping[str, Levels],
    label: str,
    scale: float,
    source: Callable[..., MeanSD] | None = None,
    *,
    shared: bool = True,
) -> tuple[Figure, dict[str, tuple[Axes, dict[str, float]]]]:
    """Bars of both pulse levels in each condition, a panel per task; and the panels with where each group ends."""

    def bar(task: str, condition: str, level: str, values: Sequence[float]) -> bars.Bar:
        printed = [published_or_nan(source, condition, level)] if source else []
        return bars.Bar.of(values, _colour(task, level), *printed)

    groups = {
        task: {
            condition: [bar(task, condition, level, values) for level, values in levels.items()]
            for condition, levels in conditions.items()
        }
        for task, conditions in by_task.items()
    }
    figure, panels = bars.task_panels(3.3, groups, shared=shared)
    tops = {task: (ax, bars.draw_groups(ax, groups[task], scale)) for task, ax in panels.items()}
    handles = [
        Patch(color=_colour(task, level), label=f"{task}, {name}")
        for task, conditions in by_task.items()
        for level, name in NAMES.items()
        if any(level in levels for levels in conditions.values())
    ]
    legend(figure, *handles, *bars.printed_handles(groups.values()))
    for number, ax in enumerate(panels.values()):
        ax.set_ylim(bottom=0)
        if number == 0 or not shared:
            ax.set_ylabel(label)
    return figure, tops


def _colour(task: str, level: str) -> str:
    """Darker for the larger pulse."""
    light, _, dark = shades(COLOURS[task], 3)
    return {"min": light, "max": dark}[level]
