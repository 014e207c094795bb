"""A write, rename, fsync or allocation that fails leaves results as they were, or whole, and one line."""

import os

import pytest

from armperturb import files
from benchmarks.faults import COMMANDS, OPERATIONS, failures, laboratory


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    here, folder = os.getcwd(), tmp_path_factory.mktemp("lab")
    laboratory(folder, with_study=False)
    os.chdir(here)
    return folder


@pytest.mark.slow(reason="seven runs of a command")
@pytest.mark.parametrize("kind", OPERATIONS)
def test_each_failure_leaves_what_was_there_or_what_is_new(inputs, kind):
    found = list(failures(inputs, *COMMANDS["convert"], kind, most=4))
    assert len(found) >= 1
    assert [text for _, text in found if text] == []


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
