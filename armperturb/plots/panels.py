"""What figures share: panels of an admittance, legends, ticks."""

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MultipleLocator, NullLocator

from armperturb.arrays import Array, ComplexArray
from armperturb.plots.style import new_figure

AXES = ("x", "y")

Place = Literal["outside upper center", "outside lower center"]
"""Of a figure's legend."""

Element = tuple[int, int]
"""Output and input axis of an admittance."""

FREQUENCY = np.geomspace(0.15, 45.0, 400)
"""Where models are drawn [Hz]."""

HEIGHT = 7.9
"""Of a figure of an admittance's four elements [inch]."""

PHASES = (-270.0, 90.0)
"""The turn in which a phase begins [degree]: springs, dampers and masses lie well inside, and so do negated
ones."""

MOST_QUARTERS = 5
"""Quarters of a turn that have a line each; beyond, halves have."""


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
    panels: Mapping[Element, tuple[Axes, Axes]],
    frequency: Array,
    admittance: ComplexArray,
    near: tuple[Array, ComplexArray] | None = None,
    **look: Any,
) -> None:
    """Draw gain and phase of each element.

    Args:
      panels: element to its axes, as `admittance_panels` makes them.
      frequency: [Hz], (frequency,).
      admittance: (frequency, output, input).
      near: frequencies [Hz] and an admittance, in whose turn each phase is drawn; without it, phases are followed from
        one frequency to the next.
      **look: of the lines, as Matplotlib has it.
    """
    for (output, input_), (gain_ax, phase_ax) in panels.items():
        element = admittance[:, output, input_]
        gain_ax.plot(frequency, np.abs(element), **look)
        phase = unwrapped(element, frequency, near and (near[0], near[1][:, output, input_]))
        phase_ax.plot(frequency, phase, **look)
        show_turns(phase_ax, phase)


def unwrapped(
    response: ComplexArray, frequency: Array | None = None, near: tuple[Array, ComplexArray] | None = None
) -> Array:
    """Phase without jumps [degree], which begins within `PHASES`.

    Args:
      response: of one element, (frequency,).
      frequency: [Hz], (frequency,); needed with `near`.
      near: frequencies [Hz] and a response at them, from whose phase none is farther than half a turn: what is noisy
        does not carry a wrong turn on to all higher frequencies.

    Returns:
      (frequency,); where noise carries it more than a turn away, within `PHASES` and with jumps.
    """
    if near is not None and frequency is not None:
        # Between frequencies a phase goes on as over their logarithm.
        middle = np.interp(np.log(frequency), np.log(near[0]), unwrapped(near[1]))
        return np.asarray(middle + np.mod(np.degrees(np.angle(response)) - middle + 180.0, 360.0) - 180.0)
    phase = np.degrees(np.unwrap(np.angle(response)))
    phase -= 360.0 * math.floor((phase[0] - PHASES[0]) / 360.0)
    if np.max(phase) > PHASES[1] + 360.0 or np.min(phase) < PHASES[0] - 360.0:
        return np.asarray(PHASES[0] + np.mod(phase - PHASES[0], 360.0))
    return phase


def show_turns(ax: Axes, phase: Array) -> None:
    """Widen an axis of phases by half turns, if these [degree] leave it."""
    low, high = ax.get_ylim()
    low, high = min(low, 90.0 * math.floor(np.min(phase) / 90.0)), max(high, 90.0 * math.ceil(np.max(phase) / 90.0))
    ax.set_ylim(low, high)
    ax.yaxis.set_major_locator(MultipleLocator(90.0 if high - low <= MOST_QUARTERS * 90.0 else 180.0))


def label_frequency(ax: Axes, **text: Any) -> None:
    """Ticks in plain numbers on a logarithmic frequency axis."""
    ax.set_xlabel("frequency [Hz]", **text)
    ax.set_xlim(FREQUENCY[0], FREQUENCY[-1])
    ax.xaxis.set_major_locator(FixedLocator([0.2, 0.5, 1, 2, 5, 10, 20, 40]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def legend(figure: Figure, *handles: Line2D | Patch, n_columns: int = 6, loc: Place = "outside upper center") -> None:
    """One legend for the whole figure, above its panels or below; a $ in a name is no mathematics.

    Args:
      figure: of which it is.
      *handles: what it explains.
      n_columns: at most; fewer where names are so long that they would leave the figure.
      loc: of Matplotlib.
    """
    for n in range(min(len(handles), n_columns), 0, -1):
        drawn = figure.legend(handles=list(handles), loc=loc, ncols=n)
        for text in drawn.get_texts():
            text.set_parse_math(False)
        if n == 1 or drawn.get_window_extent().width <= figure.bbox.width:
            return
        drawn.remove()


def padded(values: list[float]) -> tuple[float, float]:
    """Limits of an axis around values; a tenth to each side if they are all one."""
    low, high = min(values), max(values)
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin
