"""Figures of estimated parameters (thesis figures 3.12 to 3.14)."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from armperturb.analysis.fit.structures import unit
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.pages.formats import letter_and_subscript
from armperturb.plots.panels import legend, padded
from armperturb.plots.style import BESIDE, GREY, PALE, PUBLISHED, TRUE, in_style, new_figure
from armperturb.study.published import tables as published
from armperturb.study.published.tables import MeanSD
from armperturb.study.report.figures.axes import looks
from armperturb.study.report.figures.groups import (
    BESIDE_MEAN,
    Groups,
    Series,
    draw_groups,
    mean_handle,
    mean_label,
    people_handle,
    printed_handles,
    stars,
)
from armperturb.study.report.tables import groups_of, parameter_rows, published_or_nan
from armperturb.study.results.mean_admittance import by_task, perturbed_conditions
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import muscle_parameter, stable_mean
from armperturb.subject import TASKS

QUANTITIES = {"b": "damping", "k": "stiffness", "kv": "velocity\nfeedback", "kp": "position\nfeedback"}
"""What is drawn of a joint, and what it is called."""

JOINT_NAMES = {"s": "shoulder", "se": "shoulder-elbow", "e": "elbow"}
MUSCLE_NAMES = {"s*": "shoulder", "se": "shoulder-elbow", "e*": "elbow"}

SEM_TABLES = {"PT7.5": "E.4", "RT2.5": "C.17", "RT7.5": "C.19", "RT22.5": "C.21"}
"""Condition to the table of the SEMs of `published.PARAMETER_TABLES`."""

Estimates = Mapping[str, Sequence[ThesisEstimate]]
"""Condition to one estimate per person."""


@in_style()
def parameters(study: StudyResult, task: str) -> Figure:
    """Estimated against true parameters of linear people in a task's conditions, beside the published mean and SD.

    Bars are 95 % intervals; what the thesis's estimator gives beyond a panel is drawn at its edge.
    """
    conditions = looks(task, by_task(study)[task])
    shown = [
        row for row in parameter_rows(study) if row["condition"] in {condition.name for condition, _ in conditions}
    ]
    n_columns = 5
    n_rows = -(-len({row["parameter"] for row in shown}) // n_columns)
    figure = new_figure(1.75 * n_rows + 0.6)
    panels = list(figure.subplots(n_rows, n_columns, squeeze=False).flat)
    any_printed = False
    for (name,), rows in groups_of(shown, "parameter"):
        ax = panels.pop(0)
        printed: list[tuple[MeanSD, str]] = []
        for condition, look in conditions:
            mine = rows[rows["condition"] == condition.name]
            half = np.nan_to_num(mine["upper_95"] - mine["estimated"], posinf=0.0)
            look = {"fmt": look["marker"], "color": look["color"], "markersize": 3.5, "elinewidth": 0.8}
            ax.errorbar(mine["true"], mine["estimated"], half, **look, alpha=0.85)
            mean_sd = published_or_nan(published.parameter, condition.name, name)
            if np.isfinite(mean_sd.mean):
                printed.append((mean_sd, look["fmt"]))
        reach = [end for (mean, sd), _ in printed for end in (mean - sd, mean + sd)]
        (left, high), (bottom, top) = padded([*rows["true"]]), padded([*rows["true"], *rows["estimated"], *reach])
        of_thesis = rows["thesis_estimated"].clip(bottom, top)
        ax.plot(rows["true"], of_thesis, **BESIDE, clip_on=False, zorder=1.5)
        ax.plot((left, high), (left, high), **{**TRUE, "linewidth": 1})
        place_width = 0.11 * (high - left)
        right = high + place_width * (len(printed) + 0.6) if printed else high
        any_printed |= bool(printed)
        ax.axvspan(high, right, color=PALE, alpha=0.35, linewidth=0)
        for place, (value, marker) in enumerate(printed, start=1):
            x = high + (place - 0.2) * place_width
            ax.errorbar(x, value.mean, value.sd, fmt=marker, color=PUBLISHED["color"], markersize=3.5)
        ax.set(xlim=(left, right), ylim=(bottom, top), box_aspect=1)
        ax.set_title(f"{parameter_symbol(name)} [{unit(name)}]")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(3))
    for ax in panels:
        ax.set_visible(False)
    figure.supxlabel("true", fontsize=9)
    figure.supylabel("estimated", fontsize=9)
    handles = [Line2D([], [], linestyle="", label=condition.name, **look) for condition, look in conditions]
    handles.append(Line2D([], [], label="thesis's estimator", **BESIDE))
    handles.append(Line2D([], [], label="estimated = true", **{**TRUE, "linewidth": 1}))
    if any_printed:
        handles.append(Line2D([], [], marker="o", linestyle="", label="published mean ± SD", **PUBLISHED))
    legend(figure, *handles)
    return figure


@in_style()
def joint_parameters(study: StudyResult, task: str, p: Mapping[str, float] | None = None) -> Figure:
    """Joint parameters and their standard errors by both estimators (thesis figs 3.12, 3.13).

    People and their means are by maximum likelihood; beside them stand means over people by the thesis's estimator, of
    each person's mean over stable trials. Standard errors have a logarithmic axis.

    Args:
      study: with estimates in the task, see `estimated`.
      task: "PT" or "RT".
      p: parameter to the p of an effect of the amplitude on it, by the thesis's estimator.
    """
    estimates = estimated(study, task)
    quantities = _quantities(estimates)
    figure = new_figure(1.9 * len(quantities) + 0.9)
    panels = figure.subplots(len(quantities), 2, squeeze=False)
    drawn = []
    for row, quantity in zip(panels, quantities, strict=True):
        for ax, sem in zip(row, (False, True), strict=True):
            sources = Sources(
                partial(_likelihood_errors if sem else _likelihood, study),
                partial(stable_mean, sem=sem),
                partial(published_or_nan, _printed_sem if sem else published.parameter),
            )
            of_quantity = (task, estimates, quantity, JOINT_NAMES)
            drawn.append(_draw(ax, *of_quantity, sources, {} if sem or p is None else p, logarithmic=sem))
    for ax, title in zip(panels[0], ("estimate", "standard error"), strict=True):
        ax.set_title(title)
    legend(figure, *_handles(task, estimates), *_mean_handles(drawn), *printed_handles(drawn), n_columns=4)
    return figure


@in_style()
def muscle_parameters(study: StudyResult, p: Mapping[str, Mapping[str, float]] | None = None) -> Figure:
    """Parameters of muscle groups by both estimators, as `joint_parameters` draws them (thesis fig. 3.14).

    Those of one-joint muscles are the joint's less the two-joint muscles' (eq. 2.10); of these the published tables
    give the mean alone.

    Args:
      study: with estimates in a task, see `estimated`.
      p: task to parameter, with a star for one-joint muscles, to the p of an effect of the amplitude on it.
    """
    tasks = {task: estimates for task in TASKS if (estimates := estimated(study, task))}
    rows = {task: _quantities(estimates) for task, estimates in tasks.items()}
    n_rows = max(map(len, rows.values()))
    figure = new_figure(1.9 * n_rows + 0.9)
    panels = figure.subplots(n_rows, len(tasks), squeeze=False)
    sources = Sources(partial(_likelihood, study), _muscle_mean, _printed_muscle)
    drawn = []
    for column, (task, estimates) in zip(panels.T, tasks.items(), strict=True):
        for ax, quantity in zip(column, rows[task], strict=False):
            drawn.append(_draw(ax, task, estimates, quantity, MUSCLE_NAMES, sources, (p or {}).get(task, {})))
        for ax in column[len(rows[task]) :]:
            ax.set_visible(False)
    handles = [handle for task, estimates in tasks.items() for handle in _handles(task, estimates)]
    legend(figure, *handles, *_mean_handles(drawn), *printed_handles(drawn), n_columns=4)
    return figure


def estimated(study: StudyResult, task: str) -> Estimates:
    """The thesis's estimates in each condition of a task in which there are any, one per person."""
    by_condition = {
        condition.name: [p.estimates[condition.name] for p in study.people if condition.name in p.estimates]
        for condition in perturbed_conditions(study, task)
    }
    return {condition: estimates for condition, estimates in by_condition.items() if estimates}


