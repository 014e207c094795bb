"""Figure of a recording: what was measured over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from armperturb.plots.panels import legend
from armperturb.plots.style import GREY, colours_for, figure_for, in_style
from armperturb.recording import QUANTITIES, SIGNALS, check_recording, is_one_axis

SHOWN = {
    "perturbation": ("perturbation", 1.0, "N"),
    "force": ("hand force", 1.0, "N"),
    "displacement": ("displacement", 1e3, "mm"),
    "joint_angle": ("joint angle", np.degrees(1.0), "deg"),
}
"""Signal to its name in the figure, and the factor to the unit in which it is drawn."""

SHOWN_UNITS = {"N": (1.0, "N"), "m": (1e3, "mm"), "Nm": (1.0, "Nm"), "rad": (np.degrees(1.0), "deg")}
"""Unit of a signal of one axis to the factor to the unit in which it is drawn, and that unit."""

OF_MASK = "plot(recording.isel(trial=mask)) draws those of a mask"
"""How trials are picked otherwise, for messages."""

ROW = 1.35
"""Height of a signal's panels [inch]."""


@in_style()
def plot_recording(
    recording: xr.Dataset, *, trial: int | Sequence[int] | None = None, figure: Figure | None = None
) -> Any:
    """Perturbation, force and displacement over time, and joint angles if there are any; conditions by colour.

    Args:
      recording: the trials.
      trial: number of the trial to draw, or several; None draws all over each other.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (signal, 2): along x and y, and of joint angles shoulder and elbow; (signal, 1) of one axis, each called
      by its quantity. A dotted line is the onset of a pulse.

    Raises:
      TypeError: a number of a trial is no whole number, as in a mask.
      ValueError: the recording is refused, has no such trial, or none is asked for.
    """
    check_recording(recording)
    n = recording.sizes["trial"]
    chosen = list(range(n)) if trial is None else np.atleast_1d(trial).tolist()
    for k in chosen:
        if isinstance(k, bool) or not isinstance(k, int):
            raise TypeError(f"plot: trial = {k!r}; expected the number of a trial ({OF_MASK})")
        if not 0 <= k < n:
            raise ValueError(f"plot: trial = {k}; expected 0 to {n - 1}")
    if not chosen:
        raise ValueError(f"plot: trial is empty; expected at least one of 0 to {n - 1} ({OF_MASK})")
    shown = recording.isel(trial=chosen)
    names = [name for name in SHOWN if name in shown.data_vars]
    conditions = list(dict.fromkeys(shown["condition"].values.tolist()))
    colours = dict(zip(conditions, colours_for(len(conditions)), strict=True))
    alpha = max(0.25, 1.0 / np.sqrt(len(chosen)))
    figure = figure_for(figure, 0.7 + ROW * len(names))
    axes = figure.subplots(len(names), 1 if is_one_axis(shown) else 2, squeeze=False, sharex=True)
    for row, name in zip(axes, names, strict=True):
        label, factor, unit = SHOWN[name]
        components = [f"{label}, {component}" for component in shown[SIGNALS[name][0][-1]].values]
        if is_one_axis(shown):
            measured = shown[name].attrs["units"]
            factor, unit = SHOWN_UNITS[measured]
            components = [label if name == "perturbation" else QUANTITIES[measured]]
        for column, (ax, component) in enumerate(zip(row, components, strict=True)):
            for values, condition in zip(shown[name].values, shown["condition"].values.tolist(), strict=True):
                time, look = shown["time"].values, {"linewidth": 0.8, "alpha": alpha}
                ax.plot(time, factor * values[:, column], color=colours[condition], **look)
            for onset in np.unique(shown["pulse_onset"].values[np.isfinite(shown["pulse_onset"].values)]):
                ax.axvline(onset, color=GREY, linewidth=0.8, linestyle=":", zorder=0.5)
            ax.set_title(component, loc="left")
        if name != "joint_angle" and len(row) > 1:
            row[1].sharey(row[0])
            row[0].autoscale()
        row[0].set_ylabel(f"[{unit}]")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    who = ", ".join(dict.fromkeys(map(str, shown["subject"].values)))
    which = f"trial {chosen[0]}" if len(chosen) == 1 else f"{len(chosen)} trials"
    title = f"{who}, {which}" + (f", {conditions[0]}" if len(conditions) == 1 else "")
    figure.suptitle(title, fontsize=9, parse_math=False)
    if len(conditions) > 1:
        legend(
            figure,
            *(Line2D([], [], color=colours[each], label=each) for each in conditions),
            loc="outside lower center",
        )
    return axes
