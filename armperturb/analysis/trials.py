"""Trials of one person in one condition, checked once and cut once."""

import numpy as np
import xarray as xr
from numpy.typing import NDArray


def of_condition(recording: xr.Dataset, condition: str) -> xr.Dataset:
    """Trials of the condition of that name."""
    return recording.isel(trial=np.flatnonzero(recording["condition"].values == condition))


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
