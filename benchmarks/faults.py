"""Fails the n-th write, rename, fsync or allocation of a command, for every n, and looks at what is left.

Run `python -m benchmarks.faults [COMMAND ...] [--kinds KIND ...] [--most N]`: by default every operation of all
commands, which takes some hours; with GLIBC_TUNABLES=glibc.malloc.hugetlb=1 and PYTHONMALLOC=malloc, large pages
make forks faster. Each command runs in this process, in a folder that may hold the results of an earlier run with other
options. After each failure every file must be the earlier one or the new one to the last byte, nothing else may be
there, the exit status must be 1, and the command must have said why in one line.

The command runs once, and forks at each operation. The operation fails in the child, which goes on in a copy of the
folder, at the same path, to the command's end; this process then goes on without the failure. What pools of threads
would do is done by the thread that asks, since a child has one thread alone. Where this process cannot fork, as another
thread asks or another process answers, the command is run for that failure alone; so it is where a child found
something wrong, and that run decides. Of more than `--most` operations of a kind, the first from each place in the code
and others spread evenly are failed; a place is told by all the calls that lead to it.
"""

import argparse
import builtins
import errno
import fcntl
import gc
import io
import os
import shutil
import signal
import stat
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from itertools import groupby
from multiprocessing import resource_tracker
from operator import itemgetter
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from armperturb import cli, foreign
from armperturb.perturbations import Multisine, save_perturbation
from armperturb.study.recording.folder import ANALYSIS
from armperturb.subject import RELAX
from benchmarks.study_kills import short_protocol

OPERATIONS = {
    "write": ((builtins, "open"), (io, "open")),
    "rename": ((os, "replace"), (os, "rename")),
    "fsync": ((os, "fsync"),),
    "allocation": ((np, "zeros"), (np, "empty"), (np, "concatenate"), (np, "stack")),
}
"""Kind to the functions that do it."""


PATIENCE = 120
"""Time that a child may take to the command's end [s]."""


class Fault:
    """Counts the operations of a kind and fails one of them, or others each in a child.

    Args:
      kind: of `OPERATIONS`.
      number: of the operation that fails, from 1; 0 for none.
      in_children: numbers of those that fail in a child, if this process may fork.

    Attributes:
      places: of the operations so far, in the code.
      is_child: whether this process is a child.
    """

    def __init__(self, kind: str, number: int = 0, in_children: Collection[int] = ()) -> None:
        self.kind, self.number, self.in_children = kind, number, frozenset(in_children)
        self.places: list[int] = []
        self.is_child = self._is_forking = False

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, the n-th call of which fails."""

        def called(*args: Any, **options: Any) -> Any:
            if self._is_forking or (self.kind == "write" and not writes_a_file(*args, **options)):
                return function(*args, **options)
            self.places.append(hash(tuple((frame.f_code, line) for frame, line in traceback.walk_stack(None))))
            if not self.is_child and len(self.places) in self.in_children and may_fork():
                self._is_forking = True
                self.is_child = in_a_child(Path.cwd())
                self._is_forking = False
                if self.is_child:
                    self.number = len(self.places)
            if len(self.places) != self.number:
                return function(*args, **options)
            if self.kind == "allocation":
                raise MemoryError("Unable to allocate")
            if self.kind == "write":
                # What could still be written is there.
                with function(*args, **options) as file:
                    file.write("half" if isinstance(file, io.TextIOBase) else b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        return called

    @contextmanager
    def injected(self) -> Iterator[None]:
        """Within the block, the operations count and one fails."""
        patches = [mock.patch.object(owner, name, self(getattr(owner, name))) for owner, name in OPERATIONS[self.kind]]
        patches.append(mock.patch.object(ThreadPoolExecutor, "map", in_this_thread))
        for patch in patches:
            patch.start()
        try:
            yield
        finally:
            for patch in patches:
                patch.stop()


def writes_a_file(file: Any, mode: str = "r", *_: Any, **__: Any) -> bool:
    """Whether what is opened so is a file that is written; no pipe, which a child would share with this process."""
    return bool(set(mode) & set("wxa")) and not (isinstance(file, int) and stat.S_ISFIFO(os.fstat(file).st_mode))


def in_this_thread(pool: ThreadPoolExecutor, function: Callable[..., Any], *of_calls: Any) -> Iterator[Any]:
    """`ThreadPoolExecutor.map` without a thread: each call when its result is asked for, and none after a failure."""
    return map(function, *of_calls)


def may_fork() -> bool:
    """Whether no other thread asks, and all processes below this one wait: the reader for files, Python's helper."""
    waiting = {each.pid for each in foreign._waiting} | {resource_tracker._resource_tracker._pid}
    below = {int(pid) for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}
    return threading.current_thread() is threading.main_thread() and below <= waiting


