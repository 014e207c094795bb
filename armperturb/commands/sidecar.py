"""`armperturb sidecar`."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command, Positional


@dataclass(frozen=True, kw_only=True)
class Sidecar(Command):
    """Write the sidecar of a laboratory's file from its names and numbers, with every guess marked."""

    file: Positional[Path]
    """CSV, MATLAB, NPZ or C3D file."""
    out: Path | None = None
    """Sidecar to write; by default FILE.json beside the file. An existing one is never overwritten."""
    rate: float | None = None
    """Sampling rate [Hz], of a file that has no column of times."""

    def run(self) -> list[str]:
        """Guess what the columns are and write the sidecar."""
        from armperturb.convert.template import write_sidecar

        path, notes = write_sidecar(self.file, self.out, rate=self.rate)
        return [*notes, f"for other files with these channels: --sidecar {shlex.quote(str(path))}", f"sidecar: {path}"]
