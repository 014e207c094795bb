"""Figures of single responses to pulses: paths of the handle, rotations of the joints (thesis figs 3.17, 3.18, F.1)."""

import math
from collections.abc import Collection
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from armperturb.analysis.fit.admittance_fit import AdmittanceFit
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.measures import kinematics
from armperturb.analysis.measures.pulse import WINDOWS, pulse_span
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.perturbations import Pulse
from armperturb.plots.panels import legend
from armperturb.plots.style import GREY, PALE, RECORDED, TRUE, in_style, new_figure
from armperturb.study.published import tables as published
from armperturb.study.report.figures.groups import MODEL_LOOKS, PRINTED, printed_handle
from armperturb.study.report.tables import published_or_nan
from armperturb.study.results.nonlinear_fits import predicted_paths
from armperturb.study.results.quantities import level_name
from armperturb.study.results.recordings import pulse_width

DOTS = {"PT": 0.05, "RT": 0.1}
"""Task to the time between dots on a path [s] (figures 3.17, 3.18)."""

PEAK: dict[str, Any] = {"arrowstyle": "->", "linewidth": 0.9, "shrinkA": 0, "shrinkB": 2}
"""Arrow to a peak."""

PUSHED: dict[str, Any] = {
    "arrowstyle": "simple,tail_width=0.35,head_width=1.1",
    "color": PALE,
    "mutation_scale": 16,
    "shrinkA": 0,
}
"""Arrow of the direction of a pulse."""

ITSELF: dict[str, Any] = {**TRUE, "linewidth": 0.9}
"""Line of the joint itself: thin, so that the one under it, which is nearly the same, keeps its colour."""

JOINT_LOOKS: dict[str, dict[str, Any]] = {
    "shoulder": {"color": "#56B4E9", "linewidth": 3.0},
    "elbow": {"color": "#0072B2", "linewidth": 3.0},
}

LEAD, LAG = 0.05, 0.5
"""From when to when around the onset of a pulse rotations are drawn at least [s]."""


def first_pulses(
    recording: xr.Dataset, level: float | None = None, preferred: Collection[int] = ()
) -> dict[float, int]:
    """Direction of each pulse [degree] to the first trial with it whose response is recorded, see `pulse_span`.

    Args:
      recording: trials.
      level: of the pulse [-]; None takes the largest.
      preferred: trials that go before the others.
    """
    levels = np.abs(recording["pulse_level"].values)
    wanted = levels.max(initial=0.0) if level is None else level
    first: dict[float, int] = {}
    for trial in sorted(np.flatnonzero(levels == wanted).tolist(), key=lambda trial: trial not in preferred):
        try:
            pulse_span(recording, trial)
        except ValueError:
            continue
        first.setdefault(float(recording["pulse_direction"].values[trial]), trial)
    return dict(sorted(first.items()))


def stable_fits(recording: xr.Dataset, estimate: ThesisEstimate | None) -> dict[int, AdmittanceFit]:
    """Trial to its own fit, of those that are stable and so predict; none where other trials were fitted.

    Args:
      recording: one person's trials of one condition.
      estimate: the fits of the trials that `ConditionTrials.multisine` keeps; None without any.
    """
    fitted = ConditionTrials.prepare(recording, is_checked=True).multisine.numbers
    if estimate is None or len(fitted) != len(estimate.fits):
        return {}
    return {int(trial): fit for trial, fit in zip(fitted, estimate.fits, strict=True) if fit.stable}


def responses(recording: xr.Dataset, estimate: ThesisEstimate | None, level: float) -> dict[float, dict[str, Array]]:
    """Direction of pulses [degree] to paths of the handle after the first: "recorded", "linear" and "skeletal".

    A trial whose fit is stable goes before one that cannot be predicted. The displacement is that from the start of the
    trial, as of peaks.

    Args:
      recording: one person's trials of one condition.
      estimate: the fits of the trials that `ConditionTrials.multisine` keeps.
      level: of the pulse [-].
    """
    fits = stable_fits(recording, estimate)
    rate = float(recording.attrs["rate"])
    results = {}
    for direction, trial in first_pulses(recording, level, fits).items():
        span = pulse_span(recording, trial)
        paths = {"recorded": recording["displacement"].values[trial, span]}
        if estimate is not None and trial in fits:
            driven = recording["perturbation"].values[trial, : span.stop]
            paths |= predicted_paths(fits[trial].arm, estimate.environment, driven, rate, span.start)
        results[direction] = paths
    return results


