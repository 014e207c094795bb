"""Figures of the perturbations (thesis figures 2.3 to 2.5)."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Ellipse

from armperturb.analysis.measures.kinematics import hand_position
from armperturb.analysis.response.spectra import LineSpectra, line_spectra
from armperturb.perturbations import MultisineThenPulse, Pulse
from armperturb.perturbations.multisine import CLUSTERS, FULL_BAND, PERIOD
from armperturb.plots.panels import AXES, label_frequency
from armperturb.plots.style import COLOURS, GREY, INK, PALE, in_style, new_figure
from armperturb.study.results.cases import Case
from armperturb.study.results.recordings import pulse_width
from armperturb.subject import Subject

PULSE_WIDTH: float = Pulse.width
"""Duration of a pulse [s]."""

BESIDE_AXIS = 0.1
"""Sine of the angle to the fronto-parallel axis below which a direction's label would stand on it [-]."""


@in_style()
def perturbation(case: Case) -> Figure:
    """A multisine, its power, and the pulse that follows it, if there is one (thesis fig. 2.5)."""
    trial = case.trials().isel(trial=[0])
    time, force = trial["time"].values, trial["perturbation"].values[0]
    onset = float(trial["pulse_onset"].values[0])

    figure = new_figure(4.4)
    try:
        lines = line_spectra(trial)
    except ValueError:  # no whole period, as of noise
        lines = None
    n_zooms = 0 if np.isnan(onset) else 1
    n_beside = n_zooms + (lines is not None)
    grid = figure.add_gridspec(1, 2, width_ratios=(1.35, 1)) if n_beside else figure.add_gridspec(1, 1)
    whole = list(grid[0].subgridspec(2, 1).subplots(sharex=True, sharey=True, squeeze=False).flat)
    beside = list(grid[1].subgridspec(n_beside, 1).subplots(squeeze=False).flat) if n_beside else []
    colours = (INK, GREY)
    for ax, axis, colour in zip(whole, range(2), colours, strict=True):
        ax.plot(time, force[:, axis], color=colour, linewidth=0.7)
        ax.set(ylabel=f"$d_{AXES[axis]}$ [N]", xlim=(0, time[-1]))
    whole[0].set_title(f"one trial of {case.condition.name}", parse_math=False)
    whole[1].set_xlabel("time [s]")

    for zoom in beside[:n_zooms]:
        near = (time > onset - 0.5) & (time < onset + 0.3)
        zoom.axvspan(onset, onset + MultisineThenPulse.fade, color=PALE, alpha=0.6, linewidth=0)
        for axis, colour in enumerate(colours):
            zoom.plot(time[near], force[near, axis], color=colour, label=f"$d_{AXES[axis]}$")
        zoom.set(title="fade (grey) and pulse", xlabel="time [s]", ylabel="force [N]", xlim=(onset - 0.5, onset + 0.3))
        zoom.legend(loc="upper left")
    if lines is not None:
        _draw_density(beside[-1], lines, float(trial.attrs["rate"]))
    return figure


def _draw_density(ax: Axes, lines: LineSpectra, rate: float) -> None:
    """Autospectral density of a multisine, mean of both axes; of the thesis's, with its bands and extra clusters."""
    period = float(lines.line[0] / lines.frequency[0])
    power = 2.0 * np.mean(np.abs(lines.perturbation[0]) ** 2, axis=-1) / (period * rate**2)
    floor = 10 ** np.floor(np.log10(power.min()) - 0.5)
    ax.set(xscale="log", yscale="log", ylim=(floor, power.max() * 3), title="power of the multisine, each axis")
    ax.set(ylabel="density [N²/Hz]")
    label_frequency(ax)
    if not (np.isclose(period, PERIOD) and np.array_equal(lines.line, np.sort(CLUSTERS.ravel()))):
        ax.vlines(lines.frequency, floor, power, color=COLOURS["PT"], linewidth=1.2)
        ax.plot(lines.frequency, power, "o", color=COLOURS["PT"], markersize=2.2)
        return
    clusters = np.searchsorted(lines.line, CLUSTERS)
    reduced = np.flatnonzero(CLUSTERS[:, 0] / PERIOD > FULL_BAND[1])
    extra = reduced[1:8:2]  # midpoints of the first five of the logarithmic grid
    for which, colour, label in (
        (np.setdiff1d(np.arange(len(CLUSTERS)), reduced), COLOURS["PT"], "full power"),
        (np.setdiff1d(reduced, extra), INK, "reduced power"),
        (extra, GREY, "extra clusters"),
    ):
        index = clusters[which].ravel()
        ax.vlines(lines.frequency[index], floor, power[index], color=colour, linewidth=1.2)
        ax.plot(lines.frequency[index], power[index], "o", color=colour, markersize=2.2, label=label)
    ax.legend(loc="upper right", handletextpad=0.1)


