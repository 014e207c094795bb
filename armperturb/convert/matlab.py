"""Reads MATLAB files, v5 to v7 and v7.3.

A channel is a variable, or a field of structures, with what its dimensions mean: `data.force(time,2)` is the second
column of a matrix, `force(trial,time,2)` of an array of all trials, `trials(trial).force(time,2)` of an array of
structures and `force{trial}(time,2)` of a cell array. A bare name is a vector over time.
"""

import re
import struct
import warnings
import zlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from pymatreader import read_mat

from armperturb.arrays import Array
from armperturb.convert.hdf5 import SIGNATURE, require_whole_hdf5
from armperturb.convert.raw import RawTrial, missing_channel, require_modest, split_trials

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMERIC = {6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}
"""MATLAB's number of a class to the size of an element in memory [byte]."""

_ADDRESS = re.compile(r"(?P<path>[A-Za-z]\w*(?:\.[A-Za-z]\w*)*)(?:\((?P<index>[^()]*)\))?")


class _Address(NamedTuple):
    """Where a channel stands: fields from the variable down, and the meaning of each dimension."""

    fields: tuple[str, ...]
    dims: tuple[str | int, ...]


def read_matlab(path: Path, names: Collection[str], number: str | None) -> Sequence[RawTrial]:
    """Channels of a MATLAB file.

    Args:
      path: of the file.
      names: of the channels that are wanted, that with the trial's number included.
      number: channel that numbers the trials, if there is one.

    Raises:
      ValueError: the file is damaged, too large or no MATLAB file, a channel is not in it, or holds no numbers.
      OSError: it cannot be read.
    """
    addresses = {name: _address(path, name) for name in names}
    require_modest(path, path.stat().st_size, "size")
    with path.open("rb") as file:
        head = file.read(1024)
        if head.startswith(SIGNATURE) or head[512:520] == SIGNATURE:
            require_whole_hdf5(path)
        else:
            _require_whole(path, head, file)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of classes that no channel needs
            content = read_mat(path, variable_names=sorted({address.fields[0] for address in addresses.values()}))
    except Exception as error:  # a damaged file makes its reader fail in any way
        raise ValueError(f"{path}: not a readable MATLAB file ({error})") from None
    found = {name: _of_trials(path, name, address, content) for name, address in addresses.items()}
    counts = {name: len(parts) for name, parts in found.items() if parts is not None and len(parts) != 1}
    n_trials = max(counts.values(), default=1)
    for name, count in counts.items():
        if count != n_trials:
            raise ValueError(f"{path}: {name} has {count} trials; expected {n_trials} as the others")
    trials = [
        RawTrial(
            name=str(trial + 1) if n_trials > 1 else path.name,
            # A channel without trials, as the times may be, is that of all.
            channels={name: parts[trial if len(parts) > 1 else 0] for name, parts in found.items()},
        )
        for trial in range(n_trials)
    ]
    if number is None:
        return trials
    if n_trials > 1:
        raise ValueError(f"{path}: trial = {number!r} beside arrays of {n_trials} trials; expected one of both")
    lengths = {len(values) for values in trials[0].channels.values()}
    if len(lengths) > 1:
        raise ValueError(f"{path}: channels of {' and '.join(map(str, sorted(lengths)))} samples; expected one length")
    return split_trials(path, trials[0].channels, number)


def _address(path: Path, name: str) -> _Address:
    plain = name.replace("(trial)", "").replace("{trial}", "")
    match = _ADDRESS.fullmatch(plain)
    index: list[str | int] = []
    if match is not None:
        for part in (match["index"] or "time").split(","):
            part = part.strip()
            number = int(part) if part.isascii() and part.isdecimal() and len(part) < 9 else 0
            index.append(part if part in ("time", "trial") else number)
    if match is None or index.count("time") != 1 or index.count("trial") > 1 or 0 in index:
        raise ValueError(
            f"{path}: channel {name!r}; expected a variable or field and its dimensions, e.g. 'data.force(time,1)'"
        )
    return _Address(tuple(match["path"].split(".")), tuple(index))


def _of_trials(path: Path, name: str, address: _Address, content: Mapping[str, Any]) -> list[Array]:
    """Values of a channel in each trial; of one if there is no dimension for them."""
    value: Any = content
    for field in address.fields:
        if isinstance(value, list):
            value = [one.get(field) if isinstance(one, dict) else None for one in value]
            continue
        if not isinstance(value, dict) or field not in value:
            known = [one for one in value if not one.startswith("__")] if isinstance(value, dict) else []
            raise missing_channel(path, name, known)
        value = value[field]
    if not isinstance(value, list):
        return _sliced(path, name, value, address.dims)
    if "trial" in address.dims:
        raise ValueError(f"{path}: channel {name!r} has its trials in a list; expected no dimension 'trial'")
    return [part for one in value for part in _sliced(path, name, one, address.dims)]