def _quantities(estimates: Estimates) -> list[str]:
    """Those of `QUANTITIES` that were estimated."""
    names = next(iter(estimates.values()))[0].parameters
    return [quantity for quantity in QUANTITIES if f"{quantity}_s" in names]


class Sources(NamedTuple):
    """Where values of a parameter come from.

    Attributes:
      likelihood: condition and name to each person's value by maximum likelihood.
      thesis: of a person's estimate and name, the value by the thesis's estimator.
      printed: condition and name to what the thesis printed.
    """

    likelihood: Callable[[str, str], Mapping[str, float]]
    thesis: Callable[[ThesisEstimate, str], float]
    printed: Callable[[str, str], MeanSD]


def _likelihood(study: StudyResult, condition: str, name: str) -> dict[str, float]:
    """Person to the maximum likelihood estimate of a parameter, of a muscle group if its name has a star."""
    values = {}
    for case in study.of(condition):
        fitted = case.identified.fit.values
        if {name.replace("*", ""), f"{name.split('_')[0]}_se"} <= fitted.keys():
            values[case.name] = muscle_parameter(name, fitted.__getitem__)
    return values


def _likelihood_errors(study: StudyResult, condition: str, name: str) -> dict[str, float]:
    """Person to the standard error of the maximum likelihood estimate of a joint's parameter."""
    errors = {case.name: case.identified.fit.standard_error for case in study.of(condition)}
    return {person: of_person[name] for person, of_person in errors.items() if name in of_person}