@in_style()
def pulse_signal(recording: xr.Dataset, *, is_known: bool = True) -> Figure:
    """A pulse without a multisine: the whole trial, and the pulse alone (thesis fig. 2.3).

    Args:
      recording: one trial with a pulse.
      is_known: whether the pulse is half a sine of `PULSE_WIDTH`; if not, its width is measured.
    """
    time, rate = recording["time"].values, float(recording.attrs["rate"])
    onset, angle = (float(recording[name].values[0]) for name in ("pulse_onset", "pulse_direction"))
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    force = recording["perturbation"].values[0] @ direction
    peak = float(force.max())

    figure = new_figure(2.6)
    whole, zoom = figure.subplots(1, 2, sharey=True, width_ratios=(1.35, 1))
    whole.plot(time, force, color=INK, linewidth=1.0)
    whole.set(xlim=(0, time[-1]), xlabel="time [s]", ylabel=f"force at {angle:g}° [N]")
    whole.set_title(f"one trial of {recording['condition'].values[0]}", parse_math=False)

    width = 1e3 * (PULSE_WIDTH if is_known else pulse_width(recording))
    since = 1e3 * (time - onset)
    near = (since > -0.5 * width) & (since < 1.5 * width)
    zoom.axvspan(0.0, width, color=PALE, alpha=0.5, linewidth=0)
    zoom.plot(since[near], force[near], "o-", color=INK, markersize=3)
    arrow = {"arrowstyle": "<->", "color": INK, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
    zoom.annotate("", (0.0, -0.1 * peak), (width, -0.1 * peak), arrowprops=arrow)
    zoom.text(0.5 * width, -0.14 * peak, f"{width:.0f} ms", ha="center", va="top")
    zoom.set(xlim=(-0.5 * width, 1.5 * width), ylim=(-0.28 * peak, 1.1 * peak), xlabel="time after the onset [ms]")
    zoom.set_title(f"{'half a sine, ' if is_known else ''}sampled at {rate:g} Hz")
    return figure


@in_style()
def pulse_directions(arms: Sequence[Subject], directions_deg: Sequence[float]) -> Figure:
    """The arm from above in its mean posture, and the directions of the pulses (thesis fig. 2.4).

    Args:
      arms: whose segments and postures are averaged.
      directions_deg: of the pulses, from the fronto-parallel axis.
    """
    upper, lower, shoulder, elbow = np.mean([[arm.l_h, arm.l_f, *arm.posture] for arm in arms], axis=0)
    hinge = upper * np.array([np.cos(shoulder), np.sin(shoulder)])
    hand = hand_position((shoulder, elbow), upper, lower)

    figure = new_figure(4.0)
    ax = figure.subplots()
    ax.add_patch(Ellipse((-0.19, -0.02), 0.44, 0.2, color=PALE, linewidth=0))
    ax.add_patch(Ellipse((-0.19, 0.0), 0.15, 0.19, color=GREY, linewidth=0))
    for start, end in (((0.0, 0.0), hinge), (hinge, hand)):
        ax.plot(*zip(start, end, strict=True), color=PALE, linewidth=17, solid_capstyle="round")
    ax.plot(*zip((0.0, 0.0), hinge, hand, strict=True), color=INK, linewidth=1.4)
    ax.plot(*zip((0.0, 0.0), hinge, strict=True), "o", color=INK, markersize=8, markerfacecolor="white")
    ax.plot(*hand, "o", color=INK, markersize=8)
    for place, text, offset in (
        ((0.0, 0.0), "shoulder", (0, -18)),
        (hinge, "elbow", (0, -18)),
        (hand, "handle", (-8, 14)),
    ):
        ax.annotate(text, tuple(place), offset, textcoords="offset points", ha="center", va="center")

    for angle, base, name in (
        (shoulder, np.zeros(2), rf"$\theta_s$ = {np.degrees(shoulder):.1f}°"),
        (elbow, hinge, rf"$\theta_e$ = {np.degrees(elbow):.1f}°"),
    ):
        start = 0.0 if base is not hinge else shoulder
        end = base + 0.17 * np.array([np.cos(start), np.sin(start)])
        ax.plot(*zip(base, end, strict=True), color=GREY, linewidth=0.9, linestyle="--")
        ax.add_patch(Arc(tuple(base), 0.2, 0.2, theta1=np.degrees(start), theta2=np.degrees(start + angle), color=GREY))
        middle = base + 0.13 * np.array([np.cos(start + angle / 2), np.sin(start + angle / 2)])
        ax.annotate(name, tuple(middle), (4, 0), textcoords="offset points", va="center", fontsize=8)

    axis = np.array([0.3, 0.0])
    ax.plot(*zip(hand - axis, hand + axis, strict=True), color=GREY, linewidth=0.9, linestyle="--")
    ax.annotate("fronto-parallel axis", tuple(hand + axis), (4, 0), textcoords="offset points", va="center", fontsize=8)
    for angle in directions_deg:
        along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        ax.update_datalim([hand + 0.3 * along])  # arrows do not count by themselves
        arrow = {"arrowstyle": "-|>", "color": COLOURS["RT"], "linewidth": 2.2, "shrinkA": 5, "shrinkB": 0}
        ax.annotate("", tuple(hand + 0.24 * along), tuple(hand), arrowprops={**arrow, "mutation_scale": 14})
        size = 0.2 + 0.14 * (angle > 180)
        ax.add_patch(Arc(tuple(hand), size, size, theta1=0.0, theta2=angle, color=COLOURS["RT"], linewidth=0.9))
        # The torque at the elbow, of which a positive one flexes: the forearm's lever across the force.
        lever = hand - hinge
        does = "flexes" if lever[0] * along[1] > lever[1] * along[0] else "extends"
        text, place, side = f"{angle:g}°, {does} the elbow", hand + 0.26 * along, "left" if along[0] > 0 else "right"
        is_beside = abs(along[1]) < BESIDE_AXIS  # above the dashed line then, not on it
        label = ax.annotate(text, tuple(place), (0, 5 * is_beside), textcoords="offset points", ha=side)
        label.set(va="bottom" if is_beside else "center", color=COLOURS["RT"], weight="bold")
    ax.set_aspect("equal")
    ax.set(xlabel="x, to the right [m]", ylabel="y, forward [m]")
    return figure
