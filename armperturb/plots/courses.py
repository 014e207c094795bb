"""Figures of parameters over time or posture."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from armperturb.arrays import Array
from armperturb.plots.style import PALETTE, figure_for, in_style


class Course(NamedTuple):
    """A parameter to be drawn.

    Attributes:
      label: of its axis.
      place: where it is known, (point,).
      value: (point,).
      lower: lower end of its band, (point,).
      upper: upper end of its band, (point,).
    """

    label: str
    place: Array
    value: Array
    lower: Array
    upper: Array


@in_style()
def plot_courses(courses: Sequence[Course], label: str, figure: Figure | None = None) -> Any:
    """Each parameter in a panel of its own, with its band.

    Args:
      courses: what to draw.
      label: of the axis that they share.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (parameter,).
    """
    figure = figure_for(figure, height=1.7 * len(courses) + 0.4)
    panels = figure.subplots(len(courses), 1, sharex=True, squeeze=False)[:, 0]
    for panel, course in zip(panels, courses, strict=True):
        panel.fill_between(course.place, course.lower, course.upper, color=PALETTE[0], alpha=0.25, linewidth=0)
        panel.plot(course.place, course.value, color=PALETTE[0])
        panel.set_ylabel(course.label)
    panels[-1].set_xlabel(label)
    return panels