def _muscle_mean(estimate: ThesisEstimate, name: str) -> float:
    return muscle_parameter(name, partial(stable_mean, estimate))


def _printed_muscle(condition: str, name: str) -> MeanSD:
    printed = partial(published_or_nan, published.parameter, condition)
    mean = muscle_parameter(name, lambda joint: printed(joint).mean)
    return MeanSD(mean, math.nan if name.endswith("*") else printed(name).sd)


def _printed_sem(condition: str, name: str) -> MeanSD:
    where = {**published.PARAMETER_TABLES[condition], "table": SEM_TABLES[condition]}
    return published.estimate(name, quantity="SEM", **where)


def _handles(task: str, estimates: Estimates) -> list[Line2D]:
    handles = []
    for condition, look in looks(task, list(estimates)):
        handles.append(people_handle(f"people, {condition}", look["color"], look["marker"]))
    return handles


def _mean_handles(drawn: Iterable[Groups]) -> list[Line2D]:
    return [mean_handle(mean_label(drawn)), mean_handle("the same, thesis's estimator", BESIDE_MEAN)]


def _draw(
    ax: Axes,
    task: str,
    estimates: Estimates,
    quantity: str,
    places: Mapping[str, str],
    sources: Sources,
    p: Mapping[str, float],
    *,
    logarithmic: bool = False,
) -> Groups:
    """A group of people for each place, a series for each condition; with stars where the parameter has a small p."""
    names = {place: f"{quantity}_{letters}" for letters, place in places.items()}
    groups = {
        place: [
            Series(
                sources.likelihood(condition, name),
                look["color"],
                look["marker"],
                sources.printed(condition, name),
                {estimate.subjects[0]: sources.thesis(estimate, name) for estimate in estimates[condition]},
            )
            for condition, look in looks(task, list(estimates))
        ]
        for place, name in names.items()
    }
    tops = draw_groups(ax, groups, joined=False, logarithmic=logarithmic)
    for group, (place, top) in enumerate(tops.items()):
        ax.text(group, top, stars(p.get(names[place], 1.0)), ha="center", va="bottom", fontsize=11)
    if not logarithmic:
        ax.axhline(0.0, color=GREY, linewidth=0.8)
        ax.margins(y=0.16)
        ax.yaxis.set_major_locator(MaxNLocator(4))
    ax.set_ylabel(f"{QUANTITIES[quantity]} [{unit(quantity)}]")
    return groups


def parameter_symbol(name: str) -> str:
    """A parameter as mathematical text, e.g. kv_se as k with the subscript v,se."""
    letter, subscript = letter_and_subscript(name)
    return f"${letter}_{{\\mathrm{{{subscript}}}}}$"
