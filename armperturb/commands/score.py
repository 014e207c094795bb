"""`armperturb score`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command, Positional
from armperturb.commands.report import kept_lines


@dataclass(frozen=True, kw_only=True)
class Score(Command):
    """Compare a study with the published tables: shares of cells within 0.5, 1 and 2 SD, and the headline numbers."""

    needs_simulator = True

    folders: Positional[tuple[Path, ...]]
    """Folders of studies, complete or not; their recordings are not changed. Of several, means and SDs over them are
    printed, so that one lucky seed is not the result."""
    out: Path | None = None
    """Folder for score.csv, headlines.csv and score.txt of a single study; by default FOLDER/score."""
    workers: int | None = None
    """Number of processes; by default about one per core. It changes the files by rounding only."""
    fresh: bool = False
    """Compute anew what analysis/ has kept; nonlinear fits are used again."""

    def run(self) -> list[str]:
        """Compare, and write the tables."""
        from armperturb.study.comparison.cohorts import CohortScores
        from armperturb.study.comparison.score import score, write_score
        from armperturb.study.results.analyse import analyse_study
        from armperturb.study.results.cache import forget_results, recalled_results

        if not self.folders:
            raise ValueError("score: no folder; expected at least one study (armperturb score FOLDER)")
        if self.out and len(self.folders) > 1:
            raise ValueError(f"score: out = {self.out} for {len(self.folders)} studies; expected one study with --out")
        scores, written = [], []
        with recalled_results() as recalled:
            for folder in self.folders:
                if self.fresh:
                    forget_results(folder)
                scores.append(score(analyse_study(folder, workers=self.workers)))
                out = self.out or folder / "score"
                write_score(scores[-1], out)
                written.append(f"results: {out}")
        result = scores[0] if len(scores) == 1 else CohortScores(scores=tuple(scores))
        return [result.summary(), *kept_lines(recalled), *written]
