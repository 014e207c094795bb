"""Damages files of every format that is read, and counts what readers and commands make of them.

Run `python -m benchmarks.fuzz [CASE ...] [--runs N] [--seed N]`; 3,000 runs by default. First `--flips` bits (4,000
by default) are flipped one by one within the arrays of a recording, each of which must be noticed or change nothing.
Then a bit is flipped, a sector of 512 bytes is zeroed, or the file is cut off, at a random place. A command, or a
function that reads, then runs in a forked process, with the parsers that the guarded child process runs: an end by a
signal, or one for lack of processor time, is what that child turns into a refusal, and the run is repeated with it. A
refused command must say one line and leave nothing. Of what is read, damage to values must be noticed.
"""

import argparse
import gc
import importlib
import io
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, TextIO
from unittest import mock

import numpy as np
from scipy.io import savemat

from armperturb import cli
from armperturb.analysis.fit.own_structures import load_structure, save_structure
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.convert import arrays, columns, reading
from armperturb.convert.exporter import export_recording
from armperturb.convert.importer import import_recording
from armperturb.foreign import program
from armperturb.recording_files import load_recording
from armperturb.study.protocol import load_protocol
from benchmarks.faults import laboratory

LONGEST, LARGEST = 30, 2**30
"""Processor time [s] of a run with the parsers in it, and memory of a parser [byte]."""

PATIENCE = 600
"""Time of a run with the guarded child process [s]."""

ENDS = (
    "carried out", "refused", "other descriptions", "DAMAGE NOT NOTICED", "NOT ONE LINE", "LEFT BEHIND", "TRACEBACK",
)  # fmt: skip
"""How a run ends, by its exit status."""

READERS = ("armperturb.recording_files", *(module.__name__ for module in (columns, reading, arrays)))
"""Modules that hold `read_foreign`."""


class Case(NamedTuple):
    """What is damaged, and who reads it.

    Attributes:
      file: that is damaged.
      run: command, the outputs of which begin with `o`, or function that returns what it has read.
      weight: share of the runs.
      compared: what must be read, or not at all: from the folder; None if that is not compared.
    """

    file: str
    run: list[str] | Callable[[], Any]
    weight: float = 1.0
    compared: Callable[[], Any] | None = None


def _parsed(path: Path, names: Any = None, *, without: Any = (), seconds: float = LONGEST) -> dict[str, Any]:
    """What the child process would give, from this one."""
    return program.parse(str(path), names, LARGEST, without)


def _view() -> None:
    """`view`, with a display that closes at once."""
    viewer = importlib.import_module("armperturb.envs.render.viewer")
    with mock.patch.object(viewer, "require_display"), mock.patch.object(viewer, "watch_trial"):
        raise SystemExit(cli.main(["view", "s.nc"]))


def _tables() -> dict[str, bytes]:
    """What `report` has written of numbers."""
    return {path.name: path.read_bytes() for path in sorted(Path("made/tables").glob("*.csv"))}


_CONVERT, _MJCF = ["--out", "o.csv"], ["--mjcf", "arm.xml", "--hand", "palm"]
_PUSH = ["--perturbation", "push.csv", "--out", "o.nc"]
_VIDEO = ["--trial", "0", "--out", "o.gif", "--start", "1", "--stop", "1.1", "--size", "160", "120", "--view", "top"]
_REPORT = ["report", "made", "--workers", "1"]
_STUDY = ["study", "--protocol", "short.toml", "--subjects", "1", "--workers", "1", "--record-only", "--out", "made"]
_DESIGN = ["--goal", "intrinsic", "--force", "5", "--displacement", "0.01", "--duration", "20", "--out", "o"]

