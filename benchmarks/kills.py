"""Sends KILL, INT, TERM and HUP to commands at random moments, and looks at what is left.

Run `python -m benchmarks.kills [COMMAND ...] [--kills N] [--keep FOLDER]`: by default every command that writes, 100
kills each, half an hour of a core; with a folder, what was seen is kept there and the rest can follow later. A signal
goes to the command, to its process group, or to a process that it has started, if there is one. Half of the moments are
after the first file was begun. Then no process may be left; each file must be that of an undisturbed run or of before,
to the last byte, or absent if there was none before, but checksums may be of the first recordings alone; the command
must have said at most one line of an error; and after every signal but KILL there may be no other files. KILL may leave
hidden part files, which are counted, and what a study continues from. Of every fifth kill of a command that continues
where it was interrupted, the same command then runs undisturbed, and its files must be those of a first run.
"""

import argparse
import dataclasses
import gc
import importlib
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path

import psutil
import tomli_w

from armperturb import cli
from armperturb.study.protocol import THESIS
from armperturb.study.recording.folder import SUMS
from benchmarks.faults import COMMANDS as FAILED
from benchmarks.faults import REMOVED, VALIDATE, contents, laboratory
from benchmarks.kept_rows import Row, with_kept_rows

SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
TARGETS = ("command", "group", "worker")
PATIENCE, AFTERWARDS = 300.0, 10.0
"""Time that a command may take, and that what it has started may last longer [s]."""

_STUDY = ["study", "--protocol", "tiny.toml", "--subjects", "2", "--block", "2", "--workers", "2", "--record-only"]
_DESIGN = ["--goal", "mass", "--force", "5", "--displacement", "0.01", "--duration", "9.2"]

COMMANDS = {
    **FAILED,
    "study": ([], [*_STUDY, "--out", "o"]),
    "validate": ([], [*VALIDATE, "--workers", "2", "--out", "o"]),
    "design": ([], ["design", "--subject", "person.toml", *_DESIGN, "--out", "o"]),
}
"""Name to the command that ran before, and the command that is stopped."""

CONTINUING = ("study", "report")
"""Commands that continue where they were interrupted."""

RECALLED = re.compile(rb"<details>\s*<summary>Numbers recalled from an earlier analysis.*?</details>", re.DOTALL)
"""Where a report names the results that it did not compute."""

