"""A command that is asked to end leaves nothing half-written and says one line."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from armperturb import files

SIGNALS = ["SIGINT", "SIGTERM", "SIGHUP"]
MOMENTS = ["callback", "half_made", "twice"]

FORKED = """
import json, os, signal, sys
from armperturb import cli
from armperturb.commands.command import Command

def forked(name, run, *, session=False):
    child = os.fork()
    if child:
        return child
    if session:
        os.setsid()
    signal.signal(getattr(signal, name), signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)

    class Long(Command):
        def run(self):
            run()
            return []

    cli._parse = lambda arguments: Long()
    sys.exit(cli.main([]))
"""
"""A function that runs a command in a child process, in which a signal does what it does by default."""

INTERRUPTED = (
    FORKED
    + """
import time, weakref

def interrupt():
    signal.raise_signal(getattr(signal, name))
    time.sleep(0.1)

class Thing:
    pass

class HalfMade:
    def __init__(self):
        interrupt()
        self.made = True

    def __del__(self):
        self.made

def callback():
    thing = Thing()
    kept = weakref.ref(thing, lambda _: interrupt())
    del thing
    time.sleep(20.0)

def half_made():
    kept = HalfMade.__new__(HalfMade)
    kept.__init__()

def twice():
    try:
        interrupt()
    finally:
        interrupt()

for name, moment in json.loads(sys.argv[1]):
    said = os.open(f"{name} {moment}", os.O_WRONLY | os.O_CREAT)
    os.dup2(said, 2)
    print(os.waitstatus_to_exitcode(os.waitpid(forked(name, globals()[moment]), 0)[1]), flush=True)
"""
)

PROGRAM = (
    FORKED
    + """
import time
from pathlib import Path
from armperturb.files import written_whole
from armperturb.workers import completed, workers_for

def write():
    with workers_for(2, None) as pool, written_whole(out / "result.csv") as part:
        part.write_text("half")
        for _ in completed(time.sleep, [0.0, 60.0, 60.0], pool):
            (out / "ready").touch()

for line in sys.stdin:
    out, name = json.loads(line)
    out = Path(out)
    os.dup2(os.open(f"{out} said", os.O_WRONLY | os.O_CREAT), 2)
    child = forked(name, write, session=True)
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
)


@pytest.fixture(scope="module")
def program():
    """A process that forks one for each command, as to load what they need takes longest."""
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as run:
        yield run


@pytest.mark.slow(reason="a process of its own")
@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("to_group", [False, True], ids=["process", "group"])
def test_signals_end_a_command_in_order(program, tmp_path, name, to_group):
    number, out = getattr(signal, name), tmp_path / "out"
    out.mkdir()
    print(json.dumps([str(out), name]), file=program.stdin, flush=True)
    child, latest = int(program.stdout.readline()), time.monotonic() + 30.0
    while not (out / "ready").exists():
        assert time.monotonic() < latest
        time.sleep(0.05)
    (os.killpg if to_group else os.kill)(child, number)
    status = int(program.stdout.readline())
    assert (status, (tmp_path / "out said").read_text()) == (128 + number, "armperturb: interrupted\n")
    assert [path.name for path in out.iterdir()] == ["ready"]


@pytest.fixture(scope="module")
def ends(tmp_path_factory):
    """Signal and moment to the exit status of a command that it interrupts then, and what that says."""
    folder = tmp_path_factory.mktemp("interrupted")
    asked = list(itertools.product(SIGNALS, MOMENTS))
    run = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, json.dumps(asked)],
        capture_output=True,
        text=True,
        timeout=15.0,
        cwd=folder,
        check=True,
    )
    statuses = map(int, run.stdout.split())
    return {each: (status, (folder / " ".join(each)).read_text()) for each, status in zip(asked, statuses, strict=True)}


@pytest.mark.slow(reason="starts processes")
@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_signal_ends_a_command_in_one_line(ends, name, moment):
    assert ends[name, moment] == (128 + getattr(signal, name), "armperturb: interrupted\n")


def test_a_part_file_of_any_moment_is_removed(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    made = files.os.close
    monkeypatch.setattr(files.os, "close", lambda handle: (made(handle), interrupted()))  # it is there, and not known
    with pytest.raises(KeyboardInterrupt), files.written_whole(tmp_path / "o.csv"):
        pass
    monkeypatch.undo()
    assert len(list(tmp_path.iterdir())) == 1
    files.remove_unfinished()
    assert not list(tmp_path.iterdir())
