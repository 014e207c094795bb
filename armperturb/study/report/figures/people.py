"""Every person as a point, with lines within people, and beside them means over people with 95 % intervals."""

import math
import textwrap
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from armperturb.plots.style import COLOURS, INK
from armperturb.study.report.findings import arithmetic_mean, geometric_mean

Groups = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Task and label of a group to person to value."""

PERSON: dict[str, Any] = {"linewidth": 0.7, "marker": "o", "markersize": 2.6, "alpha": 0.45}
"""A person's values in several conditions, joined."""

MEAN: dict[str, Any] = {
    "color": INK,
    "marker": "D",
    "markersize": 4.2,
    "linestyle": "",
    "elinewidth": 1.6,
    "capsize": 3,
}
"""A mean over people with its interval, beside the people."""

ASIDE = 0.22
"""How far to the right of the people their mean is drawn [groups]."""


CHARACTER, FILLED = 0.58, 1.12
"""Mean width of a character [size of the text], and how much wider panels are once the figure is laid out [-]."""

SHORT, LONGEST_LINE = 7, 18
"""Characters of names that always stand side by side, as the thesis's do, and of a line that is turned."""


def draw_people(ax: Axes, groups: Groups, *, logarithmic: bool = True) -> dict[str, int]:
    """Draw points of people, joined within a task, and beside them their mean with its interval.

    Args:
      ax: where; the groups of all tasks stand side by side at 0, 1, 2 ...
      groups: task and label to person to value; positive ones if logarithmic.
      logarithmic: whether values have a logarithmic axis and a geometric mean, or a linear one and an arithmetic mean.

    Returns:
      Label to its place on the x axis.
    """
    places: dict[str, int] = {}
    average = geometric_mean if logarithmic else arithmetic_mean
    means = []
    for task, of_task in groups.items():
        for label in of_task:
            places[label] = len(places)
        # Artists are slow: one holds everybody of a task, with gaps between people.
        x: list[float] = []
        y: list[float] = []
        for name in dict.fromkeys(name for values in of_task.values() for name in values):
            there = [label for label in of_task if name in of_task[label]]
            x += [*(places[label] for label in there), math.nan]
            y += [*(of_task[label][name] for label in there), math.nan]
        ax.plot(x, y, color=COLOURS[task], **PERSON)
        means += [
            (places[label] + ASIDE, *average(list(people.values()))) for label, people in of_task.items() if people
        ]
    if means:
        place, mean, lower, upper = np.transpose(means)
        ax.errorbar(place, mean, (mean - lower, upper - mean), **MEAN)
    ax.set_xticks(list(places.values()), list(places), parse_math=False)
    ax.set_xlim(-0.5, len(places) - 0.5 + ASIDE)
    ax.grid(visible=False, axis="x")
    if logarithmic:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(10, subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    return places


def fit_labels(ax: Axes) -> None:
    """Wrap the labels of groups whose names are too long to stand side by side, and turn them where a word is.

    Args:
      ax: with the groups' labels below it, of the size in which they are drawn.
    """
    labels = ax.get_xticklabels()
    names = [label.get_text() for label in labels]
    size = float(labels[0].get_fontsize()) if labels else 1.0
    low, high = ax.get_xlim()
    points = FILLED * 72.0 * ax.bbox.width / ax.figure.dpi / (high - low)
    room = max(int(points / (CHARACTER * size)), SHORT)
    if all(len(line) <= room for name in names for line in name.split("\n")):
        return
    if max(len(word) for name in names for word in name.split()) > room:
        wrapped, turned = ["\n".join(textwrap.wrap(name, LONGEST_LINE)) for name in names], 90
    else:
        lines = [[part for line in name.split("\n") for part in textwrap.wrap(line, room)] for name in names]
        wrapped, turned = ["\n".join(each) for each in lines], 0
    ax.set_xticks(ax.get_xticks(), wrapped, parse_math=False, fontsize=size, rotation=turned)


def with_margins(ax: Axes) -> None:
    """Let a linear axis begin at zero or below, with room for whole marks at either end."""
    low, high = ax.get_ylim()
    low = min(low, 0.0)
    ax.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))


def people_legend(tasks: Mapping[str, Any], n_people: int) -> list[Line2D]:
    """Entries in a legend of the people of each task, and of their means, which have no interval of one person."""
    return [
        *(Line2D([], [], label=f"people, {task}", color=COLOURS[task], **PERSON) for task in tasks),
        Line2D(
            [],
            [],
            label="mean, 95 % interval" if n_people > 1 else "mean",
            **{key: MEAN[key] for key in ("color", "marker", "markersize", "linestyle")},
        ),
    ]
