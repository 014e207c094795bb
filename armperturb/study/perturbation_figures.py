"""Figures of the perturbations (thesis figures 2.3 to 2.5)."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from armperturb.analysis.spectra import LineSpectra, line_spectra
from armperturb.perturbations import MultisineThenPulse
from armperturb.perturbations.multisine import CLUSTERS, FULL_BAND, PERIOD
from armperturb.study.axes import AXES, label_frequency
from armperturb.study.cases import Case
from armperturb.study.style import COLOURS, GREY, INK, PALE, in_style, new_figure

Array = NDArray[np.float64]


@in_style()
def perturbation(case: Case) -> Figure:
    """A multisine, its power, and the pulse that follows it, if there is one (thesis fig. 2.5)."""
    trial = case.trials().isel(trial=[0])
    time, force = trial["time"].values, trial["perturbation"].values[0]
    onset = float(trial["pulse_onset"].values[0])

    figure = new_figure(4.4)
    grid = figure.add_gridspec(1, 2, width_ratios=(1.35, 1))
    whole = list(grid[0].subgridspec(2, 1).subplots(sharex=True, sharey=True, squeeze=False).flat)
    *zooms, density = grid[1].subgridspec(1 if np.isnan(onset) else 2, 1).subplots(squeeze=False).flat
    colours = (INK, GREY)
    for ax, axis, colour in zip(whole, range(2), colours, strict=True):
        ax.plot(time, force[:, axis], color=colour, linewidth=0.7)
        ax.set(ylabel=f"$d_{AXES[axis]}$ [N]", xlim=(0, time[-1]))
    whole[0].set_title(f"one trial of {case.condition.name}")
    whole[1].set_xlabel("time [s]")

    for zoom in zooms:
        near = (time > onset - 0.5) & (time < onset + 0.3)
        zoom.axvspan(onset, onset + MultisineThenPulse.fade, color=PALE, alpha=0.6, linewidth=0)
        for axis, colour in enumerate(colours):
            zoom.plot(time[near], force[near, axis], color=colour, label=f"$d_{AXES[axis]}$")
        zoom.set(title="fade (grey) and pulse", xlabel="time [s]", ylabel="force [N]", xlim=(onset - 0.5, onset + 0.3))
        zoom.legend(loc="upper left")
    _draw_density(density, line_spectra(trial), float(trial.attrs["rate"]))
    return figure


def _draw_density(ax: Axes, lines: LineSpectra, rate: float) -> None:
    """Autospectral density of a multisine, mean of both axes, with its bands and its extra clusters."""
    power = 2.0 * np.mean(np.abs(lines.perturbation[0]) ** 2, axis=-1) / (PERIOD * rate**2)
    floor = 10 ** np.floor(np.log10(power.min()) - 0.5)
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
    ax.set(xscale="log", yscale="log", ylim=(floor, power.max() * 3), title="power of the multisine, each axis")
    ax.set(ylabel="density [N²/Hz]")
    label_frequency(ax)
    ax.legend(loc="upper right", handletextpad=0.1)
