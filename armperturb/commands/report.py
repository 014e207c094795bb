"""`armperturb report`."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from armperturb.commands.command import Command, Positional
from armperturb.progress import stages

MOST_NAMES = 6
"""Recalled results that are named on the terminal."""

LAST_STAGE = "armperturb.study.report.report"
"""Module of the stage that needs the code of all others."""

NONLINEAR = {"RT": 90.0, "PT": 270.0}
"""Task to the usual share of the time of its nonlinear fits, see `analysis_stages`."""


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Analyse the recordings of a study, complete or not, and write its report."""

    needs_simulator = True
    resumes = True

    folder: Positional[Path]
    """Folder of the study; its recordings are not changed."""
    nonlinear: tuple[Literal["RT", "PT"], ...] = ()
    """Tasks in which each person's muscle law is identified and the pulses left out of the fit are predicted; takes
    minutes per person. Later reports include these fits without the option."""
    workers: int | None = None
    """Number of processes; by default about one per core. It changes the files by rounding only."""
    fresh: bool = False
    """Compute anew what analysis/ has kept; nonlinear fits only with the option that asks for them."""

    def run(self) -> list[str]:
        """Analyse the folder and write the report."""
        from armperturb.study.report.report import write_report
        from armperturb.study.results.analyse import analyse_study
        from armperturb.study.results.cache import forget_results, recalled_results
        from armperturb.workers import kept_workers

        if self.fresh:
            forget_results(self.folder, self.nonlinear)
        shares = analysis_stages(self.nonlinear)
        with stages(shares), recalled_results() as recalled, kept_workers(LAST_STAGE):
            result = analyse_study(self.folder, workers=self.workers, nonlinear=self.nonlinear)
            path = write_report(result, self.folder, workers=self.workers)
        return [*kept_lines(recalled), f"report: {path}"]


def kept_lines(recalled: Sequence[Path]) -> list[str]:
    """Which results were not computed now, in one line; none if all were."""
    names = sorted(path.name.removesuffix(".json.gz") for path in recalled)
    if len(names) > MOST_NAMES:
        names[MOST_NAMES:] = [f"and {len(names) - MOST_NAMES} more"]
    return [f"recalled from analysis/ (--fresh computes them anew): {', '.join(names)}"] if names else []


def analysis_stages(nonlinear: Collection[str]) -> dict[str, float]:
    """Stages of the analysis of a study and of its report, to their usual shares of the time.

    Args:
      nonlinear: tasks in which everybody is identified nonlinearly.
    """
    of_fits = sum(NONLINEAR[task] for task in nonlinear)
    fits = {"nonlinear fits": of_fits, "nonlinear fits with pulses": 1.5 * of_fits} if nonlinear else {}
    return {"analysis": 40.0, **fits, "figures": 12.0, "figures of the muscle law": 1.0}