@in_style()
def trajectories(recording: xr.Dataset, estimate: ThesisEstimate | None, level: float) -> Figure:
    """Paths of the handle after a pulse in each direction, recorded and predicted (thesis figs 3.17, 3.18).

    Dots stand every 50 ms in PT and every 100 ms in RT, thin arrows end at the peaks, and a pale arrow has the
    direction of the pulse.

    Args:
      recording: as of `responses`.
      estimate: likewise.
      level: likewise [-].
    """
    task = str(recording["task"].values[0])
    step = round(DOTS[task] * float(recording.attrs["rate"]))
    lines: dict[str, dict[str, Any]] = {"recorded": RECORDED, **MODEL_LOOKS}
    first = responses(recording, estimate, level)
    figure = new_figure(4.2)
    ax = figure.subplots()
    drawn = set()
    for paths in first.values():
        for name, path in paths.items():
            x, y = 100.0 * path.T
            ax.plot(x, y, **lines[name])
            ax.plot(x[::step], y[::step], "o", color=lines[name]["color"], markersize=3.2)
            drawn.add(name)
            if np.isfinite(path).all():
                peak = int(np.argmax(np.linalg.norm(path, axis=1)))
                to_peak = {**PEAK, "color": lines[name]["color"]}
                ax.annotate("", (x[peak], y[peak]), (0.0, 0.0), arrowprops=to_peak)
    reach = 100.0 * max(np.linalg.norm(paths["recorded"], axis=1).max() for paths in first.values())
    for angle in map(math.radians, first):
        tip = (0.4 * reach * math.cos(angle), 0.4 * reach * math.sin(angle))
        ax.annotate("", tip, (0.0, 0.0), arrowprops=PUSHED, zorder=0.5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x, to the right [cm]", ylabel="y, forward [cm]")
    condition = str(recording["condition"].values[0])
    shown = f"{1e3 * WINDOWS[task]:g} ms from the onset, a dot every {1e3 * DOTS[task]:g} ms"
    ax.set_title(f"{condition}, {shown}", parse_math=False)
    names = {"recorded": "recorded", "linear": "linear model", "skeletal": "skeletal model"}
    handles: list[Line2D | Patch] = [Line2D([], [], label=names[n], **look) for n, look in lines.items() if n in drawn]
    legend(figure, *handles, Patch(color=PALE, label="direction of the pulse"))
    return figure


def around_pulse(recording: xr.Dataset, trial: int) -> xr.Dataset:
    """A trial from shortly before its pulse to half a second after its onset or its window, or to the end."""
    after = max(LAG, WINDOWS[str(recording["task"].values[trial])])
    rate = float(recording.attrs["rate"])
    onset = round(float(recording["pulse_onset"].values[trial]) * rate)
    first = max(0, onset - round(LEAD * rate))
    return recording.isel(trial=[trial], time=slice(first, onset + round(after * rate) + 1))


@in_style()
def joint_rotations(recording: xr.Dataset, *, is_known: bool = True) -> Figure:
    """Rotations of shoulder and elbow after a largest pulse in each direction, with their peaks (thesis fig. F.1).

    Peaks are those in the window of table F.5, which a dotted line ends; the shoulder may come later.

    They come from the path of the handle; where a simulator recorded the joints themselves, these are drawn too. Beside
    them stand the mean peaks of table F.5.

    Args:
      recording: one person's trials of one condition, whose handle stays within the arm's reach.
      is_known: whether pulses are half a sine of `PULSE_WIDTH`; if not, their width is measured.
    """
    condition = str(recording["condition"].values[0])
    trials = first_pulses(recording)
    level = level_name(condition, float(np.abs(recording["pulse_level"].values).max()))
    figure = new_figure(3.4)
    panels = figure.subplots(1, len(trials), sharey=True, squeeze=False)[0]
    any_printed = False
    window = 1e3 * WINDOWS[str(recording["task"].values[0])]
    for ax, (direction, trial) in zip(panels, trials.items(), strict=True):
        around = around_pulse(recording, trial)
        time = 1e3 * (around["time"].values - float(around["pulse_onset"].values[0]))
        rotation = np.degrees(kinematics.joint_rotations(around)[0])
        width = Pulse.width if is_known else pulse_width(recording.isel(trial=[trial]))
        ax.axvspan(0.0, 1e3 * width, color=PALE, alpha=0.5, linewidth=0)
        ax.axvline(window, color=GREY, linewidth=0.9, linestyle=":")
        in_window = (time >= 0.0) & (time < window + 0.5e3 / float(recording.attrs["rate"]))
        for joint, (name, look) in enumerate(JOINT_LOOKS.items()):
            values = rotation[:, joint]
            ax.plot(time, values, **look)
            if "joint_angle" in around:
                truth = np.degrees(kinematics.true_rotations(around)[0, :, joint])
                ax.plot(time, truth, **ITSELF)
            peak = int(np.argmax(np.where(in_window, np.abs(values), 0.0)))
            sign = np.sign(values[peak])
            ax.plot(time[peak], values[peak], "o", color=look["color"], markersize=6)
            ax.annotate(
                f"{name} {time[peak]:.0f} ms",
                *((time[peak], values[peak]), (0, 7 * sign)),
                textcoords="offset points",
                ha="center",
                va="bottom" if sign > 0 else "top",
            )
            printed = published_or_nan(published.joint_motion, condition, name[0], "peak_rotation", level)
            if np.isfinite(printed.mean):
                any_printed = True
                mean, sd = np.degrees(printed)
                ax.errorbar(time[-1] + 25 + 22 * joint, sign * mean, sd, **PRINTED, elinewidth=0.9)
        ax.set(xlabel="time after the onset [ms]", title=f"{condition}, pulse at {direction:g}°")
        ax.margins(y=0.16)
    panels[0].set_ylabel("rotation [°]")
    handles = [Line2D([], [], label=name, **look) for name, look in JOINT_LOOKS.items()]
    handles += [Line2D([], [], label="the joint itself", **ITSELF)] if "joint_angle" in recording else []
    legend(figure, *handles, *([printed_handle("published peak, mean ± SD")] if any_printed else []))
    return figure
