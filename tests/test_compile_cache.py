"""Compiled code is compiled anew when anything that it was made from changes, and finds a folder everywhere."""

import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from armperturb import compile_cache

BASE = "from armperturb.jit import jit\nFACTOR = {factor}\n@jit\ndef scaled(x):\n    return {term} * x\n"
USER = "from armperturb.jit import jit\nfrom base import {names}\n@jit\ndef used(x):\n    return {used}\n"


@pytest.fixture
def read_only(tmp_path, monkeypatch):
    """A package and a home that cannot be written to, and a temporary folder that can."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) == tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "/nowhere/at/all")
    return tmp_path / f"armperturb-{os.getuid()}"


def test_a_private_temporary_folder_takes_the_place_of_the_usual_ones(read_only):
    assert compile_cache.cache_folder(__name__).parent == read_only
    assert stat.S_IMODE(read_only.stat().st_mode) == 0o700
    assert compile_cache.cache_folder(__name__).parent == read_only


def test_a_folder_that_others_can_write_to_is_not_trusted(read_only):
    read_only.mkdir()
    read_only.chmod(0o777)
    assert compile_cache.cache_folder(__name__) is None


def test_the_package_keeps_its_own_and_the_users_choice_comes_first(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    package = Path(compile_cache.__file__).parent
    assert compile_cache.cache_folder(__name__).is_relative_to(package / "__pycache__")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert compile_cache.cache_folder(__name__).parent == tmp_path


@pytest.mark.slow(reason="compiles in processes of its own")
@pytest.mark.parametrize(
    ("names", "used", "changed"),
    [("scaled", "scaled(x)", {"term": 3.0}), ("FACTOR", "FACTOR * x", {"factor": 3.0})],
    ids=["function", "constant"],
)
def test_a_change_of_what_a_module_imports_compiles_it_anew(tmp_path, names, used, changed):
    def result(**of_base):
        (tmp_path / "base.py").write_text(BASE.format(**{"factor": 2.0, "term": 2.0} | of_base))
        (tmp_path / "user.py").write_text(USER.format(names=names, used=used))
        code = "import user; x = user.used(1.0); print(x, *user.used.stats.cache_hits.values())"
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    assert result() == ["2.0"]
    assert result() == ["2.0", "1"]
    assert result(**changed) == ["3.0"]
