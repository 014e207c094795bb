"""`armperturb score`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command, Positional
from armperturb.commands.report import kept_lines


@dataclass(frozen=True, kw_only=True)
class Score(Command):
    """Compare a study with the published tables: shares of cells within 0.5, 1 and 2 SD, and the headline numbers."""

    needs_simulator = True

    folder: Positional[Path]
    """Folder of the study, complete or not; its recordings are not changed."""
    out: Path | None = None
    """Folder for score.csv, headlines.csv and score.txt; by default FOLDER/score."""
    workers: int | None = None
    """Number of processes; by default about one per core. It changes the files by rounding only."""
    fresh: bool = False
    """Compute anew what analysis/ has kept; nonlinear fits are used again."""

    def run(self) -> list[str]:
        """Compare, and write the tables."""
        from armperturb.study.comparison.score import score, write_score
        from armperturb.study.results.analyse import analyse_study
        from armperturb.study.results.cache import forget_results, recalled_results

        if self.fresh:
            forget_results(self.folder)
        out = self.out or self.folder / "score"
        with recalled_results() as recalled:
            result = score(analyse_study(self.folder, workers=self.workers))
        write_score(result, out)
        return [result.summary(), *kept_lines(recalled), f"results: {out}"]
