"""Figures of EMG: co-contraction of everybody, and envelopes, answers to pulses and reflexes of one person."""

from matplotlib.figure import Figure

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.onset import Onsets
from armperturb.analysis.emg.reflex import Reflexes
from armperturb.plots.style import in_style, new_figure
from armperturb.study.comparison.cocontraction import index_of
from armperturb.study.protocol import Condition
from armperturb.study.report.figures.people import draw_people, fit_labels, with_margins
from armperturb.study.results.emg import PersonEmg


@in_style()
def cocontraction(people: tuple[PersonEmg, ...], conditions: tuple[Condition, ...]) -> Figure:
    """Index of co-contraction of every person in every condition, by joint.

    Args:
      people: with EMG of one unit.
      conditions: of the protocol.
    """
    figure = new_figure(4.2)
    axes = figure.subplots(2, 1, sharex=True)
    for ax, joint in zip(axes, ("shoulder", "elbow"), strict=True):
        indices = {person.name: index_of(person, joint) for person in people}
        groups: dict[str, dict[str, dict[str, float]]] = {}
        for condition in conditions:
            values = {name: 100.0 * of[condition.name] for name, of in indices.items() if condition.name in of}
            if values and condition.contraction is None:
                groups.setdefault(condition.task, {})[condition.name] = values
        draw_people(ax, groups, logarithmic=False)
        with_margins(ax)
        ax.set_title(joint, loc="left")
        ax.set_ylabel("index [%]")
    fit_labels(axes[-1])
    figure.suptitle(f"co-contraction in {people[0].unit}", fontsize=9, parse_math=False)
    return figure


def envelopes(of_trial: Envelopes) -> Figure:
    """Amplitude of every muscle over a trial."""
    figure = new_figure(4.0)
    of_trial.plot(figure)
    return figure


def pulses(onsets: Onsets) -> Figure:
    """Averages of all muscles about pulses, and when they answer."""
    figure = new_figure(4.0)
    onsets.plot(figure)
    return figure


def reflexes(of_condition: Reflexes) -> Figure:
    """Responses of all muscles to rotation."""
    figure = new_figure(4.0)
    of_condition.plot(figure)
    return figure
