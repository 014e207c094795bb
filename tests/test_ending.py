"""A command that is asked to end leaves nothing half-written and says one line."""

import os
import signal
import subprocess
import sys
import time

import pytest

from armperturb import files

SLOW = pytest.mark.slow(reason="three processes")
SIGNALS = ["SIGINT", pytest.param("SIGTERM", marks=SLOW), pytest.param("SIGHUP", marks=SLOW)]

INTERRUPTED = """
import signal, sys, time, weakref
from armperturb import cli
from armperturb.commands.command import Command

def interrupt():
    signal.raise_signal(getattr(signal, sys.argv[1]))
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

class Long(Command):
    def run(self):
        globals()[sys.argv[2]]()
        return []

cli._parse = lambda arguments: Long()
sys.exit(cli.main([]))
"""

PROGRAM = """
import sys, time
from pathlib import Path
from armperturb import cli
from armperturb.commands.command import Command
from armperturb.files import written_whole
from armperturb.workers import completed, workers_for

class Long(Command):
    def run(self):
        out = Path(sys.argv[1])
        with workers_for(2, None) as pool, written_whole(out / "result.csv") as part:
            part.write_text("half")
            for _ in completed(time.sleep, [0.0, 60.0, 60.0], pool):
                (out / "ready").touch()
        return []

cli._parse = lambda arguments: Long()
sys.exit(cli.main([]))
"""


@pytest.mark.slow(reason="a process of its own")
@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("to_group", [False, True], ids=["process", "group"])
def test_signals_end_a_command_in_order(tmp_path, name, to_group):
    number = getattr(signal, name)
    run = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(number, signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL),
    )
    while not (tmp_path / "ready").exists() and run.poll() is None:
        time.sleep(0.05)
    (os.killpg if to_group else os.kill)(run.pid, number)
    _, errors = run.communicate(timeout=30.0)
    assert (run.returncode, errors) == (128 + number, "armperturb: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["ready"]


@pytest.mark.slow(reason="starts processes")
@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("moment", ["callback", "half_made", "twice"])
def test_a_signal_ends_a_command_in_one_line(name, moment):
    number = getattr(signal, name)
    run = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, name, moment],
        capture_output=True,
        text=True,
        timeout=15.0,
        preexec_fn=lambda: signal.signal(number, signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL),
    )
    assert (run.returncode, run.stderr) == (128 + number, "armperturb: interrupted\n")


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
