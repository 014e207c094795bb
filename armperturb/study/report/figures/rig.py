"""Pictures of the rig, drawn by MuJoCo."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from armperturb.analysis.measures.kinematics import hand_position
from armperturb.cohort import Person
from armperturb.environment import Environment
from armperturb.envs.render.camera import render, simplify
from armperturb.models.rig import build_model
from armperturb.plots.style import COLOURS, INK, in_style, new_figure
from armperturb.study.results.study_result import StudyResult

TIMES = {"PT": (0.0, 0.05, 0.1, 0.2, 0.3), "RT": (0.0, 0.1, 0.3, 0.6, 1.0)}
"""Task to the times after a pulse's onset that stills show [s]."""

SEEN = (-0.644, 0.764, -0.484, 0.924)
"""Left, right, bottom and top of a square picture from above, at the height of the arm, from the shoulder [m]."""

CROP = (-0.3, 0.58, -0.2, 0.68)
"""What stills show of it."""

PIXELS = 380
"""Width of a picture before it is cropped."""


@in_style()
def rig(study: StudyResult) -> Figure:
    """The first person on the manipulator, from above and from the side.

    Raises:
      RuntimeError: this machine cannot draw; the message names what to install.
    """
    model = build_model(study.cohort[0].subjects[study.protocol.conditions[0].task], study.environment)
    figure = new_figure(3.95)
    for ax, camera in zip(figure.subplots(1, 2), ("top", "oblique"), strict=True):
        ax.imshow(render(model, camera=camera, width=840, height=840), interpolation="none")
        ax.set_axis_off()
        if camera == "top":
            _draw_directions(ax)
    return figure


def _draw_directions(ax: Axes) -> None:
    """The axes x and y in the lower left corner of a picture from above."""
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
    for tip, label, place in (((0.18, 0.06), "x", (0.205, 0.06)), ((0.06, 0.18), "y", (0.06, 0.205))):
        ax.annotate("", tip, (0.06, 0.06), xycoords="axes fraction", arrowprops=arrow)
        ax.text(*place, label, transform=ax.transAxes, ha="center", va="center", weight="bold")


@in_style()
def stills(person: Person, environment: Environment, pulses: Sequence[xr.Dataset]) -> Figure:
    """A person from above during and after pulses, with the path of the handle so far.

    Args:
      person: who was recorded.
      environment: what the hand held.
      pulses: single trials with a pulse and with joint angles, a row each.

    Raises:
      RuntimeError: this machine cannot draw; the message names what to install.
    """
    times = [TIMES[str(trial["task"].values[0])] for trial in pulses]
    figure = new_figure(1.78 * len(pulses))
    panels = figure.subplots(len(pulses), max(map(len, times)), squeeze=False)
    for row, trial, after in zip(panels, pulses, times, strict=True):
        task, rate = str(trial["task"].values[0]), float(trial.attrs["rate"])
        model = build_model(person.subjects[task], environment)
        simplify(model, PIXELS)
        onset = round(float(trial["pulse_onset"].values[0]) * rate)
        displacement, angle = (trial[name].values[0] for name in ("displacement", "joint_angle"))
        start = hand_position(person.subjects[task].posture, person.subjects[task].l_h, person.subjects[task].l_f)
        direction = np.radians(float(trial["pulse_direction"].values[0]))
        samples = onset + np.rint(np.multiply(after, rate)).astype(int)
        poses = np.hstack([angle[samples], displacement[samples]])
        pictures = render(model, poses, "top", width=PIXELS, height=PIXELS)
        for ax, since, now, picture in zip(row, after, samples, pictures, strict=True):
            _draw_still(ax, picture)
            path = start + displacement[onset : now + 1]
            ax.plot(*path.T, color=COLOURS["RT"], linewidth=1.6)
            ax.plot(*path[-1], "o", color=COLOURS["RT"], markersize=3)
            tip = start + 0.22 * np.array([np.cos(direction), np.sin(direction)])
            if since == 0:
                ax.annotate(
                    "", tip, start, arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 2.0, "shrinkA": 0}
                )
            ax.set_title(f"+ {1e3 * since:.0f} ms" if since else "onset")
        row[0].set_ylabel(f"{trial['condition'].values[0]}, pulse at {np.degrees(direction):.0f}°")
    return figure


def _draw_still(ax: Axes, picture: npt.NDArray[np.uint8]) -> None:
    """A picture from above, cropped, on axes in metres."""
    left, right, bottom, top = SEEN
    n_rows, n_columns = picture.shape[:2]
    columns = [round((x - left) / (right - left) * n_columns) for x in CROP[:2]]
    rows = [round((top - y) / (top - bottom) * n_rows) for y in CROP[:1:-1]]
    ax.imshow(picture[slice(*rows), slice(*columns)], extent=CROP, interpolation="none")
    ax.set(xlim=CROP[:2], ylim=CROP[2:], xticks=(), yticks=())
    ax.grid(visible=False)
