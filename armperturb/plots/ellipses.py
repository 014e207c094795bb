"""Figure of an arm seen from above, with ellipses at its hand."""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from armperturb.arrays import Array
from armperturb.plots.panels import legend
from armperturb.plots.style import GREY, INK, PALE, colours_for, figure_for, in_style, round_number_below

LARGEST = 0.45
"""Longer half axis of the largest ellipse of a panel over the length of the stretched arm [-]."""

DIRECTIONS = np.linspace(0.0, 2.0 * np.pi, 361)

PANELS = {"stiffness": ("stiffness", "static stiffness"), "damping": ("damping",), "inertia": ("inertia",)}
"""Title of a panel to the quantities whose ellipses it shows."""

LEGEND_COLUMNS, LEGEND_ROW = 4, 0.2
"""Columns of the legend, and height of a row of it [inch]; panels of equal axes do not shrink to make room."""

DASHED = (0, (4, 2))

Outline = Callable[[Array], tuple[Array, Array, Array]]
"""From directions [rad] to distances from the centre, and to their lower and upper limits."""


class Posture(NamedTuple):
    """Where the joints are, and what is drawn at the hand.

    Attributes:
      joints: shoulder, elbow and hand [m], (3, axis).
      outlines: quantity to its ellipse.
    """

    joints: Array
    outlines: Mapping[str, Outline]


@in_style()
def plot_ellipses(postures: Mapping[str, Posture], units: Mapping[str, str], figure: Figure | None = None) -> Any:
    """Ellipses of several conditions over one another, each with its band and the arm; a panel for each quantity.

    Args:
      postures: label, for the legend, to what is drawn.
      units: quantity to its unit.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (panel,), in the order of `PANELS`.
    """
    has_static = any("static stiffness" in each.outlines for each in postures.values())
    legend_rows = math.ceil((len(postures) + has_static + 1) / LEGEND_COLUMNS)
    figure = figure_for(figure, 3.3 + LEGEND_ROW * (legend_rows - 1))
    axes = figure.subplots(1, len(PANELS), sharex=True, sharey=True)
    colours = dict(zip(postures, colours_for(len(postures)), strict=True))
    unit_vectors = np.column_stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)])
    reach = max(np.linalg.norm(np.diff(each.joints, axis=0), axis=1).sum() for each in postures.values())
    shown, scales = [np.zeros(2)], []
    for ax, (title, quantities) in zip(axes, PANELS.items(), strict=True):
        ellipses = [
            (label, quantity, each.joints[-1], each.outlines[quantity](DIRECTIONS))
            for label, each in postures.items()
            for quantity in quantities
            if quantity in each.outlines
        ]
        ellipses = [ellipse for ellipse in ellipses if np.isfinite(ellipse[-1][0]).all()]
        scale = LARGEST * reach / max((outline[0].max() for *_, outline in ellipses), default=1.0)
        for each in postures.values():
            ax.plot(*each.joints.T, color=PALE, linewidth=5.0, solid_joinstyle="round", zorder=1)
            ax.plot(*each.joints[:2].T, "o", color=GREY, markersize=4.5, zorder=1)
            shown += [*each.joints]
        for label, quantity, hand, (radius, lower, upper) in ellipses:
            line = hand + scale * radius[:, None] * unit_vectors
            if np.isfinite(upper).all():
                inner, outer = (hand + scale * r[:, None] * unit_vectors for r in (lower, upper))
                ring = np.concatenate([outer, inner[::-1]])
                ax.fill(*ring.T, color=colours[label], alpha=0.25, linewidth=0.0, zorder=2)
            style = DASHED if quantity != quantities[0] else "-"
            ax.plot(*line.T, color=colours[label], linestyle=style, zorder=3)
            shown += [*line]
        ax.set(title=title, aspect="equal", xlabel="x [m]")
        scales.append(scale)
    margin = 0.06 * reach
    low, high = np.min(shown, axis=0) - [0.0, 0.15 * reach], np.max(shown, axis=0)  # room for a bar below
    middle, half = (low + high) / 2.0, np.max(high - low) / 2.0 + margin
    (left, bottom), (right, top) = middle - half, middle + half
    axes[0].set(xlim=(left, right), ylim=(bottom, top), ylabel="y [m]")
    for ax, scale, quantities in zip(axes, scales, PANELS.values(), strict=True):
        size = round_number_below(0.3 * reach / scale)
        ends, at = (right - margin - scale * size, right - margin), bottom + margin
        ax.plot(ends, (at, at), color=INK, linewidth=2.0, solid_capstyle="butt")
        ax.text(ends[1], at + 0.3 * margin, f"{size:g} {units[quantities[0]]}", ha="right", va="bottom")
    handles: list[Line2D | Patch] = [Line2D([], [], color=colour, label=label) for label, colour in colours.items()]
    if has_static:
        colour = INK if len(postures) == 1 else GREY
        handles += [Line2D([], [], color=colour, linestyle=DASHED, label="with reflexes, static")]
    legend(figure, *handles, Patch(facecolor=GREY, alpha=0.4, label="95 %"), n_columns=LEGEND_COLUMNS)
    return axes
