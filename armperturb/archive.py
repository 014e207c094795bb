"""Results of an analysis as plain files, which can hold numbers, texts and classes of this package, but no code.

Arrays are kept to the last bit, in base64 of NumPy's own format; classes are dataclasses and named tuples of this
package, by name and field. Below the JSON stands its digest with a key of the user's: what somebody else has written,
or changed, is not believed. The key lies in the file that ARMPERTURB_KEY names, by default `armperturb/key` in the
user's folder of data; where that cannot be written, results are not recalled by another process.
"""

import base64
import dataclasses
import errno
import gzip
import hashlib
import hmac
import importlib
import io
import json
import operator
import os
import secrets
import zlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from armperturb.files import write_whole

PACKAGE = "armperturb"

LARGEST = 2**26
"""Largest content of a file, unpacked [byte]: JSON takes some 20 times as much in memory."""

LARGEST_KEY = 2**12
"""Of the file of the key, what is read [byte]."""

_KIND, _CONTENT = "kind", "content"

_MAKE: Mapping[str, Callable[[Any], Any]] = {
    "complex": lambda parts: complex(*parts),
    "array": lambda text: np.load(io.BytesIO(base64.b64decode(text)), allow_pickle=False),
    "path": Path,
    "tuple": tuple,
    "mapping": dict,
    "table": lambda parts: pd.DataFrame(parts["columns"], index=parts["index"]),
}
"""Kind to what makes it of its content."""


class Archive(NamedTuple):
    """A value that was read, and what it was made from.

    Attributes:
      source: as `write_archive` was given it, as JSON has it.
      value: likewise.
    """

    source: Any
    value: Any


def write_archive(path: Path, source: Any, value: Any) -> None:
    """Write a value, whole or not at all.

    Args:
      path: of the file; its folder is there.
      source: what the value was made from, as JSON has it.
      value: None, truth values, numbers, texts, paths, tuples, lists, mappings, arrays, tables of such, and
        dataclasses and named tuples of this package that hold such.

    Raises:
      TypeError: it holds anything else.
      OSError: the file cannot be written.
    """
    content = json.dumps({"source": source, "value": _plain(value)}, separators=(",", ":")).encode()
    if len(content) > LARGEST:
        raise OSError(errno.EFBIG, f"{len(content)} bytes; expected at most {LARGEST}", str(path))
    write_whole(path, gzip.compress(content + b"\n" + _signature(content), compresslevel=1, mtime=0))


@cache
def _key() -> bytes:
    given, home = os.environ.get("ARMPERTURB_KEY"), os.environ.get("XDG_DATA_HOME")
    new = secrets.token_bytes(32)
    try:
        path = Path(given) if given else (Path(home) if home else Path.home() / ".local/share") / PACKAGE / "key"
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(new)
        except FileExistsError:
            if not path.is_file():  # a pipe would never end
                return new
            with path.open("rb") as of_user:
                key = of_user.read(LARGEST_KEY)
            return key if len(key) >= len(new) else new
    except (OSError, RuntimeError):  # there is no home, or none that can be written to
        pass
    return new


def _signature(content: bytes) -> bytes:
    return hmac.new(_key(), content, hashlib.sha256).hexdigest().encode()


def digest(value: Any) -> str:
    """Checksum of a value that `write_archive` can write."""
    return hashlib.sha256(json.dumps(_plain(value)).encode()).hexdigest()


def read_archive(path: Path) -> Archive:
    """What `write_archive` wrote.

    Raises:
      FileNotFoundError: there is no file.
      ValueError: the file cannot be read, is damaged or too large, was written by somebody else or changed, or holds
        classes that this version of the package lacks.
    """
    try:
        if path.exists() and not path.is_file():
            raise ValueError("a folder, a pipe or a device")
        with path.open("rb") as file:
            unpacker = zlib.decompressobj(wbits=31)  # of gzip
            text, _, signature = unpacker.decompress(file.read(LARGEST), LARGEST + 128).rpartition(b"\n")
        if not unpacker.eof or not hmac.compare_digest(signature, _signature(text)):
            raise ValueError("written by somebody else, or changed since")
        content = json.loads(text)
        return Archive(content["source"], _restored(content["value"]))
    except FileNotFoundError:
        raise
    except Exception as error:  # damage makes libraries fail in any way
        raise ValueError(f"{path}: {type(error).__name__}: {error}; expected what this version writes") from None


def _plain(value: Any) -> Any:
    """What JSON can hold; everything that it does not know by itself is an object of kind and content."""
    if value is None or isinstance(value, bool | str | int | float):
        return value
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, complex):
        return {_KIND: "complex", _CONTENT: [value.real, value.imag]}
    if isinstance(value, np.ndarray):
        buffer = io.BytesIO()
        np.save(buffer, value, allow_pickle=False)
        return {_KIND: "array", _CONTENT: base64.b64encode(buffer.getvalue()).decode("ascii")}
    if isinstance(value, Path):
        return {_KIND: "path", _CONTENT: str(value)}
    if isinstance(value, pd.DataFrame):
        columns = {name: column.tolist() for name, column in value.items()}
        return {_KIND: "table", _CONTENT: _plain({"columns": columns, "index": value.index.tolist()})}
    if _is_record(type(value)):
        names = getattr(value, "_fields", None) or [each.name for each in dataclasses.fields(value) if each.init]
        return {_KIND: _name(type(value)), _CONTENT: {name: _plain(getattr(value, name)) for name in names}}
    if isinstance(value, tuple):
        return {_KIND: "tuple", _CONTENT: [_plain(entry) for entry in value]}
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    if isinstance(value, Mapping):
        return {_KIND: "mapping", _CONTENT: [[_plain(key), _plain(entry)] for key, entry in value.items()]}
    raise TypeError(f"{type(value).__qualname__} = {value!r:.60}; expected numbers, texts, arrays or classes of ours")


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return [_restored(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    kind, content = value[_KIND], value[_CONTENT]
    if kind in _MAKE:
        return _MAKE[kind](_restored(content))
    return _class(kind)(**{name: _restored(entry) for name, entry in content.items()})


def _is_record(kind: type) -> bool:
    """Whether it is a dataclass or a named tuple."""
    return dataclasses.is_dataclass(kind) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def _name(kind: type) -> str:
    if kind.__module__.partition(".")[0] != PACKAGE:
        raise TypeError(f"{kind.__module__}.{kind.__qualname__}; expected a class of {PACKAGE}")
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> Any:
    module, _, qualified = name.partition(":")
    if module.partition(".")[0] != PACKAGE:
        raise ValueError(f"class {name!r}; expected one of {PACKAGE}")
    kind = operator.attrgetter(qualified)(importlib.import_module(module))
    if not (isinstance(kind, type) and _is_record(kind)):
        raise ValueError(f"{name!r}; expected a dataclass or a named tuple")
    return kind
