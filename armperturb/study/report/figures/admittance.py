"""Figures of the estimated admittance (thesis figures 3.1 to 3.6)."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from armperturb.analysis.response.local_polynomial import N_INPUTS
from armperturb.plots.bands import draw_bands
from armperturb.plots.panels import (
    AXES,
    FREQUENCY,
    Element,
    admittance_panels,
    label_frequency,
    legend,
    plot_admittance,
)
from armperturb.plots.style import COLOURS, GREY, INK, PUBLISHED, in_style, new_figure
from armperturb.study.published import tables as published
from armperturb.study.report.figures.axes import Marks, looks, marks_legend, plot_marks, plot_truth
from armperturb.study.results.cases import Case
from armperturb.study.results.mean_admittance import (
    MeanAdmittance,
    at_usual_frequencies,
    by_task,
    main_conditions,
    mean_admittance,
    mean_curves,
)
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import N_LOW

MATRIX_ELEMENTS: tuple[Element, ...] = ((0, 0), (1, 1), (0, 1), (1, 0))
"""Diagonal first: it is what the thesis's factors are about."""

HIGHEST = 10.0
"""End of the gains on a linear scale [Hz] (figure 3.5)."""

FACTORS = {
    "PT": 1.0 / published.headline("admittance_amplitude_factor_pt"),
    "RT": published.headline("admittance_amplitude_factor_rt"),
}
"""Task to the published gain of the largest over that of the smallest amplitude at the lowest frequencies [-]."""

EXPECTED: dict[str, Any] = {**PUBLISHED, "marker": "_", "linestyle": "", "markersize": 9, "markeredgewidth": 1.8}
"""Where a published factor puts a gain, given another one of ours."""


@in_style()
def admittance_of_trials(case: Case) -> Figure:
    """Admittance of one subject, from each trial and from all, and a linear one's own (thesis fig. 3.1)."""
    spectra = case.identified.spectra
    figure, panels = admittance_panels()
    mean = spectra.frequency, spectra.arm
    for trial in case.single_trials:
        plot_admittance(panels, trial.frequency, trial.arm, mean, color=GREY, linewidth=0.7, alpha=0.6)
    plot_admittance(panels, spectra.frequency, spectra.arm, color=INK, linewidth=1.5)
    single = Line2D([], [], color=GREY, linewidth=0.9, alpha=0.6, label="single trials")
    legend(
        figure,
        *([single] if case.single_trials else []),
        Line2D([], [], color=INK, linewidth=1.5, label="spectra averaged over trials"),
        *plot_truth(panels, case),
    )
    return figure


@in_style()
def admittance_by_task(study: StudyResult) -> Figure:
    """Admittance of each task's main condition, mean and SD over subjects (thesis fig. 3.2)."""
    figure, panels = admittance_panels()
    handles: list[Line2D | Patch] = []
    expected = None
    curves = dict(zip([condition.name for condition in study.conditions], mean_curves(study), strict=True))
    for task, condition in main_conditions(study).items():
        curve = curves[condition.name]
        look: dict[str, Any] = {"color": COLOURS[task], "marker": "o", "markersize": 3}
        draw_bands(panels, curve, {"color": COLOURS[task], "alpha": 0.18, "linewidth": 0})
        plot_admittance(panels, curve.frequency, curve.response, **look)
        handles.append(Line2D([], [], label=condition.name, **look))
        if condition.name == "PT7.5":
            factor = published.headline("admittance_ratio_rt7.5_pt7.5")
            for axis in range(2):
                gain = factor * np.abs(curve.response[:N_LOW, axis, axis])
                panels[axis, axis][0].plot(curve.frequency[:N_LOW], gain, **EXPECTED)
            expected = Line2D([], [], label=f"{condition.name} × {factor:g}, published", **EXPECTED)
    if expected is not None and len(handles) > 1:
        handles.append(expected)
    if study.n_people > 1:
        handles.append(Patch(facecolor=GREY, alpha=0.3, label="± 1 SD over people"))
    legend(figure, *handles)
    return figure


@in_style()
def admittance_by_amplitude(study: StudyResult, task: str, marks: Marks | None = None) -> Figure:
    """Admittance of all conditions of a task, mean over subjects (thesis figs 3.3, 3.4).

    Args:
      study: in which somebody was identified in the task.
      task: "PT" or "RT".
      marks: where the gains of the conditions differ.
    """
    figure, panels = admittance_panels()
    handles = []
    drawn = looks(task, by_task(study)[task])
    means = [mean_admittance(study, condition.name) for condition, _ in drawn]
    # In the turn of all conditions together, so that noise in one does not part it from the others.
    near = None
    if are_alike := _are_alike(means):
        near = means[0].frequency, np.exp(1j * np.array([mean.phase for mean in means])).sum(axis=0)
    for mean, (condition, look) in zip(means, drawn, strict=True):
        plot_admittance(panels, mean.frequency, mean.gain * np.exp(1j * mean.phase), near, **look, markersize=3.5)
        handles.append(Line2D([], [], label=condition.name, **look))
    for element, masks in (marks or {}).items() if are_alike else ():
        highest = np.max([mean.gain[:, *element] for mean in means], axis=0)
        plot_marks(panels[element][0], means[0].frequency, 1.7 * highest, masks)
    legend(figure, *handles, *(marks_legend() if marks else ()))
    return figure


def _are_alike(means: Sequence[MeanAdmittance]) -> bool:
    """Whether conditions are known at the same frequencies."""
    return all(np.array_equal(mean.frequency, means[0].frequency) for mean in means)


@in_style()
def gain_linear_scale(study: StudyResult, marks: Mapping[str, Marks] | None = None) -> Figure:
    """Gain of all conditions on a linear scale up to 10 Hz, mean over subjects (thesis fig. 3.5).

    At the lowest two frequencies stands also where the published factor puts the gain of the largest amplitude, given
    that of the smallest.

    Args:
      study: in which somebody was identified.
      marks: task to where the gains of its conditions differ.
    """
    tasks = by_task(study)
    figure = new_figure(2.3 * len(tasks) + 0.6)
    panels = figure.subplots(len(tasks), len(MATRIX_ELEMENTS), sharex=True, sharey="row", squeeze=False)
    named: list[list[Line2D]] = []
    expected = []
    for row, task in zip(panels, tasks, strict=True):
        drawn = looks(task, tasks[task])
        means = [mean_admittance(study, condition.name) for condition, _ in drawn]
        named.append([Line2D([], [], label=condition.name, **look) for condition, look in drawn])
        ends = (drawn[0][0].name, drawn[-1][0].name)
        shown = means[0].frequency <= HIGHEST
        frequency, highest = (
            means[0].frequency[shown],
            1e3 * max(mean.gain[mean.frequency <= HIGHEST].max() for mean in means),
        )
        for ax, element in zip(row, MATRIX_ELEMENTS, strict=True):
            of_element = [1e3 * mean.gain[mean.frequency <= HIGHEST][:, *element] for mean in means]
            for mean, values, (_, look) in zip(means, of_element, drawn, strict=True):
                ax.plot(mean.frequency[mean.frequency <= HIGHEST], values, **{**look, "markersize": 3})
            if marks and element in marks.get(task, {}) and _are_alike(means):
                differs, clearly = marks[task][element]
                height = np.max(of_element, axis=0) + 0.08 * highest
                plot_marks(ax, frequency, height, (differs[shown], clearly[shown]))
            if element[0] == element[1] and ends == (f"{task}2.5", f"{task}22.5"):
                expected.append(ax.plot(frequency[:N_LOW], FACTORS[task] * of_element[0][:N_LOW], **EXPECTED))
        row[0].set_ylabel(f"gain in {task} [mm/N]")
        row[0].set_ylim(0, 1.16 * highest)
    for ax, (output, input_) in zip(panels[0], MATRIX_ELEMENTS, strict=True):
        ax.set_title(f"$|H_{{{AXES[output]}{AXES[input_]}}}|$")
    for ax in panels[-1]:
        ax.set_xscale("log")
        label_frequency(ax)
        ax.set_xlim(FREQUENCY[0], 1.1 * HIGHEST)
    # Legends run down their columns: a row for each task.
    handles = [handle for column in itertools.zip_longest(*named) for handle in column if handle is not None]
    if expected:
        handles.append(Line2D([], [], label="published factor", **EXPECTED))
    legend(figure, *handles, *(marks_legend() if marks else ()), n_columns=6 if len(tasks) == 1 else 5)
    return figure


@in_style()
def coherence(study: StudyResult) -> Figure:
    """Multiple coherence of single trials, mean and SD over subjects (thesis fig. 3.6)."""
    n_columns = max(2, min(3, max(map(len, by_task(study).values()))))
    blocks = [
        conditions[first : first + n_columns]
        for conditions in by_task(study).values()
        for first in range(0, len(conditions), n_columns)
    ]
    figure = new_figure(3.3 * len(blocks) + 0.3)
    parts = figure.subfigures(len(blocks), 1, squeeze=False)
    for number, (part, block) in enumerate(zip(parts.flat, blocks, strict=True)):
        panels = part.subplots(2, n_columns, sharex=True, sharey=True, squeeze=False)
        for column, condition in zip(panels.T, block, strict=False):
            _draw_coherence(column, study.of(condition.name))
            column[0].set_title(condition.name, parse_math=False)
            label_frequency(column[-1])
        for column in panels.T[len(block) :]:
            for ax in column:
                ax.set_visible(False)
        for output, ax in enumerate(panels[:, 0]):
            ax.set_ylabel(rf"$\gamma^2_{{{AXES[output]}d}}$ [-]")
        if number == 0:
            panels[0, 0].text(0.02, 0.04, "dotted: noise", color=GREY, fontsize=8, transform=panels[0, 0].transAxes)
    return figure


def _draw_coherence(column: NDArray[np.object_], cases: list[Case]) -> None:
    """The coherence of a condition's displacement along x, and along y below."""
    cases = [case for case in at_usual_frequencies(cases) if case.single_trials]
    if not cases:
        return
    n_points = len(cases[0].single_trials[0].frequency)
    cases = [case for case in cases if len(case.single_trials[0].frequency) == n_points]
    of_subjects = np.stack([np.mean([trial.coherence for trial in case.single_trials], axis=0) for case in cases])
    spread = of_subjects.std(axis=0, ddof=1) if len(of_subjects) > 1 else None
    mean, frequency = of_subjects.mean(axis=0), cases[0].single_trials[0].frequency
    look: dict[str, Any] = {"markersize": 3, "elinewidth": 0.9, "color": COLOURS[cases[0].condition.task]}
    for output, ax in enumerate(column):
        ax.errorbar(frequency, mean[:, output], None if spread is None else spread[:, output], fmt="o-", **look)
        ax.plot(frequency, N_INPUTS / cases[0].single_trials[0].n_averages, color=GREY, linewidth=1, linestyle=":")
        ax.set(xscale="log", ylim=(0, 1.05))
