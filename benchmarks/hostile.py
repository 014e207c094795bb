"""Gives every command hostile files, and looks at how it ends, how long it takes and how much memory.

Run `python -m benchmarks.hostile [COMMAND ...] [--most N] [--keep FOLDER]`; half an hour of a core, or N cases that are
spread evenly; with a folder, what was seen is kept there and the rest can follow later. The cases are those of the
tests of malformed and crafted files (MATLAB, HDF5, netCDF, C3D, CSV, sidecars), and those of this file (TOML, JSON,
NPZ, XML, pipes, links, devices). A command must refuse each in one line, without a traceback or a signal, within 35 s
and 1.5 GB of any of its processes, and leave nothing; or carry it out. On a busy machine, read the
processor time beside the time by the clock.
"""

import argparse
import gc
import importlib
import io
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path

from armperturb import cli
from armperturb.perturbations import Multisine, save_perturbation
from armperturb.subject import RELAX
from benchmarks.kept_rows import Row, with_kept_rows

LONGEST, LARGEST = 35.0, 1.5e9
"""Time of a run by the clock [s], and memory of a process [byte]."""

Make = Callable[[Path], Path]
"""Writes a case into a folder, and says which file it is."""

_LAUGHS = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))

TEXTS: dict[str, bytes] = {
    "lists in lists.toml": b"a = " + b"[" * 30_000,
    "tables in tables.toml": b"a = " + b"{a = " * 6_000,
    "a key of many parts.toml": b".".join([b"a"] * 30_000) + b" = 1",
    "a quoted key of many parts.toml": b".".join([b'"a"'] * 15_000) + b" = 1",
    "a header of many parts.toml": b"[" + b".".join([b"a"] * 30_000) + b"]",
    "a number of many digits.toml": b"k_s = " + b"9" * 60_000,
    "half a megabyte.toml": b"a = 1\n" * 90_000,
    "two marks.toml": b"\xef\xbb\xbf\xef\xbb\xbfk_s = 1",
    "zeros.toml": bytes(5000),
    "Latin.toml": "name = 'Jürgen'".encode("latin-1"),
    "UTF-16.toml": "k_s = 1".encode("utf-16"),
    "twice.toml": b"k_s = 1\nk_s = 2",
    "infinite.toml": b"k_s = inf\nl_h = nan",
    "dates.toml": b"k_s = 1979-05-27T07:32:00Z",
    "escapes.toml": b'name = "\\u001b[2J\\u0000"',
    "formula.toml": b"name = \"=cmd|' /C calc'!A0\"",
    "empty.toml": b"",
    "negative.toml": b"k_s = -1e308\nl_h = 1e-300",
    "lists in lists.json": b"[" * 200_000,
    "objects in objects.json": b'{"a":' * 100_000,
    "a number of many digits.json": b'{"rate": ' + b"9" * 500_000 + b"}",
    "no numbers.json": b'{"rate": NaN, "signals": Infinity}',
    "large.json": b'{"a": "' + b"x" * 3_000_000 + b'"}',
    "a surrogate.json": b'{"subject": "\\ud800"}',
    "zeros.json": bytes(5000),
    "a list.json": b"[1, 2, 3]",
    "null.json": b"null",
    "empty.json": b"",
    "a long line.csv": b"a" * 20_000_000,
    "many columns.csv": b",".join(b"c%d" % i for i in range(300_000)) + b"\n1,2\n",
    "an open quote.csv": b'time_s,d_x_N,d_y_N\n"0,1,1\n' + b"1,1,1\n" * 100_000,
    "zeros.csv": bytes(5_000_000),
    "commas.csv": b"," * 5_000_000,
    "numbers of many digits.csv": b"time_s,d_x_N,d_y_N\n" + b"9" * 100_000 + b",1,1\n",
    "infinite.csv": b"time_s,d_x_N,d_y_N\n0,inf,nan\n0.005,1e400,-1e400\n",
    "times run back.csv": b"time_s,d_x_N,d_y_N\n0,1,1\n-1,1,1\n-2,0,0\n",
    "steps of no length.csv": b"time_s,d_x_N,d_y_N\n" + b"0,1,1\n" * 1000,
    "one step in a year.csv": b"time_s,d_x_N,d_y_N\n0,1,1\n31536000,1,1\n",
    "entities.xml": f'<!DOCTYPE m [<!ENTITY a0 "ha">{_LAUGHS}]><mujoco model="&a9;"/>'.encode(),
    "an entity of a file.xml": b'<!DOCTYPE m [<!ENTITY a SYSTEM "file:///etc/passwd">]><mujoco model="&a;"/>',
    "elements in elements.xml": b"<mujoco>" + b"<worldbody>" + b"<body>" * 20_000,
    "itself.xml": b'<mujoco><include file="itself.xml"/></mujoco>',
    "a device.xml": b'<mujoco><include file="/dev/zero"/></mujoco>',
    "many numbers.xml": b'<mujoco><worldbody><body pos="' + b"1 " * 500_000 + b'"/></worldbody></mujoco>',
    "much memory.xml": b'<mujoco><size memory="900G"/><worldbody><body/></worldbody></mujoco>',
    "many copies.xml": b'<mujoco><worldbody><replicate count="100000000"><geom size="1"/></replicate></worldbody>'
    b"</mujoco>",
    "a small step.xml": b'<mujoco><option timestep="1e-300"/><worldbody><body><site name="palm"/></body></worldbody>'
    b"</mujoco>",
    "empty.xml": b"",
    "garbage.mat": b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + b"\xff" * 4096,
    "garbage.nc": b"\x89HDF\r\n\x1a\n" + b"\xff" * 4096,
    "netCDF-3.nc": b"CDF\x01" + b"\x7f" * 4096,
    "garbage.c3d": b"\x02\x50" + b"\xff" * 4096,
    "garbage.npz": b"PK\x03\x04" + b"\xff" * 4096,
}  # fmt: skip
"""Name to content."""


