"""Figures of nonlinear fits: estimates over truth, and left-out pulses as all models predict them."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from armperturb.analysis.measures.pulse import WINDOWS
from armperturb.plots.panels import AXES, legend
from armperturb.plots.style import GREY, INK, RECORDED, in_style, new_figure, shades
from armperturb.study.report import nonlinear_tables as tables
from armperturb.study.report.figures import groups
from armperturb.study.report.figures.groups import MODEL_LOOKS
from armperturb.study.report.words import WORDS
from armperturb.study.results.nonlinear_fits import LeftOutPulse, drawn_pulse
from armperturb.study.results.study_result import StudyResult

LOOKS: dict[str, dict[str, Any]] = {
    **MODEL_LOOKS,
    tables.SEES_NONE: {"color": "#009E73", "linewidth": 1.3},
    tables.SEES_OTHERS: {"color": "#56B4E9", "linewidth": 1.3, "linestyle": (0, (1.5, 1.2))},
}
"""Model to its look."""

NAMES = {name: name for name in ("recorded", *MODEL_LOOKS)} | WORDS["models"]
"""What is drawn to its entry in legends."""

RATIOS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)


@in_style()
def prediction(study: StudyResult) -> Figure:
    """Predicted over recorded peak displacement of pulses that a model had not seen: people's means over trials."""
    models = dict(zip(tables.SHOWN_MODELS, groups.MARKERS, strict=True))
    drawn = {
        task: {
            f"{condition}\n\u00d7{level:g}": [
                groups.Series(_means(of_model[model]), LOOKS[model]["color"], marker)
                for model, marker in models.items()
            ]
            for (condition, level), of_model in of_pulses.items()
        }
        for task in tables.tasks_fitted(study)
        if (of_pulses := tables.left_out_pulses(study, task))
    }
    handles = [groups.people_handle(NAMES[model], LOOKS[model]["color"], marker) for model, marker in models.items()]
    return groups.draw_predictions(3.8, drawn, handles, 3)


def _means(pulses: Sequence[tuple[str, float, float]]) -> dict[str, float]:
    """Person to the mean peak [%] of the person's pulses, as `tables.left_out_pulses` has them."""
    peaks: dict[str, list[float]] = {}
    for name, peak, _ in pulses:
        peaks.setdefault(name, []).append(peak)
    return {name: float(np.mean(values)) for name, values in peaks.items()}


