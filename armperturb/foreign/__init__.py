"""MATLAB, NPZ, C3D and HDF5 files, parsed in a child process.

Damaged or crafted files crash the libraries that parse them, keep them busy for ever, or make them allocate any amount
of memory. All of that happens to `program.py`; this process reads plain arrays from a pipe. Starting a child takes
longer than parsing most files, so one that has parsed a file of usual size well waits for the next; any other is ended.
"""

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from armperturb.extras import naming_the_extra
from armperturb.files import require_input
from armperturb.foreign.program import Refused as Refused

LARGEST = 2**30
"""Largest file, and largest content of one [byte]: an hour of eight channels at 2 kHz takes less than half of it."""

LARGE = 2**27
"""A child process that has parsed a larger file [byte] is ended, since it may keep much of the memory that it took."""

LONGEST = 30.0
"""Time in which a file must be parsed [s]."""

_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "HDF5_PLUGIN_PRELOAD": "::"}
"""One thread needs less address space, and no filter is loaded from a folder of plugins."""

_waiting: list["subprocess.Popen[bytes]"] = []
"""The child process that waits for the next file, if there is one."""


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
    wanted = None if names is None else sorted(names)
    request = {"path": str(path.resolve()), "names": wanted, "without": sorted(without)}
    is_large, latest = path.stat().st_size > LARGE, time.monotonic() + seconds
    child, answer = _taken(), {}
    watch = threading.Timer(seconds, child.kill)
    watch.start()
    try:
        answer = _answer(child, {**request, "largest": LARGEST, "seconds": seconds})
    finally:
        watch.cancel()
        in_time = time.monotonic() < latest
        if in_time and "content" in answer and not _waiting and not is_large:
            _waiting.append(child)
        else:
            _end(child)
    if "content" in answer:
        return dict(answer["content"])
    if "refused" in answer:
        raise Refused(f"{path}: {answer['refused']}")
    if not in_time:
        raise Refused(f"{path}: parsing took {seconds:g} s; expected an undamaged file")
    status = child.returncode
    ending = next((s.name for s in signal.Signals if s == -status), f"status {status}")
    raise Refused(f"{path}: parsing crashed ({ending}); expected an undamaged file")


def _taken() -> "subprocess.Popen[bytes]":
    """The child process that waits, or a new one."""
    with suppress(IndexError):
        child = _waiting.pop()
        if child.poll() is None:
            return child
        _end(child)
    return subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__).with_name("program.py"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **_ENVIRONMENT},
    )


def _end(child: "subprocess.Popen[bytes]") -> None:
    child.kill()
    with suppress(OSError), child:  # what it was not told any more cannot be written
        pass


@atexit.register
def _end_all() -> None:
    while _waiting:
        _end(_waiting.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_waiting.clear)  # it answers one process


def _answer(child: "subprocess.Popen[bytes]", request: dict[str, Any]) -> dict[str, Any]:
    """`content` or `refused`, or nothing of a child process that dies."""
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        child.stdin.write(json.dumps(request).encode() + b"\n")
        child.stdin.flush()
        answer: dict[str, Any] = json.loads(child.stdout.readline())
        if "content" in answer:
            answer["content"] = _content(answer["content"], SimpleNamespace(read=child.stdout.read))
    except (OSError, ValueError):
        return {}
    return answer


def _content(item: Any, stream: SimpleNamespace) -> Any:
    """What the JSON of the program stands for; arrays follow in the order in which they stand there."""
    if isinstance(item, list):
        return [_content(part, stream) for part in item]
    if not isinstance(item, dict):
        return item
    if "array" in item:
        return np.lib.format.read_array(stream, allow_pickle=False)[()]
    return {name: _content(part, stream) for name, part in item["fields"].items()}
