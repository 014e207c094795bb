"""Names, tables, settings and files that would run, obey, or run away are refused, or made harmless."""

import io
import json
import os
import resource
import shlex
import sys
import time

import pytest

from armperturb import cli
from armperturb.cli import printable
from armperturb.commands.command import command_line
from armperturb.commands.identify import Identify
from armperturb.files import read_toml, write_csv
from armperturb.plots.panels import legend
from armperturb.plots.style import in_style, new_figure, svg
from armperturb.study.protocol import Condition, load_protocol

PROTOCOL = """
forces = "published"
[[conditions]]
name = %s
task = "RT"
rms_displacement = 0.0075
published_force = 2.0
repetitions = %d
"""


def refused(capsys, *arguments):
    """The one line in which a command is refused, within a second and without memory."""
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    assert cli.main(list(map(str, arguments))) == 1
    assert time.monotonic() - start < 20.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("name", ["a\x1b[2Jb", "a\0b", "a\nb", "x" * 101])
def test_names_are_printable(tmp_path, capsys, name):
    path = tmp_path / "p.toml"
    path.write_text(PROTOCOL % (json.dumps(name), 1), encoding="utf-8")
    line = refused(capsys, "study", "--protocol", path, "--out", tmp_path / "s")
    assert "expected a text of at most 100 printable characters" in line
    assert line.isprintable()
    assert not (tmp_path / "s").exists()


def test_a_dollar_in_a_name_is_no_mathematics():
    name = r"RT$\frac"
    assert Condition(name=name, task="RT", rms_displacement=0.01, published_force=1.0).name == name
    with in_style():
        figure = new_figure(2.0)
        (line,) = figure.subplots().plot([0, 1], label=name)
        legend(figure, line)
        assert svg(figure).startswith(b"<?xml")


@pytest.mark.parametrize("start", ["=", "+", "-", "@", "\t", "\r"])
def test_spreadsheets_run_no_cell(tmp_path, start):
    write_csv([{"name": f"{start}cmd|'/c calc'!A1", "value": -1.5, "text": "-1.5"}], tmp_path / "t.csv")
    cells = (tmp_path / "t.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert cells[0].lstrip('"').startswith("'")
    assert cells[-1].endswith(",-1.5,-1.5")


@pytest.mark.slow(reason="runs whole commands")
def test_results_are_written_where_nothing_can_be_printed(tmp_path, monkeypatch, capsys):
    page = tmp_path / "o.html"
    with open("/dev/full", "w") as full, monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", full)
        message = refused(capsys, "live", "--out", str(page))
    assert "standard output: cannot be written (No space left on device); the results are" in message
    assert page.stat().st_size > 10_000


def test_a_terminal_without_a_letter_shows_its_number(monkeypatch):
    with io.TextIOWrapper(io.BytesIO(), encoding="ascii") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        cli.show(["Jürgen: 3°"])
        assert terminal.buffer.getvalue() == b"J\\xfcrgen: 3\\xb0\n"


def test_control_characters_do_not_reach_a_terminal(capsys, tmp_path):
    assert printable("a\x1b[2Jb\n") == "a\\x1b[2Jb\n"
    assert "\\x1b[2J" in refused(capsys, "identify", tmp_path / "\x1b[2J.nc", "--model", "3b", "--out", tmp_path / "o")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("study", "--subjects", "100000000"), "subjects = 100000000; expected a finite number"),
        (("validate", "--groups", "1000000000"), "groups = 1000000000; expected a finite number"),
        (("validate", "--trials", "1000000000"), "trials = 1000000000; expected a finite number"),
        (
            ("validate", "--workers", "1000000", "--groups", "100000"),
            "workers = 1000000; expected a finite number at least 1 and",
        ),
    ],
)
def test_counts_that_run_away_are_refused(tmp_path, capsys, arguments, message):
    assert message in refused(capsys, *arguments, "--out", tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_more_trials_than_a_file_can_hold_are_refused(tmp_path, capsys):
    path = tmp_path / "p.toml"
    path.write_text(PROTOCOL % ('"RT7.5"', 1_000_000_000), encoding="utf-8")
    line = refused(capsys, "study", "--protocol", path, "--out", tmp_path / "s")
    assert "1000000000 trials of 36 s take" in line
    assert "expected at most 1 GiB" in line


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 60_000, "a" + ".a" * 30_000 + " = 1", "a" + ' . "a"' * 9_000 + " = 1", "[" + "a." * 30_000 + "a]"],
    ids=["lists", "keys", "spaced keys", "tables"],
)
def test_deep_toml_is_refused(tmp_path, capsys, text):
    path = tmp_path / "p.toml"
    path.write_text(text, encoding="utf-8")
    assert "p.toml: " in refused(capsys, "study", "--protocol", path, "--out", tmp_path / "s")


def test_large_toml_and_pipes_are_refused(tmp_path, capsys):
    path = tmp_path / "p.toml"
    path.write_text("# " + "x" * 70_000, encoding="utf-8")
    assert "expected at most 65536" in refused(capsys, "study", "--protocol", path, "--out", tmp_path / "s")
    os.mkfifo(tmp_path / "pipe.toml")
    line = refused(capsys, "study", "--protocol", tmp_path / "pipe.toml", "--out", tmp_path / "s")
    assert "is a folder, a pipe or a device" in line


def test_a_byte_order_mark_is_no_part_of_toml(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text(PROTOCOL % ('"RT7.5"', 2), encoding="utf-8-sig")
    assert read_toml(path, "a = 1")["forces"] == "published"
    assert load_protocol(path).conditions[0].repetitions == 2


def test_the_command_that_a_page_shows_can_be_typed(tmp_path, capsys):
    command = Identify(recordings=(tmp_path / "a b.nc",), out=tmp_path / "o", model="3b", emg=True, overwrite=True)
    typed = shlex.split(command_line(command))
    given = ["identify", f"{tmp_path}/a b.nc", "--out", f"{tmp_path}/o", "--model", "3b"]
    assert typed == ["armperturb", *given, "--emg", "--overwrite"]
    assert "a b.nc: no such file" in refused(capsys, *typed[1:])
