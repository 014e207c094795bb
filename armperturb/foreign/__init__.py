"""MATLAB, NPZ, C3D and HDF5 files, parsed in a child process.

Damaged or crafted files crash the libraries that parse them, keep them busy for ever, or make them allocate any amount
of memory. All of that happens to `program.py`; this process reads plain arrays from a temporary file.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Collection
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

import numpy as np

from armperturb.extras import naming_the_extra
from armperturb.files import require_input
from armperturb.foreign.program import REFUSED
from armperturb.foreign.program import Refused as Refused

LARGEST = 2**30
"""Largest file, and largest content of one [byte]: an hour of eight channels at 2 kHz takes less than half of it."""

LONGEST = 30.0
"""Time in which a file must be parsed [s]."""

_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
"""One thread needs less address space, and no filter is loaded from a folder of plugins."""


def read_foreign(
    path: Path, names: Collection[str] | None = None, *, without: Collection[str] = (), seconds: float = LONGEST
) -> dict[str, Any]:
    """Content of a file as nested dictionaries and lists of numbers, texts and arrays.

    | ending | content |
    |---|---|
    | .mat | variable to an array without dimensions of length 1, text, dictionary (a structure; of lists if it is an
      array of structures) or list (a cell array) |
    | .npz | array to an array without dimensions of length 1 |
    | .c3d | channel to `values` (time,), `rate` [Hz] and `unit` |
    | other | netCDF4: `attrs`, and in `variables` each one's `dims`, `attrs` and `values` |

    Args:
      path: of the file.
      names: variables or channels that are wanted; the others, or their values, are None. By default all are read.
      without: variables of netCDF that are left out.
      seconds: time in which the file must be parsed.

    Raises:
      Refused: (a ValueError) the file is damaged, of another format or too large, or parsing it takes too long.
      ModuleNotFoundError: C3D is to be read, and ezc3d is not installed.
      OSError: the file cannot be read.
    """
    require_input(path, LARGEST)
    with path.open("rb"):
        pass  # raises what the child process could not
    if path.suffix.lower() == ".c3d" and find_spec("ezc3d") is None:
        with naming_the_extra(f"{path}: C3D"):
            raise ModuleNotFoundError(name="ezc3d")
    program, wanted = Path(__file__).with_name("program.py"), json.dumps(None if names is None else sorted(names))
    arguments = (program, path.resolve(), wanted, LARGEST, seconds, json.dumps(sorted(without)))
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(
                [sys.executable, "-P", *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.PIPE,
                timeout=seconds,
                env={**os.environ, **_ENVIRONMENT},
            )
        except subprocess.TimeoutExpired:
            raise Refused(f"{path}: parsing took {seconds:g} s; expected an undamaged file") from None
        if done.returncode == REFUSED:
            raise Refused(f"{path}: {done.stderr.decode(errors='replace')}")
        if done.returncode:
            ending = next((s.name for s in signal.Signals if s == -done.returncode), f"status {done.returncode}")
            raise Refused(f"{path}: parsing crashed ({ending}); expected an undamaged file")
        output.seek(0)
        return dict(_content(json.loads(output.readline()), output))


def _content(item: Any, file: IO[bytes]) -> Any:
    """What the JSON of the program stands for; arrays follow in the file in the order in which they stand there."""
    if isinstance(item, list):
        return [_content(part, file) for part in item]
    if not isinstance(item, dict):
        return item
    if "array" in item:
        return np.load(file, allow_pickle=False)[()]
    return {name: _content(part, file) for name, part in item["fields"].items()}
