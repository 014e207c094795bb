"""Channels of files of arrays: MATLAB, v5 to v7 and v7.3, and NumPy's NPZ.

A channel is a variable, or a field of structures, with what its dimensions mean: `data.force(time,2)` is the second
column of a matrix, `force(trial,time,2)` of an array of all trials, `trials(trial).force(time,2)` of an array of
structures and `force{trial}(time,2)` of a cell array. A bare name is a vector over time; in NPZ it is that of an array.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.arrays import Array
from armperturb.convert.raw import RawTrial, missing_channel, split_trials
from armperturb.foreign import read_foreign

_ADDRESS = re.compile(r"(?P<path>[A-Za-z]\w*(?:\.[A-Za-z]\w*)*)(?:\((?P<index>[^()]*)\))?")
_Dims = list[str | int]


def read_arrays(path: Path, names: Collection[str], number: str | None) -> Sequence[RawTrial]:
    """Read channels of a MATLAB or NPZ file.

    Args:
      path: of the file.
      names: channels that are wanted, including the one with the trial's number.
      number: channel that numbers the trials, if there is one.

    Raises:
      ValueError: the file is damaged, too large or of another format, a channel is not in it, or holds no numbers.
      OSError: it cannot be read.
    """
    addresses = {name: _address(path, name) for name in names}
    content = read_foreign(path, {fields[0] for fields, _ in addresses.values()})
    channels = {name: _of_trials(path, name, *address, content) for name, address in addresses.items()}
    counts = {name: len(parts) for name, parts in channels.items() if len(parts) != 1}
    n_trials = max(counts.values(), default=1)
    for name, count in counts.items():
        if count != n_trials:
            raise ValueError(f"{path}: {name} has {count} trials; expected {n_trials} as the others")
    trials = []
    for trial in range(n_trials):
        # A channel without trials, as the times may be, is that of all.
        of_trial = {name: parts[trial if len(parts) > 1 else 0] for name, parts in channels.items()}
        trials.append(RawTrial(name=str(trial + 1) if n_trials > 1 else path.name, channels=of_trial))
    if number is None:
        return trials
    if n_trials > 1:
        raise ValueError(f"{path}: trial = {number!r} beside arrays of {n_trials} trials; expected only one of them")
    lengths = {len(values) for values in trials[0].channels.values()}
    if len(lengths) > 1:
        raise ValueError(f"{path}: channels of {' and '.join(map(str, sorted(lengths)))} samples; expected one length")
    return split_trials(path, trials[0].channels, number)


def _address(path: Path, name: str) -> tuple[list[str], _Dims]:
    """Where a channel stands: fields from the variable down, and the meaning of each dimension."""
    plain = name.replace("(trial)", "").replace("{trial}", "")
    match = _ADDRESS.fullmatch(plain)
    index: _Dims = []
    if match is not None:
        for part in (match["index"] or "time").split(","):
            part = part.strip()
            number = int(part) if part.isascii() and part.isdecimal() and len(part) < 9 else 0
            index.append(part if part in ("time", "trial") else number)
    if match is None or index.count("time") != 1 or index.count("trial") > 1 or 0 in index:
        raise ValueError(
            f"{path}: channel {name!r}; expected a variable or field and its dimensions, e.g. 'data.force(time,1)'"
        )
    return match["path"].split("."), index


def _of_trials(path: Path, name: str, fields: list[str], dims: _Dims, content: Mapping[str, Any]) -> list[Array]:
    """Values of a channel in each trial; of a single one if there is no dimension for trials."""
    value: Any = content
    for field in fields:
        if isinstance(value, list):
            value = [part.get(field) if isinstance(part, dict) else None for part in value]
            continue
        if not isinstance(value, dict) or field not in value:
            raise missing_channel(path, name, list(value) if isinstance(value, dict) else [])
        value = value[field]
    if not isinstance(value, list):
        return _sliced(path, name, value, dims)
    if "trial" in dims:
        raise ValueError(f"{path}: channel {name!r} has its trials in a list; expected no dimension 'trial'")
    return [values for part in value for values in _sliced(path, name, part, dims)]


def _sliced(path: Path, name: str, array: Any, index: _Dims) -> list[Array]:
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
        what = f"values of type {array.dtype}" if isinstance(array, np.ndarray) else f"{array!r:.40}"
        raise ValueError(f"{path}: channel {name!r} holds {what}; expected an array of numbers")
    dims = list(index)
    # The reader drops dimensions of length one: of a single trial first, then that of a single column.
    while len(dims) > array.ndim and ("trial" in dims or 1 in dims):
        dims.remove("trial" if "trial" in dims else 1)
    if len(dims) != array.ndim:
        raise ValueError(
            f"{path}: channel {name!r} has {array.ndim} dimensions longer than 1; expected {len(index)}, as its name "
            "in the sidecar says"
        )
    for axis, dim in enumerate(dims):
        if isinstance(dim, int) and dim > array.shape[axis]:
            raise ValueError(
                f"{path}: channel {name!r} has shape {array.shape}; expected at least {dim} along dimension {axis + 1}"
            )
    array = array[tuple(dim - 1 if isinstance(dim, int) else slice(None) for dim in dims)].astype(float)
    free = [dim for dim in dims if not isinstance(dim, int)]
    return [array] if free == ["time"] else list(array if free == ["trial", "time"] else array.T)
