"""Figures of a frequency response with its uncertainty, and of the levels of noise and distortion."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from armperturb.analysis.response.best_linear import BestLinear
from armperturb.analysis.response.frequency_response import FrequencyResponse
from armperturb.plots.axes import AXES, PHASES, Element, admittance_panels, label_frequency, legend, plot_admittance
from armperturb.plots.style import COLOURS, GREY, INK, in_style, new_figure


@in_style()
def response_bands(
    found: FrequencyResponse,
    level: float = 0.95,
    panels: tuple[Figure, Mapping[Element, tuple[Axes, Axes]]] | None = None,
) -> Figure:
    """Gain and phase of each element, with the limits within which it lies with a probability if these are known.

    Args:
      found: the response.
      level: the probability [-].
      panels: what `study.axes.admittance_panels` gave, to draw over what they show; None makes new ones.

    Returns:
      Their figure.

    Raises:
      ValueError: the level is no probability.
    """
    figure, axes = admittance_panels() if panels is None else panels
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=INK, marker="o", markersize=2.5, label=f"estimate ({found.what})")
    ]
    if found.covariance is not None:
        _draw_bands(axes, found, level)
        handles.append(Patch(facecolor=GREY, alpha=0.4, label=f"{level:.0%} of each element"))
    plot_admittance(axes, found.frequency, found.response, color=INK, marker="o", markersize=2.5)
    legend(figure, *handles)
    return figure


def _draw_bands(panels: Mapping[Element, tuple[Axes, Axes]], found: FrequencyResponse, level: float) -> None:
    bands = found.bands(level)
    for element, (gain_ax, phase_ax) in panels.items():
        at = (slice(None), *element)
        gain = np.abs(found.response[at])
        # A logarithmic axis has no zero.
        gain_ax.fill_between(
            found.frequency,
            np.maximum(bands.gain_low[at], 1e-2 * gain),
            bands.gain_high[at],
            color=GREY,
            alpha=0.4,
            lw=0,
        )
        # Bands go on where the line starts again at the other end of the axis.
        angle = np.angle(found.response[at])
        whole = np.unwrap(angle)
        low, high = (np.degrees(limit[at] + whole - angle) for limit in (bands.phase_low, bands.phase_high))
        first, last = np.floor((PHASES[0] - high.max()) / 360.0), np.ceil((PHASES[1] - low.min()) / 360.0)
        limits = phase_ax.get_ylim()
        for turn in 360.0 * np.arange(first, last + 1):
            phase_ax.fill_between(found.frequency, low + turn, high + turn, color=GREY, alpha=0.4, lw=0)
        phase_ax.set_ylim(limits)


@in_style()
def distortion_levels(found: BestLinear) -> Figure:
    """Root mean squares of linear response, distortion and noise at a line, of each displacement."""
    figure = new_figure(3.2)
    frequency = found.response.frequency
    for output, ax in enumerate(figure.subplots(1, 2, sharey=True)):
        for power, colour, label in (
            (found.linear, INK, "linear response"),
            (found.distortion, COLOURS["RT"], "distortion"),
            (found.noise, GREY, "noise"),
        ):
            shown = np.where(power[:, output] > 0.0, power[:, output], np.nan)
            ax.plot(frequency, 1e3 * np.sqrt(shown), color=colour, marker="o", markersize=3, label=label)
        limit = 1e3 * np.sqrt(1.645 * found.distortion_error[:, output])  # one-sided, as `p_value`
        ax.plot(frequency, limit, color=COLOURS["RT"], linestyle=":", label="distortion of a linear arm, 95 %")
        ax.set(xscale="log", yscale="log", title=f"displacement {AXES[output]}")
        label_frequency(ax)
    axes = figure.axes
    axes[0].set_ylabel("RMS at a line [mm]")
    legend(figure, *[handle for handle in axes[0].get_lines() if isinstance(handle, Line2D)], n_columns=4)
    return figure
