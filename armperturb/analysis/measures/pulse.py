"""Responses to force pulses: peaks, pulse admittance, and what a linear arm predicts of them (thesis 2.8).

Displacement and force are taken as they are recorded, from the start of the trial and not from the pulse's onset, and
so are those of the model: a multisine's last movement is part of both.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.arm.state_space import largest_real_pole, simulate_linear
from armperturb.analysis.cuts import limit_samples, onset_samples
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject
from armperturb.validation import require_one_of

WINDOWS = {"PT": 0.3, "RT": 1.0}
"""Task to the time after a pulse's onset in which the peaks are looked for [s]."""


class PulsePeaks(NamedTuple):
    """Peaks of the responses to pulses; NaN for a trial without a pulse, or whose window is not recorded.

    Attributes:
      displacement: largest distance of the handle from its start [m], (trial,).
      force: largest hand reaction force [N], (trial,).
    """

    displacement: Array
    force: Array

    @property
    def admittance(self) -> Array:
        """Pulse admittance [m/N], (trial,). Source: eq. 2.24."""
        return self.displacement / self.force


def pulse_span(recording: xr.Dataset, trial: int) -> slice:
    """Samples of the window after the pulse of a trial, both ends included.

    Raises:
      ValueError: the trial has no pulse, its task no window, the recording ends or the workspace limit comes before the
        window is over.
    """
    onset = float(recording["pulse_onset"].values[trial])
    if np.isnan(onset):
        raise ValueError(f"trial {trial} has no pulse; expected one with a pulse_onset")
    task = str(recording["task"].values[trial])
    require_one_of(f"trial {trial}", "task", task, list(WINDOWS))
    rate = float(recording.attrs["rate"])
    first = int(onset_samples(recording)[trial])
    last = first + round(WINDOWS[task] * rate)
    if last >= recording.sizes["time"]:
        raise ValueError(
            f"trial {trial} ends {recording.sizes['time'] / rate - onset:.3g} s after its pulse began; expected more "
            f"than {WINDOWS[task]:g} s in {task}"
        )
    limit_sample = float(limit_samples(recording)[trial])
    if limit_sample <= last:
        limit = limit_sample / rate
        late = limit - onset
        when = f"{abs(late):.3f} s {'after' if late >= 0.0 else 'before'}"
        raise ValueError(
            f"trial {trial} reached the workspace limit at {limit:.3f} s, {when} its pulse began; expected it to stay "
            f"inside for {WINDOWS[task]:g} s"
        )
    return slice(first, last + 1)


def peak_norm(vectors: Array) -> float:
    """Largest norm of vectors (..., axis)."""
    return float(np.linalg.norm(vectors, axis=-1).max())


def is_cut(path: Array) -> bool:
    """Whether a path after a pulse, (time, axis), is farthest at its last sample: the peak may be later, and larger."""
    return int(np.linalg.norm(path, axis=-1).argmax()) == len(path) - 1


def cut_peaks(recording: xr.Dataset) -> list[str]:
    """Conditions with pulses after which the handle still moves away where their window ends, a line each."""
    counts: dict[tuple[str, str], list[bool]] = {}
    for trial, span in _spans(recording):
        condition, task = (str(recording[name].values[trial]) for name in ("condition", "task"))
        counts.setdefault((condition, task), []).append(is_cut(recording["displacement"].values[trial, span]))
    return [
        f"{condition}: after {sum(cut)} of {len(cut)} pulses the handle is farthest at the end of the "
        f"{WINDOWS[task]:g} s in which peaks are looked for: peaks may be later (shorter pulses, a lighter handle)"
        for (condition, task), cut in counts.items()
        if any(cut)
    ]


def _spans(recording: xr.Dataset) -> Iterator[tuple[int, slice]]:
    """Trials that have a `pulse_span`, and that."""
    for trial in range(recording.sizes["trial"]):
        try:
            span = pulse_span(recording, trial)
        except ValueError:
            continue
        yield trial, span


def pulse_peaks(recording: xr.Dataset) -> PulsePeaks:
    """Peak displacement and peak hand reaction force after each pulse. Source: thesis 2.8."""
    peaks = np.full((2, recording.sizes["trial"]), np.nan)
    for trial, span in _spans(recording):
        for row, name in zip(peaks, ("displacement", "force"), strict=True):
            row[trial] = peak_norm(recording[name].values[trial, span])
    return PulsePeaks(*peaks)


def predicted_peaks(recording: xr.Dataset, arm: Subject, environment: Environment) -> Array:
    """Peak displacement after each pulse as a linear arm has it [m], (trial,); NaN where `pulse_peaks` has it.

    The whole disturbance is simulated from rest, so that the state at the onset is that of the model itself.

    Args:
      recording: trials of any number of conditions; their perturbation drives the model.
      arm: the model.
      environment: what the hand held.

    Returns:
      Infinity for an arm that is unstable on the environment, as its response has no bound.

    Source: thesis 2.8.
    """
    peaks = np.full(recording.sizes["trial"], np.nan)
    stable = largest_real_pole(arm, environment) < 0
    for trial, samples in _spans(recording):
        if not stable:
            peaks[trial] = np.inf
            continue
        driven = recording["perturbation"].values[trial, : samples.stop]
        response = simulate_linear(arm, environment, driven, float(recording.attrs["rate"]))
        peaks[trial] = peak_norm(response.displacement[samples])
    return peaks


def pulse_prediction(recording: xr.Dataset, arm: Subject, environment: Environment) -> Array:
    """Predicted over recorded peak displacement after each pulse [%], (trial,); as `predicted_peaks`.

    Source: eq. 2.25.
    """
    return 100.0 * predicted_peaks(recording, arm, environment) / pulse_peaks(recording).displacement
