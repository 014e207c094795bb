"""Groups of values of people side by side, with means over people, and what the thesis printed beside each."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from armperturb.plots.panels import legend
from armperturb.plots.style import FITTED, GREY, PUBLISHED, SKELETAL, new_figure
from armperturb.study.published.tables import MeanSD, conditions, headline
from armperturb.study.report.figures.people import MEAN, PERSON, fit_labels
from armperturb.study.report.findings import arithmetic_mean, geometric_mean

MODEL_LOOKS: dict[str, dict[str, Any]] = {"linear": FITTED, "skeletal": SKELETAL}
"""Model to its look in figures: the linear arm, and the nonlinear skeletal one."""

PRINTED: dict[str, Any] = {**PUBLISHED, "marker": "s", "markersize": 3.5, "linestyle": ""}

MARKERS = "o^sv"
"""Of series side by side, so that they can be told without colours."""

SMALL_MEAN: dict[str, Any] = {**MEAN, "markersize": 3.4, "capsize": 2}
"""A mean over people with its interval, where many stand side by side."""

BESIDE_MEAN: dict[str, Any] = {**SMALL_MEAN, "color": GREY, "marker": "o", "markerfacecolor": "white"}
"""A mean of the thesis's estimator, beside that of the recommended one."""

FILL = 0.9
"""Share of the room between groups that their series take."""

FEWEST_SERIES = 2
"""A group leaves room for as many, so that single ones stand as close as pairs."""

NOTHING_PRINTED = MeanSD(math.nan, math.nan)


class Series(NamedTuple):
    """Values of people in one group.

    Attributes:
      values: person to value; those that are not finite are not drawn.
      colour: of the people.
      marker: of the people.
      printed: what the thesis has; a NaN mean draws nothing, a NaN SD no whisker.
      beside: person to the value by the thesis's estimator, where it is drawn beside the recommended one.
    """

    values: Mapping[str, float]
    colour: str
    marker: str = "o"
    printed: MeanSD = NOTHING_PRINTED
    beside: Mapping[str, float] = {}

    @property
    def known(self) -> dict[str, float]:
        """The values that are drawn."""
        return {name: value for name, value in self.values.items() if math.isfinite(value)}


Groups = Mapping[str, Sequence[Series]]
"""Label of a group to its series."""


def task_panels(height: float, groups: Mapping[str, Groups], *, shared: bool = True) -> tuple[Figure, dict[str, Axes]]:
    """One panel per task side by side, as wide as its groups need."""
    figure = new_figure(height)
    widths = [len(of_task) for of_task in groups.values()]
    panels = figure.subplots(1, len(groups), sharey=shared, squeeze=False, width_ratios=widths)
    return figure, dict(zip(groups, panels.flat, strict=True))


def draw_predictions(height: float, groups: Mapping[str, Groups], handles: Iterable[Line2D], n_columns: int) -> Figure:
    """Predicted over recorded peaks, a panel per task, and the range of the thesis's means beside its conditions."""
    figure, panels = task_panels(height, groups)
    low, high = (headline(f"pulse_prediction_{end}") for end in ("low", "high"))
    is_printed = any(label.partition("\n")[0] in conditions() for of_task in groups.values() for label in of_task)
    for task, ax in panels.items():
        if is_printed:
            ax.axhspan(low, high, color=PUBLISHED["color"], alpha=0.18, linewidth=0)
        ax.axhline(100.0, color=GREY, linewidth=0.9)
        draw_groups(ax, groups[task])
        fit_labels(ax)
    # Not before all are drawn: panels share their axis, which then no longer grows.
    first = next(iter(panels.values()))
    first.set_ylim(bottom=0)
    first.set_ylabel("predicted / recorded peak [%]")
    shown: list[Line2D | Patch] = [*handles, mean_handle(mean_label(groups.values()))]
    if is_printed:
        label = f"published range, {low:g} to {high:g} %"
        shown.append(Patch(color=PUBLISHED["color"], alpha=0.25, linewidth=0, label=label))
    legend(figure, *shown, n_columns=n_columns)
    return figure


