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

    starts: bool = False
    """Fit appendix C also from the published and from scattered starts, and print all three side by side with the cells
    that the start made; FOLDER/score/starts.csv has every cell."""

    def run(self) -> list[str]:
        """Compare, and write the tables."""
        from armperturb.files import write_csv
        from armperturb.study.comparison.cohorts import CohortScores
        from armperturb.study.comparison.score import score, write_score
        from armperturb.study.comparison.start_scores import compare_starts
        from armperturb.study.recording.folder import find_recordings
        from armperturb.study.results.analyse import analyse_study
        from armperturb.study.results.cache import forget_results, recalled_results

        if not self.folders:
            raise ValueError("score: no folder; expected at least one study (armperturb score FOLDER)")
        if self.out and len(self.folders) > 1:
            raise ValueError(f"score: out = {self.out} for {len(self.folders)} studies; expected one study with --out")
        scores, written, of_starts = [], [], list[str]()
        with recalled_results() as recalled:
            for folder in self.folders:
                if self.fresh:
                    forget_results(folder)
                scores.append(score(analyse_study(folder, workers=self.workers)))
                out = self.out or folder / "score"
                write_score(scores[-1], out)
                written.append(f"results: {out}")
                if self.starts:
                    result = compare_starts(find_recordings(folder)[0])
                    write_csv(result.to_frame(), out / "starts.csv")
                    of_starts.append(result.summary())
        total = scores[0] if len(scores) == 1 else CohortScores(scores=tuple(scores))
        return [total.summary(), *of_starts, *kept_lines(recalled), *written]