def _array(shape: str, kind: str = "'<f8'") -> bytes:
    """Head of an array in NumPy's format."""
    head = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + (len(head) + 1).to_bytes(2, "little") + head + b"\n"


_PARTS: dict[str, dict[str, bytes]] = {
    "zeros of 4 GB.npz": {"force.npy": _array("(2**9,)") + bytes(300_000_000)},
    "claims 8 EB.npz": {"force.npy": _array("(1000000000000000000,)") + bytes(100)},
    "claims less than nothing.npz": {"force.npy": _array("(-1, 5)") + bytes(100)},
    "a thousand dimensions.npz": {"force.npy": _array(f"({'1, ' * 1000})") + bytes(8)},
    "code in a head.npz": {"force.npy": _array("__import__('os').getcwd()")},
    "a deep head.npz": {"force.npy": _array("(" * 5000)},
    "objects.npz": {"force.npy": _array("(1,)", "'|O'") + b"cos\nsystem\n(S'true'\ntR."},
    "outside.npz": {"../../force.npy": _array("(1,)") + bytes(8)},
    "many parts.npz": {f"{i}.npy": b"" for i in range(20_000)},
}


def _zipped(name: str) -> Make:
    def make(folder: Path) -> Path:
        with zipfile.ZipFile(folder / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for part, content in _PARTS[name].items():
                archive.writestr(part, content)
        return folder / name

    return make


def _written(name: str) -> Make:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(TEXTS[name])
        return folder / name

    return make


def _special(kind: str, ending: str) -> Make:
    def make(folder: Path) -> Path:
        path = folder / f"{kind}{ending}"
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            path.symlink_to({"link to itself": path, "link to zeros": "/dev/zero", "link to nothing": "none"}[kind])
        return path

    return make


def cases() -> dict[str, Make]:
    """All cases by name."""
    tests = Path(__file__).parents[1] / "tests"
    sys.path[:0] = [str(tests), *(str(tests / part) for part in ("convert", "foreign", "commands"))]
    malformed, crafted, recordings = map(
        importlib.import_module, ("test_malformed", "test_foreign", "test_hostile_files")
    )
    made: dict[str, Make] = {}
    for table in ("TEXTS", "SIDECARS", "CONTENTS", "BINARIES"):
        made |= {f"{name} ({table.lower()})": make for name, (make, _) in getattr(malformed, table).items()}
    for name in crafted.CRAFTED:
        made[name] = lambda folder, name=name: crafted.crafted(folder, name)[0]
    for name, damage in recordings.HOSTILE.items():

        def make(folder: Path, damage: Callable[[Path], object] = damage) -> Path:
            (folder / "h.nc").write_bytes(malformed.good_netcdf())
            damage(folder / "h.nc")
            return folder / "h.nc"

        made[f"{name} (netCDF)"] = make
    made |= {name: _written(name) for name in TEXTS} | {name: _zipped(name) for name in _PARTS}
    for ending in (".nc", ".mat", ".csv", ".toml", ".json", ".xml"):
        kinds = ("pipe", "folder", "link to itself", "link to zeros", "link to nothing")
        made |= {f"{kind}{ending}": _special(kind, ending) for kind in kinds}
    return made


def _view(file: str) -> int:
    viewer = importlib.import_module("armperturb.envs.render.viewer")
    viewer.__dict__["require_display"] = viewer.__dict__["watch_trial"] = lambda *_, **__: None
    return cli.main(["view", file])


def _of_a_study(command: list[str]) -> Callable[[str], int]:
    """A command on a study, of which the file is the manifest, the protocol or a recording."""

    def run(file: str) -> int:
        place = {".json": "manifest.json", ".toml": "protocol.toml"}.get(Path(file).suffix, "recordings/S01.nc")
        Path("study/recordings").mkdir(parents=True)
        os.rename(file, Path("study") / place)
        return cli.main(command)

    return run


_INTO = ["--out", "o", "--overwrite"]
_LIMITS = ["--goal", "intrinsic", "--force", "5", "--displacement", "0.01", "--duration", "20", *_INTO]

COMMANDS: dict[str, Callable[[str], int]] = {
    "convert": lambda file: cli.main(["convert", file, "--out", "o.csv"]),
    "convert --sidecar": lambda file: cli.main(["convert", "good.csv", "--sidecar", file, "--out", "o.csv"]),
    "sidecar": lambda file: cli.main(["sidecar", file, "--out", "o.json"]),
    "identify": lambda file: cli.main(["identify", file, *_INTO]),
    "identify --model": lambda file: cli.main(["identify", "good.csv", "--model", file, *_INTO]),
    "response": lambda file: cli.main(["response", file, *_INTO]),
    "compare": lambda file: cli.main(["compare", file, *_INTO]),
    "video": lambda file: cli.main(["video", file, "--trial", "0", "--out", "o.gif"]),
    "view": _view,
    "joint": lambda file: cli.main(["joint", "--person", file, "--duration", "1", "--out", "o.nc"]),
    "simulate": lambda file: cli.main(["simulate", "--subject", file, "--perturbation", "push.csv", "--out", "o.nc"]),
    "simulate --perturbation": lambda file: cli.main(
        ["simulate", "--subject", "person.toml", "--perturbation", file, "--out", "o.nc"]
    ),
    "simulate --mjcf": lambda file: cli.main(
        ["simulate", "--mjcf", file, "--hand", "palm", "--perturbation", "push.csv", "--out", "o.nc"]
    ),
    "design": lambda file: cli.main(["design", "--subject", file, *_LIMITS]),
    "validate": lambda file: cli.main(["validate", "--subject", file, "--groups", "1", "--workers", "1", *_INTO]),
    "live": lambda file: cli.main(["live", "--arms", file, "--out", "o.html"]),
    "study": lambda file: cli.main(["study", "--protocol", file, "--subjects", "1", "--workers", "1", "--out", "o"]),
    "study, again": _of_a_study(["study", "--subjects", "1", "--workers", "1", "--record-only", "--out", "study"]),
    "report": _of_a_study(["report", "study", "--workers", "1"]),
    "score": _of_a_study(["score", "study"]),
}
"""Name to what runs with a file, in a folder that holds good ones."""


def outcome(run: Callable[[str], int], make: Make, good: Path, folder: Path) -> Row:
    """How a command ends with a case (`end`), the time that it takes by the clock and of the processor [s] (`took`,
    `processor`), and the memory of its largest process [byte] (`memory`).

    Args:
      run: of `COMMANDS`.
      make: of `cases`.
      good: folder with good files.
      folder: new one to work in.
    """
    shutil.copytree(good, folder)
    file = make(folder)
    before, start = {*os.listdir(folder), "study"}, time.monotonic()
    child = os.fork()
    if child == 0:
        status = 99
        try:
            os.setsid()
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.alarm(round(3 * LONGEST))
            os.chdir(folder)
            os.dup2(os.open("../said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
            with redirect_stdout(io.StringIO()):
                status = run(file.name)
            gc.collect()  # this process ends without what Python does at its end: pools give back what they share
        except SystemExit as stop:  # the command line cannot be parsed
            status = int(stop.code or 0)
        finally:
            sys.stderr.flush()
            os._exit(status)
    _, status, usage = os.wait4(child, 0)
    took, code = time.monotonic() - start, os.waitstatus_to_exitcode(status)
    said = (folder.parent / "said").read_text(errors="replace")
    new = {name for name in os.listdir(folder) if name not in before}
    lines = said.splitlines()
    if code < 0:
        end = f"SIGNAL {-code}"
    elif code == 2 and "Traceback" not in said and not new:
        end = "not parsed"
    elif code not in (0, 1) or "Traceback" in said:
        end = f"TRACEBACK {said[-300:]!r}"
    elif code == 1 and (len(lines) != 1 or not lines[0].startswith("armperturb: error: ")):
        end = f"NOT ONE LINE {said[-300:]!r}"
    elif code == 1 and not lines[0].isprintable():
        end = f"CONTROL CHARACTERS {lines[0]!r}"
    elif code == 1 and new:
        end = f"LEFT BEHIND {sorted(new)}"
    else:
        end = "refused" if code else "carried out"
    processor, memory = usage.ru_utime + usage.ru_stime, 1024.0 * usage.ru_maxrss
    if took > LONGEST or memory > LARGEST:
        end = f"TOO MUCH, then {end}"
    for path in folder.rglob("*"):
        if path.is_dir() and not path.is_symlink():
            path.chmod(0o700)
    shutil.rmtree(folder)
    return {"end": end, "took": took, "processor": processor, "memory": memory}


def outcomes(command: str, made: dict[str, Make], good: Path, numbers: list[int]) -> Iterator[Row]:
    """`outcome` of a command with cases by their numbers (`seed`), and their names (`case`)."""
    for number in numbers:
        case = sorted(made)[number]
        yield {"seed": number, "case": case} | outcome(COMMANDS[command], made[case], good, good.parent / "now")


def stated(command: str, rows: list[Row]) -> Counter[str]:
    """How often its runs ended in each way; printed, with each fault and the most that any run took."""
    ends = Counter(row["end"].split()[0] if row["end"][0].isupper() else row["end"] for row in rows)
    for row in rows:
        if row["end"][0].isupper():
            print(f"    {command}, {row['case']}: {row['end']}", flush=True)
    most = [max(row[cost] for row in rows) for cost in ("processor", "took", "memory")]
    print(
        f"{command}: {dict(ends)}, at most {most[0]:.1f} s of processor time, {most[1]:.1f} s by the clock and "
        f"{most[2] / 1e9:.2f} GB",
        flush=True,
    )
    return ends


def main(arguments: list[str] | None = None) -> None:
    """Print for each command how its runs ended, and the most time and memory."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[[], *COMMANDS])
    parser.add_argument("--most", type=int, default=10**6)
    parser.add_argument("--keep", type=Path, help="folder for what was seen, from which the next run goes on")
    options = parser.parse_args([] if arguments is None else arguments)
    keep = options.keep and options.keep.absolute()
    made, total = cases(), Counter[str]()
    numbers = range(0, len(made), max(-(-len(made) // options.most), 1))
    print(f"{len(made)} cases")
    with tempfile.TemporaryDirectory() as name:
        good = Path(name) / "good"
        good.mkdir()
        RELAX.save(good / "person.toml")
        save_perturbation(Multisine.draw(seed=0, rms=2.0), good / "push.csv", 200.0)
        lab = importlib.import_module("laboratory").write(good)
        lab.rename(good / "good.csv")
        lab.with_suffix(".json").rename(good / "good.json")
        for module in ("report.report", "validation.validate", "planning.plan", "comparison.likeness"):
            importlib.import_module(f"armperturb.study.{module}")
        gc.freeze()  # or each forked process would copy most of this one's memory
        for command in options.commands or COMMANDS:
            path = keep / f"{command.replace(' ', '_')}.jsonl" if keep else None
            rows = with_kept_rows(path, numbers, partial(outcomes, command, made, good))
            total += stated(command, rows)
    print(f"all: {dict(total)}")


if __name__ == "__main__":
    main(sys.argv[1:])
