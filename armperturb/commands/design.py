"""`armperturb design`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command
from armperturb.files import require_new_results
from armperturb.study.planning.settings import DesignSettings

RESULTS = (
    "tables/design.csv",
    "tables/spectrum.csv",
    "tables/signals.csv",
    "figures/design.svg",
    "perturbations/trial_*.csv",
    "settings.json",
)
"""Files that are written."""


@dataclass(frozen=True, kw_only=True)
class Design(Command):
    """Plan an experiment: predicted standard errors, and the multisine that minimises those of the goal."""

    settings: DesignSettings
    out: Path
    """Folder for tables/design.csv, tables/spectrum.csv, tables/signals.csv, figures/design.svg, perturbations/ (one
    CSV per trial, for simulate) and settings.json."""
    overwrite: bool = False
    """Replace an earlier plan in the folder; an input is never replaced."""

    def run(self) -> list[str]:
        """Plan, and write the plan."""
        from armperturb.study.planning.plan import design
        from armperturb.study.planning.report import earlier_perturbations, write_design

        require_new_results(self.out, RESULTS, overwrite=self.overwrite)
        earlier_perturbations(self.out)
        result = design(self.settings)
        write_design(result, self.out)
        return [result.summary(), f"results: {self.out}"]