def _sliced(path: Path, name: str, value: Any, index: tuple[str | int, ...]) -> list[Array]:
    array = np.asarray(value if isinstance(value, np.ndarray | int | float) else np.nan, dtype=None)
    if array.dtype.kind not in "fiub" or not isinstance(value, np.ndarray):
        what = f"values of type {array.dtype}" if isinstance(value, np.ndarray) else f"{value!r:.40}"
        raise ValueError(f"{path}: channel {name!r} holds {what}; expected an array of numbers")
    dims = list(index)
    # The reader drops dimensions of length one: of a single trial first, then that of a single column.
    while len(dims) > array.ndim and ("trial" in dims or 1 in dims):
        dims.remove("trial" if "trial" in dims else 1)
    if len(dims) != array.ndim:
        raise ValueError(
            f"{path}: channel {name!r} has {array.ndim} dimensions of more than one; expected {len(index)}"
        )
    for axis, dim in enumerate(dims):
        if isinstance(dim, int) and dim > array.shape[axis]:
            raise ValueError(
                f"{path}: channel {name!r} has shape {array.shape}; expected at least {dim} along {axis + 1}"
            )
    array = array[tuple(dim - 1 if isinstance(dim, int) else slice(None) for dim in dims)].astype(float)
    kept = [dim for dim in dims if not isinstance(dim, int)]
    return [array] if kept == ["time"] else list(array if kept == ["trial", "time"] else array.T)


def _require_whole(path: Path, head: bytes, file: BinaryIO) -> None:
    """Refuse a file of v5 to v7 that is cut off or whose variables claim more than there is."""
    order = {b"IM": "<", b"MI": ">"}.get(head[126:128])
    if len(head) < _HEADER or order is None:
        shown = "a zip archive" if head.startswith(b"PK\x03\x04") else f"it begins with {head[:8]!r}"
        shown = "the file is empty" if not head else shown
        raise ValueError(f"{path}: no MATLAB file of v5 or later ({shown}); expected one, as `save` writes it")
    size, at, total = path.stat().st_size, _HEADER, 0
    while at < size:
        file.seek(at)
        tag = file.read(8)
        kind, length = struct.unpack(f"{order}II", tag) if len(tag) == 8 else (0, 0)
        if kind not in (_MATRIX, _COMPRESSED):
            raise ValueError(f"{path}: no variable at byte {at}; expected one (the file is damaged or cut off)")
        if at + 8 + length > size:
            raise ValueError(
                f"{path}: the variable at byte {at} claims {length} bytes; expected at most {size - at - 8}, "
                "which is what is left (the file is cut off or damaged)"
            )
        # Enough of it to see how large an array it claims to be.
        packed = file.read(min(length, 4096))
        start = packed if kind == _MATRIX else _inflated(path, at, packed)
        claim = length
        if kind == _COMPRESSED:
            claim = struct.unpack(f"{order}I", start[4:8])[0] if len(start) >= 8 else 0
            start = start[8:]
        require_modest(path, claim, f"the variable at byte {at} unpacked")
        total += claim
        _require_room(path, at, start, claim, order)
        at += 8 + length
    require_modest(path, total, "all of it unpacked")


def _inflated(path: Path, at: int, packed: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(packed, 4096)
    except zlib.error as error:
        raise ValueError(f"{path}: the variable at byte {at} cannot be unpacked ({error})") from None


def _require_room(path: Path, at: int, start: bytes, length: int, order: str) -> None:
    """Refuse an array whose dimensions say that it is larger than the variable that holds it."""
    if len(start) < 32:
        return
    flags, n_dims = struct.unpack(f"{order}I", start[8:12])[0], struct.unpack(f"{order}I", start[20:24])[0] // 4
    if flags & 0xFF not in _NUMERIC or len(start) < 24 + 4 * n_dims:
        return
    n_elements = 1
    for dim in struct.unpack(f"{order}{n_dims}i", start[24 : 24 + 4 * n_dims]):
        n_elements *= max(dim, 0)
    # Numbers are stored in the shortest type that holds them: at least one byte each.
    if n_elements > length:
        raise ValueError(
            f"{path}: the variable at byte {at} claims {n_elements} elements; expected at most {length}, its bytes"
        )
    require_modest(path, n_elements * _NUMERIC[flags & 0xFF], f"the variable at byte {at} unpacked")
