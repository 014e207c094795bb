"""Runs the readers that damaged files can crash, or keep busy for ever, in a process of their own."""

import subprocess
import sys
from pathlib import Path

LONGEST = 30.0
"""That a file may take to be read [s]."""


def run_reader(program: str, path: Path, *arguments: str) -> bytes:
    """What a program of this folder writes about a file.

    Args:
      program: its name. It needs nothing of this package.
      path: of the file.
      arguments: of the program, behind the path.

    Raises:
      ValueError: it ended otherwise than well, or not in time; its last line on standard error says why.
    """
    command = [sys.executable, "-P", str(Path(__file__).with_name(program)), str(path.resolve()), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, timeout=LONGEST, check=False)
    except subprocess.TimeoutExpired:
        raise ValueError(f"its reader took {LONGEST:g} s") from None
    if done.returncode:
        said = done.stderr.decode(errors="replace").strip().splitlines()
        why = said[-1] if said and done.returncode > 0 else f"its reader ended with status {done.returncode}"
        raise ValueError(f"{why:.200}")
    return done.stdout
