"""Figure of one trial as it was recorded: all of it, and some seconds enlarged."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from armperturb.arrays import Array, Indices
from armperturb.plots.panels import AXES, legend
from armperturb.plots.style import PALE, PALETTE, figure_for, in_style

ROW = 1.3
"""Height of a signal's panels [inch]."""

COLUMNS = 400
"""Pieces into which a trace is cut: of each, the extremes are drawn."""

ZOOM = 5.0
"""Length of what is enlarged [s]."""

SIGNALS = {"d [N]": 1.0, "f [N]": 1.0, "x [mm]": 1e3}
"""Label of perturbation, force on the hand and displacement to the factor from SI to its unit."""


@in_style()
def plot_traces(signals: tuple[Array, Array, Array], rate: float, figure: Figure | None = None) -> Any:
    """Perturbation, force and displacement of one trial, along x and y.

    Args:
      signals: d [N], f [N] and x [m], (time, axis) each.
      rate: of the samples [Hz].
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (signal, 2): the whole trial, and `ZOOM` from its middle.
    """
    figure = figure_for(figure, 0.7 + ROW * len(SIGNALS))
    axes = figure.subplots(len(SIGNALS), 2, sharex="col", sharey="row", width_ratios=(1.6, 1.0))
    n = len(signals[0])
    length = min(n, round(ZOOM * rate))
    enlarged = slice((n - length) // 2, (n - length) // 2 + length)
    for row, values, (label, factor) in zip(axes, signals, SIGNALS.items(), strict=True):
        for ax, part in zip(row, (slice(0, n), enlarged), strict=True):
            for axis, name in enumerate(AXES):
                time, shown = outline(factor * values[part, axis])
                ax.plot((part.start + time) / rate, shown, color=PALETTE[axis], linewidth=0.8, label=name)
        row[0].axvspan(enlarged.start / rate, enlarged.stop / rate, color=PALE, alpha=0.35, linewidth=0.0, zorder=0.5)
        row[0].set_ylabel(label)
        row[0].margins(x=0.01)
        row[1].margins(x=0.01)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    legend(figure, *axes[0, 0].get_lines())
    return axes


def outline(values: Array) -> tuple[Indices, Array]:
    """Samples and values of a trace that looks the same in print: the extremes of each of `COLUMNS` pieces.

    Args:
      values: (time,).
    """
    if len(values) <= 2 * COLUMNS:
        return np.arange(len(values)), values
    pieces = np.array_split(np.arange(len(values)), COLUMNS)
    places = np.concatenate([np.sort([p[np.argmin(values[p])], p[np.argmax(values[p])]]) for p in pieces])
    return places, values[places]
