"""A person in a condition, and what both estimators make of the trials."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

from armperturb.analysis.fit.identify import Identification, identify, identify_conditions
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.response.spectra import SpectralEstimate, estimate_spectra, line_spectra
from armperturb.analysis.results import Description, Result
from armperturb.analysis.trials import multisine_part, of_condition
from armperturb.perturbations.multisine import PERIOD
from armperturb.recording import load_recording, stack_trials
from armperturb.study.protocol import Condition, Protocol
from armperturb.subject import Subject

MODELS = {"PT": "3b", "RT": "1"}
"""Task to the structure that is fitted, see `armperturb.analysis.fit.structures`."""

WINDOW_START = 8.0
"""Time from which on a trial is analysed [s]: the transient has gone by then."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Case(Result):
    """One person in one condition.

    Attributes:
      condition: what was run.
      name: of the person.
      recording: path of the person's recording.
      identification: what the analysis made of it, by greatest likelihood over whole records; None if it could not be
        identified.
      thesis: what the thesis's estimator makes of the same trials; None if it cannot.
      left_out: reasons why trials were left out, or why an estimator gave nothing.
      single_trials: spectra of each trial behind the identification, averaged over adjacent lines only.
      force: RMS force of the multisine per axis in the window of the analysis, pooled over axes and trials [N]; NaN if
        not identified.
      displacement: RMS displacement, likewise [m].
      truth: the subject that was simulated; None of people, and of subjects that this version would not draw.
    """

    condition: Condition
    name: str
    recording: Path
    identification: Identification | None
    left_out: tuple[str, ...]
    thesis: Identification | None = None
    single_trials: tuple[SpectralEstimate, ...] = ()
    force: float = math.nan
    displacement: float = math.nan
    truth: Subject | None = None

    def describe(self) -> Description:
        """The identification, and why parts are missing."""
        if self.identification is None:
            return Description(title=f"{self.name} in {self.condition.name}: not identified", remarks=self.left_out)
        said = self.identification.describe()
        return replace(said, remarks=(*said.remarks, *self.left_out))

    @property
    def model(self) -> str:
        """Structure that is fitted, see `armperturb.analysis.fit.structures`."""
        return MODELS[self.condition.task]

    @property
    def identified(self) -> Identification:
        """The identification of a case that `StudyResult.of` gives, which has one."""
        assert self.identification is not None
        return self.identification

    @property
    def estimate(self) -> Estimate:
        """What the greatest likelihood gives of such a case beside the arm: intervals, correlations, lack of fit."""
        assert isinstance(self.identified.fit.detail, Estimate)
        return self.identified.fit.detail

    @property
    def thesis_estimate(self) -> ThesisEstimate | None:
        """The fits of single trials behind `thesis`."""
        if self.thesis is None:
            return None
        assert isinstance(self.thesis.fit.detail, ThesisEstimate)
        return self.thesis.fit.detail

    def trials(self) -> xr.Dataset:
        """The recorded trials behind the identification, pulses included."""
        mine = of_condition(load_recording(self.recording, ["joint_angle"]), self.condition.name)
        return mine.isel(trial=multisine_part(mine)[1])


def identify_person(recording: xr.Dataset, path: Path, protocol: Protocol) -> tuple[Case, ...]:
    """Identify a person in every condition of a protocol that has a multisine.

    Args:
      recording: the person's trials, of at least one condition.
      path: where it lies.
      protocol: what was to be recorded.
    """
    name = str(recording["subject"].values[0])
    cases, parts = [], {}
    for condition in protocol.conditions:
        if condition.has_multisine:
            case, part = _identify(condition, name, recording, path, protocol)
            cases.append(case)
            if part is not None:
                parts[condition.name] = part
    thesis, failed = _by_thesis(parts)
    return tuple(
        replace(
            case,
            thesis=thesis.get(case.condition.name),
            left_out=case.left_out
            + tuple(f"{name} {line}" for of, line in failed.items() if of == case.condition.name),
        )
        for case in cases
    )


def _identify(
    condition: Condition, name: str, recording: xr.Dataset, path: Path, protocol: Protocol
) -> tuple[Case, xr.Dataset | None]:
    """By greatest likelihood, and the trials that can be analysed, up to the pulse."""
    mine = of_condition(recording, condition.name)
    part, kept = multisine_part(mine)
    limits = mine["limit_time"].values
    left_out = [
        f"trial {trial} of {name} in {condition.name} reached the workspace limit at {limits[trial]:.3f} s"
        for trial in range(mine.sizes["trial"])
        if trial not in kept
    ]
    lasts = protocol.multisine_duration if condition.pulse_levels else protocol.trial_duration
    case = Case(condition=condition, name=name, recording=path, identification=None, left_out=tuple(left_out))
    if lasts < WINDOW_START + PERIOD:
        left_out.append(
            f"{name} in {condition.name} was not identified: the multisine lasts {lasts:g} s, and the analysis "
            f"needs {WINDOW_START + PERIOD:g} s"
        )
        return replace(case, left_out=tuple(left_out)), None
    if not len(kept):
        return case, None
    try:
        return replace(
            case,
            identification=identify(part, MODELS[condition.task], start=WINDOW_START),
            single_trials=tuple(
                estimate_spectra(line_spectra(part.isel(trial=[trial]), start=WINDOW_START))
                for trial in range(len(kept))
            ),
            force=_rms(part["perturbation"]),
            displacement=_rms(part["displacement"]),
        ), part
    except ValueError as error:  # must not cost the other people their results
        left_out.append(f"{name} in {condition.name} was not identified: {error}")
        return replace(case, left_out=tuple(left_out)), part


def _by_thesis(parts: Mapping[str, xr.Dataset]) -> tuple[dict[str, Identification], dict[str, str]]:
    """What the thesis's estimator gives in each condition, and why it gives nothing in others.

    Conditions of one task are fitted together, which is faster; not so those whose trials differ in length.
    """
    alike: dict[tuple[str, int], list[str]] = {}
    for condition, part in parts.items():
        alike.setdefault((str(part["task"].values[0]), part.sizes["time"]), []).append(condition)
    found: dict[str, Identification] = {}
    failed: dict[str, str] = {}
    for (task, _), conditions in alike.items():
        together = stack_trials([parts[condition] for condition in conditions])
        try:
            found |= identify_conditions(together, MODELS[task], estimator="thesis", start=WINDOW_START)
        except ValueError as error:
            for condition in conditions:
                failed[condition] = f"in {condition} was not identified by the thesis's estimator: {error}"
    return found, failed


def _rms(signal: xr.DataArray) -> float:
    """RMS per axis over the window of the analysis, pooled over axes and trials."""
    window = (signal["time"] >= WINDOW_START) & (signal["time"] < WINDOW_START + PERIOD - 1e-9)
    return float(np.sqrt(np.mean(signal.values[:, window.values] ** 2)))
