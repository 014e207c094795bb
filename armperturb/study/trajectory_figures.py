"""Figures of single responses to pulses: paths of the handle, rotations of the joints (thesis figs 3.17, 3.18, F.1)."""

import math
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from armperturb.analysis import kinematics
from armperturb.analysis.arm_model import simulate_linear
from armperturb.analysis.pulse import WINDOWS, pulse_span
from armperturb.analysis.thesis import ThesisEstimate
from armperturb.envs.skeletal import Prediction, simulate_skeletal
from armperturb.study import published
from armperturb.study.axes import legend
from armperturb.study.bars import MODELS, PRINTED, printed_handle
from armperturb.study.cells import JOINTS, LEVELS
from armperturb.study.measure import multisine_part
from armperturb.study.style import GREY, INK, PALE, RECORDED, TRUE, in_style, new_figure
from armperturb.study.tables import published_or_nan

Array = NDArray[np.float64]

DOTS = {"PT": 0.05, "RT": 0.1}
"""Task to the time between dots on a path [s] (figures 3.17, 3.18)."""

PUSHED: dict[str, Any] = {"arrowstyle": "-|>", "color": GREY, "linewidth": 2.4, "shrinkA": 0, "shrinkB": 0}
"""Arrow of the direction of a pulse."""

JOINT_COLOURS = ("#56B4E9", "#0072B2")
"""Of shoulder and elbow."""


class Response(NamedTuple):
    """Paths of the handle after a pulse.

    Attributes:
      direction_deg: of the pulse from the x axis [degree].
      paths: "recorded", "linear" and "skeletal" to the displacement from the onset on [m], (time, axis); only those that
        there are.
    """

    direction_deg: float
    paths: dict[str, Array]


def responses(recording: xr.Dataset, estimate: ThesisEstimate | None, level: str) -> list[Response]:
    """The first response to a pulse of each direction, and what the models make of it.

    A trial whose fit is stable goes before one that cannot be predicted. The displacement is the handle's from the start
    of the trial, as peaks are.

    Args:
      recording: one person's trials of one condition.
      estimate: the fits of the trials that `multisine_part` gives.
      level: of the pulse, "min" or "max".
    """
    fits = {}
    if estimate is not None:
        _, fitted = multisine_part(recording)
        fits = {int(trial): fit for trial, fit in zip(fitted, estimate.fits, strict=True) if fit.stable}
    chosen: dict[float, int] = {}
    rate = float(recording.attrs["rate"])
    for trial in sorted(range(recording.sizes["trial"]), key=lambda trial: trial not in fits):
        if abs(float(recording["pulse_level"].values[trial])) != LEVELS[level]:
            continue
        try:
            pulse_span(recording, trial)
        except ValueError:
            continue
        chosen.setdefault(float(recording["pulse_direction"].values[trial]), trial)
    found = []
    for direction, trial in sorted(chosen.items()):
        span = pulse_span(recording, trial)
        paths = {"recorded": recording["displacement"].values[trial, span]}
        if trial in fits and estimate is not None:
            arm, environment = fits[trial].arm, estimate.environment
            driven = recording["perturbation"].values[trial, : span.stop]
            paths["linear"] = simulate_linear(arm, environment, driven, rate).displacement[span]
            asked = Prediction(arm=arm, environment=environment, perturbation=driven, onset=span.start)
            paths["skeletal"] = simulate_skeletal([asked], rate)[0]
        found.append(Response(direction, paths))
    return found