TRIES = 5
"""Moments that are drawn until one is before the end of the command."""


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder that is removed by this process alone, not by those that are forked from it."""
    folder = Path(tempfile.mkdtemp())
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@contextmanager
def inputs_of(commands: list[str]) -> Iterator[Path]:
    """A folder with what commands read; what they need is then imported in this process, which forks."""
    here = Path.cwd()
    with scratch_folder() as folder:
        inputs = folder / "inputs"
        inputs.mkdir()
        os.environ["ARMPERTURB_KEY"] = str(folder / "key")
        child = os.fork()  # which may draw and start processes, as this one may not before it forks
        if not child:
            try:
                laboratory(inputs, with_study=bool({"report", "score", "video"} & set(commands)))
                tiny_protocol(inputs / "tiny.toml")
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        os.chdir(here)
        with redirect_stdout(StringIO()):
            for module in ("report.report", "validation.validate", "planning.plan", "experiments.calibration"):
                importlib.import_module(f"armperturb.study.{module}")
        calibration = importlib.import_module("armperturb.study.experiments.calibration")
        calibration.__dict__["N_UNSEEN"] = 1  # it takes twice as long otherwise
        gc.freeze()  # or each forked process would copy most of this one's memory
        yield inputs


def started(command: list[str]) -> int:
    """Process of a command, in a session of its own and in the current folder, by a fork of this one."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for each in (signal.SIGTERM, signal.SIGHUP):  # what runs in the background, or under nohup, ignores some
            signal.signal(each, signal.SIG_DFL)
        said = os.open("../said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(said, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        status = cli.main(command)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def below(process: int) -> list[psutil.Process]:
    """What a process has started, and what that has."""
    try:
        return psutil.Process(process).children(recursive=True)
    except psutil.Error:
        return []


def runs(process: psutil.Process) -> bool:
    """Whether a process still runs."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


def end_of(process: int) -> int | None:
    """Its exit status, minus the signal that ended it; None if it runs."""
    ended, status = os.waitpid(process, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if ended else None


def undisturbed(command: list[str]) -> tuple[float, float]:
    """Time that a command takes, and time of its first new file [s]; in the current folder."""
    before, start, first = set(os.listdir()), time.monotonic(), None
    process = started(command)
    while (status := end_of(process)) is None:
        if first is None and set(os.listdir()) != before:
            first = time.monotonic() - start
        time.sleep(0.002)
    if status:
        raise RuntimeError(f"{' '.join(command)}: {Path('../said').read_text()}")
    took = time.monotonic() - start
    return took, min(first or 0.0, 0.9 * took)


def stopped(
    command: list[str], moment: float, number: int, target: str, rng: random.Random
) -> tuple[int, list[psutil.Process]] | None:
    """Exit status, and processes that are left; None if the command had ended before that moment [s]."""
    process, start = started(command), time.monotonic()
    seen: dict[int, psutil.Process] = {}
    while time.monotonic() < start + moment:
        if end_of(process) is not None:
            return None
        time.sleep(0.002)
    seen |= {each.pid: each for each in below(process)}
    if target == "worker" and not seen:
        target = "command"
    try:
        if target == "group":
            os.killpg(process, number)
        elif target == "command":
            os.kill(process, number)
        else:
            os.kill(rng.choice(list(seen)), number)
    except ProcessLookupError:
        pass
    while (status := end_of(process)) is None:
        seen |= {each.pid: each for each in below(process)}
        if time.monotonic() > start + PATIENCE:
            os.kill(process, signal.SIGKILL)
        time.sleep(0.005)
    latest = time.monotonic() + AFTERWARDS
    while (left := [each for each in seen.values() if runs(each)]) and time.monotonic() < latest:
        time.sleep(0.02)
    return status, left


def wrong(status: int, by: str, files: tuple[dict[str, bytes], dict[str, bytes], dict[str, bytes]], said: str) -> str:
    """What is not as it should be, in words; empty if nothing is.

    Args:
      status: of the command.
      by: signal and target.
      files: before the command, after an undisturbed one, and now.
      said: what it said of errors.
    """
    before, after, now = files
    if "Traceback" in said or sum(line.startswith("armperturb: ") for line in said.splitlines()) > 1:
        return f"status {status}, {said[-200:]!r}"
    hidden = {name for name in now if any(part.startswith(".") for part in Path(name).parts)}
    other = [
        name
        for name, content in now.items()
        if content not in (before.get(name), after.get(name))
        and not (Path(name).name == SUMS and set(content.split(b"\n")) <= set(after.get(name, b"").split(b"\n")))
    ]
    if others := [name for name in other if not (name in hidden and by.startswith("SIGKILL"))]:
        return f"status {status}, other or new files: {', '.join(others)}"
    if lost := [name for name in before if name not in now and name in after]:
        return f"status {status}, lost: {', '.join(lost)}"
    if status == 0 and now != after:
        return "status 0 without all outputs"
    return ""


def kills(name: str, inputs: Path, seeds: list[int]) -> Iterator[Row]:
    """What each kill of a command led to.

    Args:
      name: of `COMMANDS`.
      inputs: folder whose copy is the current folder of each run.
      seeds: one of each kill.

    Yields:
      The `seed`, the signal and its target (`by`), whether it came in time (`stopped`), what was wrong (`fault`), and
      how many part files were left by KILL (`parts`).
    """
    earlier, command = COMMANDS[name]
    here = Path.cwd()
    with scratch_folder() as scratch:
        old, now = scratch / "old", scratch / "now"

        def afresh() -> None:
            os.chdir(scratch)
            shutil.rmtree(now, ignore_errors=True)
            shutil.copytree(old, now)
            os.chdir(now)

        try:
            shutil.copytree(inputs, old)
            os.chdir(old)
            if earlier:
                _in_a_fork(earlier)
            for path in [path for pattern in REMOVED.get(name, ()) for path in old.glob(pattern)]:
                path.unlink()
            before = contents(old)
            afresh()
            undisturbed(command)  # imports, and what is compiled
            after = contents(now)
            afresh()
            took, first = undisturbed(command)
            if contents(now) != after:
                raise RuntimeError(f"{name}: other files each time")
            for seed in seeds:
                rng = random.Random(f"{name} {seed}")
                by, ended = "", None
                for _ in range(TRIES):
                    afresh()
                    number, target = rng.choice(SIGNALS), rng.choice(TARGETS)
                    moment = rng.uniform(first if rng.random() < 0.5 else 0.0, took)
                    by = f"{number.name} to {target}"
                    if (ended := stopped(command, moment, number, target, rng)) is not None:
                        break
                if ended is None:
                    yield {"seed": seed, "by": by, "stopped": False, "fault": "", "parts": 0}
                    continue
                left = contents(now)
                said = Path("../said").read_text(errors="replace")
                fault = wrong(ended[0], by, (before, after, left), said)
                if ended[1]:
                    fault = f"{fault} processes left: {[each.pid for each in ended[1]]}"
                    for each in ended[1]:
                        each.kill()
                if not fault and name in CONTINUING and seed % 5 == 0:
                    _in_a_fork(command)
                    fault = "" if _visible(contents(now)) == _visible(after) else "continued to other files"
                parts = sum(each.endswith(".part") for each in left)
                yield {"seed": seed, "by": by, "stopped": True, "fault": fault, "parts": parts}
        finally:
            os.chdir(here)


def _visible(files: dict[str, bytes]) -> dict[str, bytes]:
    """Files that are not hidden, `without_recalled`."""
    return without_recalled({name: each for name, each in files.items() if not Path(name).name.startswith(".")})


def without_recalled(files: dict[str, bytes]) -> dict[str, bytes]:
    """Files without what a report says of results that were kept, as a first one has none."""
    return {name: b" ".join(RECALLED.sub(b" ", content).split()) for name, content in files.items()}


def _in_a_fork(command: list[str]) -> None:
    process = started(command)
    if os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]):
        raise RuntimeError(f"{' '.join(command)}: {Path('../said').read_text()}")


def main(arguments: list[str] | None = None) -> None:
    """Print for each command how often it was stopped, and what was wrong."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[[], *COMMANDS])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--keep", type=Path, help="folder for what was seen, from which the next run goes on")
    options = parser.parse_args([] if arguments is None else arguments)
    commands = options.commands or list(COMMANDS)
    keep = options.keep and options.keep.absolute()
    with inputs_of(commands) as inputs:
        for command in commands:
            path = keep / f"{command}.jsonl" if keep else None
            rows = with_kept_rows(path, range(options.kills), partial(kills, command, inputs))
            seen = [row for row in rows if row["stopped"]]
            faults = [f"{row['by']}: {row['fault']}" for row in seen if row["fault"]]
            counts = dict(sorted(Counter(row["by"] for row in seen).items()))
            parts = sum(row["parts"] for row in seen)
            print(f"{command}: {len(seen)} stopped, {len(faults)} wrong, {parts} part files left by KILL", flush=True)
            for fault in faults[:5]:
                print(f"    {fault}", flush=True)
            print(f"    {', '.join(f'{count} {by}' for by, count in counts.items())}", flush=True)


def tiny_protocol(path: Path) -> None:
    """Two conditions of the thesis in trials of 8 s."""
    conditions = tuple(each for each in THESIS.conditions if each.name in ("PT0", "PT7.5"))
    tiny = dataclasses.replace(
        THESIS,
        conditions=conditions,
        forces="published",
        trial_duration=8.0,
        multisine_duration=6.0,
        onset_window=(1.0, 4.0),
    )
    path.write_text(tomli_w.dumps(tiny.to_dict()))


if __name__ == "__main__":
    main(sys.argv[1:])
