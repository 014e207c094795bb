"""Results of an analysis as plain files: what is read back can hold numbers, texts and classes of ours, but no code.

Arrays are kept to the last bit, in base64 of NumPy's own format; classes are dataclasses and named tuples of this
package, by name and field.
"""

import base64
import dataclasses
import functools
import gzip
import hashlib
import importlib
import io
import json
import logging
import math
import zlib
from collections.abc import Callable, Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from armperturb.files import written_whole

LOG = logging.getLogger(__name__)

Value = TypeVar("Value")

PACKAGE = "armperturb"

_KIND, _CONTENT = "kind", "content"

_DAMAGED = (
    *(OSError, EOFError, zlib.error, ValueError, KeyError, TypeError, AttributeError, ImportError),
    RecursionError,
)
"""What reading raises of a file that is not there, not whole, or not ours."""


def write_archive(path: Path, key: str, value: Any) -> None:
    """Write a value, whole or not at all.

    Args:
      path: of the file; its folder is there.
      key: what the value was made from; see `read_archive`.
      value: None, truth values, numbers, texts, paths, tuples, lists, mappings, arrays, and dataclasses and named
        tuples of this package that hold such.

    Raises:
      TypeError: it holds anything else.
      OSError: the file cannot be written.
    """
    content = json.dumps({"key": key, "value": _plain(value)}, separators=(",", ":")).encode()
    with written_whole(path) as temporary:
        temporary.write_bytes(gzip.compress(content, compresslevel=1, mtime=0))


def read_archive(path: Path, key: str, kind: type[Value]) -> Value | None:
    """The value that was written with that key; None if there is none of that kind, or the file is damaged."""
    try:
        found = json.loads(gzip.decompress(path.read_bytes()))
        value = _restored(found["value"]) if found["key"] == key else None
    except _DAMAGED:
        return None
    return value if isinstance(value, kind) else None


def recalled(path: Path, key: str, kind: type[Value], compute: Callable[[], Value]) -> Value:
    """What was computed earlier with that key; else it is computed now, and kept.

    Args:
      path: of the file; its folder is made if needed.
      key: what the value is made from.
      kind: of the value.
      compute: gives the value.
    """
    kept = read_archive(path, key, kind)
    if kept is not None:
        return kept
    value = compute()
    keep(path, key, value)
    return value


def keep(path: Path, key: str, value: Any) -> None:
    """As `write_archive`, into a folder that is made if needed; a folder that cannot be written to is only told of."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_archive(path, key, value)
    except OSError as error:
        LOG.warning("%s cannot be written (%s): it will be computed again next time", path, error.strerror or error)


@functools.cache
def code_digest() -> str:
    """SHA-256 of the package's own source and data, which every result depends on."""
    total = hashlib.sha256()

    def add(folder: Traversable, name: str) -> None:
        for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
            if entry.is_dir():
                add(entry, f"{name}/{entry.name}")
            elif entry.name.endswith((".py", ".csv", ".toml", ".xml")):
                total.update(f"{name}/{entry.name}\n".encode())
                total.update(entry.read_bytes())

    add(resources.files(PACKAGE), PACKAGE)
    return total.hexdigest()


def _plain(value: Any) -> Any:
    """What JSON can hold; everything that it does not know by itself is an object of kind and content."""
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {_KIND: "float", _CONTENT: repr(value)}
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, complex):
        return {_KIND: "complex", _CONTENT: [_plain(value.real), _plain(value.imag)]}
    if isinstance(value, np.ndarray):
        buffer = io.BytesIO()
        np.save(buffer, value, allow_pickle=False)
        return {_KIND: "array", _CONTENT: base64.b64encode(buffer.getvalue()).decode("ascii")}
    if isinstance(value, Path):
        return {_KIND: "path", _CONTENT: str(value)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        return {_KIND: _name(type(value)), _CONTENT: {name: _plain(entry) for name, entry in fields.items()}}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {_KIND: _name(type(value)), _CONTENT: {name: _plain(getattr(value, name)) for name in value._fields}}
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
    if kind == "float":
        return float(content)
    if kind == "complex":
        return complex(*map(_restored, content))
    if kind == "array":
        return np.load(io.BytesIO(base64.b64decode(content)), allow_pickle=False)
    if kind == "path":
        return Path(content)
    if kind == "tuple":
        return tuple(_restored(entry) for entry in content)
    if kind == "mapping":
        return {_restored(key): _restored(entry) for key, entry in content}
    return _class(kind)(**{name: _restored(entry) for name, entry in content.items()})


def _name(kind: type) -> str:
    if kind.__module__.partition(".")[0] != PACKAGE:
        raise TypeError(f"{kind.__module__}.{kind.__qualname__}; expected a class of {PACKAGE}")
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> Any:
    module, _, qualified = name.partition(":")
    if module.partition(".")[0] != PACKAGE:
        raise ValueError(f"class {name!r}; expected one of {PACKAGE}")
    found: Any = importlib.import_module(module)
    for part in qualified.split("."):
        found = getattr(found, part)
    is_tuple = isinstance(found, type) and issubclass(found, tuple) and hasattr(found, "_fields")
    if not (is_tuple or (isinstance(found, type) and dataclasses.is_dataclass(found))):
        raise ValueError(f"{name!r}; expected a dataclass or a named tuple")
    return found
