"""The columns of a file, under the names that a sidecar gives them, with what their names say."""

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from armperturb.convert.reading import C3D, TEXT
from armperturb.convert.sidecar import Dialect
from armperturb.convert.tables import TABLES
from armperturb.convert.text import is_row_of_text, lines_of
from armperturb.convert.units import UNITS
from armperturb.files import require_input
from armperturb.foreign import LARGEST, read_foreign

WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_KNOWN = {unit for known in UNITS.values() for unit in known} - {""}
_UNITS = "|".join(sorted(_KNOWN))
_EMG = {*TABLES["words"]["emg"]}
_SIGNALS = {word for known in TABLES["roles"].values() for word in known.split()}
_UNIT = re.compile(rf"\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$|[\s_.-]+({_UNITS})$")


class Column(NamedTuple):
    """A channel: what the sidecar calls it, what it is named after, its values, and what the file states of it."""

    channel: str
    label: str
    values: NDArray[Any]
    unit: str = ""
    rate: float = 0.0

    @property
    def name(self) -> str:
        """What it is named after, without a unit."""
        match = _UNIT.search(self.label)
        return self.label[: match.start()] if match else self.label

    def words(self) -> tuple[list[str], str]:
        """Words of the name in lower case, and the unit, which may stand in brackets or as the last word."""
        match = _UNIT.search(self.label)
        unit = "" if match is None else match[1] or match[2] or ""
        return [word.lower() for word in WORD.findall(self.name)], self.unit or unit


def axis_of(words: Sequence[str]) -> tuple[tuple[str, ...], str | None]:
    """Words without that for the axis, and the axis: force x, x force, Fx, force 1, and Fx1 of the first sensor."""
    axes = {"x": "x", "y": "y", "1": "x", "2": "y"}
    if len(words) > 1 and words[-1].isdecimal() and words[-2][-1] in "xy":
        stem = tuple(word for word in (*words[:-2], words[-2][:-1]) if word)
        if stem not in ((), ("m",)):  # x1 may be the first axis, and Mx1 is a moment of the first sensor
            return (*stem, words[-1]), words[-2][-1]
    for at in (-1, 0):
        if words and words[at] in axes:
            return tuple(words[:-1] if at else words[1:]), axes[words[at]]
    if words and words[-1][-1] in "xy":
        return (*words[:-1], words[-1][:-1]), words[-1][-1]
    return tuple(words), None


def dialect_of(path: Path) -> Dialect:
    """Dialect of a text file: that of the longest table among its first lines.

    Raises:
      ValueError: the file is no text, too large, or has too long a line.
      OSError: it cannot be read.
    """
    lines = _first_lines(path, 50)
    best, length, width = Dialect(), 0, 1
    for delimiter in (";", "\t", ",", " "):
        counts = [line.count(delimiter) for line in lines]
        start = next((at for at in range(len(lines)) if len(set(counts[at:])) == 1), len(lines))
        if counts[-1:] > [0] and (len(lines) - start, counts[-1]) > (length, width):
            length, width = len(lines) - start, counts[-1]
            comma = delimiter != "," and bool(re.search(r"\d,\d", lines[-1]))
            best = Dialect(delimiter, "," if comma else ".", start)
    rows = _rows(lines[best.skip_lines :], best) if length else []
    return best._replace(skip_lines=best.skip_lines + _row_of_names(rows, best.decimal))


def _first_lines(path: Path, number: int) -> list[str]:
    require_input(path, LARGEST)
    try:
        with path.open(encoding="utf-8-sig") as file:
            return "".join(islice(lines_of(file, path), number)).rstrip("\r\n").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no readable text ({error}); expected columns in UTF-8") from None


def _rows(lines: Sequence[str], dialect: Dialect) -> list[list[str]]:
    return [[field.strip().strip('"') for field in line.split(dialect.delimiter)] for line in lines]


def _row_of_names(rows: Sequence[Sequence[str]], decimal: str) -> int:
    """Which row holds the names: the last above the numbers, or that before it if the last is one of units.

    The title above a table of a spreadsheet has as many fields as the table, most of them empty.
    """
    numbers = [
        at for row in rows[-1:] for at, field in enumerate(row) if field and not is_row_of_text([field], decimal)
    ]

    def has_numbers(row: Sequence[str]) -> bool:
        fields = [row[at] for at in numbers]
        return any(fields) and not any(is_row_of_text([field], decimal) for field in fields)

    first = next((at for at, row in enumerate(rows) if has_numbers(row)), 0)
    if first < 2:
        return 0
    above, last = ({*row} - {""} for row in rows[first - 2 : first])
    is_units = len(above) > len(last) or (len(above) == len(last) and {_bare(field) for field in last} <= _KNOWN)
    return first - 2 if is_units else first - 1


def _bare(unit: str) -> str:
    return unit.strip("[]() ")


