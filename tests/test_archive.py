"""Results as plain files: nothing is lost, nothing foreign is run, and damage is an error."""

import gzip
import json
import math
import os
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

from armperturb import archive
from armperturb.archive import read_archive, write_archive
from armperturb.environment import Environment
from armperturb.study.published.tables import MeanSD
from armperturb.subject import POSITION

VALUES = [
    None,
    True,
    -3,
    0.1,
    math.inf,
    -math.inf,
    1 + 2j,
    "a text: µ",
    Path("a/b.nc"),
    (1, (2.5, "x"), ()),
    [1, [2]],
    {"a": 1, ("PT7.5", "3b"): 2.0, 3: None},
    MeanSD(1.0, 2.0),
    Environment(),
    POSITION,
]


@pytest.mark.parametrize("value", VALUES, ids=[type(value).__name__ for value in VALUES])
def test_values_come_back_as_they_were(value, tmp_path):
    write_archive(tmp_path / "a", {"x": 1}, value)
    found = read_archive(tmp_path / "a").value
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.array([1 + 1j, np.nan]),
        np.zeros((0, 2)),
        np.array([True]),
        np.array("s"),
        np.float64(0.1 + 0.2),
    ],
    ids=("table", "complex", "empty", "truth", "text", "scalar"),
)
def test_arrays_come_back_to_the_last_bit(array, tmp_path):
    write_archive(tmp_path / "a", {"x": 1}, {"x": array})
    found = read_archive(tmp_path / "a").value["x"]
    np.testing.assert_array_equal(found, array)
    assert np.asarray(found).dtype == array.dtype


def test_tables_come_back_with_their_index(tmp_path):
    table = pd.DataFrame({"name": ["a", "b"], "n": [1, 2], "x": [0.1, math.nan], "is_odd": [True, False]}, index=[3, 7])
    write_archive(tmp_path / "a", {"x": 1}, table)
    pd.testing.assert_frame_equal(read_archive(tmp_path / "a").value, table, check_exact=True)


def test_nan_and_mappings_that_cannot_change(tmp_path):
    write_archive(tmp_path / "a", {"x": 1}, MappingProxyType({"x": math.nan}))
    found = read_archive(tmp_path / "a").value
    assert math.isnan(found["x"])


class Foreign(NamedTuple):
    x: int


@pytest.mark.parametrize(
    "value",
    [Foreign(1), {1, 2}, object(), len, np.array([object()])],
    ids=("foreign tuple", "set", "object", "function", "array of objects"),
)
def test_what_is_not_plain_is_refused(value, tmp_path):
    with pytest.raises((TypeError, ValueError)):
        write_archive(tmp_path / "a", {"x": 1}, value)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    "kind",
    ["os:system", "armperturb.archive:read_archive", "armperturb.archive:gzip", "armperturb.nothing:X", "x"],
)
def test_a_file_cannot_make_anything_run(kind, tmp_path):
    content = {"source": "", "value": {"kind": kind, "content": {"command": "touch ran"}}}
    text = json.dumps(content).encode()
    (tmp_path / "a").write_bytes(gzip.compress(text + b"\n" + archive._signature(text)))
    with pytest.raises(
        ValueError, match=r"expected (a class|a dataclass|one of)|No module|not enough values|attribute"
    ):
        read_archive(tmp_path / "a")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no gzip",
        gzip.compress(b"no json"),
        gzip.compress(b"[]"),
        gzip.compress(b'{"source":1}'),
        gzip.compress(b"x" * 100)[:10] + b"\xff" * 50,
        gzip.compress(b"[" * 100_000),
    ],
    ids=("empty", "no gzip", "no json", "a list", "no value", "bits turned", "deep"),
)
def test_damaged_files_are_refused(content, tmp_path):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(ValueError, match="expected what this version writes"):
        read_archive(tmp_path / "a")


def test_a_file_says_what_it_was_made_from(tmp_path):
    write_archive(tmp_path / "a", {"x": [1, "y"]}, 2)
    assert read_archive(tmp_path / "a") == ({"x": [1, "y"]}, 2)
    with pytest.raises(FileNotFoundError):
        read_archive(tmp_path / "b")


def test_what_was_changed_or_written_with_another_key_is_not_believed(tmp_path, monkeypatch):
    path = tmp_path / "a"
    write_archive(path, {"x": 1}, {"k_s": 30.0})
    text = gzip.decompress(path.read_bytes())
    path.write_bytes(gzip.compress(text.replace(b"30.0", b"300.0")))
    with pytest.raises(ValueError, match="written by somebody else, or changed since"):
        read_archive(path)
    path.write_bytes(gzip.compress(text))
    assert read_archive(path).value == {"k_s": 30.0}
    monkeypatch.setattr(archive, "_key", lambda: b"another")
    with pytest.raises(ValueError, match="written by somebody else, or changed since"):
        read_archive(path)


def test_a_pipe_is_no_key(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "key")
    monkeypatch.setenv("ARMPERTURB_KEY", str(tmp_path / "key"))
    assert len(archive._key.__wrapped__()) == 32


def test_the_key_is_the_users_alone_and_lasts(tmp_path, monkeypatch):
    monkeypatch.setenv("ARMPERTURB_KEY", str(tmp_path / "new" / "key"))
    first = archive._key.__wrapped__()
    assert first == archive._key.__wrapped__() == (tmp_path / "new" / "key").read_bytes()
    assert (tmp_path / "new" / "key").stat().st_mode & 0o077 == 0
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ARMPERTURB_KEY", str(tmp_path / "file" / "key"))
    assert archive._key.__wrapped__() != archive._key.__wrapped__()  # nowhere to keep it


def test_a_pipe_is_no_archive(tmp_path):
    os.mkfifo(tmp_path / "a.json.gz")
    with pytest.raises(ValueError, match="a folder, a pipe or a device; expected what this version writes"):
        read_archive(tmp_path / "a.json.gz")


@pytest.mark.slow(reason="packs gigabytes")
def test_an_archive_that_unpacks_to_gigabytes_is_refused(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(gzip.compress(b" " * (archive.LARGEST + 1000)))
    with pytest.raises(ValueError, match="written by somebody else, or changed since"):
        read_archive(path)
