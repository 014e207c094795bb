"""What the EMG of a person tells in a study: activity, co-contraction and reflexes in each condition."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from armperturb.analysis.emg.activity import Activity, activity
from armperturb.analysis.emg.envelope import MAXIMAL, REST, Envelopes, envelopes
from armperturb.analysis.emg.onset import Onsets, onsets
from armperturb.analysis.emg.reflex import Reflexes, reflexes
from armperturb.analysis.trials import ConditionTrials, trials_by_condition
from armperturb.study.protocol import Condition
from armperturb.study.results.recordings import load_trials
from armperturb.subject import Subject


class Level(NamedTuple):
    """A row of `Activity.levels`."""

    condition: str
    part: str
    muscle: str
    amplitude: float
    lower_95: float
    trials: int
    p: float
    is_active: bool


class Cocontraction(NamedTuple):
    """A row of `Activity.cocontraction`.

    Attributes:
      condition: of the trials.
      part: "before" or "during" the perturbation.
      joint: name.
      lesser: the index, the mean of the lesser amplitude of antagonists [-].
      ratio: that over the mean of both [-].
    """

    condition: str
    part: str
    joint: str
    lesser: float
    ratio: float


class Reflex(NamedTuple):
    """The delay of a muscle's response to rotation in a condition.

    Attributes:
      condition: with a perturbation of some length.
      muscle: name of the channel.
      delay_s: from rotation to EMG [s].
      lower_95_s: limit of its 95 % interval [s].
      upper_95_s: likewise.
      coherence: of amplitude and rotation [-].
      p: of no response [-].
    """

    condition: str
    muscle: str
    delay_s: float
    lower_95_s: float
    upper_95_s: float
    coherence: float
    p: float


class ShownEmg(NamedTuple):
    """What figures show of a person's EMG in a condition.

    Attributes:
      envelopes: of its first trial alone.
      onsets: answers to the pulses of all conditions of its task; None if it has none.
      reflexes: of its trials.
    """

    envelopes: Envelopes
    onsets: Onsets | None
    reflexes: Reflexes


@dataclass(frozen=True, kw_only=True, eq=False)
class PersonEmg:
    """What a person's EMG tells; nothing if there is none.

    Attributes:
      name: of the person.
      unit: of amplitudes; empty without EMG.
      limit: amplitude up to which a muscle counts as relaxed [-].
      levels: of each muscle in each condition but contractions.
      cocontraction: of each joint, likewise.
      reflexes: of each muscle, in conditions whose trials are long enough.
      remarks: of the channels, or why there is nothing.
      shown: what figures show, where that was asked for.
    """

    name: str
    unit: str = ""
    limit: float = 0.0
    levels: tuple[Level, ...] = ()
    cocontraction: tuple[Cocontraction, ...] = ()
    reflexes: tuple[Reflex, ...] = ()
    remarks: tuple[str, ...] = ()
    shown: ShownEmg | None = None

    @property
    def activity(self) -> Activity:
        """Levels and co-contraction as the analysis of EMG has them."""
        return Activity(
            subject=self.name,
            unit=self.unit,
            limit=self.limit,
            levels=pd.DataFrame(self.levels, columns=list(Level._fields)),
            cocontraction=pd.DataFrame(self.cocontraction, columns=["condition", "part", "joint", "index", "ratio"]),
            remarks=self.remarks,
        )


def of_one_unit(people: Sequence[PersonEmg]) -> tuple[PersonEmg, ...]:
    """Those with EMG whose amplitudes have the unit of most people, so that means over them make sense.

    Args:
      people: in any order; of units that equally many have, the first counts. Who has an index of co-contraction goes
        before those of whom it is not known whether they relax.
    """
    with_emg = [person for person in people if person.levels]
    there = [person for person in with_emg if person.cocontraction] or with_emg
    units = Counter(person.unit for person in there)
    return tuple(person for person in there if person.unit == units.most_common(1)[0][0])


def person_emg(
    name: str,
    path: Path,
    shown: Condition | None = None,
    contractions: Collection[str] = (),
    arms: Mapping[str, Subject] | None = None,
) -> PersonEmg:
    """Analyse the EMG of a person's recording.

    Contractions last for a part of their trial, so that the mean over the trial, which levels and indices are of, says
    nothing of them.

    Args:
      name: of the person.
      path: of the recording.
      shown: condition of which figures are drawn, if the recording has trials of it that are long enough.
      contractions: conditions of contractions, beside the maximal ones that amplitudes refer to.
      arms: condition to the arm whose grip gives, where that is known; needed without joint angles, see `reflexes`.

    Raises:
      ValueError: the recording is refused.
      OSError: it cannot be read.
    """
    recording = load_trials(path, ["emg", "joint_angle"])
    try:
        amplitudes = envelopes(recording, contractions=tuple(contractions))
    except ValueError as error:
        return PersonEmg(name=name, remarks=(f"{name}: {error}",))
    of_muscles = activity(amplitudes)
    # Cut without the EMG, of which copies take long.
    by_condition = trials_by_condition(recording.drop_vars("emg"), is_checked=True)
    contracted = {MAXIMAL, *contractions}
    arms = arms or {}
    of_conditions: dict[str, Reflexes] = {}
    for label, trials in by_condition.items():
        if label not in (*contracted, REST):
            with suppress(ValueError):  # trials that are too short
                of_conditions[label] = reflexes(trials, amplitudes, arm=arms.get(label))
    columns = ["muscle", *Reflex._fields[2:]]
    levels, cocontraction = (
        frame[~frame["condition"].isin(contracted)] for frame in (of_muscles.levels, of_muscles.cocontraction)
    )
    of_reflexes = [line for reflex in of_conditions.values() for line in reflex.remarks]
    if "joint_angle" not in recording and (rigid := [label for label in of_conditions if label not in arms]):
        of_reflexes.append(
            f"delays from rotation to EMG in {', '.join(rigid)} may be too short: without joint angles and an "
            "identified arm, the handle's movement passes for the hand's"
        )
    return PersonEmg(
        name=name,
        unit=of_muscles.unit,
        limit=float(of_muscles.limit),
        levels=tuple(Level(*row) for row in _plain(levels)),
        cocontraction=tuple(Cocontraction(*row) for row in _plain(cocontraction)),
        reflexes=tuple(
            Reflex(label, *row)
            for label, reflex in of_conditions.items()
            for row in reflex.responses[columns].itertuples(index=False, name=None)
        ),
        remarks=tuple(f"{name}: {line}" for line in (*of_muscles.remarks, *of_reflexes)),
        shown=_shown(amplitudes, by_condition, of_conditions, shown, arms)
        if shown and shown.name in of_conditions
        else None,
    )


def _shown(
    amplitudes: Envelopes,
    trials: Mapping[str, ConditionTrials],
    of_conditions: Mapping[str, Reflexes],
    condition: Condition,
    arms: Mapping[str, Subject],
) -> ShownEmg:
    """What figures show of a condition, from all the person's trials and what reflexes do in each condition."""
    is_first = np.zeros(len(amplitudes.labels), dtype=bool)
    is_first[int((amplitudes.labels["condition"] == condition.name).to_numpy().argmax())] = True
    same = [part for part in trials.values() if part.recording["task"].values[0] == condition.task]
    with_pulses = [part for part in same if (part.onset < part.n_samples).any()]
    return ShownEmg(
        envelopes=replace(
            amplitudes,
            labels=amplitudes.labels[is_first],
            power=amplitudes.power[is_first],
            rectified=amplitudes.rectified[is_first],
        ),
        onsets=onsets(with_pulses, amplitudes, arms) if condition.pulse_levels else None,
        reflexes=of_conditions[condition.name],
    )


def _plain(frame: pd.DataFrame) -> list[list[Any]]:
    """Rows of Python's own types, which results can be kept as."""
    return [list(row) for row in frame.astype(object).to_numpy().tolist()]
