"""What figures share: panels of an admittance, legends, ticks."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MultipleLocator, NullLocator

from armperturb.arrays import Array, ComplexArray
from armperturb.plots.style import new_figure

AXES = ("x", "y")

Element = tuple[int, int]
"""Output and input axis of an admittance."""

FREQUENCY = np.geomspace(0.15, 45.0, 400)
"""Where models are drawn [Hz]."""

HEIGHT = 7.9
"""Of a figure of an admittance's four elements [inch]."""

PHASES = (-270.0, 90.0)
"""The turn in which phases are drawn [degree]: springs, dampers and masses lie well inside, and so do negated ones."""


def admittance_panels(figure: Figure | None = None) -> tuple[Figure, dict[Element, tuple[Axes, Axes]]]:
    """Axes for gain and phase of each element, gain over phase, two rows by two columns of such pairs.

    Args:
      figure: where they go; None makes one of `HEIGHT`.

    Returns:
      The figure; element to its axes.
    """
    figure = new_figure(HEIGHT) if figure is None else figure
    grid = figure.add_gridspec(4, 2, height_ratios=(1.35, 1, 1.35, 1))
    panels: dict[Element, tuple[Axes, Axes]] = {}
    for output in range(2):
        for input_ in range(2):
            first = panels.get((0, 0))
            gain = figure.add_subplot(grid[2 * output, input_], sharex=first and first[0], sharey=first and first[0])
            phase = figure.add_subplot(grid[2 * output + 1, input_], sharex=gain, sharey=first and first[1])
            panels[output, input_] = gain, phase
            if first is None:
                gain.set(xscale="log", yscale="log")
                gain.yaxis.set_major_locator(LogLocator(10, numticks=10))
                gain.yaxis.set_minor_locator(NullLocator())
            gain.tick_params(labelbottom=False, labelleft=input_ == 0)
            phase.tick_params(labelbottom=output == 1, labelleft=input_ == 0)
            phase.yaxis.set_major_locator(MultipleLocator(90))
            phase.set_ylim(PHASES)
            element = AXES[output] + AXES[input_]
            gain.set_title(f"$H_{{{element}}}$: from force {AXES[input_]} to displacement {AXES[output]}")
            if input_ == 0:
                gain.set_ylabel("gain [m/N]")
                phase.set_ylabel("phase [°]")
            if output == 1:
                label_frequency(phase)
    return figure, panels


def plot_admittance(
    panels: Mapping[Element, tuple[Axes, Axes]], frequency: Array, admittance: ComplexArray, **look: Any
) -> None:
    """Draw gain and phase of each element of (frequency, output, input)."""
    for (output, input_), (gain_ax, phase_ax) in panels.items():
        element = admittance[:, output, input_]
        gain_ax.plot(frequency, np.abs(element), **look)
        phase_ax.plot(*within_turn(frequency, np.angle(element)), **look)


def within_turn(frequency: Array, phase: Array) -> list[Array]:
    """Phases [rad] in degrees within `PHASES`, with a gap wherever they leave it on one side and return on the other.

    Args:
      frequency: [Hz], (frequency,).
      phase: [rad], (frequency,).

    Returns:
      Frequencies [Hz] and phases [degree], longer by the gaps.
    """
    low = PHASES[0]
    wrapped = low + np.mod(np.degrees(phase) - low, 360.0)
    jumps = np.flatnonzero(np.abs(np.diff(wrapped)) > 180.0) + 1
    return [np.insert(values, jumps, np.nan) for values in (frequency, wrapped)]


def label_frequency(ax: Axes, **text: Any) -> None:
    """Ticks in plain numbers on a logarithmic frequency axis."""
    ax.set_xlabel("frequency [Hz]", **text)
    ax.set_xlim(FREQUENCY[0], FREQUENCY[-1])
    ax.xaxis.set_major_locator(FixedLocator([0.2, 0.5, 1, 2, 5, 10, 20, 40]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def legend(figure: Figure, *handles: Line2D | Patch, n_columns: int = 6) -> None:
    """One legend for the whole figure, above its panels; a $ in a name is no mathematics."""
    drawn = figure.legend(handles=list(handles), loc="outside upper center", ncols=min(len(handles), n_columns))
    for text in drawn.get_texts():
        text.set_parse_math(False)


def padded(values: list[float]) -> tuple[float, float]:
    """Limits of an axis around values; a tenth to each side if they are all one."""
    low, high = min(values), max(values)
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin
