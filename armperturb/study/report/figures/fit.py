"""Figures of the arm model's fits, and of what they predict of the multisine (thesis figures 3.7 to 3.11, C.1)."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit.admittance_problem import penalty_factor
from armperturb.analysis.measures.vaf import variance_accounted_for
from armperturb.arrays import Array
from armperturb.plots.panels import AXES, FREQUENCY, admittance_panels, legend, plot_admittance
from armperturb.plots.style import COLOURS, FITTED, INK, PUBLISHED, RECORDED, in_style, new_figure
from armperturb.study.published import tables as published
from armperturb.study.report.figures import groups
from armperturb.study.report.figures.axes import plot_truth
from armperturb.study.report.figures.people import fit_labels
from armperturb.study.results.cases import Case
from armperturb.study.results.mean_admittance import perturbed_conditions
from armperturb.study.results.study_result import StudyResult
from armperturb.subject import TASKS

VAF_TABLES = {"PT7.5": ("E.5", "3b", "vartheta_i5"), "PT": ("C.12", "3", ""), "RT": ("C.22", "1", "")}
"""Condition, or task of the others, to table, model and start of the printed VAF; PT7.5 alone has a fit of model 3b."""


@in_style()
def fit(case: Case) -> Figure:
    """Arm model fitted to the admittance of one subject, and a linear one's own (thesis figs 3.7, 3.8)."""
    identification = case.identified
    spectra = identification.spectra
    model = arm_admittance(identification.fit.arm, FREQUENCY)
    estimated: dict[str, Any] = {**RECORDED, "marker": "o", "markersize": 4.5}
    figure, panels = admittance_panels()
    plot_admittance(panels, spectra.frequency, spectra.arm, (FREQUENCY, model), **estimated)
    plot_admittance(panels, FREQUENCY, model, **FITTED)
    legend(
        figure,
        Line2D([], [], label="estimated", **estimated),
        Line2D([], [], label=f"fitted model {identification.fit.structure}", **FITTED),
        *plot_truth(panels, case),
    )
    return figure


@in_style()
def prediction(case: Case, *, trial: int = 0, start: float = 20.0, span: float = 5.0) -> Figure:
    """Recorded displacement of the handle against the fitted model's (thesis figs 3.9, 3.10).

    Args:
      case: who, in which condition.
      trial: which of the trials that were analysed.
      start: of the part that is shown [s]; earlier where the trial ends before that part does.
      span: of the part that is shown [s].
    """
    identification, recording = case.identified, case.trials().isel(trial=trial)
    rate, onset = float(recording.attrs["rate"]), float(recording["pulse_onset"])
    n = recording.sizes["time"] if np.isnan(onset) else round(onset * rate)
    time, recorded = recording["time"].values[:n], recording["displacement"].values[:n]
    predicted = None
    if identification.fit.stable:
        d = recording["perturbation"].values[:n]
        predicted = simulate_linear(identification.fit.arm, identification.environment, d, rate).displacement
    start = max(0.0, min(start, time[-1] - span))
    shown = (time >= start) & (time <= start + span)

    figure = new_figure(3.5)
    panels = figure.subplots(2, 1, sharex=True)
    for axis, ax in enumerate(panels):
        ax.plot(time[shown], 1e3 * recorded[shown, axis], label="recorded", **RECORDED)
        if predicted is None:
            ax.set_title("the fitted model is unstable: no prediction", loc="left")
        else:
            vaf = variance_accounted_for(recorded, predicted, rate)[axis]
            ax.plot(time[shown], 1e3 * predicted[shown, axis], label="fitted model", **FITTED)
            ax.set_title(f"along {AXES[axis]}: VAF {vaf:.1f} %", loc="left")
        ax.set(ylabel=f"${AXES[axis]}$ [mm]", xlim=(start, start + span))
    panels[-1].set_xlabel("time [s]")
    panels[0].legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, borderaxespad=0)
    return figure


