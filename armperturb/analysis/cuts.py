"""Where trials of a recording are cut: at the pulse, at the workspace limit, by condition."""

import numpy as np
import xarray as xr

from armperturb.arrays import Array, Indices


def onset_samples(recording: xr.Dataset) -> Indices:
    """First sample of each trial's pulse, or the number of samples of a trial without one, (trial,)."""
    n_samples, rate = recording.sizes["time"], float(recording.attrs["rate"])
    onset = recording["pulse_onset"].values.astype(float) * rate
    return np.minimum(np.round(np.where(np.isnan(onset), n_samples, onset)), n_samples).astype(np.intp)


def limit_samples(recording: xr.Dataset) -> Array:
    """When each trial met the workspace limit [samples], (trial,); infinite if it did not."""
    limit = recording["limit_time"].values.astype(float) * float(recording.attrs["rate"])
    return np.where(np.isnan(limit), np.inf, limit)


def of_condition(recording: xr.Dataset, condition: str) -> xr.Dataset:
    """Trials of the condition of that name; no copy where all are."""
    of = recording["condition"].values == condition
    return recording if of.all() else recording.isel(trial=np.flatnonzero(of))
