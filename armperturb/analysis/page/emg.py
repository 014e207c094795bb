"""The section EMG of the page: whether muscles were active, how they answer to rotation and to pulses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armperturb.analysis.emg.activity import Activity, activity, relaxation_sentence
from armperturb.analysis.emg.envelope import REST, Envelopes
from armperturb.analysis.emg.onset import Onsets, onsets
from armperturb.analysis.emg.reflex import Reflexes, reflexes
from armperturb.analysis.results import Description
from armperturb.analysis.trials import ConditionTrials
from armperturb.pages.page import Picture
from armperturb.plots.style import new_figure
from armperturb.subject import Subject


@dataclass(frozen=True, kw_only=True)
class EmgSection:
    """What the page says of EMG.

    Attributes:
      sentence: whether the person relaxed; empty where no condition asked for that.
      unit: of amplitudes.
      tables: name to what a table says.
      pictures: name to a figure.
      conditions: of which there is a figure of the response to rotation.
      has_index: whether there is an index of co-contraction.
      has_pulses: whether any trial has a pulse that EMG goes with.
      left_out: why an answer to rotation or to pulses is not shown, a line each.
    """

    sentence: str
    unit: str
    tables: Mapping[str, Description]
    pictures: Mapping[str, Picture]
    conditions: tuple[str, ...]
    has_index: bool
    has_pulses: bool
    left_out: tuple[str, ...]


def emg_section(
    envelopes: Envelopes, trials: Mapping[str, Sequence[ConditionTrials]], arms: Mapping[str, Subject]
) -> EmgSection:
    """Analyse EMG for the page.

    Args:
      envelopes: of all trials of the person.
      trials: identified condition to its trials, those of one length together; where lengths differ, EMG of that
        condition is left out.
      arms: condition to the arm that was identified.
    """
    of_muscles = activity(envelopes)
    left_out = list[str]()
    responses = _responses(envelopes, trials, arms, left_out)
    of_pulses = _onsets(envelopes, trials, arms, left_out)
    labels = envelopes.labels
    # What noise is taken from is no test of relaxation.
    relaxed = list(dict.fromkeys(labels["condition"][(labels["task"] == "RT") & (labels["condition"] != REST)]))
    shown = labels["condition"].isin(list(trials)).to_numpy()
    tables = {"emg_activity": of_muscles.describe()}
    pictures = {
        "emg_envelopes": _drawn(envelopes, trial=int(shown.argmax())),
        "emg_activity": _drawn(of_muscles),
    }
    for number, result in enumerate(responses.values()):
        tables[f"emg_reflexes_{number}"], pictures[f"emg_reflexes_{number}"] = result.describe(), _drawn(result)
    if of_pulses:
        tables["emg_pulses"], pictures["emg_pulses"] = of_pulses.describe(), _drawn(of_pulses)
    return EmgSection(
        sentence=relaxation_sentence([of_muscles], relaxed) if relaxed else "",
        unit=envelopes.unit,
        tables=tables,
        pictures=pictures,
        conditions=tuple(responses),
        has_index=not of_muscles.cocontraction.empty,
        has_pulses=of_pulses is not None,
        left_out=tuple(left_out),
    )


def _responses(
    envelopes: Envelopes,
    trials: Mapping[str, Sequence[ConditionTrials]],
    arms: Mapping[str, Subject],
    left_out: list[str],
) -> dict[str, Reflexes]:
    """Condition to the response from rotation to EMG, where there is one; `left_out` gets why of the others."""
    responses = {}
    for label, parts in trials.items():
        if len(parts) == 1 and parts[0].drive.any():  # neither rest nor a maximal contraction
            try:
                responses[label] = reflexes(parts[0], envelopes, arm=arms.get(label))
            except ValueError as error:
                left_out.append(f"Not shown: {error}")
    return responses


def _onsets(
    envelopes: Envelopes,
    trials: Mapping[str, Sequence[ConditionTrials]],
    arms: Mapping[str, Subject],
    left_out: list[str],
) -> Onsets | None:
    """Answers to pulses of all conditions together; None where there are none, and `left_out` gets why."""
    parts = [each[0] for each in trials.values() if len(each) == 1 and (each[0].onset < each[0].n_samples).any()]
    try:
        return onsets(parts, envelopes, arms) if parts else None
    except ValueError as error:
        left_out.append(f"Not shown: {error}")
        return None


def _drawn(result: Activity | Envelopes | Onsets | Reflexes, **options: int) -> Picture:
    figure = new_figure(1.0)
    result.plot(figure, **options)
    return Picture.of(figure)
