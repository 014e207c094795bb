"""What the thesis reports of one person, from the person's recordings: cells of tables, admittance, pulses, fits."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from armperturb.analysis.pulse import predicted_peaks, pulse_peaks
from armperturb.analysis.spectra import estimate_spectra, line_spectra
from armperturb.analysis.thesis import VARTHETA, ThesisEstimate, fit_trials
from armperturb.study import published
from armperturb.study.cases import MODELS, WINDOW_START, of_condition
from armperturb.study.cells import LEVELS, Cell, measure

Array = NDArray[np.float64]

STARTS = {"PT": VARTHETA[published.PARAMETER_TABLES["PT7.5"]["start"]], "RT": None}
"""Task to where the fit starts whose prediction of pulses counts (thesis E.5); None for the structure's own start."""

N_LOW = 2
"""How many of the lowest frequency points tell the low-frequency gain (thesis 3.1)."""


class PulseMeans(NamedTuple):
    """A person's responses to the pulses of a condition and level, as means over trials.

    Attributes:
      displacement: peak [m].
      admittance: pulse admittance [m/N].
      prediction: predicted over recorded peak displacement [%]; NaN if there is no model.
      excess: recorded over predicted peak displacement [-]; likewise.
    """

    displacement: float
    admittance: float
    prediction: float
    excess: float


@dataclass(frozen=True, kw_only=True, eq=False)
class PersonMeasures:
    """What a person's recordings tell.

    Attributes:
      name: of the person.
      conditions: that were recorded.
      cells: of tables 2.1 and F.2 to F.6 to the person's values, SI.
      low_gain: condition to the gain of the diagonal of the admittance at the lowest frequencies [m/N], (frequency,
        axis).
      pulses: condition and level ("min", "max") to the responses.
      estimates: condition to the fits of its trials that predict them.
      left_out: why trials, or parts of them, tell nothing; one line each.
    """

    name: str
    conditions: tuple[str, ...]
    cells: Mapping[Cell, float]
    low_gain: Mapping[str, Array]
    pulses: Mapping[tuple[str, str], PulseMeans]
    estimates: Mapping[str, ThesisEstimate]
    left_out: tuple[str, ...]


def multisine_part(recording: xr.Dataset) -> tuple[xr.Dataset, NDArray[np.int64]]:
    """What comes before the first pulse, of the trials that stay inside the workspace until then, and which these are.

    A pulse may well take the handle to the limit: that does not harm the multisine before it.
    """
    onsets, limits = recording["pulse_onset"].values, recording["limit_time"].values
    end = recording.sizes["time"]
    if np.isfinite(onsets).any():
        end = min(end, round(float(np.nanmin(onsets)) * float(recording.attrs["rate"])))
    kept = np.flatnonzero(~(limits * float(recording.attrs["rate"]) < end))
    part = recording.isel(trial=kept, time=slice(0, end))
    return part.assign_coords(limit_time=("trial", np.full(len(kept), np.nan))), kept


def measure_person(recording: xr.Dataset) -> PersonMeasures:
    """All that needs one fit per trial.

    Args:
      recording: the person's trials.

    Raises:
      ValueError: the recording is refused, or holds several people.
    """
    cells, told = measure(recording)
    name = str(recording["subject"].values[0])
    left_out = [f"{name}: {line}" for line in told]
    conditions = tuple(dict.fromkeys(recording["condition"].values.tolist()))
    low_gain: dict[str, Array] = {}
    pulses: dict[tuple[str, str], PulseMeans] = {}
    estimates: dict[str, ThesisEstimate] = {}
    for condition in published.conditions():
        mine = of_condition(recording, condition)
        if not mine.sizes["trial"]:
            continue
        estimate, fitted = None, np.empty(0, dtype=int)
        if published.has_multisine(condition):
            part, fitted = multisine_part(mine)
            left_out += [
                f"{name} in {condition}: a trial reached the workspace limit at {limit:.3f} s, before its pulse; it is "
                "in no fit"
                for limit in np.delete(mine["limit_time"].values, fitted)
            ]
            try:
                if len(fitted):
                    spectra = estimate_spectra(line_spectra(part, start=WINDOW_START))
                    low_gain[condition] = np.abs(np.diagonal(spectra.arm, axis1=1, axis2=2))[:N_LOW]
                    task = str(part["task"].values[0])
                    estimate = fit_trials(part, MODELS[task], initial=STARTS[task], start=WINDOW_START)
            except ValueError as error:
                left_out.append(f"{name} in {condition} was not fitted: {error}")
        if estimate is not None:
            estimates[condition] = estimate
            left_out += [f"{name}, {line}" for line in _unstable(estimate, condition)]
        for level, means in _pulses(mine, estimate, fitted).items():
            pulses[condition, level] = means
    return PersonMeasures(
        name=name,
        conditions=conditions,
        cells=cells,
        low_gain=low_gain,
        pulses=pulses,
        estimates=estimates,
        left_out=tuple(left_out),
    )


def _unstable(estimate: ThesisEstimate, condition: str) -> list[str]:
    n = len(estimate.fits) - estimate.n_stable
    if not n:
        return []
    return [
        f"{condition}, model {estimate.structure}: {n} of {len(estimate.fits)} fits diverged (unstable on the "
        "manipulator in spite of the penalty) and are left out"
    ]


def _pulses(recording: xr.Dataset, estimate: ThesisEstimate | None, fitted: NDArray[np.int64]) -> dict[str, PulseMeans]:
    """Level to the means over its trials; each trial that was fitted is predicted by its own fit."""
    peaks = pulse_peaks(recording)
    predicted = np.full(len(peaks.displacement), np.nan)
    if estimate is not None:
        for trial, fit in zip(fitted, estimate.fits, strict=True):
            if fit.stable:
                predicted[trial] = predicted_peaks(recording.isel(trial=[trial]), fit.arm, estimate.environment)[0]
    found = {}
    for name, level in LEVELS.items():
        its = np.flatnonzero((np.abs(recording["pulse_level"].values) == level) & np.isfinite(peaks.displacement))
        if len(its):
            ratio = predicted[its] / peaks.displacement[its]
            known = ratio[np.isfinite(ratio)]
            found[name] = PulseMeans(
                displacement=float(peaks.displacement[its].mean()),
                admittance=float(peaks.admittance[its].mean()),
                prediction=100.0 * float(known.mean()) if len(known) else float("nan"),
                excess=float((1.0 / known).mean()) if len(known) else float("nan"),
            )
    return found
