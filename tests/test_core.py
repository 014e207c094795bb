"""The core works without the optional libraries and what only POSIX systems have, and looks for no simulator."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow(reason="identifies a recording in a process of its own")
def test_the_core_needs_no_extra(tmp_path):
    script = Path(__file__).with_name("core.py")
    run = subprocess.run(
        [sys.executable, script, tmp_path, "--hide"], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert run.returncode == 0, run.stderr
    assert [line.partition(" needs ")[2] for line in run.stderr.splitlines()] == [
        "mujoco, which is not installed; expected `pip install 'armperturb[sim]'`",
        "loky, which is not installed; expected `pip install 'armperturb[nonlinear]'`",
    ]
    assert not (tmp_path / "none").exists()
