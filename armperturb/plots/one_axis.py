"""Figure of the response of one axis: gain and phase with their bands, coherence and distortion."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from armperturb.plots.bands import POINTS
from armperturb.plots.panels import label_frequency, legend
from armperturb.plots.style import GREY, PALETTE, figure_for, in_style


@in_style()
def plot_axis_response(estimate: Any, level: float, figure: Figure | None = None) -> Any:
    """Gain and phase with their bands, and coherence and distortion, over frequency.

    Args:
      estimate: an `analysis.response.one_axis.AxisResponse`.
      level: probability with which a band holds the true response [-].
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Matplotlib axes, (3,).
    """
    figure = figure_for(figure, 6.0)
    gain, phase, shares = figure.subplots(3, 1, sharex=True, height_ratios=(1.35, 1, 1))
    f, values = estimate.frequency, estimate.response.ravel()
    low, high, phase_low, phase_high = (each.ravel() for each in estimate.bands(level))
    gain.set(xscale="log", yscale="log", ylabel=f"gain [{estimate.units}]")
    band = {"color": GREY, "alpha": 0.4, "lw": 0}
    gain.fill_between(f, np.maximum(low, 1e-2 * np.abs(values)), high, label=f"{level:.0%}", **band)
    gain.plot(f, np.abs(values), label=estimate.kind, **POINTS)
    whole = np.unwrap(np.angle(values))
    shift = whole - np.angle(values)
    phase.fill_between(f, np.degrees(phase_low + shift), np.degrees(phase_high + shift), **band)
    phase.plot(f, np.degrees(whole), **POINTS)
    phase.set_ylabel("phase [°]")
    shares.plot(f, estimate.coherence, label="coherence", **POINTS)
    look = {"color": PALETTE[1], "linewidth": 1.1}
    shares.plot(f, np.maximum(estimate.distortion, 0.0), label="distortion", marker="o", markersize=2.5, **look)
    shares.plot(f, estimate.distortion_limit, label="of a linear limb (95 %)", linestyle=":", **look)
    shares.set(ylabel="share of power [-]", ylim=(0.0, 1.02))
    label_frequency(shares)
    shares.set_xlim(0.9 * f[0], 1.1 * f[-1])
    handles = [handle for ax in (gain, shares) for handle in ax.get_legend_handles_labels()[0]]
    legend(figure, *handles, n_columns=3)
    return np.array([gain, phase, shares])
