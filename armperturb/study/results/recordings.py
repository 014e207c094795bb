"""Recordings of a study's people, as its analysis reads them."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import onset_samples
from armperturb.recording_files import load_recording

PULSE_LASTS = 0.3
"""How long after its onset a pulse reaches its peak at the latest [s]."""

FAINT = 0.01
"""Share of its peak up to which the force of a pulse counts as over [-]."""

NOISE, LONGEST = 2.0, 1.5
"""Largest force before a pulse counts so many times as noise [-], and the pulse is over after so long [s]."""

ROUNDED_TO = 5.0
"""Steps of directions that are taken from the force [deg], as a multisine beside the pulse turns them a little."""


def load_trials(path: Path, optional: Iterable[str] = ()) -> xr.Dataset:
    """A person's recording, whose pulses all have a level and a direction, see `with_pulse_labels`.

    Args:
      path: of the file.
      optional: what to read beside the signals that all have, see `load_recording`.

    Raises:
      OSError: the file cannot be read.
      ValueError: it is no recording.
    """
    return with_pulse_labels(load_recording(path, optional))


def with_pulse_labels(recording: xr.Dataset) -> xr.Dataset:
    """The recording with a level and a direction of every pulse, which those of a laboratory need not have.

    A level that nobody says is 1. A direction is that of the largest force after the onset.

    Args:
      recording: trials of any conditions.
    """
    level, direction = (recording[name].values.astype(float) for name in ("pulse_level", "pulse_direction"))
    has_pulse = np.isfinite(recording["pulse_onset"].values)
    level = np.where(np.isfinite(level), level, 0.0)
    level[has_pulse & (level == 0.0)] = 1.0
    onset, duration = onset_samples(recording), round(PULSE_LASTS * float(recording.attrs["rate"]))
    for trial in np.flatnonzero(has_pulse & ~np.isfinite(direction)):
        force = recording["perturbation"].values[trial, onset[trial] : onset[trial] + duration]
        size = np.hypot(*force.T)
        if size.any():
            x, y = force[np.argmax(size)]
            direction[trial] = ROUNDED_TO * round(np.degrees(np.arctan2(y, x)) / ROUNDED_TO) % 360.0
    return recording.assign_coords(
        pulse_level=recording["pulse_level"].copy(data=level),
        pulse_direction=recording["pulse_direction"].copy(data=direction),
    )


def pulse_width(recording: xr.Dataset) -> float:
    """How long the force of a pulse that comes alone lasts from its onset, to the next sample [s]; NaN without force.

    Args:
      recording: one trial with a pulse.
    """
    onset, rate = int(onset_samples(recording)[0]), float(recording.attrs["rate"])
    size = np.hypot(*recording["perturbation"].values[0].T)
    noise, after = NOISE * float(size[:onset].max(initial=0.0)), size[onset : onset + round(LONGEST * rate)]
    above = np.flatnonzero(after > max(FAINT * after.max(initial=0.0), noise))
    return float((above[-1] + 1) / rate) if len(above) else math.nan
