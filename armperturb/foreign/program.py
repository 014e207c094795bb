"""Child process that parses MATLAB, NPZ, C3D and HDF5 files and writes their arrays to standard output.

It runs as a file and imports nothing of this package. Each line of standard input asks for one file; the process ends
with the first that it refuses, since a damaged file may leave a library damaged. Each parser counts what a file claims
to hold, at 8 bytes per element or more, before it allocates any of it. Where the operating system can, the address
space is limited as well.
"""

import json
import math
import mmap
import os
import re
import signal
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Collection, Iterator
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np

DEEPEST = 32
"""Largest number of structures and cell arrays within one another."""

OVERHEAD = 256
"""Counted for each item besides its elements [byte]."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""At byte 0 of an HDF5 file, or at byte 512, below MATLAB's own header."""


class Refused(ValueError):
    """A file is not read; the message says why."""


class Budget:
    """Memory that the content of a file may still take [byte]."""

    def __init__(self, largest: int) -> None:
        self.largest = self.left = largest

    def require(self, size: int, what: str) -> None:
        """Refuse an item that is larger than what is left.

        Raises:
          Refused: it is.
        """
        if size > self.left:
            raise Refused(f"{what} unpacked = {size} bytes; expected at most {self.largest} in the whole file")

    def take(self, n_elements: int, what: str, itemsize: int = 8) -> None:
        """Count an item before it is allocated; raises as `require`."""
        size = n_elements * max(itemsize, 8)
        self.require(size, what)
        self.left -= size + OVERHEAD


def parse(path: str, names: Collection[str] | None, largest: int, without: Collection[str] = ()) -> dict[str, Any]:
    """Content of a file, see `read_foreign`.

    Args:
      path: of the file.
      names: variables or channels that are wanted, all others being None; None for all.
      largest: size that the content may have [byte].
      without: variables of netCDF that are left out.

    Raises:
      Refused: the file is damaged, of another format, or its content too large.
    """
    suffix, budget = Path(path).suffix.lower(), Budget(largest)
    with open(path, "rb") as file:
        head = file.read(1024)
        is_hdf5 = suffix not in (".c3d", ".npz") and SIGNATURE in (head[:8], head[512:520])
        readers = {".mat": ("MATLAB", _mat5), ".c3d": ("C3D", _c3d), ".npz": ("NPZ", _npz)}
        if not is_hdf5 and suffix not in readers:
            raise Refused(f"no HDF5 file ({_beginning(head)}); expected netCDF4")
        try:
            if is_hdf5:
                return _hdf5(file, head, names, without, budget)
            return readers[suffix][1](file, names, budget)
        except Refused:
            raise
        except Exception as error:  # damage makes libraries fail in any way
            kind = readers[suffix][0] if suffix in readers else "netCDF4"
            reason = " ".join(str(error).split()) or type(error).__name__
            raise Refused(f"not a readable {kind} file ({reason:.300}); expected an undamaged one") from None


def _beginning(head: bytes) -> str:
    if head.startswith(b"PK\x03\x04"):
        return "a zip archive"
    return f"it begins with {head[:8]!r}" if head else "the file is empty"


# MATLAB v5 to v7: The MathWorks, "MAT-File Format", section 1.

_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CELL, _STRUCT, _OBJECT, _CHAR, _OPAQUE = 1, 2, 3, 4, 17
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_CODECS = {1: "latin-1", 2: "latin-1", 16: "utf-8", 3: "utf-16", 4: "utf-16", 17: "utf-16", 18: "utf-32"}


def _mat5(file: IO[bytes], names: Collection[str] | None, budget: Budget) -> dict[str, Any]:
    file.seek(0)
    content = memoryview(file.read())
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:128]))
    if order is None:
        beginning = _beginning(bytes(content[:8]))
        raise Refused(f"no MATLAB file of v5 or later ({beginning}); expected one, as `save` writes it")
    variables, at = {}, 128
    while at < len(content):
        what = f"the variable at byte {at}"
        kind, length = struct.unpack_from(f"{order}II", content, at) if at + 8 <= len(content) else (0, 0)
        if kind not in (_MATRIX, _COMPRESSED):
            raise Refused(f"no variable at byte {at}; expected one (the file is damaged or cut off)")
        at += 8
        if length > len(content) - at:
            raise Refused(
                f"{what} claims {length} bytes; expected at most {len(content) - at}, which is what is left (the file "
                "is cut off or damaged)"
            )
        part, at = content[at : at + length], at + length
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            _, length = struct.unpack(f"{order}II", unpacker.decompress(part, 8))
            budget.require(length, what)
            part = memoryview(unpacker.decompress(unpacker.unconsumed_tail, length))
        of_name = next(islice(_elements(part, order, what), 2, 3), (0, b""))[1]
        name = bytes(of_name).decode("latin-1")
        wanted = names is None or name in names
        variables[name] = _matrix(part, order, budget, what, 0) if wanted else None
    return variables