@in_style()
def parameters(study: StudyResult, task: str) -> Figure:
    """Estimates over true values with 95 % intervals, a point per person and fit."""
    rows = [
        row for row in tables.nonlinear_parameter_rows(study) if row["task"] == task and math.isfinite(row["ratio"])
    ]
    names = list(dict.fromkeys(row["parameter"] for row in rows))
    kinds = sorted({row["fitted_pulses_deg"] for row in rows})
    colours = [LOOKS[tables.SEES_NONE]["color"], *shades(LOOKS[tables.SEES_OTHERS]["color"], 3)[1:]]
    figure = new_figure(0.7 + 0.28 * len(names))
    ax = figure.subplots()
    ratios = [row["ratio"] for row in rows]
    low, high = max(RATIOS[0], min(0.5, 0.8 * min(ratios))), min(RATIOS[-1], max(2.0, 1.25 * max(ratios)))
    people = list(dict.fromkeys(row["subject"] for row in rows))
    for place, name in enumerate(names):
        if place % 2:
            ax.axhspan(place - 0.5, place + 0.5, color=GREY, alpha=0.08, linewidth=0)
        for row in rows:
            if row["parameter"] != name:
                continue
            kind = kinds.index(row["fitted_pulses_deg"])
            slot = kind * len(people) + people.index(row["subject"])
            y = place - 0.42 + 0.84 * (slot + 0.5) / (len(kinds) * len(people))
            # What is beyond the axis, as a group of the wrong sign, stands at its end.
            ratio, *ends = np.clip([row[end] / row["true"] for end in ("estimated", "lower_95", "upper_95")], low, high)
            mark = "<" if row["ratio"] < low else ">" if row["ratio"] > high else "o"
            ax.plot(ends, (y, y), color=colours[kind], linewidth=0.7)
            ax.plot(ratio, y, mark, color=colours[kind], markersize=2.2 if mark == "o" else 4.0, clip_on=False)
    ax.axvline(1.0, color=INK, linewidth=0.9)
    ax.set_xscale("log")
    ax.set_xlim(low, high)
    ax.xaxis.set_major_locator(FixedLocator(RATIOS))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.set_yticks(range(len(names)), [tables.words_of(name) for name in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("estimated / true")
    labels = [f"pulses at {tables.degrees(kind)} fitted too" if kind else "from multisines" for kind in kinds]
    handles = [
        Line2D([], [], color=colour, marker="o", markersize=3, label=label)
        for colour, label in zip(colours, labels, strict=False)
    ]
    legend(figure, *handles)
    return figure


def drawn_pulses(study: StudyResult, task: str) -> dict[float, dict[str, LeftOutPulse]]:
    """Direction to whether pulses were fitted to the first left-out `drawn_pulse` to the first person with one.

    Both are of one trial, the first of its direction whose linear fit predicts it, if any does.
    """
    wanted = drawn_pulse(study.protocol.conditions, task)
    for person in study.names:
        shown: dict[float, dict[str, LeftOutPulse]] = {}
        for model, pulses in ((tables.SEES_NONE, False), (tables.SEES_OTHERS, True)):
            for fit in tables.fitted(study, task, pulses=pulses):
                left_out = [pulse for pulse in fit.pulses if (pulse.condition, pulse.level) == wanted and pulse.paths]
                for pulse in sorted(left_out, key=lambda pulse: "linear" not in pulse.paths):
                    if fit.name == person:
                        shown.setdefault(pulse.direction_deg, {}).setdefault(model, pulse)
        if shown:
            return dict(sorted(shown.items()))
    return {}


@in_style()
def trajectories(study: StudyResult, task: str) -> Figure:
    """Paths of the handle after left-out pulses, from above and over time (thesis figs 3.17, 3.18).

    Args:
      study: in which `drawn_pulses` finds some.
      task: "PT" or "RT".
    """
    figure = new_figure(4.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    above = figure.add_subplot(grid[:, 0])
    over_time = [figure.add_subplot(grid[row, 1]) for row in range(2)]
    used: list[str] = []
    looks = {"recorded": RECORDED, **LOOKS}
    pulses = drawn_pulses(study, task)
    condition = next(pulse.condition for of_fit in pulses.values() for pulse in of_fit.values())
    for of_fit in pulses.values():
        first = next(iter(of_fit.values()))
        paths = {name: path for name, path in first.paths.items() if name in ("recorded", *MODEL_LOOKS)}
        paths |= {model: pulse.paths["nonlinear"] for model, pulse in of_fit.items() if "nonlinear" in pulse.paths}
        for name, path in paths.items():
            look = looks[name]
            x, y = 100.0 * path.T
            above.plot(x, y, **look)
            above.plot(x[0], y[0], "o", color=look["color"], markersize=3)
            time = np.linspace(0.0, WINDOWS[task], len(path))
            for ax, along in zip(over_time, (x, y), strict=True):
                ax.plot(time, along, **look)
            used.append(name)
    above.set_aspect("equal", adjustable="datalim")
    above.set(xlabel="x, to the right [cm]", ylabel="y, forward [cm]", title=f"{condition}, from above")
    for ax, axis in zip(over_time, AXES, strict=True):
        ax.set_ylabel(f"{axis} [cm]")
    over_time[0].tick_params(labelbottom=False)
    over_time[1].set_xlabel("time after the onset [s]")
    legend(figure, *(Line2D([], [], label=NAMES[n], **look) for n, look in looks.items() if n in used), n_columns=3)
    return figure
