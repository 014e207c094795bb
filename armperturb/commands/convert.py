"""`armperturb convert`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command, Positional
from armperturb.convert.tables import Repair
from armperturb.files import checksum, require_folder_of, require_new


@dataclass(frozen=True, kw_only=True)
class Convert(Command):
    """Turn a laboratory's files into a recording, or a recording into files for other programs."""

    files: Positional[tuple[Path, ...]]
    """CSV, MATLAB, NPZ or C3D files with a JSON sidecar that describes them, or recordings (netCDF4); the output holds
    the trials of all of them."""
    out: Path
    """Recording to write (.nc), or text (.csv) or MATLAB (.mat) with a sidecar beside it."""
    sidecar: Path | None = None
    """Sidecar of all files, see docs/recordings.md; by default FILE.json beside each."""
    repair: tuple[Repair, ...] = ()
    """Faults to repair instead of refusing them: gaps of up to 0.1 s (of forces 0.025 s), dropped samples of up to
    0.025 s, an uneven clock, unequal lengths; stretch keeps the longest part without longer gaps, trials leaves out
    trials with other faults."""
    rate: float | None = None
    """Sampling rate of the recording but for its EMG [Hz], also where it is netCDF; by default that of the files."""
    checksum: bool = False
    """Print the SHA-256 of each file that is written, in lines as `sha256sum -c` reads them."""
    overwrite: bool = False
    """Replace existing files of the output; an input is never replaced."""

    def run(self) -> list[str]:
        """Read the files and write their trials in the other format."""
        from armperturb.convert.exporter import export_recording, require_ending, written_files
        from armperturb.convert.importer import import_recording

        require_ending(self.out)  # before long recordings are read
        require_folder_of(self.out)
        imported = import_recording(self.files, sidecar=self.sidecar, repair=self.repair, rate=self.rate)
        require_new(written_files(imported.recording, self.out), overwrite=self.overwrite)
        paths = export_recording(imported.recording, self.out)
        sums = [f"{checksum(path)}  {path}" for path in paths if self.checksum]
        return [*imported.notes, f"recording: {', '.join(map(str, paths))}", *sums]