def _elements(part: memoryview, order: str, what: str) -> Iterator[tuple[int, memoryview]]:
    """Type and data of each element of a matrix."""
    after = 0
    while after < len(part):
        kind, length = struct.unpack_from(f"{order}II", part, after)
        if kind >> 16:  # up to four bytes within the tag
            kind, length, at, after = kind & 0xFFFF, kind >> 16, after + 4, after + 8
        else:
            at = after + 8
            after = at + length + -length % 8
        if at + length > len(part):
            raise Refused(f"{what} holds an element of {length} bytes; expected at most {len(part) - at} (damaged)")
        yield kind, part[at : at + length]


def _matrix(part: memoryview, order: str, budget: Budget, what: str, depth: int) -> Any:
    if depth > DEEPEST:
        raise Refused(f"{what} is nested more than {DEEPEST} deep; expected arrays, structures and cells of them")
    elements = _elements(part, order, what)
    if not len(part):
        return np.empty(0)
    flags = struct.unpack_from(f"{order}I", next(elements)[1])[0]
    kind = flags & 0xFF
    if kind == _OPAQUE:
        return None
    dims = np.frombuffer(next(elements)[1], f"{order}u4").tolist()
    next(elements)
    n_elements = math.prod(dims)
    # Each element takes at least a byte: numbers are stored in the shortest type that holds them.
    if n_elements > len(part):
        raise Refused(f"{what} claims {n_elements} elements; expected at most {len(part)}, its bytes")
    budget.take(n_elements, what)
    if kind == _CELL:
        return [_matrix(inner, order, budget, what, depth + 1) for _, inner in islice(elements, n_elements)]
    if kind == _OBJECT:  # a structure below the name of its class
        next(elements)
    if kind in (_STRUCT, _OBJECT):
        width = struct.unpack_from(f"{order}i", next(elements)[1])[0]
        text = bytes(next(elements)[1])
        fields = [text[at : at + width].split(b"\0")[0].decode("latin-1") for at in range(0, len(text), width)]
        inner = islice(elements, n_elements * len(fields))
        members = [_matrix(of_field, order, budget, what, depth + 1) for _, of_field in inner]
        columns = {name: members[at :: len(fields)] for at, name in enumerate(fields)}
        return {name: column[0] for name, column in columns.items()} if n_elements == 1 else columns
    if kind == _CHAR:
        coded, data = next(elements)
        codec = _CODECS[coded] + ({"<": "-le", ">": "-be"}[order] if coded in (3, 4, 17, 18) else "")
        return bytes(data).decode(codec, "replace")
    if kind not in _CLASSES:
        return None
    is_complex = flags >> 11 & 1
    parts = [np.frombuffer(data, order + _TYPES[stored]) for stored, data in islice(elements, 1 + is_complex)]
    values = parts[0].astype(_CLASSES[kind])
    return (values + 1j * parts[1] if is_complex else values).reshape(dims, order="F").squeeze()


# HDF5, as netCDF4 and MATLAB v7.3 use it.


def _hdf5(
    file: IO[bytes], head: bytes, names: Collection[str] | None, without: Collection[str], budget: Budget
) -> dict[str, Any]:
    import h5py

    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        again = content.find(SIGNATURE, head.index(SIGNATURE) + 8)
    if again >= 0:
        raise Refused(f"a second HDF5 file begins at byte {again}; expected one recording (two files in one?)")
    with h5py.File(file.name, "r") as opened:
        is_matlab = file.name.lower().endswith(".mat")
        read = _matlab_hdf5 if is_matlab else _variable
        values = {
            name: read(item, name, budget) if names is None or name in names else None
            for name, item in _members(opened)
            if (name != "#refs#" if is_matlab else isinstance(item, h5py.Dataset) and name not in without)
        }
    if is_matlab:
        return values
    import h5netcdf

    with h5netcdf.File(file.name, "r") as described:
        variables = {
            name: {"dims": list(item.dimensions), "attrs": dict(item.attrs), "values": values[name]}
            for name, item in described.variables.items()
            if name in values
        }
        return {"attrs": dict(described.attrs), "variables": variables}


def _members(group: Any) -> Iterator[tuple[str, Any]]:
    """Name and item of what a group itself holds."""
    import h5py

    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise Refused(f"{name!r} is a link; expected an array that the file itself holds")
        yield name, group[name]