CASES = {
    "recording": Case("r.nc", partial(load_recording, "r.nc"), 20, partial(load_recording, "r.nc")),
    "recording, convert": Case("r.nc", ["convert", "r.nc", *_CONVERT], 5),
    "recording, response": Case("r.nc", ["response", "r.nc", "--method", "welch", "--out", "o"], 2),
    "recording, identify": Case("r.nc", ["identify", "r.nc", "--model", "1", "--out", "o"], 0.5),
    "recording, video": Case("s.nc", ["video", "s.nc", *_VIDEO], 0.5),
    "recording, view": Case("s.nc", _view, 2),
    "CSV": Case("lab.csv", ["convert", "lab.csv", *_CONVERT], 10),
    "CSV, sidecar": Case("bare.csv", ["sidecar", "bare.csv", "--out", "o.json"], 3),
    "sidecar": Case("lab.json", ["convert", "lab.csv", *_CONVERT], 10),
    "MATLAB v5": Case("m5.mat", ["convert", "m5.mat", *_CONVERT], 10),
    "MATLAB v5, compressed": Case("m5z.mat", ["convert", "m5z.mat", *_CONVERT], 5),
    "MATLAB v7.3": Case("m73.mat", ["convert", "m73.mat", *_CONVERT], 10),
    "NPZ": Case("n.npz", ["convert", "n.npz", *_CONVERT], 10),
    "C3D": Case("marker.c3d", ["convert", "marker.c3d", *_CONVERT, "--rate", "200"], 10),
    "protocol": Case("short.toml", partial(load_protocol, "short.toml"), 10),
    "structure": Case("own.toml", partial(load_structure, "own.toml"), 5),
    "person, simulate": Case("person.toml", ["simulate", "--subject", "person.toml", *_PUSH], 3),
    "person, design": Case("person.toml", ["design", "--subject", "person.toml", *_DESIGN], 0.5),
    "perturbation": Case("push.csv", ["simulate", "--subject", "person.toml", *_PUSH], 5),
    "MJCF": Case("arm.xml", ["simulate", *_MJCF, *_PUSH], 5),
    "study, report": Case("made/recordings/S01.nc", _REPORT, 2),
    "study, score": Case("made/recordings/S01.nc", ["score", "made"], 2),
    "study, study": Case("made/recordings/S01.nc", _STUDY, 0.5),
    "checksums, report": Case("made/recordings/SHA256SUMS", _REPORT, 1),
    "manifest, report": Case("made/manifest.json", _REPORT, 2),
    "manifest, score": Case("made/manifest.json", ["score", "made"], 3),
    "manifest, study": Case("made/manifest.json", _STUDY, 1),
    "analysis, report": Case("made/analysis/*.json.gz", _REPORT, 4, _tables),
}
"""Name to what is damaged and who reads it."""


