"""Figures of frequency responses with their uncertainty, and of the levels of noise and distortion."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from armperturb.arrays import Array, ComplexArray
from armperturb.plots.panels import (
    AXES,
    HEIGHT,
    Element,
    admittance_panels,
    label_frequency,
    legend,
    plot_admittance,
    unwrapped,
)
from armperturb.plots.style import COLOURS, GREY, INK, figure_for, in_style

POINTS: dict[str, Any] = {"color": INK, "marker": "o", "markersize": 2.5}
"""Line of an estimate at single frequencies."""


class Curve(NamedTuple):
    """A frequency response to be drawn.

    Attributes:
      label: for the legend.
      frequency: [Hz], (frequency,).
      response: [m/N], (frequency, output, input).
      bands: lowest and highest gain [m/N], and lowest and highest phase [rad], each (frequency, output, input); None if
        they are not known.
      look: of the line, as Matplotlib has it.
      near: frequencies [Hz] and a response in whose turn its phases are drawn, as of `plot_admittance`.
    """

    label: str
    frequency: Array
    response: ComplexArray
    bands: tuple[Array, Array, Array, Array] | None = None
    look: Mapping[str, Any] = POINTS
    near: tuple[Array, ComplexArray] | None = None

    def phase(self, at: tuple[slice, int, int]) -> Array:
        """Phase of an element as it is drawn [degree], (frequency,)."""
        return unwrapped(self.response[at], self.frequency, self.near and (self.near[0], self.near[1][at]))


@in_style()
def plot_responses(curves: Sequence[Curve], meaning: str = "95% of each element", figure: Figure | None = None) -> Any:
    """Gain and phase of each element of frequency responses, with their bands.

    Args:
      curves: what to draw.
      meaning: of the bands, for the legend.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (output, input, 2): gain and phase.
    """
    figure, panels = admittance_panels(figure_for(figure, HEIGHT))
    handles: list[Line2D | Patch] = []
    for curve in curves:
        look = dict(curve.look)
        draw_bands(panels, curve, {"color": _shade(look["color"]), "alpha": 0.4, "lw": 0})
        plot_admittance(panels, curve.frequency, curve.response, curve.near, **look)
        handles.append(Line2D([], [], label=curve.label, **look))
    colours = {curve.look["color"] for curve in curves if curve.bands is not None}
    if colours:
        colour = colours.pop() if len(colours) == 1 else GREY
        handles.append(Patch(facecolor=_shade(colour), alpha=0.4, label=meaning))
    legend(figure, *handles, n_columns=3 if len(handles) > 4 else 4)
    return np.array([[panels[output, input_] for input_ in range(2)] for output in range(2)])


def _shade(colour: str) -> str:
    """Colour of the band of a line."""
    return GREY if colour == INK else colour


def draw_bands(panels: Mapping[Element, tuple[Axes, Axes]], curve: Curve, shade: Mapping[str, Any]) -> None:
    """Shade the bands of a curve, if they are known."""
    if curve.bands is None:
        return
    gain_low, gain_high, phase_low, phase_high = curve.bands
    if curve.look.get("linestyle") == "":
        _draw_limits(panels, curve, shade["color"])
        return
    for element, (gain_ax, phase_ax) in panels.items():
        at: tuple[slice, int, int] = (slice(None), *element)
        # A logarithmic axis has no zero.
        least = np.maximum(gain_low[at], 1e-2 * np.abs(curve.response[at]))
        gain_ax.fill_between(curve.frequency, least, gain_high[at], **shade)
        middle, angle = curve.phase(at), np.degrees(np.angle(curve.response[at]))
        low, high = (np.degrees(limit[at]) + middle - angle for limit in (phase_low, phase_high))
        phase_ax.fill_between(curve.frequency, low, high, **shade)


def _draw_limits(panels: Mapping[Element, tuple[Axes, Axes]], curve: Curve, colour: str) -> None:
    """The bands of single points as bars."""
    assert curve.bands is not None
    gain_low, gain_high, phase_low, phase_high = curve.bands
    for element, (gain_ax, phase_ax) in panels.items():
        at = (slice(None), *element)
        gain = np.abs(curve.response[at])
        gain_ax.vlines(curve.frequency, np.maximum(gain_low[at], 1e-2 * gain), gain_high[at], color=colour, lw=0.9)
        middle = curve.phase(at)
        half = np.degrees(phase_high[at] - phase_low[at]) / 2.0
        phase_ax.vlines(curve.frequency, middle - half, middle + half, color=colour, lw=0.9)


@in_style()
def plot_distortion(
    frequency: Array, linear: Array, distortion: Array, noise: Array, limit: Array, figure: Figure | None = None
) -> Any:
    """Root mean squares of linear response, distortion and noise at a line, of each displacement.

    Args:
      frequency: [Hz], (frequency,).
      linear: power of the linear response [m^2], (frequency, output).
      distortion: of the distortion, likewise; what is not above zero is not drawn.
      noise: of the noise, likewise.
      limit: below which the distortion of a linear arm stays with a probability of 95 % [m^2], likewise.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (output,).
    """
    figure = figure_for(figure, 3.2)
    axes = figure.subplots(1, 2, sharey=True)
    for output, ax in enumerate(axes):
        for power, colour, label in (
            (linear, INK, "linear response"),
            (distortion, COLOURS["RT"], "distortion"),
            (noise, GREY, "noise"),
        ):
            shown = np.where(power[:, output] > 0.0, power[:, output], np.nan)
            ax.plot(frequency, 1e3 * np.sqrt(shown), color=colour, marker="o", markersize=3, label=label)
        of_linear: dict[str, Any] = {"color": COLOURS["RT"], "linestyle": ":"}
        ax.plot(frequency, 1e3 * np.sqrt(limit[:, output]), **of_linear, label="distortion of a linear arm, 95 %")
        ax.set(xscale="log", yscale="log", title=f"displacement {AXES[output]}")
        label_frequency(ax)
    axes[0].set_ylabel("RMS at a line [mm]")
    legend(figure, *axes[0].get_lines(), n_columns=4)
    return axes