def _variable(item: Any, name: str, budget: Budget) -> Any:
    import h5py

    if item.dtype.kind not in "biufS" and h5py.check_string_dtype(item.dtype) is None:
        raise Refused(f"{name!r} holds values of type {item.dtype}; expected numbers or texts")
    return _array(item, name, budget)


def _array(item: Any, name: str, budget: Budget) -> Any:
    import h5py

    if item.is_virtual or item.external:
        raise Refused(f"{name!r} refers to values elsewhere; expected an array that the file itself holds")
    if item.shape is None:
        return np.empty(0)
    # A chunk is unpacked as a whole.
    budget.take(max(item.size, math.prod(item.chunks or (0,))), f"{name!r}", item.dtype.itemsize)
    is_characters = item.dtype == "S1" and "_Encoding" in item.attrs  # text along a dimension, as CF has it
    if h5py.check_string_dtype(item.dtype) is None or is_characters:
        return item[()]
    texts = item.asstr()[()]
    if isinstance(texts, str):
        return texts
    budget.take(texts.size * max(map(len, texts.flat), default=0), f"{name!r}", 4)
    return texts.astype(str)


def _matlab_hdf5(item: Any, name: str, budget: Budget, depth: int = 0) -> Any:
    import h5py

    if depth > DEEPEST:
        raise Refused(f"{name!r} is nested more than {DEEPEST} deep; expected arrays, structures and cells of them")
    if isinstance(item, h5py.Group):
        budget.take(0, f"{name!r}")
        if "MATLAB_sparse" in item.attrs:
            return None
        return {field: _matlab_hdf5(inner, f"{name}.{field}", budget, depth + 1) for field, inner in _members(item)}
    if "MATLAB_empty" in item.attrs:
        return np.empty(0)
    values = _array(item, name, budget)
    if h5py.check_ref_dtype(item.dtype) is not None:
        return [_matlab_hdf5(item.file[reference], name, budget, depth + 1) for reference in values.ravel()]
    if item.attrs.get("MATLAB_class") == b"char":
        return values.astype("<u2").tobytes().decode("utf-16-le", "replace")
    if values.dtype.names == ("real", "imag"):
        values = values["real"] + 1j * values["imag"]
    return values.T.squeeze()


# NPZ: NumPy Enhancement Proposal 1, arrays in a zip archive.


def _npz(file: IO[bytes], names: Collection[str] | None, budget: Budget) -> dict[str, Any]:
    file.seek(0)
    values: dict[str, Any] = {}
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in values:
                raise Refused(f"the array {name!r:.60} comes twice; expected it once")
            values[name] = None
            if names is None or name in names:
                budget.take(member.file_size, f"{name!r:.60}", 1)
                with archive.open(member) as part:
                    values[name] = _npy(part, name, member.file_size)
    return values


def _npy(part: IO[bytes], name: str, size: int) -> Any:
    major = np.lib.format.read_magic(part)[0]
    read = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read(part)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > size:
        what = "objects" if dtype.hasobject else f"{math.prod(shape)} values in {size} bytes"
        raise Refused(f"{name!r:.60} holds {what}; expected numbers")
    values = np.frombuffer(part.read(), dtype, math.prod(shape))
    return values.reshape(shape, order="F" if is_fortran else "C").squeeze()


# C3D: https://www.c3d.org, "The C3D file format user guide".

_BLOCK = 512
_FRAMES = re.compile(rb"[\x06\xfa].FRAMES..\x02(?:\x00|\x01\x01)(..)", re.DOTALL)
"""The parameter POINT:FRAMES: length of its name, group, name, place of the next, type, dimensions, value."""

_PROCESSORS = {84: ("<", 15), 85: ("<", 13), 86: (">", 12)}
"""Intel, DEC and MIPS: order of bytes, and which byte of the header holds the sign of the scale."""


