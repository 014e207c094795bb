"""Runs commands where something is missing around them: space, a home, rights, a reader of what they print.

Run `python -m benchmarks.surroundings [COMMAND ...] [--keep FOLDER]`: every command that writes, once in each of the
surroundings. Then a command either writes what it writes otherwise, to the last byte, or says why not in one line,
leaves every earlier file as it was and adds none.
"""

import argparse
import ctypes
import os
import resource
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from armperturb import cli
from armperturb.study.recording.folder import ANALYSIS
from benchmarks.faults import REMOVED, contents
from benchmarks.kept_rows import Row, with_kept_rows
from benchmarks.kills import COMMANDS, inputs_of, scratch_folder, without_recalled, wrong

OF_FILES, PR_CAPBSET_DROP, CAPABILITY_VERSION = (1, 2, 3), 24, 0x20080522
"""Capabilities that pass over rights of files (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER), and how Linux is
asked to drop them, see capabilities(7)."""


def _largest_file(size: int) -> Callable[[], None]:
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def _without_home() -> None:
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "ARMPERTURB_KEY", "MPLCONFIGDIR"):
        os.environ.pop(name, None)


def _home_that_is_read_only() -> None:
    _without_home()
    os.environ["HOME"] = "/proc/1"


def _no_rights() -> None:
    """Neither the home nor any folder here may be written to, and root gives up its rights to do so nevertheless."""
    _home_that_is_read_only()
    for folder, _, _ in os.walk("."):
        os.chmod(folder, 0o555)
    system = ctypes.CDLL(None)
    for capability in OF_FILES:
        system.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # also of what is started
    system.capset((ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)())


def _output_to(path: str) -> Callable[[], None]:
    return lambda: _replaced(os.open(path, os.O_WRONLY))


def _no_reader() -> None:
    reads, writes = os.pipe()
    os.close(reads)
    _replaced(writes)


def _replaced(output: int) -> None:
    os.dup2(output, 1)
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)


SURROUNDINGS: dict[str, Callable[[], None]] = {
    "files of at most 0 B": _largest_file(0),
    "files of at most 3 kB": _largest_file(3000),
    "files of at most 60 kB": _largest_file(60_000),
    "no home": _without_home,
    "a home that is read-only": _home_that_is_read_only,
    "no rights to write": _no_rights,
    "a full disk for what is printed": _output_to("/dev/full"),
    "nobody who reads what is printed": _no_reader,
}
"""Name to what a process does to be in them."""


def ended(command: list[str], surround: Callable[[], None]) -> tuple[int, str]:
    """Exit status of a command in the current folder, and what it said of errors."""
    reads, writes = os.pipe()  # as files may have no size
    child = os.fork()
    if child == 0:
        status = 99
        try:
            os.setsid()
            os.close(reads)
            os.dup2(writes, 2)
            os.close(writes)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            surround()
            status = cli.main(command)
            sys.stdout.flush()
        except BaseException as error:
            print(f"Traceback: {error!r}", file=sys.stderr)
        finally:
            sys.stderr.flush()
            os._exit(status)
    os.close(writes)
    with os.fdopen(reads, errors="replace") as pipe:
        said = pipe.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), said


def outcomes(name: str, inputs: Path, numbers: list[int]) -> Iterator[Row]:
    """What a command did in each of the surroundings.

    Args:
      name: of `COMMANDS`.
      inputs: folder whose copy is the current folder of each run.
      numbers: of `SURROUNDINGS`.

    Yields:
      The number (`seed`), the name (`where`), the exit `status`, the last line that was `said`, and what was wrong
      (`fault`).
    """
    earlier, command = COMMANDS[name]
    here = Path.cwd()
    with scratch_folder() as scratch:
        old, now = scratch / "old", scratch / "now"

        def after(run: list[str], surround: Callable[[], None]) -> tuple[int, str, dict[str, bytes]]:
            os.chdir(scratch)
            for folder, _, _ in os.walk(now):
                os.chmod(folder, 0o755)
            shutil.rmtree(now, ignore_errors=True)
            shutil.copytree(old, now)
            os.chdir(now)
            return *ended(run, surround), contents(now)

        try:
            shutil.copytree(inputs, old)
            os.chdir(old)
            if earlier and (first := ended(earlier, lambda: None))[0]:
                raise RuntimeError(f"{' '.join(earlier)}: {first[1]}")
            for path in [path for pattern in REMOVED.get(name, ()) for path in old.glob(pattern)]:
                path.unlink()
            before = contents(old)
            status, said, expected = after(command, lambda: None)
            if status:
                raise RuntimeError(f"{' '.join(command)}: {said}")
            for number in numbers:
                where = list(SURROUNDINGS)[number]
                status, said, left = after(command, SURROUNDINGS[where])
                files = before, expected, left
                if "home" in where:  # where the key lies with which kept results are signed: they are computed anew
                    retained = [name for name in left if name in expected and Path(name).parent.name == ANALYSIS]
                    left |= {name: expected[name] for name in retained}
                    files = without_recalled(before), without_recalled(expected), without_recalled(left)
                errors = [line for line in said.splitlines() if line.startswith("armperturb: error: ")]
                fault = wrong(status, where, files, said)
                if not fault and (status not in (0, 1) or len(errors) != status):
                    fault = f"status {status}, {len(errors)} lines of errors: {said[-200:]!r}"
                last = said.splitlines()[-1] if said else ""
                yield {"seed": number, "where": where, "status": status, "said": last, "fault": fault}
        finally:
            os.chdir(here)


def main(arguments: list[str] | None = None) -> None:
    """Print how each command ended in each of the surroundings."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[[], *COMMANDS])
    parser.add_argument("--keep", type=Path, help="folder for what was seen, from which the next run goes on")
    options = parser.parse_args([] if arguments is None else arguments)
    commands = options.commands or list(COMMANDS)
    keep = options.keep and options.keep.absolute()
    with inputs_of(commands) as inputs:
        for command in commands:
            path = keep / f"{command}.jsonl" if keep else None
            rows = with_kept_rows(path, range(len(SURROUNDINGS)), partial(outcomes, command, inputs))
            refused = sum(row["status"] != 0 for row in rows)
            faults = [f"{row['where']}: {row['fault']}" for row in rows if row["fault"]]
            print(f"{command}: {len(rows)} runs, {refused} refused, {len(faults)} wrong", flush=True)
            for fault in faults:
                print(f"    {fault}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
