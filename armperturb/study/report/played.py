"""Trials with a pulse that the report plays: each person's first after each pulse, recorded and predicted."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.cuts import of_condition
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.measures.kinematics import start_posture
from armperturb.analysis.measures.pulse import pulse_span
from armperturb.archive import digest
from armperturb.arrays import Array
from armperturb.study.recording.folder import ANALYSIS
from armperturb.study.report.figures.trajectories import first_pulses, stable_fits
from armperturb.study.results.cache import CachedResult, Unit
from armperturb.study.results.recordings import load_trials
from armperturb.study.results.study_result import StudyResult

MOST_PEOPLE = 10
"""The first of them are played: some 40 kB a person."""

LEAD = 0.1
"""Time before the pulse from which a trial is shown [s]."""

RATE = 100.0
"""Of what is shown at most [Hz]; between samples, a page draws straight lines."""

PER_METRE, PER_NEWTON = 1e4, 10.0
"""Displacements are written in 0.1 mm, forces in 0.1 N."""


class PlayedTrial(NamedTuple):
    """A trial from shortly before its pulse to the end of the window after it.

    Attributes:
      condition: of the protocol.
      level: of the pulse, multiple of the unit.
      direction_deg: of its force, from the x axis.
      trial: number among the person's trials of the condition, from 0.
      rate: of the samples [Hz].
      lead: number of samples before the onset.
      force: the disturbance [N], (time, axis).
      recorded: displacement of the handle from the start of the trial [m], (time, axis).
      predicted: likewise, of the linear arm fitted to the multisine of this trial; empty without one.
    """

    condition: str
    level: float
    direction_deg: float
    trial: int
    rate: float
    lead: int
    force: Array
    recorded: Array
    predicted: Array


class PlayedPerson(NamedTuple):
    """A person's trials, and the arm that made them.

    Attributes:
      name: of the person.
      l_h: length of the humerus [m].
      l_f: length of the forearm to the middle of the grip [m].
      posture: of shoulder and elbow at the start [rad].
      trials: that are played; none of a person whose arm nobody measured.
    """

    name: str
    l_h: float
    l_f: float
    posture: tuple[float, float]
    trials: tuple[PlayedTrial, ...]


def played_units(study: StudyResult, checksums: Mapping[str, str], out: Path) -> list[Unit[PlayedPerson]]:
    """What reads each person's trials, if they are not kept.

    Args:
      study: analysed.
      checksums: file name of each recording to its checksum.
      out: the study folder.
    """
    conditions = [condition.name for condition in study.protocol.conditions if condition.pulse_levels]
    estimates = {person.name: person.estimates for person in study.people}
    units = []
    for name, path in list(study.recordings.items())[: MOST_PEOPLE if conditions else 0]:
        of_person = estimates.get(name, {})
        cached = CachedResult(
            path=out / ANALYSIS / f"played-{path.stem}.json.gz",
            kind="played",
            result=PlayedPerson,
            recordings={path.name: checksums[path.name]},
            settings={"name": name, "conditions": conditions, "estimates": digest(dict(of_person))},
        )
        units.append(Unit(cached=cached, run=partial(played_person, name, path, conditions, of_person)))
    return units


def played_person(
    name: str, path: Path, conditions: Sequence[str], estimates: Mapping[str, ThesisEstimate]
) -> PlayedPerson:
    """The first trial of a person after each pulse: condition, level and direction.

    Args:
      name: of the person.
      path: of the recording.
      conditions: of the protocol, those with pulses.
      estimates: condition to the fits that predict its trials.

    Raises:
      OSError: the recording is gone.
      ValueError: it cannot be read.
    """
    recording = load_trials(path, ())
    l_h, l_f = (float(recording[name].values[0]) if name in recording else math.nan for name in ("l_h", "l_f"))
    if not math.isfinite(l_h + l_f):
        return PlayedPerson(name, l_h, l_f, (math.nan, math.nan), ())
    trials = []
    for condition in conditions:
        mine = of_condition(recording, condition)
        estimate = estimates.get(condition)
        fits = stable_fits(mine, estimate)
        step = max(1, round(float(mine.attrs["rate"]) / RATE))
        for level in np.unique(np.abs(mine["pulse_level"].values)):
            for direction, trial in first_pulses(mine, float(level), fits).items():
                span, rate = pulse_span(mine, trial), float(mine.attrs["rate"])
                lead = min(round(LEAD * rate), span.start) // step * step
                shown = slice(span.start - lead, span.stop, step)
                force = mine["perturbation"].values[trial]
                predicted = np.empty((0, 2))
                if estimate is not None and trial in fits:
                    driven = force[: span.stop]
                    predicted = simulate_linear(fits[trial].arm, estimate.environment, driven, rate).displacement[shown]
                recorded = mine["displacement"].values[trial, shown]
                of_pulse = (condition, float(level), direction, trial)
                trials.append(PlayedTrial(*of_pulse, rate / step, lead // step, force[shown], recorded, predicted))
    shoulder, elbow = start_posture(recording)[0]
    return PlayedPerson(name, l_h, l_f, (float(shoulder), float(elbow)), tuple(trials))


def played_data(people: Sequence[PlayedPerson]) -> list[dict[str, Any]]:
    """People with trials as JSON may hold them, in 0.1 mm and 0.1 N; without those of whom nothing is played."""
    return [
        {
            "name": person.name,
            "l_h": person.l_h,
            "l_f": person.l_f,
            "posture": [round(angle, 5) for angle in person.posture],
            "trials": [
                {
                    **{name: getattr(trial, name) for name in ("condition", "level", "trial", "rate", "lead")},
                    "direction": trial.direction_deg,
                    "force": _whole(PER_NEWTON * trial.force),
                    "recorded": _whole(PER_METRE * trial.recorded),
                    "predicted": _whole(PER_METRE * trial.predicted),
                }
                for trial in person.trials
                if np.isfinite(trial.recorded).all() and np.isfinite(trial.predicted).all()
            ],
        }
        for person in people
        if person.trials
    ]


def _whole(values: Array) -> list[list[int]]:
    """Whole numbers along x, and along y."""
    return [np.rint(values[:, axis]).astype(int).tolist() for axis in range(2)]
