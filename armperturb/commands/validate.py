"""`armperturb validate`."""

from dataclasses import dataclass, field
from pathlib import Path

from armperturb.commands.command import Command
from armperturb.files import require_new_results
from armperturb.study.validation.settings import ValidateSettings

RESULTS = ("tables/validation.csv", "tables/validation_summary.csv", "figures/validation.svg", "settings.json")
"""Files that are written."""


@dataclass(frozen=True, kw_only=True)
class Validate(Command):
    """Judge the estimators on synthetic trials whose truth is known: bias, error over Cramer-Rao bound, coverage."""

    needs_simulator = True

    out: Path
    """Folder for tables/validation.csv, tables/validation_summary.csv, figures/validation.svg and settings.json."""
    settings: ValidateSettings = field(default_factory=ValidateSettings)
    workers: int | None = None
    """Number of processes; by default one per core. It has no effect on the files."""
    overwrite: bool = False
    """Replace results of an earlier run in the folder."""

    def run(self) -> list[str]:
        """Simulate, identify, and write tables and figure."""
        from armperturb.study.validation.report import write_validation
        from armperturb.study.validation.validate import validate

        require_new_results(self.out, RESULTS, overwrite=self.overwrite)
        result = validate(self.settings, workers=self.workers)
        write_validation(result, self.out)
        return [result.summary(), f"results: {self.out}"]
