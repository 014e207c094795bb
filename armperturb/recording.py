"""The one log format: what a laboratory records of a set of trials, as an `xarray.Dataset`.

| variable | dims | unit | |
|---|---|---|---|
| `perturbation` | trial, time, axis | N | disturbance force d on the manipulator |
| `force` | trial, time, axis | N | reaction force f that the handle exerts on the hand |
| `displacement` | trial, time, axis | m | of the handle, from its start |
| `joint_angle` | trial, time, joint | rad | shoulder from the x axis, elbow from the humerus; may be absent |

Axes are x = right, y = forward; the environment sees d - f, and admittance is displacement per f. Along `trial` lie the
coordinates of `TRIAL_COORDINATES`. `rate` [Hz] is an attribute of the dataset; every variable has its `units`. On disk
it is netCDF4.
"""

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from armperturb.files import written_whole

SIGNALS = {
    "perturbation": ("axis", "N", "disturbance force d on the manipulator"),
    "force": ("axis", "N", "reaction force f that the handle exerts on the hand"),
    "displacement": ("axis", "m", "displacement of the handle from its start"),
    "joint_angle": ("joint", "rad", "joint angle"),
}
"""Variable name to last dimension, unit and description."""

REQUIRED_SIGNALS = ("perturbation", "force", "displacement")

LABELS = {"axis": ("x", "y"), "joint": ("shoulder", "elbow")}

TRIAL_COORDINATES = {
    "subject": ("", "who was perturbed"),
    "task": ("", "PT position task, RT relax task"),
    "condition": ("", "condition of the protocol, e.g. PT7.5"),
    "repetition": ("", "repetition of the condition, from 0"),
    "pulse_level": ("", "multiple of the unit pulse; 0 without pulse"),
    "pulse_direction": ("deg", "direction of the pulse from the x axis"),
    "pulse_onset": ("s", "onset of the pulse; NaN without pulse"),
    "l_h": ("m", "length of the humerus"),
    "l_f": ("m", "length of the forearm to the middle of the grip"),
    "theta_s_deg": ("deg", "shoulder angle of the start posture"),
    "theta_e_deg": ("deg", "elbow angle of the start posture"),
    "limit_time": ("s", "first instant at the workspace limit; NaN if never"),
}
"""Coordinate along `trial` to unit and description."""

TEXT_COORDINATES = ("subject", "task", "condition")


def make_recording(
    signals: Mapping[str, ArrayLike], trials: Mapping[str, ArrayLike], rate: float, **attributes: Any
) -> xr.Dataset:
    """A checked recording.

    Args:
      signals: variable name to values, (trial, time, axis) or (trial, time, joint).
      trials: coordinate name to one value per trial.
      rate: sampling rate [Hz].
      **attributes: further attributes of the dataset.

    Raises:
      ValueError: as `check_recording`.
    """
    n_time = np.asarray(signals["perturbation"]).shape[1]
    dataset = xr.Dataset(
        {
            name: (("trial", "time", SIGNALS[name][0]), np.asarray(values, dtype=float), _describe(*SIGNALS[name][1:]))
            for name, values in signals.items()
        },
        coords={
            "time": ("time", np.arange(n_time) / rate, {"units": "s"}),
            **{dim: (dim, list(labels)) for dim, labels in LABELS.items() if dim == "axis" or "joint_angle" in signals},
            **{
                name: ("trial", np.asarray(values), _describe(*TRIAL_COORDINATES[name]))
                for name, values in trials.items()
            },
        },
        attrs={"rate": float(rate), **attributes},
    )
    check_recording(dataset)
    return dataset


def _describe(units: str, description: str) -> dict[str, str]:
    return {"units": units, "long_name": description} if units else {"long_name": description}


