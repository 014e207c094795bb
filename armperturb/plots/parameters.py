"""Figure of estimated parameters with their confidence intervals."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from armperturb.plots.panels import legend
from armperturb.plots.style import GREY, colours_for, figure_for, in_style

if TYPE_CHECKING:
    import pandas as pd

ROW, PANEL = 0.24, 0.55
"""Height of a parameter, and of what a panel needs besides [inch]."""

APART = 0.6
"""Share of a parameter's row over which several fits are spread [-]."""

WIDEST = 100.0
"""An interval so many times as wide as the largest estimate of its panel is drawn as if it had no limits [-]."""


@in_style()
def plot_parameters(fits: "Mapping[str, pd.DataFrame]", figure: Figure | None = None) -> Any:
    """Estimates as points with their 95 % intervals as bars, one panel per unit.

    An interval without limits, or one far wider than all estimates, crosses the panel as a dotted line; a hollow
    point sits on a bound.

    Args:
      fits: label, for the legend, to a table of parameters (`results.PARAMETER_COLUMNS`).
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (unit,), in the order in which units first appear.
    """
    units: dict[str, list[str]] = {}
    for frame in fits.values():
        for parameter, unit in zip(frame["parameter"], frame["unit"], strict=True):
            names = units.setdefault(unit, [])
            if parameter not in names:
                names.append(parameter)
    rows = [len(names) for names in units.values()]
    figure = figure_for(figure, 0.4 + sum(ROW * n + PANEL for n in rows))
    axes = figure.subplots(len(units), 1, squeeze=False, height_ratios=[ROW * n + 0.1 for n in rows])[:, 0]
    colours = colours_for(len(fits))
    places = np.linspace(-0.5, 0.5, len(fits) + 2)[1:-1] * APART
    for ax, (unit, names) in zip(axes, units.items(), strict=True):
        largest = max(frame.loc[frame["unit"] == unit, "value"].abs().max() for frame in fits.values())
        for (label, frame), colour, place in zip(fits.items(), colours, places, strict=True):
            for row in frame[frame["unit"] == unit].to_dict("records"):
                y = names.index(row["parameter"]) + place
                if row["upper_95"] - row["lower_95"] <= WIDEST * largest:
                    ax.hlines(y, row["lower_95"], row["upper_95"], color=colour, linewidth=1.3)
                else:
                    ax.axhline(y, color=GREY, linewidth=0.9, linestyle=":")
                face = "white" if row["at_bound"] else colour
                ax.plot(row["value"], y, "o", color=colour, markerfacecolor=face, label=label)
        ax.set_ylim(len(names) - 0.5, -0.5)
        ax.set_yticks(range(len(names)), names)
        ax.tick_params(axis="y", length=0)
        ax.grid(False, axis="y")
        ax.set_xlabel(f"[{unit}]", labelpad=1.0)
    if len(fits) > 1:
        looks = zip(fits, colours, strict=True)
        legend(figure, *(Line2D([], [], color=colour, marker="o", label=label) for label, colour in looks))
    return axes
