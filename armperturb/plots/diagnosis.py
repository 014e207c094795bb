"""Figures of what a fitted model leaves unexplained."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from armperturb.arrays import Array
from armperturb.plots.panels import AXES, label_frequency, legend
from armperturb.plots.style import COLOURS, FITTED, GREY, PALE, colours_for, figure_for, in_style
from armperturb.plots.traces import outline

ROW = 1.7
"""Height of an axis's panels [inch]."""

PER_OCTAVE = 6
"""Points at which spectra are drawn."""


@in_style()
def plot_residual(
    time: tuple[Array, Array, Array], spectra: tuple[Array, Array, Array, Array], figure: Figure | None = None
) -> Any:
    """Displacement and what a model leaves of it, over time and over frequency.

    Args:
      time: [s], (time,); displacement and residual of one trial [m], (time, axis).
      spectra: frequency [Hz], (frequency,); densities of displacement, residual and the modelled noise [m^2/Hz],
        (frequency, axis).
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (axis, 2): over time, over frequency.
    """
    figure = figure_for(figure, 0.8 + ROW * len(AXES))
    axes = figure.subplots(len(AXES), 2, sharex="col", sharey="col", width_ratios=(1.35, 1.0))
    seconds, recorded, residual = time
    frequency, *densities = spectra
    points = _octaves(frequency)
    looks: list[dict[str, Any]] = [
        {"color": PALE, "linewidth": 1.6, "label": "displacement"},
        {"color": COLOURS["RT"], "linewidth": 1.0, "label": "left by the model"},
        {**FITTED, "linestyle": (0, (4, 2)), "label": "modelled noise"},
    ]
    for axis, (over_time, over_frequency) in enumerate(axes):
        for values, look in zip((recorded, residual), looks, strict=False):
            places, shown = outline(1e3 * values[:, axis])
            over_time.plot(seconds[places], shown, **{**look, "linewidth": 0.8})
        over_time.set_ylabel(f"{AXES[axis]} [mm]")
        over_time.margins(x=0.01)
        for density, look in zip(densities, looks, strict=True):
            mean = [np.sqrt(np.mean(density[part, axis])) for part in points]
            over_frequency.plot([np.mean(frequency[part]) for part in points], 1e3 * np.array(mean), **look)
        over_frequency.set(xscale="log", yscale="log")
        over_frequency.set_ylabel(f"{AXES[axis]} [mm/√Hz]")
    axes[-1, 0].set_xlabel("time [s]")
    label_frequency(axes[-1, 1])
    legend(figure, *axes[0, 1].get_lines())
    return axes


def _octaves(frequency: Array) -> list[slice]:
    """Bands of equal width on a logarithmic axis, none of them empty."""
    band = np.floor(PER_OCTAVE * np.log2(frequency / frequency[0]))
    starts = np.flatnonzero(np.diff(band, prepend=-1.0))
    return [slice(int(a), int(b)) for a, b in zip(starts, [*starts[1:], len(frequency)], strict=True)]


@in_style()
def plot_fit_quality(
    coherence: Mapping[str, tuple[Array, Array]],
    lack: Mapping[str, Sequence[tuple[float, float, float]]],
    figure: Figure | None = None,
) -> Any:
    """Coherence, and lack of fit by band of frequency.

    Args:
      coherence: condition to frequencies [Hz], (frequency,), and coherence of each displacement, (frequency, axis).
      lack: condition to lowest and highest frequency [Hz] of each band, and the mean square of what is left there over
        that of the noise, 1 for a right model [-].
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (3,): coherence of x and of y, and lack of fit.
    """
    figure = figure_for(figure, 2.6)
    axes = figure.subplots(1, 3, sharex=True)
    colours = dict(zip(coherence, colours_for(len(coherence)), strict=True))
    for axis, ax in enumerate(axes[:2]):
        for label, (frequency, values) in coherence.items():
            ax.plot(frequency, values[:, axis], color=colours[label], marker="o", markersize=2.5, label=label)
        ax.set(ylim=(-0.03, 1.03), title=f"coherence {AXES[axis]}", xscale="log")
    axes[2].axhline(1.0, color=GREY, linewidth=0.8)
    for label, bands in lack.items():
        for low, high, ratio in bands:
            axes[2].plot((low / 1.03, high * 1.03), (ratio, ratio), color=colours[label], linewidth=2.6)
    axes[2].set(title="left over noise", yscale="log")
    axes[2].yaxis.set_major_locator(LogLocator(10, (1.0, 2.0, 5.0)))
    axes[2].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes[2].yaxis.set_minor_locator(NullLocator())
    for ax in axes:
        label_frequency(ax)
    if len(coherence) > 1:
        legend(figure, *axes[0].get_lines(), n_columns=4)
    return axes