@in_style()
def vaf(study: StudyResult) -> Figure:
    """VAF of the linear and the nonlinear skeletal model: people's means over trials (thesis fig. 3.11).

    As in the thesis's tables, trials count whose VAF is positive along both axes. The published values are those of the
    linear model: table E.5 in PT7.5, model 3 of table C.12 in the other position tasks, and table C.22 in RT.
    """
    of_task = {task: [condition.name for condition in perturbed_conditions(study, task)] for task in TASKS}
    tasks = [task for task, conditions in of_task.items() if any(_vafs(study, c, "linear") for c in conditions)]
    looks = list(zip(groups.MODEL_LOOKS.items(), groups.MARKERS, strict=False))
    figure = new_figure(4.8)
    panels = figure.subplots(2, len(tasks), sharey=True, squeeze=False)
    drawn = []
    for column, task in zip(panels.T, tasks, strict=True):
        for axis, ax in enumerate(column):
            drawn_here = {
                condition: [
                    groups.Series(
                        {name: float(mean[axis]) for name, mean in _vafs(study, condition, model).items()},
                        look["color"],
                        marker,
                        _printed_vaf(condition, axis) if model == "linear" else groups.NOTHING_PRINTED,
                    )
                    for (model, look), marker in looks
                ]
                for condition in of_task[task]
                if _vafs(study, condition, "linear")
            }
            drawn.append(drawn_here)
            groups.draw_groups(ax, drawn_here)
            fit_labels(ax)
            ax.set(ylim=(0, 100), ylabel=f"VAF along {AXES[axis]} [%]" if task == tasks[0] else "")
    printed = groups.printed_handles(drawn, label="published mean ± SD, linear model")
    legend(figure, *groups.model_handles(), groups.mean_handle(groups.mean_label(drawn)), *printed)
    return figure


def _vafs(study: StudyResult, condition: str, model: str) -> dict[str, Array]:
    """Person to the mean over trials of the VAF that is positive along both axes [%], (axis,); only those with any."""
    means = {}
    for person in study.people:
        its = [trial for trial in person.trials if trial.condition == condition and np.isfinite(trial.vaf_linear).all()]
        values = np.array([getattr(trial, f"vaf_{model}") for trial in its]).reshape(-1, 2)
        if (positive := (values > 0.0).all(axis=1)).any():
            means[person.name] = values[positive].mean(axis=0)
    return means


def _printed_vaf(condition: str, axis: int) -> published.MeanSD:
    if condition not in published.conditions():
        return groups.NOTHING_PRINTED
    table, *fit = VAF_TABLES.get(condition, VAF_TABLES[condition[:2]])
    wanted = (table, condition, *fit, f"VAF_{AXES[axis]}")
    return next(entry.value for entry in published.fit_entries() if entry[:5] == wanted)


@in_style()
def penalty(study: StudyResult) -> Figure:
    """The factor on the error that keeps fits stable, and where the poles of the fits lie (thesis fig. C.1)."""
    figure = new_figure(3.1)
    curve, *places = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    pole = np.linspace(-1.5, 0.25, 351)
    curve.plot(pole, [penalty_factor(value) for value in pole], **FITTED)
    curve.set(yscale="log", xlim=(pole[0], pole[-1]), ylim=(0.5, 1e9), ylabel="penalty factor [-]")
    inactive = published.headline("penalty_inactive_below")
    curve.axvline(inactive, **PUBLISHED, linestyle="--")
    curve.text(inactive - 0.02, 1e8, f"published: acts right of −{-inactive:g}", ha="right", color=PUBLISHED["color"])
    curve.axvline(0.0, color=INK, linewidth=0.8)
    curve.text(0.02, 3.0, "unstable")
    for ax in places:
        for row, task in enumerate(TASKS):
            conditions = [condition.name for condition in perturbed_conditions(study, task)]
            estimates = [person.estimates[c] for person in study.people for c in conditions if c in person.estimates]
            poles = [fit.largest_real_pole for estimate in estimates for fit in estimate.fits]
            ax.plot(poles, np.full(len(poles), -row), "|", color=COLOURS[task], markersize=9, alpha=0.6, label=task)
        ax.set_yticks((0, -1), TASKS)
        ax.set(ylim=(-1.6, 0.6), xlabel="largest real part of a pole of arm and manipulator [1/s]", ylabel="fits")
        ax.grid(visible=False)
    return figure