def files(folder: Path, *, with_study: bool) -> None:
    """Writes a file of each kind, those of a study if asked."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    tests = {name: importlib.import_module(name) for name in ("laboratory", "foreign_models")}
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "convert"))
    forms = importlib.import_module("test_convert")
    laboratory(folder, with_study=with_study)
    if with_study:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            if cli.main(_REPORT):
                raise RuntimeError(f"{_REPORT}: failed")
        shutil.copy("made/recordings/S01.nc", "s.nc")
    tests["laboratory"].write(folder)
    export_recording(import_recording([folder / "lab.csv"]).recording, folder / "m5.mat")
    content, channels = forms.in_matlab("time by trial")
    meaning = forms.matlab_meaning(channels)
    del meaning["trial"]
    for name in ("m5z", "m73", "n"):
        (folder / f"{name}.json").write_text(json.dumps(meaning))
    savemat(folder / "m5z.mat", content, do_compression=True)
    forms.v73(folder / "m73.mat", content)
    forms.write_c3d(folder / "marker.c3d")
    save_structure(STRUCTURES["3b"], folder / "own.toml")
    (folder / "arm.xml").write_text(tests["foreign_models"].TWO_LINK)
    np.savez(folder / "n.npz", **content)


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


def _end(
    run: list[str] | Callable[[], Any], compared: Callable[[], Any] | None, expected: Any, tracebacks: TextIO
) -> int:
    """Index among `ENDS`, in the current folder."""
    sys.stderr = said = io.StringIO()
    before = set(os.listdir())
    try:
        if isinstance(run, list):
            with redirect_stdout(io.StringIO()):
                status = cli.main(run)
            there = compared() if compared and not status else None
        else:
            status, there = 0, run()
    except SystemExit as error:
        status, there = int(error.code or 0), None
    except BaseException as error:
        if not isinstance(run, list) and isinstance(error, ValueError | TypeError | OSError):
            return 1
        traceback.print_exc(file=tracebacks)
        return 6
    if status:
        errors = [line for line in said.getvalue().splitlines() if line.startswith("armperturb: error: ")]
        if status != 1 or len(errors) != 1 or "Traceback" in said.getvalue():
            return 4
        return 1 if set(os.listdir()) <= before else 5
    if compared is None:
        return 0
    if not hasattr(expected, "identical"):
        return 0 if there == expected else 3
    if expected.identical(there):
        return 0
    return 2 if there is not None and set(there.variables) == set(expected.variables) and expected.equals(there) else 3


def outcome(folder: Path, case: Case, expected: Any, *, guarded: bool) -> str:
    """How a run in a folder ends.

    Args:
      folder: which holds the damaged file.
      case: what runs.
      expected: what `compared` gives of undamaged files.
      guarded: whether files are parsed in the guarded child process, and not in this one.
    """
    child = os.fork()
    if child == 0:
        status = 6
        gc.freeze()  # what the parent has left is not finalised in here, amid anything
        tracebacks = os.fdopen(os.dup(2), "w", buffering=1)  # where tracebacks go; what libraries print is dropped
        try:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            if not guarded:
                resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))
                for name in READERS:
                    sys.modules[name].__dict__["read_foreign"] = _parsed
            signal.alarm(PATIENCE)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            os.chdir(folder)
            status = _end(case.run, case.compared, expected, tracebacks)
        except BaseException:
            traceback.print_exc(file=tracebacks)
        finally:
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status >= 0:
        return ENDS[status]
    return f"SIGNAL {-status}" if guarded else "signal"


def _in_a_fork(make: Callable[[], Any]) -> None:
    """Run a function in a forked process: a process that has drawn pictures cannot be forked and draw again."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            make()
            status = 0
        finally:
            os._exit(status)
    if os.waitpid(child, 0)[1]:
        raise RuntimeError("the files cannot be made")


def _import_for(cases: list[Case]) -> None:
    """Import what the cases need, so that forked processes need not."""
    commands = {case.run[0] for case in cases if isinstance(case.run, list)}
    of_commands = {"report": "armperturb.study.report.report", "video": "armperturb.envs.render.video"}
    for library in ("h5py", "h5netcdf", "ezc3d", *(of_commands[name] for name in of_commands if name in commands)):
        if find_spec(library):
            importlib.import_module(library)


