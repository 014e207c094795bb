"""Writes recordings as text or MATLAB files for other programs, each with the sidecar that reads it back."""

import io
import json
import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.io import savemat

from armperturb.files import written_whole
from armperturb.recording import LABELS, SIGNALS, TRIAL_COORDINATES, check_recording, save_recording
from armperturb.validation import require_one_of

COLUMNS = {
    "perturbation": ("d_x_N", "d_y_N"),
    "force": ("f_x_N", "f_y_N"),
    "displacement": ("x_x_m", "x_y_m"),
    "joint_angle": ("q_shoulder_rad", "q_elbow_rad"),
    "shoulder_marker": ("marker_x_m", "marker_y_m"),
    "emg": tuple(f"{name}_V" for name in LABELS["muscle"]),
}
"""Variable to its columns in text. EMG, which has another sampling rate, goes to a separate file."""

ENDINGS = (".nc", ".csv", ".mat")


def export_recording(recording: xr.Dataset, path: str | Path) -> list[Path]:
    """Write a recording in the format that the ending of the path names; on an error nothing is written.

    Args:
      recording: what to write.
      path: ending in .nc (netCDF4), .csv (text, with a sidecar beside it, and EMG in `*_emg.csv`) or .mat (MATLAB v5,
        with a sidecar).

    Returns:
      The paths written.

    Raises:
      ValueError: the recording is refused, the ending is another, or trials are too long for the format.
      OSError: the folder is missing or cannot be written to.
    """
    path = Path(path)
    require_ending(path)
    check_recording(recording)
    if path.suffix == ".nc":
        save_recording(recording, path)
        return [path]
    sidecar = path.with_suffix(".json")
    content, meaning = _text(recording) if path.suffix == ".csv" else _matlab(recording)
    files = {path: content}
    if path.suffix == ".csv" and "emg" in recording.data_vars:
        beside = path.with_name(f"{path.stem}_emg.csv")
        files[beside] = _emg_text(recording)
        meaning["signals"]["emg"]["file"] = beside.name
    files[sidecar] = (json.dumps(meaning, indent=2, allow_nan=False) + "\n").encode()
    with ExitStack() as stack:  # files are moved to their places only after all were written
        parts = {file: stack.enter_context(written_whole(file)) for file in files}
        for file, part in parts.items():
            part.write_bytes(files[file])
    return list(files)


def require_ending(path: Path) -> None:
    """Refuse a file whose name does not say in which format to write.

    Raises:
      ValueError: the ending is none of `ENDINGS`.
    """
    require_one_of(str(path), "ending", path.suffix, ENDINGS)


def _text(recording: xr.Dataset) -> tuple[bytes, dict[str, Any]]:
    names = [name for name in COLUMNS if name in recording.data_vars and name != "emg"]
    file = io.StringIO()
    file.write(",".join(("trial", "time_s", *(column for name in names for column in COLUMNS[name]))) + "\n")
    time = recording["time"].values.tolist()
    for trial in range(recording.sizes["trial"]):
        values = np.concatenate([recording[name].values[trial] for name in names], axis=1).astype(float)
        # The repr of a float is exact.
        file.writelines(
            f"{trial + 1},{at!r},{','.join(map(repr, row))}\n" for at, row in zip(time, values.tolist(), strict=True)
        )
    channels = {name: COLUMNS[name] for name in COLUMNS if name in recording.data_vars}
    meaning = _sidecar(recording, channels)
    return file.getvalue().encode(), {
        **meaning,
        "time": {"channel": "time_s", "unit": "s"},
        "trial": "trial",
        "trials": _trials(recording),
    }


def _emg_text(recording: xr.Dataset) -> bytes:
    file = io.StringIO()
    file.write(",".join(("trial", *COLUMNS["emg"])) + "\n")
    line = ",%.9g" * len(COLUMNS["emg"]) + "\n"  # nine digits are exact in single precision
    for trial, values in enumerate(recording["emg"].values):
        file.writelines(f"{trial + 1}{line % tuple(row)}" for row in values.tolist())
    return file.getvalue().encode()


def _matlab(recording: xr.Dataset) -> tuple[bytes, dict[str, Any]]:
    """Arrays (trial, time, component), with labels and units for readers in MATLAB."""
    names = [str(name) for name in recording.data_vars]
    trials = _trials(recording)
    content: dict[str, Any] = {name: recording[name].values for name in names}
    content |= {dim: recording[dim].values[:, None] for dim in ("time", "emg_time") if dim in recording.dims}
    content["units"] = {name: SIGNALS[name][1] for name in names}
    content["labels"] = {
        name: np.array([str(v) for v in recording[name].values], dtype=object)[:, None]
        if recording[name].dtype.kind in "UO"
        else recording[name].values[:, None]
        for name in TRIAL_COORDINATES
        if name in recording.coords
    }
    content["rate"] = float(recording.attrs["rate"])
    file = io.BytesIO()
    savemat(file, content, format="5", do_compression=True, oned_as="column")
    channels = {
        name: tuple(f"{name}(trial,time,{i + 1})" for i in range(len(LABELS[SIGNALS[name][0][1]]))) for name in names
    }
    meaning = _sidecar(recording, channels)
    if recording.sizes["trial"] == 1:  # importing names a single trial after the file
        return file.getvalue(), {**meaning, "labels": trials["1"]}
    return file.getvalue(), {**meaning, "trials": trials}


def _sidecar(recording: xr.Dataset, channels: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    signals: dict[str, Any] = {}
    for name, of_signal in channels.items():
        (_, dim), unit, _ = SIGNALS[name]
        signals[name] = {"channels": dict(zip(LABELS[dim], of_signal, strict=True)), "unit": unit}
    signals["force"]["exerted_by"] = "handle"
    if "emg" in signals:
        signals["emg"]["rate"] = float(recording.attrs["emg_rate"])
    return {
        "rate": float(recording.attrs["rate"]),
        "axes": {"x": "right", "y": "forward"},
        "signals": signals,
        "labels": {},
    }


def _trials(recording: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Labels of each trial; what does not exist is left out."""
    rows = {}
    for trial in range(recording.sizes["trial"]):
        row = {name: recording[name].values[trial].item() for name in TRIAL_COORDINATES if name in recording.coords}
        rows[str(trial + 1)] = {
            name: value for name, value in row.items() if not (isinstance(value, float) and math.isnan(value))
        }
    return rows
