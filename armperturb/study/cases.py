"""A person in a condition, and what both estimators make of the trials."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from armperturb.analysis.identify import Identification, identify
from armperturb.analysis.maximum_likelihood import Estimate
from armperturb.analysis.spectra import SpectralEstimate, estimate_spectra, line_spectra
from armperturb.perturbations.multisine import PERIOD
from armperturb.recording import REQUIRED_SIGNALS, load_recording
from armperturb.study.protocol import Condition, Protocol
from armperturb.subject import Subject

MODELS = {"PT": "3b", "RT": "1"}
"""Task to the structure that is fitted, see `armperturb.analysis.structures`."""

WINDOW_START = 8.0
"""Time from which on a trial is analysed [s]: the transient has gone by then."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
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

    @property
    def model(self) -> str:
        """Structure that is fitted, see `armperturb.analysis.structures`."""
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

    def trials(self) -> xr.Dataset:
        """The recorded trials behind the identification."""
        return inside(of_condition(load_signals(self.recording), self.condition.name))


def load_signals(path: Path) -> xr.Dataset:
    """The signals of a recording that are analysed; EMG takes most of the memory."""
    recording = load_recording(path)
    return recording[[*REQUIRED_SIGNALS, *({"joint_angle"} & set(recording.data_vars))]]


def of_condition(recording: xr.Dataset, condition: str) -> xr.Dataset:
    """Trials of the condition of that name."""
    return recording.isel(trial=np.flatnonzero(recording["condition"].values == condition))


def inside(recording: xr.Dataset) -> xr.Dataset:
    """Trials that stayed off the workspace limit."""
    return recording.isel(trial=np.flatnonzero(np.isnan(recording["limit_time"].values)))


def identify_person(recording: xr.Dataset, path: Path, protocol: Protocol) -> tuple[Case, ...]:
    """Identify a person in every condition of a protocol that has a multisine.

    Args:
      recording: the person's trials, of at least one condition.
      path: where it lies.
      protocol: what was to be recorded.
    """
    name = str(recording["subject"].values[0])
    return tuple(
        _identify(condition, name, recording, path, protocol)
        for condition in protocol.conditions
        if condition.has_multisine
    )


def _identify(condition: Condition, name: str, recording: xr.Dataset, path: Path, protocol: Protocol) -> Case:
    mine = of_condition(recording, condition.name)
    limits = mine["limit_time"].values
    left_out = [
        f"trial {trial} of {name} in {condition.name} reached the workspace limit at {limits[trial]:.3f} s"
        for trial in np.flatnonzero(np.isfinite(limits))
    ]
    kept = inside(mine)
    lasts = protocol.multisine_duration if condition.pulse_levels else protocol.trial_duration
    identification = thesis = None
    single_trials: tuple[SpectralEstimate, ...] = ()
    force = displacement = math.nan
    if lasts < WINDOW_START + PERIOD:
        left_out.append(
            f"{name} in {condition.name} was not identified: the multisine lasts {lasts:g} s, and the analysis "
            f"needs {WINDOW_START + PERIOD:g} s"
        )
    elif kept.sizes["trial"]:
        try:
            identification = identify(kept, MODELS[condition.task], start=WINDOW_START)
            single_trials = tuple(
                estimate_spectra(line_spectra(kept.isel(trial=[trial]), start=WINDOW_START))
                for trial in range(kept.sizes["trial"])
            )
            force, displacement = (_rms(kept[signal]) for signal in ("perturbation", "displacement"))
        except ValueError as error:  # must not cost the other people their results
            left_out.append(f"{name} in {condition.name} was not identified: {error}")
    if identification is not None:
        try:
            thesis = identify(kept, MODELS[condition.task], estimator="thesis", start=WINDOW_START)
        except ValueError as error:
            left_out.append(f"{name} in {condition.name} was not identified by the thesis's estimator: {error}")
    return Case(
        condition=condition,
        name=name,
        recording=path,
        identification=identification,
        left_out=tuple(left_out),
        thesis=thesis,
        single_trials=single_trials,
        force=force,
        displacement=displacement,
    )


def _rms(signal: xr.DataArray) -> float:
    """RMS per axis over the window of the analysis, pooled over axes and trials."""
    window = (signal["time"] >= WINDOW_START) & (signal["time"] < WINDOW_START + PERIOD - 1e-9)
    return float(np.sqrt(np.mean(signal.values[:, window.values] ** 2)))
