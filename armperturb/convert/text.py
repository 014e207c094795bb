"""Reads text files of columns, such as CSV: one line per sample, below a line of names and perhaps one of units."""

import csv
import math
from array import array
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np

from armperturb.convert.raw import RawTrial, missing_channel, split_trials
from armperturb.convert.sidecar import Dialect
from armperturb.convert.units import parsed_number
from armperturb.files import require_input
from armperturb.foreign import LARGEST

MARKS = {b"PK\x03\x04": "a zip archive", b"\x89HDF": "an HDF5 file", b"MATLAB": "a MATLAB file", b"\x1f\x8b": "gzip"}
"""First bytes of files that are not text."""


LONGEST_LINE = 2**20
"""Characters of the longest line: a file of commas alone would become a column for each."""


def lines_of(file: TextIO, path: Path) -> Iterator[str]:
    """Lines of a text file.

    Raises:
      ValueError: one is too long.
    """
    for number, line in enumerate(iter(partial(file.readline, LONGEST_LINE), ""), 1):
        if len(line) == LONGEST_LINE:
            raise ValueError(f"{path}, line {number}: {LONGEST_LINE} characters or more; expected lines of a table")
        yield line


def is_row_of_text(fields: Sequence[str], decimal: str) -> bool:
    """Whether a row holds text and no number, as one of names or units does."""
    return any(map(str.strip, fields)) and not any(
        parsed_number(number) is not None for field in fields for number in (field, field.replace(decimal, "."))
    )


def read_text(path: Path, names: Collection[str], number: str | None, dialect: Dialect) -> Sequence[RawTrial]:
    """Columns of a text file.

    Args:
      path: of the file, in UTF-8.
      names: of the columns that are wanted, that with the trial's number included.
      number: column that numbers the trials, if there is one.
      dialect: how the file is written.

    Raises:
      ValueError: the file is empty, no text, lacks a column, or holds what is no number; the message names the line.
      OSError: it cannot be read.
    """
    require_input(path, LARGEST)
    with path.open("rb") as file:
        start = file.read(8)
    for mark, what in MARKS.items():
        if start.startswith(mark):
            raise ValueError(f"{path}: the file is {what}; expected text with columns")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = lines_of(file, path)
            for _ in range(dialect.skip_lines):
                next(lines, "")
            reader = csv.reader(lines, delimiter=dialect.delimiter)
            header = [name.strip() for name in next(reader, [])]
            if not any(header):
                raise ValueError(f"{path}: the file is empty; expected the names of the columns, then numbers")
            columns = _columns(path, header, names)
            values: dict[str, array[float]] = {name: array("d") for name in columns}
            blank = 0
            for row, fields in enumerate(reader):
                if row == 0 and len(fields) == len(header) and is_row_of_text(fields, dialect.decimal):
                    continue  # units, which the sidecar says
                if not fields:
                    blank = blank or reader.line_num
                    continue
                line = reader.line_num + dialect.skip_lines
                if blank:
                    raise ValueError(f"{path}, line {blank + dialect.skip_lines}: empty; expected {len(header)} values")
                if len(fields) != len(header):
                    raise ValueError(
                        f"{path}, line {line}: {len(fields)} values; expected {len(header)} as in the header"
                    )
                for name, column in columns.items():
                    values[name].append(_number(path, line, name, fields[column], dialect.decimal))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: no readable text ({error}); expected columns in UTF-8") from None
    channels = {name: np.array(column) for name, column in values.items()}
    n_rows = len(next(iter(channels.values())))
    if n_rows < 2:
        raise ValueError(f"{path}: rows = {n_rows}; expected at least 2 below the names of the columns")
    return split_trials(path, channels, number)


def _columns(path: Path, header: list[str], names: Collection[str]) -> dict[str, int]:
    columns = {}
    for name in names:
        if name not in header:
            if all(parsed_number(each) is not None for each in header):
                raise ValueError(
                    f"{path}: {header[0][:40]!r} where the names of the columns are expected (skip_lines of csv in the "
                    "sidecar, or in its signals.emg for the file of the EMG: how many lines stand above the names)"
                )
            raise missing_channel(path, name, header)
        if header.count(name) > 1:
            raise ValueError(f"{path}: column {name!r} comes {header.count(name)} times; expected once")
        columns[name] = header.index(name)
    return columns


def _number(path: Path, line: int, name: str, text: str, decimal: str) -> float:
    """A number, or NaN where there is none: an empty field, NaN, Inf."""
    text = text.strip()
    if not text:
        return math.nan
    other = "." if decimal == "," else ","
    number = None if other in text else parsed_number(text.replace(decimal, "."))
    if number is None:
        raise ValueError(f"{path}, line {line}: {name} = {text[:40]!r}; expected a number with a decimal {decimal!r}")
    return number if math.isfinite(number) else math.nan
