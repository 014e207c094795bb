"""`armperturb validate`."""

from dataclasses import dataclass, field
from pathlib import Path

from armperturb.commands.command import Command
from armperturb.study.validation.settings import ValidateSettings


@dataclass(frozen=True, kw_only=True)
class Validate(Command):
    """Judge the estimators on synthetic trials whose truth is known: bias, error over Cramer-Rao bound, coverage."""

    needs_simulator = True

    out: Path
    """Folder for tables/validation.csv, tables/validation_summary.csv, figures/validation.svg and settings.json."""
    settings: ValidateSettings = field(default_factory=ValidateSettings)
    workers: int | None = None
    """Number of processes; by default one per core. It has no effect on the files."""

    def run(self) -> list[str]:
        """Simulate, identify, and write tables and figure."""
        from armperturb.study.validation.report import write_validation
        from armperturb.study.validation.validate import validate

        result = validate(self.settings, workers=self.workers)
        write_validation(result, self.out)
        return [result.summary(), f"results: {self.out}"]