def check_recording(
    recording: xr.Dataset, signals: Iterable[str] = REQUIRED_SIGNALS, source: str = "recording"
) -> None:
    """Refuse a recording that does not hold what an analysis needs.

    Args:
      recording: the dataset to check.
      signals: variables that must be there.
      source: where the recording comes from, for the message.

    Raises:
      ValueError: a variable, coordinate or attribute is missing, has the wrong dims or unit, holds NaN, or the time
        axis does not run evenly at the stated rate.
    """
    for name in signals:
        if name not in recording.data_vars:
            raise ValueError(f"{source}: variable {name!r} is missing; expected {', '.join(signals)}")
    for name, (last, units, _) in SIGNALS.items():
        if name not in recording.data_vars:
            continue
        variable = recording[name]
        if variable.dims != ("trial", "time", last):
            raise ValueError(f"{source}: {name} has dims {variable.dims}; expected ('trial', 'time', '{last}')")
        if variable.attrs.get("units") != units:
            raise ValueError(f"{source}: {name} has units {variable.attrs.get('units')!r}; expected {units!r}")
        if last not in recording.coords or tuple(map(str, recording[last].values)) != LABELS[last]:
            raise ValueError(f"{source}: dimension {last!r} is not labelled; expected {', '.join(LABELS[last])}")
        bad = np.argwhere(~np.isfinite(variable.values))
        if len(bad):
            trial, sample, _ = bad[0]
            raise ValueError(
                f"{source}: {name} of trial {trial} is {variable.values[tuple(bad[0])]} at sample {sample}; expected "
                "finite values"
            )
    for name in TRIAL_COORDINATES:
        if name not in recording.coords or recording[name].dims != ("trial",):
            raise ValueError(f"{source}: coordinate {name!r} along trial is missing; expected one value per trial")
    _check_clock(recording, source)


def _check_clock(recording: xr.Dataset, source: str) -> None:
    rate = recording.attrs.get("rate")
    if not isinstance(rate, (int, float, np.number)) or not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"{source}: rate = {rate!r}; expected the sampling rate in Hz as an attribute, above 0")
    time = recording["time"].values if "time" in recording.coords else np.empty(0)
    if len(time) < 2:
        raise ValueError(f"{source}: time has {len(time)} samples; expected at least 2")
    off = np.abs(time - np.arange(len(time)) / rate)
    if off.max() > 0.01 / rate:
        found = 1.0 / np.median(np.diff(time))
        raise ValueError(
            f"{source}: time runs at {found:.6g} Hz, or not evenly (sample {int(np.argmax(off > 0.01 / rate))} is at "
            f"{time[np.argmax(off > 0.01 / rate)]:.6g} s); expected even steps from 0 s at rate = {float(rate):.6g} Hz"
        )


def encode_recording(recording: xr.Dataset) -> bytes:
    """The content of a recording's netCDF4 file; the same recording gives the same bytes.

    Raises:
      ValueError: as `check_recording`.
    """
    check_recording(recording)
    compression = {
        name: {"compression": "gzip", "compression_opts": 1, "shuffle": True} for name in recording.data_vars
    }
    # In memory: on a full disk HDF5 fails over and over while it closes the file, up to a segmentation fault.
    memory = io.BytesIO()
    recording.to_netcdf(memory, engine="h5netcdf", encoding=compression)
    return memory.getvalue()


def save_recording(recording: xr.Dataset, path: str | Path) -> None:
    """Write a recording as netCDF4, whole or not at all.

    Raises:
      ValueError: as `check_recording`.
      OSError: the folder cannot be written to.
    """
    content = encode_recording(recording)
    with written_whole(path) as temporary:
        temporary.write_bytes(content)


def load_recording(path: str | Path) -> xr.Dataset:
    """Read a recording and check it.

    Raises:
      ValueError: the file is no netCDF4 file or no recording.
      OSError: the file cannot be read.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected a recording (netCDF4)")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as opened:
            recording = opened.load()
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{path}: not a readable netCDF4 file ({error})".replace("\n", " ")) from None
    for name in TEXT_COORDINATES:
        if name in recording.coords:
            recording[name] = recording[name].astype(str)
    check_recording(recording, source=str(path))
    return recording
