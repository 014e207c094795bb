"""What appendices C to E of the thesis fit to every trial of every person: structures, starts and penalties.

Each step takes one person; only the second step of appendix C needs those of everybody, as it starts from their mean.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from armperturb.analysis.fit import thesis
from armperturb.analysis.fit.structures import neutral_start, structure_of
from armperturb.analysis.response.spectra import single_trial_spectra
from armperturb.analysis.trials import ConditionTrials
from armperturb.seeds import random_stream
from armperturb.study.published import tables as published
from armperturb.study.results.settings import AnalysisSettings, Start
from armperturb.subject import TASKS

FIRST_STEP = {"PT": "PT7.5", "RT": "RT7.5"}
"""Task to the condition of the first step of appendix C."""

WITHOUT_PENALTY = {"PT": "C.3", "RT": "C.13"}
"""Task to the table of the estimates of the first step."""

Key = tuple[str, str]
"""Condition and structure."""


class Fits(NamedTuple):
    """Fits to the trials of one person.

    Attributes:
      name: of the person.
      first: step 1 of appendix C, without penalty.
      starts: name of each start of appendices D and E to its fits.
      left_out: why there are none, one line each.
    """

    name: str
    first: Mapping[Key, thesis.ThesisEstimate]
    starts: Mapping[str, thesis.ThesisEstimate]
    left_out: tuple[str, ...]


class SecondStep(NamedTuple):
    """Step 2 of appendix C for one person, with penalty, from everybody's means.

    Attributes:
      estimates: condition and structure to the fits.
      left_out: why there are none, one line each.
    """

    estimates: Mapping[Key, thesis.ThesisEstimate]
    left_out: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Appendices:
    """Everybody's fits.

    Attributes:
      first: step 1 of appendix C, condition and structure to the fits.
      second: step 2, likewise.
      starts: name of each start of appendices D and E to its fits.
    """

    first: Mapping[Key, thesis.ThesisEstimate] = field(default_factory=dict)
    second: Mapping[Key, thesis.ThesisEstimate] = field(default_factory=dict)
    starts: Mapping[str, thesis.ThesisEstimate] = field(default_factory=dict)


SCATTER = 0.4
"""SD of the logarithm of the factors of scattered starts [-]."""


def first_start(model: str, task: str, start: Start) -> dict[str, float]:
    """Where the first step of appendix C starts, SI, within the bounds of the model.

    Args:
      model: structure of appendix C, "1" to "6".
      task: "PT" or "RT".
      start: see `AnalysisSettings.start`.
    """
    structure = structure_of(model)
    if start == "neutral":
        return neutral_start(structure, task)
    table = WITHOUT_PENALTY[task]
    values = np.array([published.estimate(name, table, model=model).mean for name in structure.free])
    if start == "scattered":
        rng = np.random.default_rng(random_stream(0, "appendix C", TASKS.index(task), int(model)))
        values = values * np.exp(SCATTER * rng.standard_normal(len(values)))
    lower, upper = np.array(list(structure.bounds.values())).T
    return dict(zip(structure.free, np.clip(values, lower, upper).tolist(), strict=True))


def fit_person(
    conditions: Mapping[str, ConditionTrials], settings: AnalysisSettings, unidentified: Collection[str] = ()
) -> Fits:
    """Step 1 of appendix C, and appendices D and E, for one person.

    Args:
      conditions: condition to the person's trials.
      settings: which fits are made.
      unidentified: conditions in which nobody can be identified, of which nothing is said here.
    """
    name = next(iter(conditions.values())).name
    left_out: list[str] = []
    prepared = _fittable(conditions, _others(FIRST_STEP.values(), unidentified), left_out)
    first: dict[Key, thesis.ThesisEstimate] = {}
    starts: dict[str, thesis.ThesisEstimate] = {}
    try:
        first = {
            (condition, model): thesis.fit_trials(
                trials, model, initial=first_start(model, condition[:2], settings.start), use_penalty=False
            )
            for condition, trials in prepared.items()
            for model in settings.structures
        }
        if settings.starts_of in prepared:
            trials = prepared[settings.starts_of]
            starts = thesis.fit_starts(trials, thesis.THETA) | thesis.fit_starts(trials, thesis.VARTHETA)
    except ValueError as error:
        left_out.append(f"{name} was not fitted as in appendices C to E: {error}")
    return Fits(name, first, starts, tuple(left_out))


def fit_second_step(
    conditions: Mapping[str, ConditionTrials],
    means: Mapping[Key, Mapping[str, float]],
    unidentified: Collection[str] = (),
) -> SecondStep:
    """Step 2 of appendix C for one person.

    Args:
      conditions: condition to the person's trials.
      means: task and structure to everybody's means of step 1, from which the fits start.
      unidentified: as of `fit_person`.
    """
    name = next(iter(conditions.values())).name
    left_out: list[str] = []
    printed = filter(published.has_multisine, published.conditions())
    prepared = _fittable(conditions, _others(printed, unidentified), left_out)
    estimates: dict[Key, thesis.ThesisEstimate] = {}
    try:
        estimates = {
            (condition, model): thesis.fit_trials(trials, model, initial=start)
            for condition, trials in prepared.items()
            for (task, model), start in means.items()
            if condition.startswith(task)
        }
    except ValueError as error:
        left_out.append(f"{name} was not fitted as in step 2 of appendix C: {error}")
    return SecondStep(estimates, tuple(left_out))


def _others(conditions: Iterable[str], without: Collection[str]) -> list[str]:
    return [condition for condition in conditions if condition not in without]


def _fittable(
    conditions: Mapping[str, ConditionTrials], wanted: Iterable[str], left_out: list[str]
) -> dict[str, ConditionTrials]:
    """Conditions to their multisines, as far as there are any that give spectra; else says why not."""
    fittable = {}
    for condition in wanted:
        if condition not in conditions or not conditions[condition].multisine.n_trials:
            continue
        multisine = conditions[condition].multisine
        try:
            single_trial_spectra(multisine)
            multisine.instruments  # noqa: B018  (raises)
            fittable[condition] = multisine
        except ValueError as error:
            left_out.append(
                f"{next(iter(conditions.values())).name} in {condition} was not fitted as in appendices C to E: {error}"
            )
    return fittable


def means_of(first: Mapping[Key, thesis.ThesisEstimate]) -> dict[Key, dict[str, float]]:
    """Task and structure to everybody's means of step 1 (appendix C, step 2)."""
    tasks = {condition: task for task, condition in FIRST_STEP.items()}
    return {(tasks[condition], model): estimate.means() for (condition, model), estimate in first.items()}


def joined(people: Iterable[Mapping]) -> dict:
    """The fits of several people in one, by key."""
    people = list(people)
    keys = dict.fromkeys(key for person in people for key in person)
    return {key: thesis.join_estimates([person[key] for person in people if key in person]) for key in keys}
