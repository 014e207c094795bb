"""Files that are there whole or not at all, and tables that lie beside the code."""

import csv
import errno
import hashlib
import math
import os
import re
import secrets
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


_INPUTS: ContextVar[set[tuple[int, int]] | None] = ContextVar("inputs", default=None)
"""Device and number of each file that was read, where those must not be written to."""

PART = re.compile(r"\..+\.[0-9a-f]{16}\.part")
"""Name of a temporary file."""

LONGEST_PART = 180
"""How much of a file's name that of its temporary file has [byte]; a name may have 255."""

_UNFINISHED: set[Path] = set()
"""Temporary files that this process has, or is about to have."""

LARGEST_TOML = 2**16
"""Largest TOML file of a user's [byte]; the memory that a key takes is quadratic in its parts."""

_LONG_KEY = re.compile(r"""(?:[ \t]{0,9}(?:[\w-]{1,99}|"[^"\n]{0,99}"|'[^'\n]{0,99}')[ \t]{0,9}\.){32}""")


def endings_of(labels: Iterable[str]) -> dict[str, str]:
    """Label to what a name of a file may end in: what files are rarely called is replaced, and no two are alike."""
    endings: dict[str, str] = {}
    for label in dict.fromkeys(labels):
        plain = ending = re.sub(r"[^\w.+-]", "_", label)
        number = 2
        while ending in endings.values():
            ending, number = f"{plain}_{number}", number + 1
        endings[label] = ending
    return endings


@contextmanager
def inputs_untouched() -> Iterator[None]:
    """Within the block, a file that `require_input` has accepted is neither replaced nor removed."""
    token = _INPUTS.set(set())
    try:
        yield
    finally:
        _INPUTS.reset(token)


def require_input(path: str | Path, largest: int) -> None:
    """Refuse an input that is no file, or too large.

    Args:
      path: of the file.
      largest: size that it may have [byte].

    Raises:
      FileNotFoundError: there is no such file; a pipe or a device, which may never end, is none.
      ValueError: it is larger.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder, a pipe or a device" if path.exists() else "no such file"
        raise FileNotFoundError(f"{path}: {what}; expected a file")
    status = path.stat()
    if status.st_size > largest:
        raise ValueError(f"{path}: size = {status.st_size} bytes; expected at most {largest}")
    if (inputs := _INPUTS.get()) is not None:
        inputs.add((status.st_dev, status.st_ino))


def require_no_input(path: Path) -> None:
    """Refuse an output that this command has read, within `inputs_untouched`.

    Raises:
      ValueError: it is an input.
    """
    if (inputs := _INPUTS.get()) and path.exists() and (path.stat().st_dev, path.stat().st_ino) in inputs:
        raise ValueError(f"{path}: is an input of this command; expected another name to write to")


def require_new(paths: Iterable[Path], *, overwrite: bool) -> None:
    """Refuse outputs that are inputs or folders, exist already, or have no folder to lie in.

    Args:
      paths: of the files to write.
      overwrite: whether existing ones may be replaced, unless they are inputs.

    Raises:
      ValueError: one is an input, or exists and must not be replaced.
      IsADirectoryError: one is a folder.
      FileNotFoundError: the folder of one does not exist.
    """
    for path in paths:
        require_folder_of(path)
        require_no_input(path)
        require_no_folder(path)
        if os.path.lexists(path) and not overwrite:  # be it a link to nothing, or a pipe
            raise ValueError(f"{path}: exists already; expected a new name (--overwrite replaces the file)")


def require_new_results(folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Refuse a folder of results in which one is an input, or was written earlier.

    Args:
      folder: to write to; it may not exist.
      names: of the results in it; `*` stands for any text.
      overwrite: whether earlier results may be replaced, unless they are inputs.

    Raises:
      ValueError: a result is an input, or exists and must not be replaced.
      IsADirectoryError: a folder has the name of a result.
    """
    paths = [path for name in names for path in (sorted(folder.glob(name)) if "*" in name else [folder / name])]
    earlier = [path for path in paths if os.path.lexists(path)]
    for path in earlier:
        require_no_input(path)
        require_no_folder(path)
    if earlier and not overwrite:
        raise ValueError(f"{earlier[0]}: exists already; expected a folder without results (--overwrite replaces them)")


@contextmanager
def earlier_removed(paths: Iterable[Path]) -> Iterator[None]:
    """Within the block, results of an earlier run are replaced; those that were not are removed when it ends well.

    Args:
      paths: of what the earlier run may have written, and no input.
    """
    before = {path: _version(path) for path in paths if os.path.lexists(path)}
    yield
    for path, version in before.items():
        if os.path.lexists(path) and _version(path) == version:
            path.unlink()


def _version(path: Path) -> tuple[int, int]:
    """What changes when a file is written anew."""
    status = path.lstat()
    return status.st_ino, status.st_mtime_ns


