"""Writes recordings as text or MATLAB files for other programs, each with the sidecar that reads it back."""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy.io import savemat

from armperturb.arrays import Array
from armperturb.convert.tables import TABLES
from armperturb.files import written_together
from armperturb.recording import (
    SIGNALS,
    TEXT_COORDINATES,
    TRIAL_COORDINATES,
    check_recording,
    emg_highpass,
    is_one_axis,
    muscle_actions,
)
from armperturb.recording_files import save_recording
from armperturb.validation import require_one_of

COLUMNS: Mapping[str, Sequence[str]] = TABLES["columns"]
"""Variable to its columns in text. EMG, which has another sampling rate, goes to a separate file."""


def _columns(recording: xr.Dataset) -> dict[str, Sequence[str]]:
    """Variable to its columns, of those that there are; with one axis they are named after quantity and unit."""
    names = [name for name in SIGNALS if name in recording.data_vars]
    if is_one_axis(recording):
        columns: dict[str, Sequence[str]] = {name: [f"{name}_{recording[name].attrs['units']}"] for name in names}
    else:
        columns = {name: COLUMNS[name] for name in COLUMNS if name in names}
    if "emg" in names:
        columns["emg"] = [f"{muscle}_V" for muscle in recording["muscle"].values]
    return columns


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
    _, sidecar, *beside = written_files(recording, path)
    content, meaning = _text(recording) if path.suffix == ".csv" else _matlab(recording)
    files = {path: content}
    for of_emg in beside:
        files[of_emg] = _table(recording, ["emg"], float_format="%.9g")  # exact in single precision
        meaning["signals"]["emg"]["file"] = of_emg.name
    files[sidecar] = (json.dumps(meaning, indent=2, allow_nan=False) + "\n").encode()
    with written_together(files) as parts:
        for part, of_file in zip(parts, files.values(), strict=True):
            part.write_bytes(of_file)
    return list(files)


def written_files(recording: xr.Dataset, path: Path) -> list[Path]:
    """The file, and what `export_recording` writes beside it: a sidecar, and a file of EMG."""
    if path.suffix == ".nc":
        return [path]
    has_emg = path.suffix == ".csv" and "emg" in recording.data_vars
    return [path, path.with_suffix(".json"), *([path.with_name(f"{path.stem}_emg.csv")] if has_emg else [])]


def require_ending(path: Path) -> None:
    """Refuse a file whose name does not say in which format to write.

    Raises:
      ValueError: the ending is none of `ENDINGS`.
    """
    require_one_of(str(path), "ending", path.suffix, ENDINGS)


def _text(recording: xr.Dataset) -> tuple[bytes, dict[str, Any]]:
    channels = _columns(recording)
    meaning = _sidecar(recording, channels) | {"time": {"channel": "time_s", "unit": "s"}, "trial": "trial"}
    content = _table(recording, [name for name in channels if name != "emg"], recording["time"].values)
    return content, {**meaning, "trials": _trials(recording)}


def _table(
    recording: xr.Dataset, names: Sequence[str], time: Array | None = None, float_format: str | None = None
) -> bytes:
    """Signals as text, one line per sample, below a line of names; numbers are exact by default."""
    values = np.concatenate([recording[name].values for name in names], axis=2, dtype=float)
    n_trials, n_time, n_columns = values.shape
    columns = [column for name in names for column in _columns(recording)[name]]
    table = pd.DataFrame(values.reshape(-1, n_columns), columns=columns)
    if time is not None:
        table.insert(0, "time_s", np.tile(time, n_trials))
    table.insert(0, "trial", np.repeat(np.arange(1, n_trials + 1), n_time))
    return bytes(table.to_csv(index=False, lineterminator="\n", float_format=float_format).encode())


def _matlab(recording: xr.Dataset) -> tuple[bytes, dict[str, Any]]:
    """Arrays (trial, time, component), with labels and units for readers in MATLAB."""
    names = [str(name) for name in recording.data_vars]
    trials = _trials(recording)
    content: dict[str, Any] = {name: recording[name].values for name in names}
    content |= {dim: recording[dim].values[:, None] for dim in ("time", "emg_time") if dim in recording.dims}
    content["units"] = {name: recording[name].attrs["units"] for name in names}
    content["labels"] = {
        name: (values.astype(str).astype(object) if name in TEXT_COORDINATES else values)[:, None]
        for name, values in _labels(recording).items()
    }
    content["rate"] = float(recording.attrs["rate"])
    file = io.BytesIO()
    savemat(file, content, format="5", do_compression=True, oned_as="column")
    channels = {name: tuple(f"{name}(trial,time,{i + 1})" for i in range(recording[name].shape[2])) for name in names}
    # Importing names a single trial after the file.
    meaning = _sidecar(recording, channels)
    if len(trials) == 1:
        return file.getvalue(), {**meaning, "labels": meaning["labels"] | trials["1"]}
    return file.getvalue(), {**meaning, "trials": trials}


def _sidecar(recording: xr.Dataset, channels: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    signals: dict[str, Any] = {}
    for name, of_signal in channels.items():
        components = map(str, recording[SIGNALS[name][0][1]].values)
        signals[name] = {
            "channels": dict(zip(components, of_signal, strict=True)),
            "unit": recording[name].attrs["units"],
        }
    signals["force"]["exerted_by"] = "handle"
    if "emg" in signals:
        signals["emg"]["rate"] = float(recording.attrs["emg_rate"])
        if lead := recording["emg"].attrs.get("lead"):
            signals["emg"]["lead"] = float(lead)
        if highpass := emg_highpass(recording):
            signals["emg"]["highpass"] = highpass._asdict()
        if "muscle_joints" in recording.coords:
            signals["emg"]["muscles"] = {
                name: {"joints": action.joints, "sign": action.sign}
                for name, action in muscle_actions(recording).items()
            }
    if is_one_axis(recording):
        labels = {name: recording.attrs[name] for name in ("joint",) if name in recording.attrs}
        kind: dict[str, Any] = {"servo": recording.attrs["servo"]}
    else:
        labels, kind = {}, {"axes": {"x": "right", "y": "forward"}}
    meaning = {"rate": float(recording.attrs["rate"]), **kind, "signals": signals, "labels": labels}
    repairs = str(recording.attrs.get("repairs", "")).splitlines()
    return {**meaning, "repairs": repairs} if repairs else meaning


def _labels(recording: xr.Dataset) -> dict[str, Array]:
    return {name: recording[name].values for name in TRIAL_COORDINATES if name in recording.coords}


def _trials(recording: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Labels of each trial; what does not exist is left out."""
    return {
        str(number): {name: value for name, value in row.items() if value == value}  # NaN is not
        for number, row in enumerate(pd.DataFrame(_labels(recording)).to_dict("records"), start=1)
    }
