"""Reads C3D files, as motion capture and robots write them: markers at one rate, analogue channels at a multiple.

A marker's coordinate is the channel `LABEL.X`, `LABEL.Y` or `LABEL.Z`; an analogue channel has its label alone.
"""

import io
import math
import struct
from collections.abc import Collection, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armperturb.arrays import Array
from armperturb.convert.child import run_reader
from armperturb.convert.raw import RawTrial, missing_channel, require_modest

BLOCK = 512
"""In which the format counts [byte]."""

PROCESSORS = {84: ("<", 15), 85: ("<", 13), 86: (">", 12)}
"""Intel, DEC and MIPS: order of bytes, and which byte of the header holds the sign of the scale."""


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
    if find_spec("ezc3d") is None:
        raise RuntimeError(f"{path}: C3D needs ezc3d; install armperturb[c3d]")
    content = _unpacked(path)
    values: dict[str, Array] = {}
    rates, units = {}, {}
    for group, letters in (("POINT", "XYZ"), ("ANALOG", ("",))):
        rate, of_units = content[f"{group}.RATE"], content[f"{group}.UNITS"].tolist()
        if group == "POINT":  # which has one unit for all
            of_units = of_units[:1] * len(content["POINT.LABELS"])
        of_group = content[f"{group}.values"].reshape(len(letters), -1, content[f"{group}.values"].shape[-1])
        for i, label in enumerate(content[f"{group}.LABELS"].tolist()[: of_group.shape[1]]):
            for axis, letter in enumerate(letters):
                name = f"{label}.{letter}" if letter else label
                values[name] = of_group[axis, i]
                rates[name] = float(rate[0]) if len(rate) else 0.0
                units[name] = of_units[i] if i < len(of_units) else ""
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


def _unpacked(path: Path) -> Mapping[str, NDArray[Any]]:
    """What the program beside this module makes of a file."""
    try:
        unpacked = run_reader("c3d_program.py", path)
    except ValueError as error:
        raise ValueError(f"{path}: not a readable C3D file ({error})") from None
    with np.load(io.BytesIO(unpacked), allow_pickle=False) as content:
        return dict(content)


def _require_whole(path: Path) -> None:
    """Refuse a file that holds less than its header claims."""
    size = path.stat().st_size
    require_modest(path, size, "size")
    with path.open("rb") as file:
        head = file.read(BLOCK)
        if len(head) < BLOCK or head[1] != 0x50:
            shown = "a zip archive" if head.startswith(b"PK\x03\x04") else f"it begins with {head[:8]!r}"
            raise ValueError(f"{path}: no C3D file ({shown if head else 'the file is empty'}); expected one")
        file.seek(max(head[0] - 1, 0) * BLOCK)
        parameters = file.read(255 * BLOCK)
    if len(parameters) < 4 or parameters[3] not in PROCESSORS:
        raise ValueError(f"{path}: no parameters at byte {max(head[0] - 1, 0) * BLOCK}; expected them (damaged)")
    order, of_sign = PROCESSORS[parameters[3]]
    _require_chain(path, parameters[: parameters[2] * BLOCK], order)
    n_points, n_analogs, first, last = struct.unpack(f"{order}4H", head[2:10])
    is_float = head[of_sign] >> 7  # a negative scale says that numbers are floating
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
    with path.open("rb") as file:
        file.seek((start - 1) * BLOCK + claim)
        if head[:6] in file.read():
            raise ValueError(f"{path}: a second header follows the data; expected one recording (two files in one?)")


def _require_chain(path: Path, parameters: bytes, order: str) -> None:
    """Refuse parameters that do not lead from one to the next, in which a reader would get lost."""
    at = 4
    while at + 2 <= len(parameters):
        length, group = struct.unpack("2b", parameters[at : at + 2])
        after = at + 2 + abs(length)
        if length == 0:
            return
        if after + 2 > len(parameters):
            break
        step = struct.unpack(f"{order}H", parameters[after : after + 2])[0]
        if step == 0:
            return
        if group > 0:
            kind, n_dims = struct.unpack("bB", parameters[after + 2 : after + 4].ljust(2, b"\0"))
            dims = parameters[after + 4 : after + 4 + n_dims]
            size = math.prod(dims) * abs(kind)
            if kind not in (-1, 1, 2, 4) or 4 + n_dims + size > step:
                break
        elif group == 0:
            break
        at = after + step
    raise ValueError(f"{path}: the parameter at byte {at} of the parameters is damaged; expected a chain of them")
