"""Figure of the estimated joint parameters in all conditions, by maximum likelihood."""

from matplotlib.figure import Figure

from armperturb.analysis.fit.structures import unit
from armperturb.plots.panels import legend
from armperturb.plots.style import in_style, new_figure
from armperturb.study.published import tables as published
from armperturb.study.report.figures.groups import PRINTED, printed_handle
from armperturb.study.report.figures.parameters import JOINT_NAMES, QUANTITIES
from armperturb.study.report.figures.people import ASIDE, draw_people, fit_labels, people_legend, with_margins
from armperturb.study.report.tables import published_or_nan
from armperturb.study.results.mean_admittance import by_task
from armperturb.study.results.study_result import StudyResult


def estimated_quantities(study: StudyResult) -> list[str]:
    """Those of which somebody has an estimate at a joint."""
    conditions = [condition for of_task in by_task(study).values() for condition in of_task]
    cases = [case for condition in conditions for case in study.of(condition.name)]
    known = {name for case in cases for name in case.identified.fit.values}
    return [quantity for quantity in QUANTITIES if any(f"{quantity}_{joint}" in known for joint in JOINT_NAMES)]


@in_style()
def estimates(study: StudyResult) -> Figure:
    """Maximum likelihood estimates of each person in each condition, their means, and the published mean and SD.

    Args:
      study: in which somebody was identified.
    """
    values: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for task, conditions in by_task(study).items():
        for condition in conditions:
            for case in study.of(condition.name):
                for name, value in case.identified.fit.values.items():
                    of_task = values.setdefault(name, {}).setdefault(task, {})
                    of_task.setdefault(condition.name, {})[case.name] = value
    shown = estimated_quantities(study)
    figure = new_figure(1.75 * len(shown) + 0.5)
    panels = figure.subplots(len(shown), len(JOINT_NAMES), squeeze=False)
    any_printed = False
    for row, quantity in zip(panels, shown, strict=True):
        for ax, (joint, title) in zip(row, JOINT_NAMES.items(), strict=True):
            name = f"{quantity}_{joint}"
            if name not in values:
                ax.set_visible(False)
                continue
            for label, place in draw_people(ax, values[name], logarithmic=False).items():
                printed = published_or_nan(published.parameter, label, name)
                if printed.mean == printed.mean:
                    any_printed = True
                    ax.errorbar(place - ASIDE, printed.mean, printed.sd, **PRINTED, elinewidth=1.0, capsize=2)
            ax.set_xlim(left=-0.6)
            with_margins(ax)
            ax.tick_params(axis="x", labelsize=6.5)
            fit_labels(ax)
            if quantity == shown[0]:
                ax.set_title(title)
        row[0].set_ylabel(f"{QUANTITIES[quantity]} [{unit(f'{quantity}_s')}]")
    handles = people_legend(by_task(study), len(study.names))
    if any_printed:
        handles.append(printed_handle())
    legend(figure, *handles)
    return figure
