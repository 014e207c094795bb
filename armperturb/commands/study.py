"""`armperturb study`."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

from armperturb.commands.command import Command
from armperturb.commands.report import LAST_STAGE, analysis_stages
from armperturb.progress import stages
from armperturb.study.recording.settings import BLOCK, StudySettings

RECORDING = 40.0
"""Usual share of the time of a study, see `analysis_stages`."""


@dataclass(frozen=True, kw_only=True)
class Study(Command):
    """Run a study: draw people, perturb them, identify them, and report."""

    needs_simulator = True
    resumes = True

    out: Path
    """Folder for recordings, tables, figures and report.html; a study that was interrupted there continues."""
    settings: StudySettings = field(default_factory=StudySettings)
    workers: int | None = None
    """Number of processes; by default about one per core. Like the next two options, it has no effect on the files."""
    dask: str | None = None
    """Address of a Dask scheduler whose workers simulate, e.g. tcp://127.0.0.1:8786; needs armperturb[dask]."""
    block: int = BLOCK
    """Number of trials that a worker simulates side by side; limits its memory."""
    nonlinear: tuple[Literal["RT", "PT"], ...] = ()
    """Tasks in which each person's muscle law is identified, which takes minutes per person; see `report`."""
    record_only: bool = False
    """Stop after the recordings: no identification, no report."""

    def run(self) -> list[str]:
        """Run or continue the study."""
        from armperturb.study.recording.record import record_study

        if self.record_only:
            record_study(self.settings, self.out, workers=self.workers, dask=self.dask, block=self.block)
            return [f"recordings: {self.out}"]
        from armperturb.study.report.report import write_report
        from armperturb.study.results.analyse import run_study
        from armperturb.study.results.cache import recalled_results
        from armperturb.study.results.compiling import compile_fits, compile_simulations
        from armperturb.workers import kept_workers

        ahead = (partial(compile_simulations, self.settings.engine), compile_fits)
        shares = {"recording": RECORDING} | analysis_stages(self.nonlinear)
        with stages(shares), recalled_results(), kept_workers(LAST_STAGE, ahead=ahead):
            result = run_study(
                self.settings,
                self.out,
                workers=self.workers,
                dask=self.dask,
                block=self.block,
                nonlinear=self.nonlinear,
            )
            return [f"report: {write_report(result, self.out, workers=self.workers)}"]
