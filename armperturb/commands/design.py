"""`armperturb design`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command
from armperturb.study.planning.settings import DesignSettings


@dataclass(frozen=True, kw_only=True)
class Design(Command):
    """Plan an experiment: predicted standard errors, and the multisine that minimises those of the goal."""

    settings: DesignSettings
    out: Path
    """Folder for tables/design.csv, tables/spectrum.csv, tables/signals.csv, figures/design.svg, perturbations/ (one
    CSV per trial, for simulate) and settings.json."""

    def run(self) -> list[str]:
        """Plan, and write the plan."""
        from armperturb.study.planning.plan import design
        from armperturb.study.planning.report import earlier_perturbations, write_design

        earlier_perturbations(self.out)  # refused before the work
        result = design(self.settings)
        write_design(result, self.out)
        return [result.summary(), f"results: {self.out}"]
