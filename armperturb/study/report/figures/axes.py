"""What figures of the report share: looks of conditions, true and mean admittances, marks of significance."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.arrays import Array
from armperturb.plots.panels import FREQUENCY, Element, plot_admittance
from armperturb.plots.style import COLOURS, INK, TRUE, shades
from armperturb.study.results.cases import Case

T = TypeVar("T")

Marks = Mapping[Element, tuple[NDArray[np.bool_], NDArray[np.bool_]]]
"""Element to the frequencies at which conditions differ with p < 0.05, and with p < 0.01, (frequency,) each."""

STARRED: dict[str, Any] = {"linestyle": "", "color": INK, "markeredgewidth": 0}

STARS = (
    {**STARRED, "marker": r"$\ast$", "markersize": 5},
    {**STARRED, "marker": r"$\genfrac{}{}{0}{}{\ast}{\ast}$", "markersize": 10.5},
)
"""Markers of differences with p < 0.05, and with p < 0.01: an asterisk, and two above each other."""


def looks(task: str, conditions: Sequence[T]) -> list[tuple[T, dict[str, Any]]]:
    """Conditions of a task with their colours and markers: shades of the task's colour, darker for larger movements."""
    styles = zip(shades(COLOURS[task], len(conditions)), itertools.cycle("osD^v"), strict=False)
    return [(c, {"color": colour, "marker": marker}) for c, (colour, marker) in zip(conditions, styles, strict=True)]


def plot_truth(panels: dict[Element, tuple[Axes, Axes]], case: Case) -> list[Line2D]:
    """Draw a linear person's own admittance, and return its entry in the legend; others have neither."""
    if case.truth is None or case.truth.muscle is not None:
        return []
    plot_admittance(panels, FREQUENCY, arm_admittance(case.truth, FREQUENCY), **TRUE)
    return [Line2D([], [], label="true", **TRUE)]


def plot_marks(ax: Axes, frequency: Array, height: Array, masks: tuple[NDArray[np.bool_], NDArray[np.bool_]]) -> None:
    """Stars at the frequencies at which conditions differ; one for p < 0.05, two for p < 0.01.

    Args:
      ax: where.
      frequency: [Hz], (frequency,).
      height: of the stars, in units of the axis, (frequency,).
      masks: as in `Marks`.
    """
    differs, clearly = masks
    for star, mask in zip(STARS, (differs & ~clearly, clearly), strict=True):
        ax.plot(frequency[mask], height[mask], **star)


def marks_legend() -> list[Line2D]:
    """Entries of `plot_marks` in a legend."""
    return [Line2D([], [], **star, label=f"p < {level}") for star, level in zip(STARS, ("0.05", "0.01"), strict=True)]
