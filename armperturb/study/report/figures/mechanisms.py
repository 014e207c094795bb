"""Figures of why people yield: what `armperturb.study.experiments.mechanisms` computed."""

import itertools
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from armperturb.muscle_law import ELEMENTS
from armperturb.plots.panels import AXES, label_frequency, legend
from armperturb.plots.style import GREY, INK, PALETTE, in_style, new_figure
from armperturb.study.experiments.mechanisms import AMPLITUDES, LINEAR, PULSES, WHOLE, Yielding, intrinsic_loop
from armperturb.study.report.figures.axes import looks

DASHES = ("-", (0, (5, 1.5)), (0, (3, 1, 1, 1)), (0, (2, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (6, 1, 2, 1)))
"""Of the line of each arm without a mechanism; they tell arms apart where colours do not."""


@in_style()
def loops(yielding: Yielding) -> Figure:
    """Torque of the muscle elements over their stretch in sinusoids of each condition's RMS stretch."""
    figure = new_figure(4.9)
    panels = figure.subplots(2, 3, sharex="row", sharey="row")
    handles = []
    for row, (task, conditions) in zip(panels, AMPLITUDES.items(), strict=True):
        drawn = looks(task, conditions)
        # The largest loop first, so that smaller ones lie on top.
        for condition, look in reversed(drawn):
            response = yielding.responses.get((WHOLE, condition))
            if response is None:
                continue
            stretch, torque = intrinsic_loop(response.subject, np.sqrt(2.0) * response.stretch)
            for element, ax in enumerate(row):
                ax.plot(np.degrees(stretch[:, element]), torque[:, element], color=look["color"])
        handles += [Line2D([], [], color=look["color"], label=name) for name, look in drawn]
        row[0].set_ylabel("torque [Nm]")
    for ax, name in zip(panels[0], ELEMENTS, strict=True):
        ax.set_title(name)
    for ax in panels[-1]:
        ax.set_xlabel("stretch [°]")
    legend(figure, *handles)
    return figure


@in_style()
def admittance(yielding: Yielding) -> Figure:
    """Gain of the diagonal of the admittance at each amplitude, with the whole law and with linear muscle."""
    figure = new_figure(5.4)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    handles = []
    for column, (task, conditions) in zip(panels.T, AMPLITUDES.items(), strict=True):
        for condition, its in looks(task, conditions):
            looks_of: dict[str, dict[str, Any]] = {
                WHOLE: {**its, "markersize": 3.5},
                LINEAR: {"color": its["color"], "linestyle": (0, (4, 2)), "linewidth": 1.0},
            }
            for variant, look in looks_of.items():
                response = yielding.responses.get((variant, condition))
                if response is None:
                    continue
                for axis, ax in enumerate(column):
                    ax.loglog(response.frequency, response.gain[:, axis, axis], **look)
            handles.append(Line2D([], [], label=condition, **looks_of[WHOLE]))
        above, below = (conditions[-1], conditions[0]) if task == "RT" else (conditions[0], conditions[-1])
        factors = [yielding.rise(variant, above, below) for variant in (WHOLE, LINEAR)]
        texts = [f"{factor:.2f}" if np.isfinite(factor) else "none" for factor in factors]
        column[0].set_title(f"{above} / {below} at low f: {texts[0]}, linear {texts[1]}")
    for name, ax in zip(AXES, panels[:, 0], strict=True):
        ax.set_ylabel(f"$|H_{{{2 * name}}}|$ [m/N]")
    for ax in panels[-1]:
        label_frequency(ax)
    handles.append(Line2D([], [], color=GREY, linestyle=(0, (4, 2)), linewidth=1.0, label=LINEAR))
    legend(figure, *handles, n_columns=7)
    return figure


@in_style()
def pulses(yielding: Yielding) -> Figure:
    """Distance of the handle after pulses, with the whole law and without each mechanism."""
    figure = new_figure(4.3)
    panels = figure.subplots(1, len(PULSES))
    drawn: set[str] = set()
    lines: dict[str, dict[str, Any]] = {
        WHOLE: {"color": INK, "linewidth": 2.4},
        LINEAR: {"color": GREY, "linewidth": 1.8},
    }
    others = [name for name in yielding.variants if name not in lines]
    styles = zip(others, itertools.cycle(PALETTE), itertools.cycle(DASHES), strict=False)
    lines |= {name: {"color": colour, "linestyle": dashes} for name, colour, dashes in styles}
    for ax, (condition, level) in zip(panels, PULSES.items(), strict=True):
        whole = yielding.responses.get((WHOLE, condition))
        for variant, look in lines.items():
            response = yielding.responses.get((variant, condition))
            # An arm that is the same as with the whole law would hide it.
            if response is not None and (variant == WHOLE or whole is None or response.subject != whole.subject):
                ax.plot(response.time, 100.0 * response.distance, **look)
                drawn.add(variant)
        ax.set(title=f"{condition}, level {level:g}", xlabel="time after the onset [s]")
        ax.set_xlim(left=0.0)
    panels[1].sharey(panels[0])
    for ax in panels:
        ax.set_ylim(bottom=0.0)
    panels[0].set_ylabel("distance from the start [cm]")
    handles = [Line2D([], [], label=name, **look) for name, look in lines.items() if name in drawn]
    legend(figure, *handles, n_columns=3)
    return figure
