"""Reads C3D files, as motion capture and robots write them: markers at one rate, analogue channels at a multiple.

A marker's coordinate is the channel `LABEL.X`, `LABEL.Y` or `LABEL.Z`; an analogue channel has its label alone.
"""

import struct
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.convert.raw import RawTrial, missing_channel, require_modest

BLOCK = 512
"""In which the format counts [byte]."""

MOST_FRAMES = 65535
"""That the header can tell; longer trials stand in a parameter."""


def read_c3d(path: Path, names: Collection[str]) -> Sequence[RawTrial]:
    """Channels of a C3D file, which holds one trial.

    Args:
      path: of the file.
      names: of the channels that are wanted.

    Raises:
      ValueError: the file is damaged, cut off or no C3D file, or a channel is not in it.
      RuntimeError: ezc3d is not installed.
      OSError: it cannot be read.
    """
    _require_whole(path)
    try:
        import ezc3d
    except ImportError:
        raise RuntimeError(f"{path}: C3D needs ezc3d; install armperturb[c3d]") from None
    try:
        content = ezc3d.c3d(str(path))
        points, analogs = content["parameters"]["POINT"], content["parameters"]["ANALOG"]
        values, rates, units = {}, {}, {}
        seen = content["data"]["meta_points"]["residuals"][0] >= 0.0
        for i, label in enumerate(_parameter(points, "LABELS", [])):
            for axis, letter in enumerate("XYZ"):
                name = f"{label}.{letter}"
                values[name] = np.where(seen[i], content["data"]["points"][axis, i], np.nan)
                rates[name] = float(_parameter(points, "RATE", [0.0])[0])
                units[name] = str(next(iter(_parameter(points, "UNITS", [])), ""))
        of_analogs = list(_parameter(analogs, "UNITS", []))
        for i, name in enumerate(_parameter(analogs, "LABELS", [])):
            values[name] = content["data"]["analogs"][0, i]
            rates[name] = float(_parameter(analogs, "RATE", [0.0])[0])
            units[name] = str(of_analogs[i]) if i < len(of_analogs) else ""
    except Exception as error:  # a damaged file makes its reader fail in any way
        raise ValueError(f"{path}: not a readable C3D file ({error})") from None
    for name in names:
        if name not in values:
            raise missing_channel(path, name, list(values))
        if not (np.isfinite(rates[name]) and rates[name] > 0.0):
            raise ValueError(f"{path}: rate of {name} = {rates[name]!r}; expected a number of Hz above 0")
    return [
        RawTrial(
            name=path.name,
            channels={name: np.asarray(values[name], dtype=float) for name in names},
            rates={name: rates[name] for name in names},
            units={name: units[name] for name in names if units[name]},
        )
    ]


def _parameter(group: Any, name: str, otherwise: list[Any]) -> list[Any]:
    return list(group[name]["value"]) if name in group else otherwise


def _require_whole(path: Path) -> None:
    """Refuse a file that holds less than its header claims."""
    size = path.stat().st_size
    require_modest(path, size, "size")
    with path.open("rb") as file:
        head = file.read(BLOCK)
        if len(head) < BLOCK or head[1] != 0x50:
            shown = "a zip archive" if head.startswith(b"PK\x03\x04") else f"it begins with {head[:8]!r}"
            raise ValueError(f"{path}: no C3D file ({shown if head else 'the file is empty'}); expected one")
        file.seek((head[0] - 1) * BLOCK if head[0] else 0)
        parameters = file.read(4)
    # 84: Intel, 85: DEC, both with the low byte first; 86: MIPS.
    order = ">" if len(parameters) == 4 and parameters[3] == 86 else "<"
    n_points, n_analogs, first, last = struct.unpack(f"{order}4H", head[2:10])
    # A negative scale says that numbers are floating; which byte holds its sign depends on the processor.
    is_float = head[{85: 13, 86: 12}.get(parameters[3] if len(parameters) == 4 else 0, 15)] >> 7
    start = struct.unpack(f"{order}H", head[16:18])[0]
    n_frames = max(last - first + 1, 0)
    if n_points + n_analogs == 0 or n_frames == 0:
        raise ValueError(
            f"{path}: {n_points + n_analogs} channels and {n_frames} frames; expected at least one of both"
        )
    claim = n_frames * (4 * n_points + n_analogs) * (4 if is_float else 2)
    left = max(size - (start - 1) * BLOCK, 0)
    if claim > left:
        raise ValueError(
            f"{path}: header claims {claim} bytes of data ({n_frames} frames); expected at most {left}, which is what "
            "the file holds (it is cut off or damaged)"
        )
    require_modest(path, 2 * claim, "all of it unpacked")
