"""Recordings in files: netCDF4 as `recording` describes it."""

import io
import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from armperturb.files import write_whole
from armperturb.foreign import read_foreign
from armperturb.recording import OPTIONAL_SIGNALS, SIGNALS, TEXT_COORDINATES, check_recording
from armperturb.validation import as_list

LARGEST_CHUNK = 2**20
"""Of what one checksum of a file is about [byte]."""


def _packed(recording: xr.Dataset) -> xr.Dataset:
    """The recording as its file holds it: EMG as the counts of the converter."""
    if "emg" not in recording.data_vars or "adc_step" not in recording["emg"].attrs:
        return recording
    volts = recording["emg"]
    step = np.float32(volts.attrs["adc_step"])
    limits = np.iinfo(np.int16)
    packed = np.empty(volts.shape, dtype=np.int16)
    for trial, values in enumerate(volts.values):  # one at a time: whole recordings do not fit into the cache
        counts = values / step
        np.rint(counts, out=counts)
        error = counts * step
        error -= values
        is_whole = max(error.max(), -error.min()) <= 0.01 * step
        if not (is_whole and counts.min() >= limits.min and counts.max() <= limits.max):
            off = (np.abs(error) > 0.01 * step) | (counts < limits.min) | (counts > limits.max)
            sample, column = np.argwhere(off)[0]
            raise ValueError(
                f"recording: emg of trial {trial} is {values[sample, column]} V at sample {sample}; expected 16-bit "
                f"multiples of its adc_step = {step} V (or no attribute adc_step)"
            )
        packed[trial] = counts
    # xarray reads scale_factor among the attributes as packing that has been done.
    return recording.assign(emg=(volts.dims, packed, {**volts.attrs, "scale_factor": step}))


def encode_recording(recording: xr.Dataset) -> bytes:
    """The content of a recording's netCDF4 file.

    Raises:
      ValueError: as `check_recording`.
    """
    check_recording(recording)
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    # In memory: on a full disk HDF5 fails over and over while it closes the file, up to a segmentation fault. Without
    # compression, which takes as long as a compiled simulation for noisy signals that it shortens by a fifth. The
    # format of HDF5 1.10 has checksums on what describes the arrays, too.
    # A store would be filled with lazy arrays only later, which leaves NaN.
    memory, packed = io.BytesIO(), _packed(recording).compute()
    with h5netcdf.File(memory, "w", libver="v110") as file:
        encoding = {name: _checked(variable) for name, variable in packed.variables.items()}
        packed.dump_to_store(H5NetCDFStore(file), encoding=encoding)
    return memory.getvalue()


def _checked(variable: xr.Variable) -> dict[str, Any]:
    """How a variable is written: with a checksum on each chunk, and text as characters, since strings have none."""
    if variable.dtype.kind in "OU":
        return {"fletcher32": True, "dtype": "S1"}
    per_sample = variable.dtype.itemsize * math.prod(variable.shape[2:])
    longest = LARGEST_CHUNK // per_sample
    whole = (1, min(variable.shape[1], longest)) if variable.ndim > 1 else (min(variable.shape[0], longest),)
    return {"fletcher32": True, "chunksizes": (*whole, *variable.shape[2:])}


def require_ending(path: Path) -> None:
    """Refuse a file for a recording whose name says that something else is in it.

    Raises:
      ValueError: the ending is not .nc.
    """
    if path.suffix.lower() != ".nc":
        raise ValueError(f"{path}: ending {path.suffix!r}; expected .nc (convert makes .csv or .mat of it)")


def save_recording(recording: xr.Dataset, path: str | Path) -> None:
    """Write a recording as netCDF4, whole or not at all.

    Raises:
      ValueError: as `check_recording`.
      OSError: the folder cannot be written to.
    """
    write_whole(path, encode_recording(recording))


def wanted_signals(optional: Iterable[str], owner: str) -> set[str]:
    """What is to be read beside `REQUIRED_SIGNALS`.

    Args:
      optional: one of `OPTIONAL_SIGNALS`, or several.
      owner: what asks, for the message.

    Raises:
      TypeError: optional is neither.
      ValueError: it has something else than `OPTIONAL_SIGNALS`.
    """
    expected = f"some of {', '.join(OPTIONAL_SIGNALS)}"
    wanted = as_list(f"{owner}: optional", optional, str, expected, or_none=True)
    if unknown := [name for name in wanted if name not in OPTIONAL_SIGNALS]:
        raise ValueError(f"{owner}: optional has {', '.join(sorted(map(repr, unknown)))}; expected {expected}")
    return set(wanted)


def load_recording(path: str | Path, optional: Iterable[str] = OPTIONAL_SIGNALS) -> xr.Dataset:
    """Read a recording, parsed in a child process which a damaged file may crash, and check what was read.

    Args:
      path: of the file.
      optional: what to read beside `REQUIRED_SIGNALS`, where there is any. EMG takes most of the memory.

    Raises:
      ValueError: the file is no netCDF4 file or no recording, or something else than `OPTIONAL_SIGNALS` is asked for.
      OSError: the file cannot be read.
    """
    path, wanted = Path(path), wanted_signals(optional, "load_recording")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, or a folder; expected a recording (netCDF4)")
    left_out = set(OPTIONAL_SIGNALS) - wanted
    times = {SIGNALS[name][0][0] for name in left_out} - {"time"}
    content = read_foreign(path, without=left_out | times)
    try:
        with warnings.catch_warnings(action="ignore"):
            recording = xr.decode_cf(
                xr.Dataset(
                    {
                        name: (each["dims"], each["values"], each["attrs"])
                        for name, each in content["variables"].items()
                    },
                    attrs=content["attrs"],
                )
            )
            recording = recording[list(recording.data_vars)].load()  # without coordinates of what is not there
    except Exception as error:  # attributes contradict values in any way
        raise ValueError(f"{path}: not a readable netCDF4 file ({' '.join(str(error).split())})") from None
    for name, coordinate in recording.coords.items():
        if name in TEXT_COORDINATES or coordinate.dtype == object:
            recording[name] = coordinate.astype(str)
    if "emg" in recording.data_vars:
        recording["emg"] = recording["emg"].astype(np.float32, copy=False)
    check_recording(recording, source=str(path))
    return recording
