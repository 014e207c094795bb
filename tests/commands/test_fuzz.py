"""Damaged files of every format end in one line; more lines, other values and signals would be counted."""

import os
import random
import signal

import pytest

from benchmarks.fuzz import CASES, Case, damaged, fuzz, outcome

FORK = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
CHEAP = ("recording", "CSV", "sidecar", "MATLAB v5", "MATLAB v7.3", "NPZ", "protocol", "structure")


def refused():
    raise ValueError("not what was expected")


def broken():
    raise KeyError("never caught")


def crashed():
    os.kill(os.getpid(), signal.SIGKILL)


@FORK
@pytest.mark.parametrize(
    ("run", "compared", "end"),
    [
        (lambda: 1, lambda: 1, "carried out"),
        (lambda: 2, lambda: 1, "DAMAGE NOT NOTICED"),
        (refused, None, "refused"),
        (broken, None, "TRACEBACK"),
        (crashed, None, "SIGNAL 9"),
        (["convert", "none.csv", "--out", "o.csv"], None, "refused"),
        (["convert", "none.csv"], None, "NOT ONE LINE"),
    ],
)
def test_ends_are_told_apart(tmp_path, run, compared, end):
    assert outcome(tmp_path, Case("f", run, compared=compared), 1, guarded=True) == end


@FORK
@pytest.mark.slow(reason="a file of each kind is made, damaged and read")
def test_damage_of_each_kind_of_file_ends_well(capsys):
    assert set(CHEAP) <= set(CASES)
    ends = fuzz(list(CHEAP), runs=40, seed=7)
    assert set().union(*ends.values()) <= {"carried out", "refused", "refused by the guarded child"}, ends
    assert ends["recording"]["refused"] >= 8
    assert damaged(b"abc" * 500, random.Random(0)) != b"abc" * 500
