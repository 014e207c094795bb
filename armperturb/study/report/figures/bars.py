"""Bars of means with their spread, and what the thesis printed beside each."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from armperturb.plots.style import FITTED, INK, PUBLISHED, SKELETAL
from armperturb.study.comparison.headlines import PULSED
from armperturb.study.published.tables import MeanSD

CONDITIONS = {task: tuple(dict.fromkeys(condition for condition, _ in pulses)) for task, pulses in PULSED.items()}
"""Task to the thesis's conditions, the smallest multisine first."""

MODELS: dict[str, dict[str, Any]] = {"linear": FITTED, "skeletal": SKELETAL}
"""Model to its look in figures: the linear arm, and the nonlinear skeletal one."""

UNKNOWN = MeanSD(math.nan, math.nan)

ERROR: dict[str, Any] = {"linestyle": "", "elinewidth": 0.9, "capsize": 1.5}

PRINTED: dict[str, Any] = {**PUBLISHED, "marker": "D", "markersize": 3.5}

FILL = 0.84
"""Share of the room between groups that their bars take."""


class Bar(NamedTuple):
    """A bar.

    Attributes:
      ours: mean and SD that the bar and its whisker show; a NaN mean draws no bar, a NaN SD no whisker.
      printed: what the thesis has of it; likewise.
      colour: of the bar.
    """

    ours: MeanSD
    printed: MeanSD
    colour: str


def mean_sd(values: Iterable[float]) -> MeanSD:
    """Mean and SD of the finite values; NaN where there are too few."""
    there = [value for value in values if math.isfinite(value)]
    mean = float(np.mean(there)) if there else math.nan
    return MeanSD(mean, float(np.std(there, ddof=1)) if len(there) > 1 else math.nan)


def draw_groups(ax: Axes, groups: Mapping[str, Sequence[Bar]], scale: float = 1.0) -> dict[str, float]:
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
    ax.set_xticks(range(len(drawn)), list(drawn))
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


def printed_handles(groups: Iterable[Mapping[str, Sequence[Bar]]], **label: str) -> list[Line2D]:
    """`printed_handle`, if the thesis printed anything of the bars that are drawn."""
    shown = any(
        math.isfinite(bar.ours.mean) and math.isfinite(bar.printed.mean)
        for panel in groups
        for bars in panel.values()
        for bar in bars
    )
    return [printed_handle(**label)] if shown else []


def model_handles() -> list[Patch]:
    """Entries in a legend of the bars of each of `MODELS`."""
    return [Patch(color=look["color"], label=f"{name} model") for name, look in MODELS.items()]
