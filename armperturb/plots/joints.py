"""Figure of a joint: recorded and predicted signal, torque of the paths, profile of the delay."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from armperturb.plots.style import GREY, PALETTE, RECORDED, figure_for, in_style

SHOWN = 8.0
"""Length of the traces [s]."""


@in_style()
def plot_joint(
    trace: Any,
    profile: Any,
    fit_until: float | None,
    quantity: str,
    torque: str,
    limit: float,
    figure: Figure | None = None,
) -> Any:
    """Recorded and predicted signal, the torque of each path below it, and the profile of the delay.

    Args:
      trace: times, recorded and predicted signal and torque of the paths, see `analysis.joint.identify.Trace`.
      profile: of the likelihood over the delay, see `analysis.joint.estimate.Profile`; None without.
      fit_until: end of what was fitted [s]; None for all.
      quantity: name and unit of the signal.
      torque: name and unit of the torque.
      limit: fall of twice the log-likelihood at the ends of the interval [-].
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Matplotlib axes: of the signal, of the paths, and of the profile if there is one.
    """
    rows = 2 if profile is None else 3
    figure = figure_for(figure, 0.8 + 1.7 * rows)
    axes = figure.subplots(rows, 1)
    start = trace.time[0] if fit_until is None else max(fit_until - 0.5 * SHOWN, trace.time[0])
    shown = (trace.time >= start) & (trace.time <= start + SHOWN)
    axes[0].plot(trace.time[shown], trace.recorded[shown], label="recorded", **RECORDED)
    axes[0].plot(trace.time[shown], trace.predicted[shown], color=PALETTE[0], linewidth=1.1, label="parallel cascade")
    axes[0].set_ylabel(quantity)
    for place, (name, path) in enumerate(trace.paths.items()):
        colour = PALETTE[place % len(PALETTE)]
        axes[1].plot(trace.time[shown], path[shown] - np.mean(path), color=colour, linewidth=1.1, label=name)
    axes[1].set_ylabel(torque)
    axes[1].sharex(axes[0])
    axes[1].set_xlabel("time [s]")
    for ax in axes[:2]:
        if fit_until is not None:
            ax.axvline(fit_until, color=GREY, linewidth=0.8, linestyle=":")
        ax.legend(loc="upper right", ncols=2)
    if profile is not None:
        axes[2].plot(1e3 * profile.values, profile.rise, color=PALETTE[0], marker="o", markersize=2.5, linewidth=1.0)
        axes[2].axhline(limit, color=GREY, linewidth=0.8, linestyle=":")
        axes[2].set_xlabel("reflex delay [ms]")
        axes[2].set_ylabel("fall of 2 log L [-]")
        axes[2].set_ylim(0.0, None)
    return axes
