"""A write, rename, fsync or allocation that fails leaves results as they were, or whole, and one line."""

import os
import sys

import numpy as np
import pandas as pd
import pytest

from armperturb import cli, files
from armperturb.recording_files import load_recording, save_recording
from benchmarks import faults
from benchmarks.faults import COMMANDS, OPERATIONS, failures, laboratory, numbers


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    here, folder = os.getcwd(), tmp_path_factory.mktemp("lab")
    laboratory(folder, with_study=False)
    os.chdir(here)
    # Three seconds of a trial, as the command is run dozens of times.
    save_recording(load_recording(folder / "r.nc").isel(trial=[0], time=slice(600)), folder / "r.nc")
    table = pd.read_csv(folder / "foreign.csv")
    table[(table["t"] < 3.0) & (table["trial"] == table["trial"][0])].to_csv(folder / "foreign.csv", index=False)
    return folder


@pytest.mark.slow(reason="three runs of a command, and many ends of it")
def test_each_failure_leaves_what_was_there_or_what_is_new(inputs):
    found = list(failures(inputs, *COMMANDS["convert"], list(OPERATIONS), most=4))
    assert {kind for kind, *_ in found} == set(OPERATIONS)
    assert [each for each in found if each[-1]] == []


@pytest.fixture
def in_place(monkeypatch):
    """Process of each run of a command that writes a file in place, in three parts, with an allocation before each."""
    runs = []

    def command(arguments):
        runs.append(os.getpid())
        with open("a", "w", encoding="utf-8") as file:
            for part in ("first", "second", "third"):
                try:
                    np.zeros(1)
                except MemoryError:
                    print("armperturb: error: no memory", file=sys.stderr)
                    return 1
                file.write(part)
        return 0

    monkeypatch.setattr(cli, "main", command)
    return runs


def test_a_half_written_file_is_seen(tmp_path, in_place):
    half = "neither the old nor the new file: a"
    found = list(failures(tmp_path, [], [], ["allocation"]))
    assert found == [("allocation", 1, half), ("allocation", 2, half), ("allocation", 3, half)]
    assert in_place == [os.getpid()] * 6  # three without a failure, and what a child finds wrong is looked at again


def test_a_failure_takes_no_run_of_its_own(tmp_path, in_place, monkeypatch):
    whole = cli.main
    # Other tests may have left a helper of a pool to this process.
    monkeypatch.setattr(faults, "may_fork", lambda: True)

    def with_the_file_removed(arguments):
        if status := whole(arguments):
            os.remove("a")
        return status

    monkeypatch.setattr(cli, "main", with_the_file_removed)
    found = list(failures(tmp_path, [], [], ["allocation"]))
    assert found == [("allocation", 1, ""), ("allocation", 2, ""), ("allocation", 3, "")]
    assert in_place == [os.getpid()] * 3


def test_of_many_failures_those_from_each_place_are_seen():
    assert numbers([7, 7, 5, 7], None) == numbers([7, 7, 5, 7], 4) == [1, 2, 3, 4]
    assert numbers([7, 7, 5, 7, 5, 5, 5, 7], 2) == [1, 3, 8]


@pytest.fixture
def done(monkeypatch):
    """Operations on files, in their order."""
    names = []
    for name in ("fsync", "replace"):
        whole = getattr(os, name)

        def told(*given, name=name, whole=whole):
            where = f"/proc/self/fd/{given[0]}"
            names.append(name if name == "replace" else f"{name} {'folder' if os.path.isdir(where) else 'file'}")
            return whole(*given)

        monkeypatch.setattr(os, name, told)
    return names


def test_files_are_on_disk_before_the_first_takes_its_name(tmp_path, done):
    with files.written_together([tmp_path / "a", tmp_path / "b"]) as parts:
        for part in parts:
            part.write_text("new")
    assert done == ["fsync file", "fsync file", "replace", "replace", "fsync folder"]
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": "new", "b": "new"}


@pytest.mark.parametrize(("number", "is_refused"), [(22, False), (5, True)], ids=["EINVAL", "EIO"])
def test_file_systems_that_cannot_sync_folders_are_written_to(tmp_path, monkeypatch, number, is_refused):
    whole = os.fsync

    def no_folders(handle):
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(number, os.strerror(number))
        whole(handle)

    monkeypatch.setattr(os, "fsync", no_folders)
    if is_refused:
        with pytest.raises(OSError, match=f"{os.strerror(number)}: '{tmp_path}'"):
            files.write_whole(tmp_path / "a", "new")
    else:
        files.write_whole(tmp_path / "a", "new")
    assert (tmp_path / "a").read_text() == "new"
