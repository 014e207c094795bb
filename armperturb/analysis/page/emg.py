"""The section EMG of the page: whether muscles were active, how they answer to rotation and to pulses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armperturb.analysis.emg.activity import Activity, activity, relaxation_sentence
from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.onset import Onsets, onsets
from armperturb.analysis.emg.reflex import Reflexes, reflexes
from armperturb.analysis.results import Description
from armperturb.analysis.trials import ConditionTrials
from armperturb.pages.page import Picture
from armperturb.plots.style import new_figure


@dataclass(frozen=True, kw_only=True)
class EmgSection:
    """What the page says of EMG.

    Attributes:
      sentence: whether the person relaxed; empty where no condition asked for that.
      unit: of amplitudes.
      tables: name to what a table says.
      pictures: name to a figure.
      conditions: of which there is a figure of the response to rotation.
      has_pulses: whether any trial has a pulse that EMG goes with.
    """

    sentence: str
    unit: str
    tables: Mapping[str, Description]
    pictures: Mapping[str, Picture]
    conditions: tuple[str, ...]
    has_pulses: bool


def emg_section(envelopes: Envelopes, trials: Mapping[str, Sequence[ConditionTrials]]) -> EmgSection:
    """Analyse EMG for the page.

    Args:
      envelopes: of all trials of the person.
      trials: identified condition to its trials, those of one length together; where lengths differ, EMG of that
        condition is left out.
    """
    of_muscles = activity(envelopes)
    responses = _responses(envelopes, trials)
    of_pulses = _onsets(envelopes, trials)
    labels = envelopes.labels
    relaxed = list(dict.fromkeys(labels["condition"][labels["task"] == "RT"]))
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
        has_pulses=of_pulses is not None,
    )


def _responses(envelopes: Envelopes, trials: Mapping[str, Sequence[ConditionTrials]]) -> dict[str, Reflexes]:
    """Condition to the response from rotation to EMG, of conditions that are long enough."""
    responses = {}
    for label, parts in trials.items():
        if len(parts) == 1:
            try:
                responses[label] = reflexes(parts[0], envelopes)
            except ValueError:  # trials that are too short
                continue
    return responses


def _onsets(envelopes: Envelopes, trials: Mapping[str, Sequence[ConditionTrials]]) -> Onsets | None:
    """Answers to pulses of all conditions together; None where there are no pulses."""
    parts = [each[0] for each in trials.values() if len(each) == 1 and (each[0].onset < each[0].n_samples).any()]
    try:
        return onsets(parts, envelopes) if parts else None
    except ValueError:  # pulses that come too early
        return None


def _drawn(result: Activity | Envelopes | Onsets | Reflexes, **options: int) -> Picture:
    figure = new_figure(1.0)
    result.plot(figure, **options)
    return Picture.of(figure)
