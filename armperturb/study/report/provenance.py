"""Where a report comes from: when it was written, the command that made the recordings, and a digest of these."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import NamedTuple

from armperturb.study.protocol import THESIS
from armperturb.study.recording.manifest import Manifest
from armperturb.study.recording.settings import StudySettings
from armperturb.study.results.cache import recalled_numbers
from armperturb.study.results.study_result import StudyResult


class Provenance(NamedTuple):
    """What the foot of a report tells.

    Attributes:
      date: when the report was written, UTC.
      command: that makes such recordings; empty of a laboratory's.
      digest: SHA-256 over names and checksums of all recordings.
      recalled: results of an earlier analysis that were used again.
    """

    date: str
    command: str
    digest: str
    recalled: Sequence[str]


def provenance(study: StudyResult, checksums: Mapping[str, str]) -> Provenance:
    """That of a study.

    Args:
      study: analysed.
      checksums: file name of each recording to its checksum.
    """
    return Provenance(
        date=datetime.now(UTC).strftime("%d %B %Y").lstrip("0"),
        command=command_of(study.made) if study.made else "",
        digest=digest_of(checksums),
        recalled=recalled_numbers(),
    )


def digest_of(checksums: Mapping[str, str]) -> str:
    """SHA-256 over the lines "NAME CHECKSUM" of the files, in their order."""
    lines = "".join(f"{name} {checksum}\n" for name, checksum in checksums.items())
    return hashlib.sha256(lines.encode()).hexdigest()


def command_of(made: Manifest) -> str:
    """The command of these settings; those that have their default value are left out, but for people and seed."""
    words = ["armperturb study --out DIR", f"--subjects {made.subjects}", f"--seed {made.seed}"]
    default = StudySettings()
    if made.ideal:
        words.append("--ideal")
    for name in ("muscles", "timestep", "engine"):
        if getattr(made, name) != getattr(default, name):
            words.append(f"--{name} {getattr(made, name)}")
    if made.protocol == replace(THESIS, forces=made.protocol.forces):
        if made.protocol.forces != THESIS.forces:
            words.append(f"--forces {made.protocol.forces}")
    else:
        words.append("--protocol FILE")
    return " ".join(words)
