"""Compiled code is compiled anew when anything that it was made from changes, and finds a folder everywhere."""

import json
import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from armperturb import compile_cache

BASE = "from armperturb.jit import jit\nFACTOR = {factor}\n@jit\ndef scaled(x):\n    return {term} * x\n"
USERS = {"function": ("scaled", "scaled(x)"), "constant": ("FACTOR", "FACTOR * x")}
USER = "from armperturb.jit import jit\nfrom base import {names}\n@jit\ndef used(x):\n    return {used}\n"

PROCESS = """
import json, os, sys
import numba  # which takes long, and compiles nothing yet

for base in json.loads(sys.argv[1]):
    with open("base.py", "w") as file:
        file.write(base)
    child = os.fork()
    if child == 0:
        sys.path.insert(0, os.getcwd())
        assert not any(name.startswith("armperturb") and "editable" not in name for name in sys.modules)
        import {users}
        for user in ({users}):
            print(user.used(1.0), sum(user.used.stats.cache_hits.values()))
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
"""


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
def test_a_change_of_what_a_module_imports_compiles_it_anew(tmp_path):
    for kind, (names, used) in USERS.items():
        (tmp_path / f"{kind}.py").write_text(USER.format(names=names, used=used))
    values = {"factor": 2.0, "term": 2.0}
    bases = [BASE.format(**(values | changed)) for changed in ({}, {}, {"term": 3.0}, {"factor": 3.0})]
    done = subprocess.run(
        [sys.executable, "-c", PROCESS.format(users=", ".join(USERS)), json.dumps(bases)],
        cwd=tmp_path,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    first, again, of_function, of_constant = np.array(done.stdout.split(), dtype=float).reshape(4, 2, 2).tolist()
    # Of each: what it returns, and how often what was compiled was found.
    assert first == [[2.0, 0], [2.0, 0]]
    assert again == [[2.0, 1], [2.0, 1]]
    assert of_function[0] == [3.0, 0]
    assert of_constant[1] == [3.0, 0]