@in_style()
def trajectories(recording: xr.Dataset, estimate: ThesisEstimate | None, level: str) -> Figure:
    """Paths of the handle after a pulse in each direction, recorded and predicted (thesis figs 3.17, 3.18).

    Dots stand every 50 ms in PT and every 100 ms in RT, thin arrows end at the peaks, and a grey arrow has the direction
    of the pulse.

    Args:
      recording: as of `responses`.
      estimate: likewise.
      level: likewise.
    """
    task = str(recording["task"].values[0])
    step = round(DOTS[task] * float(recording.attrs["rate"]))
    lines: dict[str, dict[str, Any]] = {"recorded": RECORDED, **MODELS}
    found = responses(recording, estimate, level)
    figure = new_figure(4.2)
    ax = figure.subplots()
    drawn = set()
    for response in found:
        for name, path in response.paths.items():
            x, y = 100.0 * path.T
            ax.plot(x, y, **lines[name])
            ax.plot(x[::step], y[::step], "o", color=lines[name]["color"], markersize=3.2)
            drawn.add(name)
            if np.isfinite(path).all():
                peak = int(np.argmax(np.linalg.norm(path, axis=1)))
                arrow = {"arrowstyle": "->", "color": lines[name]["color"], "linewidth": 0.9, "shrinkA": 0, "shrinkB": 2}
                ax.annotate("", (x[peak], y[peak]), (0.0, 0.0), arrowprops=arrow)
    reach = 100.0 * max(np.nanmax(np.linalg.norm(path, axis=1)) for one in found for path in one.paths.values())
    for response in found:
        angle = math.radians(response.direction_deg)
        ax.annotate("", 0.3 * reach * np.array([math.cos(angle), math.sin(angle)]), (0.0, 0.0), arrowprops=PUSHED)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x, to the right [cm]", ylabel="y, forward [cm]")
    condition = str(recording["condition"].values[0])
    ax.set_title(f"{condition}, {1e3 * WINDOWS[task]:g} ms from the onset, a dot every {1e3 * DOTS[task]:g} ms")
    names = {"recorded": "recorded", "linear": "linear model", "skeletal": "skeletal model"}
    legend(figure, *(Line2D([], [], label=names[name], **look) for name, look in lines.items() if name in drawn))
    return figure


@in_style()
def joint_rotations(recording: xr.Dataset, level: str) -> Figure:
    """Rotations of shoulder and elbow after a pulse in each direction, with their peaks (thesis fig. F.1).

    They come from the path of the handle; where a simulator recorded the joints themselves, these are drawn too. Beside
    each panel stands the mean peak of table F.5.

    Args:
      recording: one person's trials of one condition.
      level: of the pulse, "min" or "max".
    """
    rate, task = float(recording.attrs["rate"]), str(recording["task"].values[0])
    condition = str(recording["condition"].values[0])
    trials = {response: trial for response, trial in first_pulses(recording, level).items()}
    figure = new_figure(3.3)
    panels = figure.subplots(1, len(trials), sharey=True, squeeze=False)
    has_truth = "joint_angle" in recording
    for ax, (direction, trial) in zip(panels.flat, trials.items(), strict=True):
        one = recording.isel(trial=[trial])
        span = pulse_span(one, 0)
        before = span.start - round(0.05 * rate)
        time = 1e3 * (np.arange(before, span.stop) - span.start) / rate
        rotation = np.degrees(kinematics.joint_rotations(one)[0])
        for joint, (name, colour) in enumerate(zip(JOINTS, JOINT_COLOURS, strict=True)):
            ax.plot(time, rotation[before : span.stop, joint], color=colour, linewidth=1.8)
            peak = span.start + int(np.argmax(np.abs(rotation[span, joint])))
            at = 1e3 * (peak - span.start) / rate
            ax.plot(at, rotation[peak, joint], "o", color=colour, markersize=6)
            up = 1 if rotation[peak, joint] > 0 else -1
            ax.annotate(
                f"{at:.0f} ms",
                *((at, rotation[peak, joint]), (0, 6 * up)),
                textcoords="offset points",
                ha="center",
                va="bottom" if up > 0 else "top",
            )
            if has_truth:
                truth = np.degrees(one["joint_angle"].values[0, :, joint] - kinematics.start_posture(one)[0, joint])
                ax.plot(time, truth[before : span.stop], **TRUE)
            printed = published_or_nan(published.joint_motion, condition, name, "peak_rotation", level)
            if math.isfinite(printed.mean):
                place = time[-1] * (1.05 + 0.05 * joint)
                mean, sd = np.degrees(printed)
                ax.errorbar(place, up * mean, sd, **{**PRINTED, "marker": "oD"[joint]}, elinewidth=0.9)
        ax.axvspan(0, 80, color=PALE, alpha=0.5, linewidth=0)
        ax.set(xlabel="time after the onset [ms]", title=f"pulse at {direction:g}°")
    panels[0, 0].set_ylabel("rotation [°]")
    return figure