def require_no_folder(path: Path) -> None:
    """Refuse a file to write that is a folder.

    Raises:
      IsADirectoryError: it is.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; expected the name of a file to write")


def packaged_table(package: str, name: str) -> dict[str, Any]:
    """Content of a TOML file that lies beside the modules of a package."""
    return tomllib.loads(resources.files(package).joinpath(name).read_text(encoding="utf-8"))


def read_toml(path: str | Path, example: str) -> dict[str, Any]:
    """Content of a TOML file of the user's.

    Args:
      path: of the file.
      example: a line as the file should have, for the message.

    Raises:
      ValueError: the file is no TOML, or too large.
      OSError: the file cannot be read.
    """
    require_input(path, LARGEST_TOML)
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        if _LONG_KEY.search(text):
            raise ValueError(f"{path}: a key has more than 32 parts; expected lines such as '{example}'")
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not a TOML file ({error}); expected lines such as '{example}'") from None


def require_folder_of(path: Path) -> None:
    """Refuse a file to write whose folder does not exist.

    Raises:
      FileNotFoundError: the folder does not exist.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: folder {path.parent} does not exist; expected an existing folder")


@contextmanager
def written_together(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Temporary paths that take the places of `paths` when the block ends well, and vanish when it does not.

    All of them are on disk before the first takes its place, and their names are when this returns: a file outlasts a
    loss of power whole or not at all.

    Args:
      paths: of the files to write; existing ones are replaced.

    Raises:
      ValueError: one is an input of the command that writes.
      OSError: a folder is missing or cannot be written to; the message names the file.
    """
    parts: dict[Path, Path] = {}
    try:
        for path in paths:
            parts[path] = _part(path)
        yield list(parts.values())
        # Until then they are private; a result is as readable as any other file of the user.
        mask = os.umask(0)
        os.umask(mask)
        for part in parts.values():
            os.chmod(part, 0o666 & ~mask)
            sync(part)
        for path, part in parts.items():
            os.replace(part, path)
        for folder in {path.parent for path in parts}:
            sync(folder)
    except OSError as error:
        if error.errno is None or not parts:
            raise
        # A full disk names no file. What is named is a file that the user knows.
        known = {str(part): path for path, part in parts.items()}
        if error.filename is not None and str(error.filename) not in known:
            raise
        named = known.get(str(error.filename), next(iter(parts)))
        raise OSError(error.errno, error.strerror, str(named)) from error
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
            _UNFINISHED.discard(part)


def remove_unfinished() -> None:
    """Remove what an interruption, which may come at any moment, has left of files that were being written."""
    while _UNFINISHED:
        with suppress(OSError):
            _UNFINISHED.pop().unlink(missing_ok=True)


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """`written_together` of one file."""
    with written_together([Path(path)]) as (temporary,):
        yield temporary


def write_whole(path: str | Path, content: bytes | str) -> None:
    """Write a file whole or not at all, text as UTF-8, as `written_together` does.

    Bytes of a file's name that are no UTF-8, which Python holds as surrogates, are written as escapes.
    """
    with written_whole(path) as temporary:
        temporary.write_bytes(content.encode(errors="backslashreplace") if isinstance(content, str) else content)


def _part(path: Path) -> Path:
    """A new temporary file beside a file to write."""
    require_folder_of(path)
    require_no_input(path)
    require_no_folder(path)
    name = os.fsdecode(os.fsencode(path.name)[:LONGEST_PART])
    part = path.with_name(f".{name}.{secrets.token_hex(8)}.part")
    _UNFINISHED.add(part)  # before it is there
    try:
        os.close(os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error  # of the same subclass, by its number
    return part


def checksum(path: str | Path) -> str:
    """SHA-256 of a file, in hexadecimal digits.

    Raises:
      OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        status = os.fstat(file.fileno())
        return _checksum(Path(path).absolute(), status.st_ino, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=1024)
def _checksum(path: Path, *_: int) -> str:
    """Of a file that has not changed since: a report asks for that of each recording three times."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: str | Path) -> None:
    """Bring a file's content, or a folder's entries, to disk: a new name lasts only then.

    Raises:
      OSError: that fails; the message names the path.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some file systems of networks have nothing like this for folders.
        if error.errno != errno.EINVAL or not Path(path).is_dir():
            raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        os.close(handle)


def write_csv(table: "pd.DataFrame | Iterable[Mapping[str, Any]]", path: str | Path) -> None:
    """Write a table as CSV with a header line, numbers in full precision, and no text that a spreadsheet would run.

    Args:
      table: a pandas DataFrame, or at least one row, all with the keys of the first. Truth values are written as true
        and false.
      path: of the file.
    """
    frame: Any = table if hasattr(table, "to_dict") else None
    if frame is None:
        rows: list[Any] = list(table)
        columns = list(rows[0])
    else:
        columns = list(frame.columns)
        rows = frame.to_dict("records")
    with written_whole(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _as_text(cell) for name, cell in row.items()} for row in rows)


def finite_or_none(value: Any) -> Any:
    """What JSON is to hold, with None for each number that it cannot: infinite ones and NaN."""
    if isinstance(value, Mapping):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _as_text(cell: Any) -> Any:
    """A cell that a spreadsheet does not run: one that begins as a formula does gets an apostrophe, unless a number.

    Truth values are true and false.
    """
    if isinstance(cell, bool) or str(getattr(cell, "dtype", "")) == "bool":
        return str(cell).lower()
    if not isinstance(cell, str) or cell == "-" or not cell.startswith(("=", "+", "-", "@", "\t", "\r")):
        return cell
    try:
        float(cell)
    except ValueError:
        return f"'{cell}"
    return cell
