"""A person in a condition, and what both estimators make of the trials."""

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from armperturb.analysis.cuts import of_condition
from armperturb.analysis.defaults import LINEAR_MODELS, WINDOW_START
from armperturb.analysis.fit.identification import Identification
from armperturb.analysis.fit.identify import identify
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.response.condition_spectra import whole_periods_start
from armperturb.analysis.response.spectra import SpectralEstimate, single_trial_spectra
from armperturb.analysis.results import PARAMETER_COLUMNS, Description, Result
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.study.protocol import NEEDED, Condition, Protocol
from armperturb.study.results.quantities import multisine_window
from armperturb.study.results.recordings import load_trials
from armperturb.subject import Subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Case(Result):
    """One person in one condition.

    Attributes:
      condition: what was run.
      name: of the person.
      recording: path of the person's recording.
      identification: what the analysis made of it, by maximum likelihood over whole records; None if it could not be
        identified.
      thesis: what the thesis's estimator makes of the same trials; None if it cannot.
      left_out: reasons why trials were left out, or why an estimator gave nothing.
      single_trials: spectra of each trial behind the identification, averaged over adjacent lines only; none where one
        trial alone gives none.
      force: RMS force of the multisine per axis in the window of the analysis, pooled over axes and trials [N]; of all
        of a multisine that the protocol makes too short for that window; else NaN if not identified.
      displacement: RMS displacement, likewise [m].
      truth: the subject that was simulated, which true values are of; None of people, of subjects that this version
        would not draw, and of those whose shoulder a strap lets move, as what is fitted has a fixed one.
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

    def to_frame(self) -> pd.DataFrame:
        """One row per free parameter (see `Identification.to_frame`); none where the case is not identified."""
        if self.identification is None:
            return pd.DataFrame(columns=list(PARAMETER_COLUMNS))
        return self.identification.to_frame()

    def to_xarray(self) -> xr.Dataset:
        """Spectra and the fitted arm's admittance, see `Identification.to_xarray`; empty if not identified."""
        return xr.Dataset() if self.identification is None else self.identification.to_xarray()

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the estimated admittance and that of the fitted arm, see `Identification.plot`.

        Raises:
          ValueError: the case is not identified.
        """
        if self.identification is None:
            raise ValueError(f"{self.name} in {self.condition.name}: not identified; expected a case with an arm")
        return self.identification.plot(figure)

    @property
    def model(self) -> str:
        """Structure that is fitted, see `armperturb.analysis.fit.structures`."""
        return LINEAR_MODELS[self.condition.task]

    @property
    def identified(self) -> Identification:
        """The identification of a case that `StudyResult.of` gives, which has one."""
        assert self.identification is not None
        return self.identification

    @property
    def estimate(self) -> Estimate:
        """The maximum likelihood estimate of such a case: intervals, correlations, lack of fit."""
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
        mine = of_condition(load_trials(self.recording, ["joint_angle"]), self.condition.name)
        return mine.isel(trial=ConditionTrials.prepare(mine, is_checked=True).multisine.numbers)


def identify_person(conditions: Mapping[str, ConditionTrials], path: Path, protocol: Protocol) -> tuple[Case, ...]:
    """Identify a person in every condition of a protocol that has a multisine.

    Args:
      conditions: condition to the person's trials, of at least one condition.
      path: where their recording lies.
      protocol: what was to be recorded.
    """
    name = next(iter(conditions.values())).name
    cases = []
    for condition in protocol.conditions:
        if condition.has_multisine:
            trials = conditions.get(condition.name)
            case, multisine = _identify(condition, name, trials, path, protocol)
            cases.append(case if multisine is None else _with_thesis(case, multisine))
    return tuple(cases)


def arms_of(cases: Sequence[Case], conditions: Sequence[Condition]) -> dict[str, Subject]:
    """Condition to the arm that was identified in it or, where pulses come alone, in another one of the same task.

    Args:
      cases: of one person.
      conditions: of the protocol.
    """
    identified = [case for case in cases if case.identification is not None]
    of_task = {case.condition.task: case.identified.fit.arm for case in reversed(identified)}
    there = {case.condition.name: case.identified.fit.arm for case in identified}
    return {each.name: of_task[each.task] for each in conditions if each.task in of_task} | there


def warn_of_short_multisines(protocol: Protocol) -> None:
    """Say in which conditions nobody will be identified, in a line."""
    if short := protocol.too_short():
        LOG.warning(
            "nobody can be identified in %s: the multisine lasts %g s, and the analysis needs %g s (multisine_duration "
            "of the protocol where a pulse follows, else trial_duration)",
            *(", ".join(condition.name for condition in short), min(map(protocol.multisine_lasts, short)), NEEDED),
        )


def _identify(
    condition: Condition, name: str, trials: ConditionTrials | None, path: Path, protocol: Protocol
) -> tuple[Case, ConditionTrials | None]:
    """By maximum likelihood, and the trials that can be analysed, up to the pulse."""
    multisine = None if trials is None else trials.multisine
    left_out = []
    if trials is not None and multisine is not None:
        left_out = [
            f"trial {trial} of {name} in {condition.name} reached the workspace limit at "
            f"{trials.limit[trial] / trials.rate:.3f} s"
            for trial in range(trials.n_trials)
            if trial not in multisine.numbers
        ]
    case = Case(condition=condition, name=name, recording=path, identification=None, left_out=tuple(left_out))
    if condition in protocol.too_short() and (multisine is None or whole_periods_start(multisine) is None):
        reason = f"the multisine lasts {protocol.multisine_lasts(condition):g} s, and the analysis needs {NEEDED:g} s"
        left_out.append(f"{name} in {condition.name} was not identified: {reason}")
        case = replace(case, left_out=tuple(left_out))
        if multisine is not None and multisine.n_trials:
            force, displacement = _rms(multisine.perturbation), _rms(multisine.recorded_displacement)
            case = replace(case, force=force, displacement=displacement)
        return case, None
    if multisine is None or not multisine.n_trials:
        return case, None
    try:
        identification = identify(multisine, structure_of(LINEAR_MODELS[condition.task]))
        single_trials: tuple[SpectralEstimate, ...] = ()
        if (start := whole_periods_start(multisine)) is not None:
            with suppress(ValueError):  # one trial alone may be too short for spectra of its own
                single_trials = single_trial_spectra(multisine, window_start=start)
        window = multisine_window(multisine.recording, may_be_earlier=True)
        return replace(
            case,
            identification=identification,
            single_trials=single_trials,
            force=_rms(multisine.perturbation[:, window]),
            displacement=_rms(multisine.recorded_displacement[:, window]),
        ), multisine
    except ValueError as error:  # must not cost the other people their results
        left_out.append(f"{name} in {condition.name} was not identified: {error}")
        return replace(case, left_out=tuple(left_out)), multisine


def _with_thesis(case: Case, multisine: ConditionTrials) -> Case:
    """The case with what the thesis's estimator gives, or why it gives nothing."""
    model, start = LINEAR_MODELS[case.condition.task], whole_periods_start(multisine)
    try:
        thesis = identify(multisine, model, estimator="thesis", window_start=WINDOW_START if start is None else start)
        return replace(case, thesis=thesis)
    except ValueError as error:
        line = f"{case.name} in {case.condition.name} was not identified by the thesis's estimator: {error}"
        return replace(case, left_out=(*case.left_out, line))


def _rms(signal: Array) -> float:
    """RMS per axis, pooled over axes and trials."""
    return float(np.sqrt(np.mean(signal**2)))