def _warm(cases: list[Case]) -> None:
    """Run what the cases run, so that forked processes find it imported; those that draw are left out."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        for case in cases:
            if isinstance(case.run, list) and case.run[0] not in ("report", "video"):
                cli.main(case.run)


def fuzz(names: list[str], runs: int, seed: int = 0) -> dict[str, Counter[str]]:
    """Case to how often it ended how.

    Args:
      names: of the cases.
      runs: in all, shared out by the weights of the cases.
      seed: of the damage.
    """
    rng, ends = random.Random(seed), {name: Counter[str]() for name in names}
    here = Path.cwd()
    _import_for([CASES[each] for each in names])
    with tempfile.TemporaryDirectory() as name:
        whole, now = Path(name) / "whole", Path(name) / "now"
        whole.mkdir()
        try:
            with_study = any(CASES[each].file.startswith(("made/", "s.nc")) for each in names)
            _in_a_fork(partial(files, whole, with_study=with_study))
            shutil.copytree(whole, now)
            os.chdir(now)
            _warm([CASES[each] for each in names])
            os.chdir(whole)
            shutil.rmtree(now)
            total = sum(CASES[each].weight for each in names)
            for each in names:
                case = CASES[each]
                os.chdir(whole)
                expected = case.compared() if case.compared else None
                shutil.copytree(whole, now, copy_function=os.link)
                if (end := outcome(now, case, expected, guarded=False)) != ENDS[0]:
                    raise RuntimeError(f"{each}: {end} without damage")
                shutil.rmtree(now)
                for _ in range(max(1, round(runs * case.weight / total))):
                    shutil.copytree(whole, now, copy_function=os.link)
                    path = rng.choice(sorted(now.glob(case.file)))
                    content = damaged(path.read_bytes(), rng)
                    path.unlink()
                    path.write_bytes(content)
                    end = outcome(now, case, expected, guarded=False)
                    if end == "signal":
                        end = f"{outcome(now, case, expected, guarded=True)} by the guarded child"
                    if end.isupper() or "SIGNAL" in end:
                        retained = shutil.copy(path, Path(tempfile.gettempdir()) / f"fuzz-{os.getpid()}-{path.name}")
                        print(f"{each}: {end}, see {retained}", flush=True)
                    ends[each][end] += 1
                    shutil.rmtree(now)
                print(f"{each}: {sum(ends[each].values())} runs, {dict(ends[each])}", flush=True)
        finally:
            os.chdir(here)
    return ends


def array_bytes(path: Path) -> np.ndarray:
    """Where in a netCDF4 file the bytes of its arrays lie, their checksums included."""
    import h5py

    parts = []
    with h5py.File(path) as file:
        for each in file.values():
            dataset = each.id
            if each.chunks is None:
                chunks = [(dataset.get_offset(), dataset.get_storage_size())]
            else:
                infos = map(dataset.get_chunk_info, range(dataset.get_num_chunks()))
                chunks = [(info.byte_offset, info.size) for info in infos]
            parts += [np.arange(start, start + size) for start, size in chunks if start is not None]
    return np.concatenate(parts)


def flipped_arrays(flips: int, seed: int = 0) -> Counter[str]:
    """How often one flipped bit in an array of a recording is refused, changes nothing, or is not noticed."""
    rng, ends = random.Random(seed), Counter[str]()
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        try:
            laboratory(Path(name), with_study=False)
            expected = load_recording("r.nc")
            content, places = Path("r.nc").read_bytes(), array_bytes(Path("r.nc"))
            with mock.patch.object(importlib.import_module(READERS[0]), "read_foreign", _parsed):
                for _ in range(flips):
                    changed, at = bytearray(content), int(rng.choice(places))
                    changed[at] ^= 1 << rng.randrange(8)
                    Path("d.nc").write_bytes(changed)
                    try:
                        same = expected.identical(load_recording("d.nc"))
                        ends["as before" if same else "DAMAGE NOT NOTICED"] += 1
                    except ValueError:
                        ends["refused"] += 1
        finally:
            os.chdir(here)
    return ends


def main(arguments: list[str] | None = None) -> None:
    """Print how often each case ended how, and where files lie that were not treated as they should be."""
    parser = argparse.ArgumentParser()
    parser.add_argument("cases", nargs="*", choices=[[], *CASES])
    parser.add_argument("--runs", type=int, default=3000)
    parser.add_argument("--flips", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args([] if arguments is None else arguments)
    if options.flips:
        ends_of_flips = flipped_arrays(options.flips, options.seed)
        print(f"flips within arrays: {dict(ends_of_flips)}", flush=True)
    if not options.runs:
        return
    ends = fuzz(options.cases or list(CASES), options.runs, options.seed)
    total = sum(ends.values(), Counter[str]())
    print(f"all: {sum(total.values())} runs, {dict(total)}")


if __name__ == "__main__":
    main(sys.argv[1:])
