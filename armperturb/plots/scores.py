"""Figure of how near computed values come to published ones."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from armperturb.plots.style import COLOURS, GREY, INK, PALE, figure_for, in_style

ROW = 0.2
"""Height of a table [inch]."""

FARTHEST = 6.0
"""What is farther is drawn at the edge, as a triangle [SD]."""


@in_style()
def plot_scores(cells: pd.DataFrame, limits: Sequence[float], figure: Figure | None = None) -> Any:
    """Distance of each cell from the published one in published SDs, one row per table.

    Args:
      cells: `table`, name of the table of each, and `z`, its distance [SD]; NaN where there is none.
      limits: distances at which to draw lines [SD].
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes.
    """
    tables = {str(table): z.to_numpy(float) for table, z in cells.groupby("table", sort=False)["z"]}
    figure = figure_for(figure, 0.9 + ROW * len(tables))
    ax = figure.subplots()
    for limit in limits:
        for side in (-limit, limit):
            ax.axvline(side, color=PALE, linewidth=0.8, zorder=0.5)
    ax.axvline(0.0, color=GREY, linewidth=0.8, zorder=0.5)
    for place, z in enumerate(tables.values()):
        shown = z[np.isfinite(z)]
        height = place + 0.3 * np.linspace(-1.0, 1.0, len(shown)) if len(shown) > 1 else np.full(len(shown), place)
        near = np.abs(shown) <= FARTHEST
        ax.plot(shown[near], height[near], "o", color=INK, markersize=2.2, alpha=0.6)
        for marker, far in (("<", shown < -FARTHEST), (">", shown > FARTHEST)):
            edge = np.clip(shown[far], -FARTHEST, FARTHEST)
            ax.plot(edge, height[far], marker, color=COLOURS["RT"], markersize=3.0, linestyle="")
    ax.set(xlim=(-1.04 * FARTHEST, 1.04 * FARTHEST), ylim=(len(tables) - 0.5, -0.5))
    ax.set_yticks(range(len(tables)), list(tables))
    ax.tick_params(axis="y", length=0)
    ax.grid(False)
    ax.set_xlabel("ours - published [published SDs]; triangles lie farther out")
    return ax
