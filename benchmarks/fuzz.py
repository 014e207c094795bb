"""Damages files of every format that is read, and counts what the readers make of them.

Run `python -m benchmarks.fuzz [--runs N] [--seed N]`; 3,000 runs by default. A bit is flipped, a sector of 512 bytes is
zeroed, or the file is cut off, at a random place. Each file is then read in a forked process, with the parsers that the
guarded child process runs and its limit on time: an end by a signal is what that child turns into a refusal. Of
recordings, what is read is compared with the undamaged one: damage to values must be noticed.
"""

import argparse
import os
import random
import resource
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomli_w

from armperturb import recording as of_recordings
from armperturb.convert import arrays, columns, reading
from armperturb.convert.importer import import_recording
from armperturb.foreign import program
from armperturb.recording_files import load_recording
from armperturb.study.protocol import THESIS, load_protocol

LONGEST, LARGEST = 30, 2**30
"""Time [s] and memory [byte] of a reader."""

ENDS = ("unchanged", "refused", "other descriptions", "DAMAGE NOT NOTICED", "TRACEBACK")
"""How a reader ends, by its exit status."""


def _parsed(path: Path, names: Any = None, *, without: Any = (), seconds: float = LONGEST) -> dict[str, Any]:
    """What the child process would give, from this one."""
    return program.parse(str(path), names, LARGEST, without)


def _laboratory(folder: Path) -> dict[str, Callable[[], Any]]:
    """Writes a file of each kind, and tells how each is read."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from laboratory import write

    from armperturb.convert.exporter import export_recording
    from armperturb.recording_files import save_recording

    table = write(folder)
    recording = import_recording([table]).recording
    save_recording(recording, folder / "r.nc")
    export_recording(recording, folder / "r.mat")
    (folder / "protocol.toml").write_text(tomli_w.dumps(THESIS.to_dict()))
    shutil.copy(table, folder / "beside.csv")
    shutil.copy(table.with_suffix(".json"), folder / "beside.json")
    return {
        "r.nc": lambda: load_recording(folder / "r.nc"),
        "r.mat": lambda: import_recording([folder / "r.mat"]),
        table.name: lambda: import_recording([table]),
        "beside.json": lambda: import_recording([folder / "beside.csv"]),
        "protocol.toml": lambda: load_protocol(folder / "protocol.toml"),
    }


def damaged(content: bytes, rng: random.Random) -> bytes:
    """The content with a bit flipped, a sector zeroed, or cut off."""
    changed, at = bytearray(content), rng.randrange(len(content))
    kind = rng.randrange(4)
    if kind < 2:
        changed[at] ^= 1 << rng.randrange(8)
    elif kind == 2:
        at -= at % 512
        changed[at : at + 512] = bytes(min(512, len(changed) - at))
    else:
        del changed[at:]
    return bytes(changed)


def _end(read: Callable[[], Any], expected: Any) -> int:
    """Index among `ENDS`."""
    try:
        there = read()
    except (ValueError, TypeError, OSError):
        return 1
    except BaseException:
        return 4
    if expected is None:
        return 0
    if there.identical(expected):
        return 0
    same = set(there.variables) == set(expected.variables) and there.equals(expected)
    return 2 if same else 3


def outcome(read: Callable[[], Any], expected: Any) -> str:
    """How a reader ends in a forked process.

    Args:
      read: reads a damaged file.
      expected: what the undamaged file holds; None if that is not compared.
    """
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        status = 4
        try:
            status = _end(read, expected)
        finally:
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return ENDS[status] if status >= 0 else f"signal {-status}, refused by the child process"


def fuzz(runs: int, seed: int = 0) -> dict[str, Counter[str]]:
    """File to how often its reader ended how.

    Args:
      runs: damaged files in all, shared out evenly.
      seed: of the damage.
    """
    rng, ends = random.Random(seed), dict[str, Counter[str]]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        readers = _laboratory(folder)
        for module in (of_recordings, columns, reading, arrays):
            module.read_foreign = _parsed
        for place, (file, read) in enumerate(readers.items()):
            path, expected = folder / file, read()
            content, ends[file] = path.read_bytes(), Counter()
            for _ in range(place, runs, len(readers)):
                path.write_bytes(damaged(content, rng))
                ends[file][outcome(read, expected if file == "r.nc" else None)] += 1
            path.write_bytes(content)
    return ends


def main(arguments: list[str] | None = None) -> None:
    """Print how often the reader of each file ended how."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args([] if arguments is None else arguments)
    for file, ends in fuzz(options.runs, options.seed).items():
        print(f"{file}: {sum(ends.values())} runs, {dict(ends)}")


if __name__ == "__main__":
    main(sys.argv[1:])
