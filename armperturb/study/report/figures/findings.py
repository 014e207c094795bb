"""The summary figure of the report: every person in every condition, with means over people and 95 % intervals."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from armperturb.plots.panels import label_frequency
from armperturb.plots.style import COLOURS, GREY, in_style, new_figure
from armperturb.study.report.figures.people import draw_people, fit_labels
from armperturb.study.report.findings import excesses, geometric_mean, low_gain
from armperturb.study.results.mean_admittance import at_usual_frequencies, by_task, main_conditions
from armperturb.study.results.study_result import StudyResult


@in_style()
def findings(study: StudyResult) -> Figure:
    """Low-frequency gain in each condition, its course over frequency in each task, and recorded over predicted peaks.

    Args:
      study: in which somebody was identified.
    """
    excess: dict[str, dict[str, dict[str, float]]] = {}
    for condition, level, values in excesses(study):
        excess.setdefault(condition.task, {})[f"{condition.name}\n{level}"] = values
    figure = new_figure(5.3, width=6.2)
    if excess:
        grid = figure.subplot_mosaic(
            [["gain", "gain"], ["course", "excess"]], height_ratios=(1.0, 1.05), width_ratios=(1.0, 1.45)
        )
        draw_people(grid["excess"], excess)
        grid["excess"].axhline(1.0, color=GREY, linewidth=0.9)
        grid["excess"].set_title("c  Pulses against the linear arm", loc="left")
        grid["excess"].set_ylabel("recorded / predicted peak [-]")
        grid["excess"].yaxis.set_major_locator(FixedLocator([0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0]))
        grid["excess"].tick_params(axis="x", labelsize=7.5)
        fit_labels(grid["excess"])
    else:
        grid = figure.subplot_mosaic([["gain"], ["course"]])
    gains = {
        task: {
            condition.name: {case.name: 1e3 * low_gain(case) for case in study.of(condition.name)}
            for condition in those
        }
        for task, those in by_task(study).items()
    }
    draw_people(grid["gain"], gains)
    fit_labels(grid["gain"])
    grid["gain"].set_title("a  Admittance at low frequencies", loc="left")
    grid["gain"].set_ylabel("gain [mm/N]")
    _draw_course(grid["course"], study)
    grid["course"].set_title("b  Along x, over frequency", loc="left")
    return figure


def _draw_course(ax: Axes, study: StudyResult) -> None:
    """Gain along x of each task's main condition: people, and their geometric mean with its 95 % interval."""
    for task, condition in main_conditions(study).items():
        cases = at_usual_frequencies(study.of(condition.name))
        frequency = cases[0].identified.spectra.frequency
        gains = 1e3 * np.abs([case.identified.spectra.arm[:, 0, 0] for case in cases])
        ax.plot(frequency, gains.T, color=COLOURS[task], linewidth=0.5, alpha=0.22)
        means = np.array([geometric_mean(values) for values in gains.T])
        if len(cases) > 1:
            ax.fill_between(frequency, means[:, 1], means[:, 2], color=COLOURS[task], alpha=0.3, linewidth=0)
        ax.plot(frequency, means[:, 0], color=COLOURS[task], linewidth=1.8)
        ax.text(frequency[0], means[0, 0] * 1.25, condition.name, color=COLOURS[task], va="bottom", parse_math=False)
    ax.set(xscale="log", yscale="log", ylabel="gain [mm/N]")
    label_frequency(ax)
