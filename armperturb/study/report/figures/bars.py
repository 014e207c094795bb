"""Bars of means with their spread, and what the thesis printed beside each."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from armperturb.plots.panels import legend
from armperturb.plots.style import FITTED, GREY, INK, PUBLISHED, SKELETAL, new_figure
from armperturb.study.comparison.headlines import PULSED
from armperturb.study.published.tables import MeanSD, headline

CONDITIONS = {task: tuple(dict.fromkeys(condition for condition, _ in pulses)) for task, pulses in PULSED.items()}
"""Task to the thesis's conditions, the smallest multisine first."""

MODEL_LOOKS: dict[str, dict[str, Any]] = {"linear": FITTED, "skeletal": SKELETAL}
"""Model to its look in figures: the linear arm, and the nonlinear skeletal one."""

ERROR: dict[str, Any] = {"linestyle": "", "elinewidth": 0.9, "capsize": 1.5}

PRINTED: dict[str, Any] = {**PUBLISHED, "marker": "D", "markersize": 3.5}

FILL = 0.84
"""Share of the room between groups that their bars take."""


class Bar(NamedTuple):
    """A bar.

    Attributes:
      ours: mean and SD that the bar and its whisker show; a NaN mean draws no bar, a NaN SD no whisker.
      colour: of the bar.
      printed: what the thesis has of it; likewise.
    """

    ours: MeanSD
    colour: str
    printed: MeanSD = MeanSD(math.nan, math.nan)

    @classmethod
    def of(cls, values: Iterable[float], *others: Any) -> Self:
        """The bar of the finite ones of these values, with the other attributes."""
        there = [value for value in values if math.isfinite(value)]
        mean = float(np.mean(there)) if there else math.nan
        return cls(MeanSD(mean, float(np.std(there, ddof=1)) if len(there) > 1 else math.nan), *others)


Groups = Mapping[str, Sequence[Bar]]
"""Label of a group of bars to these."""


def task_panels(height: float, groups: Mapping[str, Groups], *, shared: bool = True) -> tuple[Figure, dict[str, Axes]]:
    """One panel per task side by side, as wide as its groups of bars need."""
    figure = new_figure(height)
    widths = [len(of_task) for of_task in groups.values()]
    panels = figure.subplots(1, len(groups), sharey=shared, squeeze=False, width_ratios=widths)
    return figure, dict(zip(groups, panels.flat, strict=True))


def draw_predictions(height: float, groups: Mapping[str, Groups], handles: Iterable[Patch], n_columns: int) -> Figure:
    """Predicted over recorded peaks, a panel per task, and the range of the thesis's means."""
    figure, panels = task_panels(height, groups)
    low, high = (headline(f"pulse_prediction_{end}") for end in ("low", "high"))
    for task, ax in panels.items():
        ax.axhspan(low, high, color=PUBLISHED["color"], alpha=0.18, linewidth=0)
        ax.axhline(100.0, color=GREY, linewidth=0.9)
        draw_groups(ax, groups[task])
    # Not before all are drawn: panels share their axis, which then no longer grows.
    first = next(iter(panels.values()))
    first.set_ylim(bottom=0)
    first.set_ylabel("predicted / recorded peak [%]")
    band = Patch(color=PUBLISHED["color"], alpha=0.25, linewidth=0, label=f"published range, {low:g} to {high:g} %")
    legend(figure, *handles, band, n_columns=n_columns)
    return figure


def draw_groups(ax: Axes, groups: Groups, scale: float = 1.0) -> dict[str, float]:
    """Draw groups of bars, and beside each bar what is printed.

    Args:
      ax: where; group k is at k on its x axis.
      groups: label to bars; those without a mean take no room.
      scale: from the unit of the bars to that of the axis.

    Returns:
      Label to where the group ends above, in units of the axis; 0 without bars.
    """
    drawn = {label: [bar for bar in bars if math.isfinite(bar.ours.mean)] for label, bars in groups.items()}
    slot = FILL / max(2, *map(len, drawn.values()))
    tops = {}
    places: list[float] = []
    for group, (label, bars) in enumerate(drawn.items()):
        reach = [0.0]
        places += [group + (number - len(bars) / 2) * slot for number in range(len(bars))]
        for bar in bars:
            for value in (bar.ours, bar.printed):
                if math.isfinite(value.mean):
                    reach.append(scale * (value.mean + (value.sd if math.isfinite(value.sd) else 0.0)))
        tops[label] = max(reach)
    flat = [bar for bars in drawn.values() for bar in bars]
    left = np.array(places)
    ours = scale * np.array([bar.ours for bar in flat]).reshape(-1, 2)
    printed = scale * np.array([bar.printed for bar in flat]).reshape(-1, 2)
    ax.bar(left + 0.33 * slot, ours[:, 0], 0.56 * slot, color=[bar.colour for bar in flat])
    ax.errorbar(left + 0.33 * slot, ours[:, 0], ours[:, 1], color=INK, **ERROR)
    known = np.isfinite(printed[:, 0])
    ax.errorbar(left[known] + 0.8 * slot, printed[known, 0], printed[known, 1], **PRINTED, **ERROR)
    ax.set_xticks(range(len(drawn)), list(drawn), parse_math=False)
    ax.set_xlim(-0.55, len(drawn) - 0.45)
    ax.grid(visible=False, axis="x")
    ax.tick_params(axis="x", length=0)
    return tops


def printed_handle(label: str = "published mean ± SD") -> Line2D:
    """Entry in a legend of what the thesis printed."""
    return Line2D([], [], linestyle="", label=label, **PRINTED)


def stars(p: float) -> str:
    """The thesis's marks of a difference: ** for p < 0.01, * for p < 0.05."""
    return "**" if p < 0.01 else "*" if p < 0.05 else ""


def printed_handles(groups: Iterable[Groups], **label: str) -> list[Line2D]:
    """`printed_handle`, if the thesis printed anything of the bars that are drawn."""
    shown = any(
        math.isfinite(bar.ours.mean) and math.isfinite(bar.printed.mean)
        for panel in groups
        for bars in panel.values()
        for bar in bars
    )
    return [printed_handle(**label)] if shown else []


def model_handles() -> list[Patch]:
    """Entries in a legend of the bars of each of `MODEL_LOOKS`."""
    return [Patch(color=look["color"], label=f"{name} model") for name, look in MODEL_LOOKS.items()]