def _c3d(file: IO[bytes], names: Collection[str] | None, budget: Budget) -> dict[str, Any]:
    n_frames, claim, left = _require_one_c3d(file, budget)
    import ezc3d

    content = ezc3d.c3d(file.name)
    # A header may count wrongly; ezc3d, which goes by the parameters, stops where the file ends.
    if claim > left and content["data"]["points"].shape[2] < n_frames:
        raise Refused(
            f"header claims {claim} bytes of data ({n_frames} frames); expected at most {left}, which is what the file "
            "holds (it is cut off or damaged)"
        )
    points, analogs = np.asarray(content["data"]["points"][:3]), np.asarray(content["data"]["analogs"][0])
    seen = np.asarray(content["data"]["meta_points"]["residuals"][0]) >= 0.0
    coordinates = np.where(seen[None], points, np.nan)
    channels: dict[str, Any] = {}
    for group, letters, of_group in (("POINT", (".X", ".Y", ".Z"), coordinates), ("ANALOG", ("",), analogs[None])):
        parameters = content["parameters"][group]
        rate, labels, units = (
            [*parameters[name]["value"]] if name in parameters else [] for name in ("RATE", "LABELS", "UNITS")
        )
        for i, label in enumerate(labels[: of_group.shape[1]]):
            unit = units[:1] if group == "POINT" else units[i : i + 1]  # one for all coordinates
            for letter, values in zip(letters, of_group[:, i], strict=True):
                name = f"{label}{letter}"
                if name in channels and names is not None and name in names:
                    raise Refused(f"the channel {name!r:.60} comes twice; expected it once (rename one in the file)")
                of_file = {"values": values, "rate": float(rate[0]) if rate else 0.0, "unit": "".join(unit)}
                channels[name] = of_file if names is None or name in names else None
    return channels


def _require_one_c3d(file: IO[bytes], budget: Budget) -> tuple[int, int, int]:
    """Refuse a file without data, or with two headers; frames that its parameter states, bytes that its header claims,
    and bytes that it holds."""
    file.seek(0)
    content = file.read()
    if len(content) < _BLOCK or content[1] != 0x50:
        raise Refused(f"no C3D file ({_beginning(content)}); expected one")
    at = max(content[0] - 1, 0) * _BLOCK
    processor = content[at + 3] if at + 3 < len(content) else 0
    if processor not in _PROCESSORS:
        raise Refused(f"no parameters at byte {at}; expected them (the file is damaged)")
    order, of_sign = _PROCESSORS[processor]
    n_points, n_analogs, first, last = struct.unpack_from(f"{order}4H", content, 2)
    start = (struct.unpack_from(f"{order}H", content, 16)[0] - 1) * _BLOCK
    n_frames = max(last - first + 1, 0)
    if n_points + n_analogs == 0 or n_frames == 0:
        raise Refused(f"{n_points + n_analogs} channels and {n_frames} frames; expected at least one of both")
    n_elements = n_frames * (4 * n_points + n_analogs)
    claim = n_elements * (4 if content[of_sign] >> 7 else 2)  # a negative scale stands for floating numbers
    left = max(len(content) - start, 0)
    budget.take(n_elements, "all of it")
    if content.find(content[:6], start + claim) >= 0:
        raise Refused("a second header follows the data; expected one recording (two files in one?)")
    parameter = _FRAMES.search(content, at, max(start, at))
    return struct.unpack(f"{order}H", parameter[1])[0] if parameter else n_frames, claim, left


# The program.


def _described(item: Any, arrays: list[Any]) -> Any:
    """The item as JSON, and its arrays in the order in which they stand there."""
    if isinstance(item, np.ndarray | np.generic):
        arrays.append(item.astype(str) if item.dtype == object else item)
        return {"array": len(arrays)}
    if isinstance(item, dict):
        return {"fields": {name: _described(part, arrays) for name, part in item.items()}}
    return [_described(part, arrays) for part in item] if isinstance(item, list) else item


def _limit(largest: int, seconds: float) -> None:
    """Limit memory, and processor time from now on, where the operating system can."""
    if find_spec("resource") is None:
        return
    import resource

    latest = math.ceil(time.process_time() + seconds) + 1
    limits = {resource.RLIMIT_AS: 4 * largest, resource.RLIMIT_CPU: latest, resource.RLIMIT_CORE: 0}
    for what, limit in limits.items():
        hard = resource.getrlimit(what)[1]
        resource.setrlimit(what, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def main() -> None:
    """Answer each request with JSON in one line, then the arrays in NumPy's format."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the one that asks ends this one
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    for line in sys.stdin.buffer:
        request = json.loads(line)
        _limit(request["largest"], request["seconds"])
        arrays: list[Any] = []
        try:
            content = parse(request["path"], request["names"], request["largest"], request["without"])
            answer = {"content": _described(content, arrays)}
        except Refused as error:
            output.write(json.dumps({"refused": f"{error}"}).encode() + b"\n")
            return
        output.write(json.dumps(answer, default=str).encode() + b"\n")
        for array in arrays:
            np.save(SimpleNamespace(write=output.write), array, allow_pickle=False)  # NumPy cannot seek in a pipe
        output.flush()
        del content, answer, arrays


if __name__ == "__main__":
    main()