def in_a_child(folder: Path) -> bool:
    """Whether this is a child process, in a copy of the current folder at its path; the parent waits for its end."""
    retained = folder.with_name("kept")
    os.rename(folder, retained)
    shutil.copytree(retained, folder)
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        shutil.rmtree(folder)
        os.rename(retained, folder)
        return False
    signal.alarm(PATIENCE)
    os.chdir(folder)
    for handle in map(int, os.listdir("/proc/self/fd")):
        with suppress(OSError, ValueError):  # not open any more, or no file of the folder
            path = folder / Path(os.readlink(f"/proc/self/fd/{handle}")).relative_to(retained)
            own = os.open(path, fcntl.fcntl(handle, fcntl.F_GETFL))
            os.lseek(own, os.lseek(handle, 0, os.SEEK_CUR), os.SEEK_SET)
            os.dup2(own, handle)
            os.close(own)
    return True


def contents(folder: Path) -> dict[str, bytes]:
    """Path to content of all files in a folder, folders included."""
    return {str(path.relative_to(folder)): b"" if path.is_dir() else path.read_bytes() for path in folder.rglob("*")}


def run(arguments: list[str]) -> tuple[int, str]:
    """Exit status of a command, which is -1 if it raises, and what it said of an error."""
    said = io.StringIO()
    with redirect_stderr(said), redirect_stdout(io.StringIO()):
        try:
            status = cli.main(arguments)
        except (Exception, SystemExit):
            traceback.print_exc()
            status = -1
    return status, said.getvalue()


def numbers(places: Sequence[int], most: int | None) -> list[int]:
    """Which operations are failed, from 1: all of few, else the first from each place and others spread evenly."""
    count = len(places)
    if most is None or count <= most:
        return list(range(1, count + 1))
    first = {place: count - back for back, place in enumerate(reversed(places))}
    return sorted({*first.values(), *np.linspace(1, count, most).round().astype(int).tolist()})


def failures(
    inputs: Path,
    earlier: list[str],
    command: list[str],
    kinds: Sequence[str],
    most: int | None = None,
    removed: Sequence[str] = (),
) -> Iterator[tuple[str, int, str]]:
    """Kind and number of each operation that was failed, and what was wrong then, empty if nothing.

    Args:
      inputs: folder whose copy is the current folder of each run.
      earlier: command that ran before; empty for none.
      command: that fails.
      kinds: of `OPERATIONS`.
      most: operations of a kind beyond which not all are failed, see `numbers`.
      removed: patterns of what is removed after the command before.

    Raises:
      RuntimeError: the command fails by itself, or writes other files each time.
    """
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name).resolve()
        old, now = scratch / "old", scratch / "now"

        def result(fault: Fault) -> tuple[int, str, dict[str, bytes]]:
            try:
                shutil.copytree(old, now)
                os.chdir(now)
                # Temporary files of the command are copied with the folder, and none may be left.
                with fault.injected(), mock.patch.object(tempfile, "tempdir", str(now)):
                    status, said = run(command)
                left = contents(now)
                if fault.is_child and not _wrong(status, said, before, after, left):
                    (scratch / f"{fault.kind} {fault.number}").touch()
            finally:
                if fault.is_child:
                    os._exit(0)
            os.chdir(here)
            shutil.rmtree(now)
            return status, said, left

        try:
            shutil.copytree(inputs, old)
            os.chdir(old)
            if earlier and (ended := run(earlier))[0]:
                raise RuntimeError(f"{' '.join(earlier)}: {ended[1]}")
            for path in [path for pattern in removed for path in old.glob(pattern)]:
                path.unlink()
            before = contents(old)
            shutil.copytree(old, now)
            os.chdir(now)
            run(command)  # what is compiled, imported and kept in memory counts no longer
            os.chdir(here)
            shutil.rmtree(now)
            gc.freeze()  # or each child would copy most of this process's memory
            for kind in kinds:
                counted = Fault(kind)
                status, said, after = result(counted)
                chosen = numbers(counted.places, most)
                again = result(Fault(kind, in_children=chosen))[2]
                if status or again != after:
                    other = [name for name in {**after, **again} if after.get(name) != again.get(name)]
                    raise RuntimeError(f"{' '.join(command)}: status {status}, files that differ: {other}; {said}")
                for number in chosen:
                    if (scratch / f"{kind} {number}").exists():
                        yield kind, number, ""
                        continue
                    fault = Fault(kind, number)
                    status, said, left = result(fault)
                    if len(fault.places) >= number:
                        yield kind, number, _wrong(status, said, before, after, left)
        finally:
            os.chdir(here)


def _wrong(status: int, said: str, before: dict[str, bytes], after: dict[str, bytes], left: dict[str, bytes]) -> str:
    if status == 0:
        other = [name for name in {**after, **left} if after.get(name) != left.get(name)]
        # What could not be kept for the next report is computed again then, and a warning says so.
        other = [name for name in other if name in left or Path(name).parent.name != ANALYSIS]
        return f"succeeded with other results: {', '.join(other)}" if other else ""
    lines = [line for line in said.splitlines() if line.startswith("armperturb: error: ")]
    if status != 1 or len(lines) != 1 or "Traceback" in said:
        return f"status {status}, {len(lines)} lines of errors: {said[-200:]!r}"
    if strange := [name for name in left if name not in before and name not in after]:
        return f"left behind: {', '.join(strange)}"
    if lost := [name for name in before if name not in left and name in after]:
        return f"lost: {', '.join(lost)}"
    halves = [name for name, content in left.items() if content not in (before.get(name), after.get(name))]
    return f"neither the old nor the new file: {', '.join(halves)}" if halves else ""