def draw_groups(
    ax: Axes, groups: Groups, scale: float = 1.0, *, joined: bool = True, logarithmic: bool = False
) -> dict[str, float]:
    """Draw people, their mean with its 95 % interval beside them, and beside that what is printed.

    Args:
      ax: where; group k is at k on its x axis.
      groups: label to series; those without people take no room.
      scale: from the unit of the values to that of the axis.
      joined: whether lines join a person's values of a series over groups; if not, those of a group over its series.
      logarithmic: whether the axis is, and means are geometric; only positive values are drawn.

    Returns:
      Label to where the group ends above, in units of the axis; 0 without people.
    """
    drawn = {label: [entry for entry in series if entry.known or entry.beside] for label, series in groups.items()}
    slot = FILL / max(FEWEST_SERIES, *map(len, drawn.values()))
    average = geometric_mean if logarithmic else arithmetic_mean
    lines: dict[tuple[Any, ...], list[tuple[float, float]]] = {}
    points: dict[tuple[str, str], list[tuple[float, float]]] = {}
    means: list[tuple[float, ...]] = []
    others: list[tuple[float, ...]] = []
    printed: list[tuple[float, ...]] = []
    tops = {}
    for group, (label, series) in enumerate(drawn.items()):
        reach = [0.0]
        for number, entry in enumerate(series):
            left = group + (number - len(series) / 2) * slot
            # People, mean, the other estimator's mean, and what is printed share the room of a series.
            parts = (0.14, 0.4, 0.62, 0.84) if entry.beside else (0.2, 0.48, 0.48, 0.78)
            at_people, at_mean, at_beside, at_printed = (left + part * slot for part in parts)
            people = _drawable(entry.known, scale, logarithmic)
            for name, value in people.items():
                lines.setdefault((name, entry.colour, entry.marker) if joined else (name, group), []).append(
                    (at_people, value)
                )
                points.setdefault((entry.colour, entry.marker), []).append((at_people, value))
            beside = _drawable(entry.beside, scale, logarithmic)
            for place, values, averages in ((at_mean, people, means), (at_beside, beside, others)):
                if values:
                    averages.append((place, *average(list(values.values()))))
                    reach += [
                        value for value in (*values.values(), averages[-1][-1]) if averages is means and value == value
                    ]
                    reach.append(averages[-1][1])
            if math.isfinite(entry.printed.mean):
                mean, sd = scale * entry.printed.mean, scale * entry.printed.sd
                printed.append((at_printed, mean, mean - sd, mean + sd))
                reach.append(mean + (sd if math.isfinite(sd) else 0.0))
        tops[label] = max(reach)
    # Artists are slow: one holds the lines of everybody, with gaps between people.
    for colour in dict.fromkeys(key[1] for key in lines):
        mine = [(*line, (math.nan, math.nan)) for key, line in lines.items() if key[1] == colour]
        x, y = zip(*(point for line in mine for point in line), strict=True)
        ax.plot(x, y, color=colour if joined else GREY, linewidth=PERSON["linewidth"], alpha=PERSON["alpha"])
    for (colour, marker), of_series in points.items():
        x, y = zip(*of_series, strict=True)
        ax.plot(x, y, **{**PERSON, "linestyle": "", "marker": marker, "color": colour})
    for averages, look in ((means, SMALL_MEAN), (others, BESIDE_MEAN), (printed, PRINTED)):
        if averages:
            x, y, low, high = np.transpose(averages)
            ax.errorbar(x, y, (y - low, high - y), **{"elinewidth": 0.9, "capsize": 1.5, **look})
    ax.set_xticks(range(len(drawn)), list(drawn), parse_math=False)
    ax.set_xlim(-0.55, len(drawn) - 0.45)
    ax.grid(visible=False, axis="x")
    ax.tick_params(axis="x", length=0)
    if logarithmic:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(10, subs=(1.0, 3.0)))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    return tops


def _drawable(values: Mapping[str, float], scale: float, logarithmic: bool) -> dict[str, float]:
    """Person to what an axis can show, in its unit."""
    scaled = {name: scale * value for name, value in values.items() if math.isfinite(value)}
    return {name: value for name, value in scaled.items() if value > 0.0} if logarithmic else scaled


def people_handle(label: str, colour: str, marker: str = "o") -> Line2D:
    """Entry in a legend of the people of a series."""
    return Line2D([], [], label=label, **{**PERSON, "color": colour, "marker": marker, "markersize": 3.5, "alpha": 0.8})


def mean_label(groups: Iterable[Groups]) -> str:
    """What means over people are called in a legend of what is drawn: that of one person has no interval."""
    several = any(len(entry.known) > 1 for panel in groups for series in panel.values() for entry in series)
    return "mean over people, 95 % interval" if several else "mean over people"


def mean_handle(label: str, look: Mapping[str, Any] = MEAN) -> Line2D:
    """Entry in a legend of means over people."""
    shown = {key: value for key, value in look.items() if key not in ("elinewidth", "capsize")}
    return Line2D([], [], label=label, **shown)


def printed_handle(label: str = "published mean ± SD") -> Line2D:
    """Entry in a legend of what the thesis printed."""
    return Line2D([], [], label=label, **PRINTED)


def stars(p: float) -> str:
    """The thesis's marks of a difference: ** for p < 0.01, * for p < 0.05."""
    return "**" if p < 0.01 else "*" if p < 0.05 else ""


def printed_handles(groups: Iterable[Groups], **label: str) -> list[Line2D]:
    """`printed_handle`, if the thesis printed anything of what is drawn."""
    shown = any(
        (entry.known or entry.beside) and math.isfinite(entry.printed.mean)
        for panel in groups
        for series in panel.values()
        for entry in series
    )
    return [printed_handle(**label)] if shown else []


def model_handles() -> list[Line2D]:
    """Entries in a legend of the people as each of `MODEL_LOOKS` has them."""
    looks = zip(MODEL_LOOKS.items(), MARKERS, strict=False)
    return [people_handle(f"{name} model", look["color"], marker) for (name, look), marker in looks]
