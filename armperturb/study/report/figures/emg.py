"""Figures of EMG: co-contraction of everybody, and envelopes, answers to pulses and reflexes of one person."""

from matplotlib.figure import Figure

from armperturb.analysis.emg.envelope import envelopes
from armperturb.analysis.emg.onset import onsets
from armperturb.analysis.emg.reflex import reflexes
from armperturb.analysis.trials import trials_by_condition
from armperturb.plots.style import in_style, new_figure
from armperturb.recording_files import load_recording
from armperturb.study.comparison.cocontraction import index_of
from armperturb.study.protocol import Condition
from armperturb.study.report.figures.people import draw_people
from armperturb.study.results.cases import Case
from armperturb.study.results.emg import PersonEmg

SHOWN = ("emg_envelopes", "emg_pulses", "emg_reflexes")


@in_style()
def cocontraction(people: tuple[PersonEmg, ...], conditions: tuple[Condition, ...]) -> Figure:
    """Index of co-contraction of every person in every condition, by joint.

    Args:
      people: with EMG.
      conditions: of the protocol.
    """
    figure = new_figure(4.2)
    axes = figure.subplots(2, 1, sharex=True)
    unit = next(person.unit for person in people if person.unit)
    for ax, joint in zip(axes, ("shoulder", "elbow"), strict=True):
        indices = {person.name: index_of(person, joint) for person in people}
        groups: dict[str, dict[str, dict[str, float]]] = {}
        for condition in conditions:
            values = {name: 100.0 * of[condition.name] for name, of in indices.items() if condition.name in of}
            if values and condition.contraction is None:
                groups.setdefault(condition.task, {})[condition.name] = values
        draw_people(ax, groups, logarithmic=False)
        ax.set_ylim(bottom=0.0)
        ax.set_title(joint, loc="left")
        ax.set_ylabel("index [%]")
    figure.suptitle(f"co-contraction in {unit}", fontsize=9, parse_math=False)
    return figure


def of_person(name: str, case: Case) -> Figure:
    """One of the figures `SHOWN` of a person in the condition of a case.

    Args:
      name: of the figure.
      case: whose recording is read.
    """
    recording = load_recording(case.recording, ["emg", "joint_angle"])
    amplitudes, trials = envelopes(recording), trials_by_condition(recording, is_checked=True)
    figure, label = new_figure(4.0), case.condition.name
    if name == "emg_envelopes":
        amplitudes.plot(figure, trial=int((amplitudes.labels["condition"] == label).to_numpy().argmax()))
    elif name == "emg_pulses":
        same = [part for part in trials.values() if part.recording["task"].values[0] == case.condition.task]
        onsets([part for part in same if (part.onset < part.n_samples).any()], amplitudes).plot(figure)
    else:
        reflexes(trials[label], amplitudes).plot(figure)
    return figure