def only_named(folder: Path, command: Sequence[str]) -> None:
    """Remove from a folder what a command does not name, as all that is left is copied for each failure."""
    named = {Path(Path(part).parts[0]).stem for part in command}
    for path in folder.iterdir():
        if path.stem in named:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def laboratory(folder: Path, *, with_study: bool) -> None:
    """What the commands read: recordings of two trials, a person, a perturbation, a protocol; its study if asked."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from foreign_arms import Arm
    from foreign_recordings import Setup, write_csv

    setup = Setup(arm=Arm(), seed=3, n_trials=2, duration=24.0, linear=True)
    write_csv(setup, *setup.record(), folder)
    os.chdir(folder)
    assert run(["convert", "foreign.csv", "--out", "r.nc"])[0] == 0
    shutil.copy("foreign.csv", "bare.csv")
    RELAX.save("person.toml")
    save_perturbation(Multisine.draw(seed=0, rms=2.0, crested=False), "push.csv", 200.0)
    short_protocol(folder / "short.toml")
    if not with_study:
        return
    assert run(["study", *_STUDY, "--out", "made"])[0] == 0


_STUDY = ["--protocol", "short.toml", "--subjects", "1", "--workers", "1", "--record-only"]
_SIMULATE = ["simulate", "--subject", "person.toml", "--perturbation", "push.csv"]
_VIDEO = ["video", "made/recordings/S01.nc", "--start", "1", "--stop", "1.2", "--size", "320", "240", "--view", "top"]
_REPORT = ["report", "made", "--workers", "1"]
_LIMITS = ["--goal", "intrinsic", "--force", "5", "--displacement", "0.01", "--duration", "20"]
VALIDATE = ["validate", "--groups", "2", "--trials", "1", "--estimators", "frequency"]

COMMANDS = {
    # Not to MATLAB, whose header holds the date.
    "convert": (
        ["convert", "foreign.csv", "--rate", "100", "--out", "o.csv"],
        ["convert", "r.nc", "--out", "o.csv", "--overwrite"],
    ),
    "sidecar": ([], ["sidecar", "bare.csv"]),
    "response": (
        ["response", "r.nc", "--out", "o", "--method", "welch"],
        ["response", "r.nc", "--out", "o", "--method", "multitaper", "--overwrite"],
    ),
    "identify": (
        ["identify", "r.nc", "--model", "1", "--out", "o"],
        ["identify", "r.nc", "--model", "2", "--out", "o", "--overwrite"],
    ),
    "simulate": (
        [*_SIMULATE, "--ideal", "--out", "o.nc"],
        [*_SIMULATE, "--out", "o.nc", "--overwrite"],
    ),
    "study": ([], ["study", *_STUDY, "--out", "o"]),
    "score": (_REPORT, ["score", "made"]),
    "video": (
        [*_VIDEO, "--trial", "0", "--out", "o.gif"],
        [*_VIDEO, "--trial", "1", "--out", "o.gif", "--overwrite"],
    ),
    "design": ([], ["design", "--subject", "person.toml", *_LIMITS, "--out", "o"]),
    "report": (_REPORT, _REPORT),
    "joint": ([], ["joint", "--duration", "20", "--out", "o.nc"]),
    "compare": ([], ["compare", "r.nc", "--with", "thesis", "--out", "o"]),
    "validate": ([], [*VALIDATE, "--workers", "1", "--out", "o"]),
    "live": ([], ["live", "--out", "o.html"]),
    "calibrate": ([], ["calibrate", "--multisines", "1", "--iterations", "1", "--out", "o.toml"]),
}
"""Name to the command that ran before, and the command that fails."""

REMOVED = {
    "report": ("made/report.html", "made/tables/*", "made/figures/p*", "made/analysis/*-p*", "made/analysis/*-emg*")
}
"""Name to what is removed of the results of the command before: a report on a study that is new takes too long."""


def main(arguments: list[str] | None = None) -> None:
    """Print for each command and kind of operation how many were failed, and what was wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[[], *COMMANDS])
    parser.add_argument("--kinds", nargs="*", choices=OPERATIONS, default=list(OPERATIONS))
    parser.add_argument("--most", type=int)
    options = parser.parse_args([] if arguments is None else arguments)
    commands = options.commands or list(COMMANDS)
    here = Path.cwd()
    for command in commands:
        earlier, failed = COMMANDS[command]
        with tempfile.TemporaryDirectory() as name:
            laboratory(Path(name), with_study=any(part.startswith("made") for part in failed))
            os.chdir(here)
            only_named(Path(name), [*earlier, *failed])
            seen = failures(Path(name), earlier, failed, options.kinds, options.most, REMOVED.get(command, ()))
            for kind, of_kind in groupby(seen, key=itemgetter(0)):
                results = [(number, text) for _, number, text in of_kind]
                wrong = [(number, text) for number, text in results if text]
                print(f"{command}, {kind}: {len(results)} failed, {len(wrong)} wrong {wrong[:3]}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
