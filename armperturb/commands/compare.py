"""`armperturb compare`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from armperturb.commands.command import Command, Positional
from armperturb.files import require_new_results, write_csv, write_whole

RESULTS = ("compare.csv", "compare.svg", "compare.txt")
"""Files that are written."""


@dataclass(frozen=True, kw_only=True)
class Compare(Command):
    """Compare an arm with people: distances of admittance, ellipses and joint parameters in SDs between people."""

    needs_simulator = True

    recordings: Positional[tuple[Path, ...]]
    """Recordings of one arm in one condition under multisines or noise: netCDF4, or others with a sidecar."""
    out: Path
    """Folder for compare.csv, compare.svg and compare.txt."""
    reference: Annotated[Literal["thesis", "people"], tyro.conf.arg(name="with")] = "people"
    """Linear arms drawn from the thesis's tables, or people of the cohort; under the perturbation of each trial."""
    sidecar: Path | None = None
    """Sidecar of all recordings that need one, see docs/recordings.md; by default FILE.json beside each."""
    subject: str | None = None
    """Which subject, if the recordings hold several."""
    condition: str | None = None
    """Which condition, if they hold several."""
    ideal: bool = False
    """People without noise of their own and with perfect instruments, beside a model that has neither."""
    seed: int = 0
    """Of the people."""
    overwrite: bool = False
    """Replace results of an earlier run in the folder; an input is never replaced."""

    def run(self) -> list[str]:
        """Compare, and write the table and the figure."""
        from armperturb.commands.selection import select_trials
        from armperturb.plots.style import save_plot
        from armperturb.study.comparison.likeness import compare

        recordings, lines = select_trials(
            self.recordings, self.sidecar, self.subject, self.condition, single_condition=True
        )
        require_new_results(self.out, RESULTS, overwrite=self.overwrite)
        try:
            likeness = compare(recordings, self.reference, ideal=self.ideal, seed=self.seed)
        except ValueError as error:
            raise ValueError(f"{', '.join(map(str, self.recordings))}: {error}") from None
        self.out.mkdir(parents=True, exist_ok=True)
        write_csv(likeness.to_frame(), self.out / "compare.csv")
        save_plot(likeness, self.out / "compare.svg")
        write_whole(self.out / "compare.txt", likeness.summary() + "\n")
        return [*lines, likeness.summary(), f"results: {self.out}"]
