"""The file in which a search is saved after each step, so that one that was stopped goes on."""

import hashlib
from pathlib import Path

import numpy as np

from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.search import Position
from armperturb.archive import read_archive, write_archive

VERSION = 5
"""Of the search: raised when a position that an earlier one has saved is none of this one's."""


def digest_of(problem: Problem, *origin: object) -> str:
    """Digest of all that a search depends on: its version, structure, trials, and where and how it begins."""
    digest = hashlib.sha256(repr((VERSION, problem.parameters.model, *origin)).encode())
    for trials in problem.sets:
        digest.update(repr((trials.label, trials.body, trials.environment, trials.end)).encode())
        for signal in (trials.drive, trials.displacement):
            digest.update(np.ascontiguousarray(signal).tobytes())
    return digest.hexdigest()


def save_position(path: Path, digest: str, position: Position) -> None:
    """Write a position; the file changes all at once.

    Raises:
      OSError: the file cannot be written.
    """
    write_archive(path, digest, position)


def load_position(path: Path, digest: str) -> Position | None:
    """The position that a search with the same digest saved; None without such a file, or if it cannot be read."""
    try:
        archive = read_archive(path)
    except (FileNotFoundError, ValueError):
        return None
    return archive.value if archive.source == digest else None
