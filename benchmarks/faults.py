"""Fails the n-th write, rename, fsync or allocation of a command, for every n, and looks at what is left.

Run `python -m benchmarks.faults [COMMAND ...] [--most N]`: convert and response take minutes, identify, study, report
and score much longer. Each command runs in this process, in a folder that holds the results of an earlier run with
other options. After each failure every file must be the earlier one or the new one to the last byte, nothing else may
be there, and the command must have said why in one line. Of more than `--most` operations of a kind, so many are
failed that are spread evenly.
"""

import argparse
import builtins
import errno
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from armperturb import cli
from benchmarks.study_kills import short_protocol

OPERATIONS = {
    "write": ((builtins, "open"), (io, "open")),
    "rename": ((os, "replace"), (os, "rename")),
    "fsync": ((os, "fsync"),),
    "allocation": ((np, "zeros"), (np, "empty"), (np, "concatenate"), (np, "stack")),
}
"""Kind to the functions that do it."""


class Fault:
    """Counts the operations of a kind and fails one of them.

    Attributes:
      count: operations so far.
    """

    def __init__(self, kind: str, number: int) -> None:
        self.kind, self.number, self.count = kind, number, 0

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, the n-th call of which fails."""

        def called(*args: Any, **options: Any) -> Any:
            mode = str(options.get("mode", args[1] if len(args) > 1 else "r"))
            if self.kind == "write" and not set(mode) & set("wxa"):
                return function(*args, **options)
            self.count += 1
            if self.count != self.number:
                return function(*args, **options)
            if self.kind == "allocation":
                raise MemoryError("Unable to allocate")
            if self.kind == "write":
                # What could still be written is there.
                with function(*args, **options) as file:
                    file.write("half" if "b" not in mode else b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        return called

    @contextmanager
    def injected(self) -> Iterator[None]:
        """Within the block, the operations count and one fails."""
        patches = [mock.patch.object(owner, name, self(getattr(owner, name))) for owner, name in OPERATIONS[self.kind]]
        for patch in patches:
            patch.start()
        try:
            yield
        finally:
            for patch in patches:
                patch.stop()


def contents(folder: Path) -> dict[str, bytes]:
    """Path to content of all files in a folder, folders included."""
    return {str(path.relative_to(folder)): b"" if path.is_dir() else path.read_bytes() for path in folder.rglob("*")}


def run(arguments: list[str]) -> tuple[int, str]:
    """Exit status of a command and what it said of an error."""
    said = io.StringIO()
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        status = cli.main(arguments)
    return status, said.getvalue()


def numbers(count: int, most: int) -> list[int]:
    """Which operations of so many are failed, from 1."""
    return sorted(set(np.linspace(1, count, min(count, most)).round().astype(int).tolist()))


def failures(inputs: Path, earlier: list[str], command: list[str], kind: str, most: int) -> Iterator[tuple[int, str]]:
    """Number of each operation that was failed, and what was wrong then, empty if nothing.

    Args:
      inputs: folder whose copy is the current folder of each run.
      earlier: command that ran before; empty for none.
      command: that fails.
      kind: of `OPERATIONS`.
      most: operations that are failed.
    """
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        old, new, now = (Path(name) / part for part in ("old", "new", "now"))
        try:
            shutil.copytree(inputs, old)
            os.chdir(old)
            if earlier:
                assert run(earlier)[0] == 0
            shutil.copytree(old, new)
            os.chdir(new)
            counted = Fault(kind, 0)
            with counted.injected():
                assert run(command)[0] == 0
            before, after = contents(old), contents(new)
            for number in numbers(counted.count, most):
                shutil.copytree(old, now)
                os.chdir(now)
                with Fault(kind, number).injected():
                    status, said = run(command)
                yield number, _wrong(status, said, before, after, contents(now))
                os.chdir(here)
                shutil.rmtree(now)
        finally:
            os.chdir(here)


def _wrong(status: int, said: str, before: dict[str, bytes], after: dict[str, bytes], left: dict[str, bytes]) -> str:
    if status == 0:
        return "" if left == after else "succeeded with other results"
    lines = [line for line in said.splitlines() if line.startswith("armperturb: error: ")]
    if len(lines) != 1 or "Traceback" in said:
        return f"{len(lines)} lines of errors: {said[-200:]!r}"
    if strange := [name for name in left if name not in before and name not in after]:
        return f"left behind: {', '.join(strange)}"
    if lost := [name for name in before if name not in left and name in after]:
        return f"lost: {', '.join(lost)}"
    halves = [name for name, content in left.items() if content not in (before.get(name), after.get(name))]
    return f"neither the old nor the new file: {', '.join(halves)}" if halves else ""


def _laboratory(folder: Path, *, with_study: bool) -> None:
    """A recording of two trials, as CSV with its sidecar and as netCDF, a short protocol, and its study if asked."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from foreign_arms import Arm
    from foreign_recordings import Setup, write_csv

    setup = Setup(arm=Arm(), seed=3, n_trials=2, duration=24.0, linear=True)
    write_csv(setup, *setup.record(), folder)
    os.chdir(folder)
    assert run(["convert", "foreign.csv", "--out", "r.nc"])[0] == 0
    short_protocol(folder / "short.toml")
    if not with_study:
        return
    study = ["study", "--protocol", "short.toml", "--subjects", "1", "--workers", "1", "--record-only", "--out", "made"]
    assert run(study)[0] == 0


COMMANDS = {
    # Not to MATLAB, whose header holds the date.
    "convert": (
        ["convert", "foreign.csv", "--rate", "100", "--out", "o.csv"],
        ["convert", "r.nc", "--out", "o.csv", "--overwrite"],
    ),
    "response": (
        ["response", "r.nc", "--out", "o", "--method", "welch"],
        ["response", "r.nc", "--out", "o", "--method", "multitaper"],
    ),
    "identify": (
        ["identify", "r.nc", "--model", "1", "--out", "o"],
        ["identify", "r.nc", "--model", "2", "--out", "o"],
    ),
    "study": (
        [],
        ["study", "--protocol", "short.toml", "--subjects", "1", "--workers", "1", "--record-only", "--out", "o"],
    ),
    "report": ([], ["report", "made", "--workers", "1"]),
    "score": ([], ["score", "made"]),
    "video": (
        ["video", "made/recordings/S01.nc", "--trial", "0", "--out", "o.gif"],
        ["video", "made/recordings/S01.nc", "--trial", "1", "--out", "o.gif", "--overwrite"],
    ),
    "calibrate": ([], ["calibrate", "--out", "o.toml"]),
}
"""Name to the command that ran before, and the command that fails."""


def main(arguments: list[str] | None = None) -> None:
    """Print for each command and kind of operation how many were failed, and what was wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", default=["convert", "response"], choices=list(COMMANDS))
    parser.add_argument("--most", type=int, default=20)
    options = parser.parse_args([] if arguments is None else arguments)
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        _laboratory(Path(name), with_study=bool({"report", "score", "video"} & set(options.commands)))
        os.chdir(here)
        for command in options.commands:
            for kind in OPERATIONS:
                seen = list(failures(Path(name), *COMMANDS[command], kind, options.most))
                wrong = [(number, text) for number, text in seen if text]
                print(f"{command}, {kind}: {len(seen)} failed, {len(wrong)} wrong {wrong[:3]}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
