"""Everything that one person's recording tells."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.trials import trials_by_condition
from armperturb.recording import ARM_LABELS
from armperturb.study.protocol import Protocol
from armperturb.study.results.appendix_fits import Fits, fit_person
from armperturb.study.results.cases import Case, identify_person
from armperturb.study.results.settings import AnalysisSettings
from armperturb.study.results.trial_measures import PersonMeasures, measure_person


class PersonResults(NamedTuple):
    """What one person's recording tells.

    Attributes:
      cases: the person in each condition that has a multisine.
      measures: what the thesis reports of a person.
      fits: of appendices C to E, but for step 2 of C.
      missing: what the protocol has and the recording lacks, one line each.
    """

    cases: tuple[Case, ...]
    measures: PersonMeasures
    fits: Fits
    missing: tuple[str, ...]


def analyse_person(recording: xr.Dataset, path: Path, protocol: Protocol, settings: AnalysisSettings) -> PersonResults:
    """Identify and measure a person.

    Args:
      recording: the person's trials, as `load_recording` has checked them.
      path: of the recording, relative to the study folder.
      protocol: what was to be recorded.
      settings: which fits are made.

    Raises:
      ValueError: the recording holds several people, or does not say what the arm looks like.
    """
    _require_arm(recording)
    conditions = trials_by_condition(recording, is_checked=True)
    cases = identify_person(conditions, path, protocol)
    identified = {case.condition.name for case in cases if case.identification is not None}
    return PersonResults(
        cases=cases,
        measures=measure_person(recording, conditions, cases),
        fits=fit_person(conditions, settings, {condition.name for condition in protocol.too_short()} - identified),
        missing=tuple(missing_trials(recording, protocol)),
    )


def _require_arm(recording: xr.Dataset) -> None:
    """Refuse a person whose segment lengths or posture are unknown: joints and models need them."""
    unknown = [name for name in ARM_LABELS if np.isnan(recording[name].values).any()]
    if unknown:
        raise ValueError(
            f"{', '.join(unknown)} unknown; expected the person's, which joints and models need (labels of the "
            "sidecar), or a folder of recordings without this one (armperturb response takes it alone)"
        )


def missing_trials(recording: xr.Dataset, protocol: Protocol) -> list[str]:
    """Which trials of the protocol a person's recording lacks, and which conditions it has besides."""
    name = str(recording["subject"].values[0])
    recorded = recording["condition"].values.tolist()
    planned = [trial.condition.name for trial in protocol.planned_trials()]
    lines = [
        f"{name} has {recorded.count(condition)} of {planned.count(condition)} trials in {condition}"
        for condition in dict.fromkeys(planned)
        if recorded.count(condition) < planned.count(condition)
    ]
    others = [condition for condition in dict.fromkeys(recorded) if condition not in planned]
    return lines + [f"{name} was recorded in {condition}, which the protocol lacks" for condition in others]