def columns_of(path: Path, dialect: Dialect) -> list[Column]:
    """Columns of a file, whatever the format.

    Args:
      path: of the file.
      dialect: of a text file.

    Raises:
      ValueError: the file is damaged, too large, or holds no columns.
      ModuleNotFoundError: C3D is to be read, and ezc3d is not installed.
      OSError: it cannot be read.
    """
    if path.suffix.lower() in TEXT:
        start = dialect.skip_lines
        header, *below = _rows(_first_lines(path, start + 2)[start:], dialect) or [[]]
        several = [name for name in dict.fromkeys(header) if name and header.count(name) > 1]
        if several:
            warnings.warn(
                f"{path}: columns {', '.join(map(repr, several))} come several times and are not used; expected once "
                "(rename all but one)",
                stacklevel=2,
            )
        units = below[0] if below and is_row_of_text(below[0], dialect.decimal) else []
        try:
            table = pd.read_csv(
                path,
                sep=dialect.delimiter,
                decimal=dialect.decimal,
                skiprows=[*range(start), *([start + 1] if units else [])],
                encoding="utf-8-sig",
                index_col=False,
                low_memory=False,
            )
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{path}: no readable table ({' '.join(str(error).split())}); expected columns") from None
        unused = {"", *several}
        named = [name for at, name in enumerate(table) if at >= len(header) or header[at] not in unused]
        columns = [Column(str(name).strip(), str(name).strip(), table[name].to_numpy()) for name in named]
        for at, unit in enumerate(units[: len(columns)]):
            if not columns[at].words()[1]:
                columns[at] = columns[at]._replace(unit=_bare(unit))
        return columns
    content = read_foreign(path)
    if path.suffix.lower() in C3D:
        return [Column(name, name, part["values"], part["unit"], part["rate"]) for name, part in content.items()]
    of_trials = _matrices_of_trials(content)
    return [column for name, value in content.items() for column in _matlab_columns(name, value, name in of_trials)]


def _matrices_of_trials(content: Mapping[str, Any]) -> set[str]:
    """Matrices that hold one axis, so that their columns are trials, however few.

    That are X and Y of one shape, and an angle and a torque that are alone of theirs.
    """
    words = {
        name: {*Column(name, name, value).words()[0]}
        for name, value in content.items()
        if isinstance(value, np.ndarray) and value.ndim == 2
    }
    angle, torque = ({*TABLES["words"][role]} for role in ("angle", "torque"))
    of_trials = set()
    for first, second in permutations(words, 2):
        shape = content[first].shape
        if content[second].shape != shape:
            continue
        is_joint = bool(words[first] & angle and words[second] & torque) and not any(
            content[name].shape == shape and not words[name] & _EMG for name in words.keys() - {first, second}
        )
        if is_joint or (words[first], words[second]) == ({"x"}, {"y"}):
            of_trials |= {first, second}
    return of_trials


def _matlab_columns(name: str, value: Any, of_trials: bool) -> Iterator[Column]:
    """Numbers, vectors over time, matrices of components or trials, and arrays of both."""
    if isinstance(value, dict):
        inside = _matrices_of_trials(value)
        for field, inner in value.items():
            yield from _matlab_columns(f"{name}.{field}", inner, field in inside)
    if isinstance(value, list) and value:
        yield from _matlab_columns(name, value[0], of_trials)
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "fiu":
        value = value[()]
    if isinstance(value, np.generic):
        yield Column(name, name, np.array([value]))
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or not 0 < value.ndim < 4:
        return
    if value.ndim == 1:
        yield Column(name, name, value)
        return
    time = int(np.argmax(value.shape))
    dims = ["time" if axis == time else "trial" for axis in range(value.ndim)]
    last = value.ndim - 1 if time != value.ndim - 1 else 0
    leaf = Column(name, name.rpartition(".")[2], value).words()[0]
    if {*leaf} & _EMG:
        for muscle in range(value.shape[last]):
            index = [f"{muscle + 1}" if at == last else dim for at, dim in enumerate(dims)]
            yield Column(f"{name}({','.join(index)})", f"{name} {muscle + 1}", value.take(muscle, last).ravel())
        return
    if of_trials:
        structure, _, field = name.rpartition(".")
        is_signal = bool({*Column(name, structure, value).words()[0]} & _SIGNALS)  # force.x, but not data.X
        yield Column(f"{name}({','.join(dims)})", name if is_signal else field, value.ravel())
    elif value.ndim == 2 and len("".join(leaf)) > 1 and axis_of(leaf)[1] is not None:
        yield Column(f"{name}({','.join(dims)})", name, value.ravel())
    elif value.shape[last] in (2, 3):
        for component, axis in enumerate("xyz"[: value.shape[last]]):
            index = [f"{component + 1}" if at == last else dim for at, dim in enumerate(dims)]
            yield Column(f"{name}({','.join(index)})", f"{name}.{axis}", value.take(component, last).ravel())
    elif value.ndim == 2 and leaf and leaf[-1] not in TABLES["words"]["time"]:  # trials of one axis
        yield Column(f"{name}({','.join(dims)})", name, value.ravel())
