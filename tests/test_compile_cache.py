"""Compiled code finds a folder where package and home cannot be written to."""

import os
import stat
import tempfile
from pathlib import Path

import pytest

from armperturb import compile_cache


@pytest.fixture
def read_only(tmp_path, monkeypatch):
    """A package and a home that cannot be written to, and a temporary folder that can."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) == tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "/nowhere/at/all")
    return tmp_path / f"armperturb-{os.getuid()}"


def test_a_private_temporary_folder_takes_the_place_of_the_usual_ones(read_only, monkeypatch):
    compile_cache.provide_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == str(read_only)
    assert stat.S_IMODE(read_only.stat().st_mode) == 0o700
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    compile_cache.provide_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == str(read_only)


def test_a_folder_that_others_can_write_to_is_not_trusted(read_only):
    read_only.mkdir()
    read_only.chmod(0o777)
    compile_cache.provide_cache()
    assert not os.environ["NUMBA_CACHE_DIR"]


def test_nothing_changes_where_there_is_a_folder(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    compile_cache.provide_cache()
    assert not os.environ["NUMBA_CACHE_DIR"]
