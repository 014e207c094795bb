"""How much of the score the start of the published search makes: appendix C fitted from three starts, side by side.

A cell that is within 1 SD from the published start and not from the scattered one was made by the start: the search
stopped where it began.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import pandas as pd

from armperturb.analysis.results import Description, Result, Table
from armperturb.analysis.trials import trials_by_condition
from armperturb.recording_files import load_recording
from armperturb.study.comparison.score import ScoredCell, fitted_cells
from armperturb.study.results.appendix_fits import Appendices, fit_person, fit_second_step, joined, means_of
from armperturb.study.results.quantities import LIMITS
from armperturb.study.results.settings import STRUCTURES, AnalysisSettings, Start
from armperturb.subject import TASKS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STARTS: tuple[Start, ...] = get_args(Start)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class StartScores(Result):
    """Cells of appendix C by start of the search.

    Attributes:
      people: number of people behind them.
      cells: of each start those of appendix C that have a published SD, in the same order.
      unstable: of each start how many fits with penalty ended unstable, in percent by task and structure.
    """

    people: int
    cells: Mapping[Start, tuple[ScoredCell, ...]]
    unstable: Mapping[Start, Mapping[tuple[str, str], float]]

    def made(self, task: str = "") -> int:
        """How many cells were made by the start.

        Args:
          task: "PT" or "RT"; both if empty.
        """
        pairs = zip(self._of(task, "published"), self._of(task, "scattered"), strict=True)
        return sum(_near(published) and not _near(scattered) for published, scattered in pairs)

    def _of(self, task: str, start: Start) -> list[ScoredCell]:
        return [each for each in self.cells[start] if each.cell.condition.startswith(task)]

    def describe(self) -> Description:
        """Shares of cells within 1 SD from each start, and those that the start made."""
        rows = []
        for name, task in (("C, PT", "PT"), ("C, RT", "RT"), ("C", "")):
            each = [sum(map(_near, self._of(task, start))) for start in STARTS]
            n = len(self._of(task, "neutral"))
            counts = [f"{count} ({100.0 * count / n:.0f} %)" for count in (*each, self.made(task))] if n else ["-"] * 4
            rows.append((name, str(n), *counts))
        return Description(
            title=f"appendix C of {self.people} {'person' if self.people == 1 else 'people'} from three starts",
            facts=("cells within 1 published SD; made by the start: from the published start and not from scattered",),
            table=Table(("cells", "number", *STARTS, "made by the start"), tuple(rows)),
            details=tuple(
                f"{start}, {task}, model {structure}: {part:.0f} % of fits with penalty end unstable"
                for start, parts in self.unstable.items()
                for (task, structure), part in parts.items()
                if part > 0.0
            ),
        )

    def to_frame(self) -> pd.DataFrame:
        """One row per cell: distance from the published mean in published SDs from each start."""
        z = {f"z_{start}": [each.z for each in self.cells[start]] for start in STARTS}
        return pd.DataFrame([each.cell._asdict() for each in self.cells["neutral"]]).assign(**z)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw how far each cell is from the published one from neutral starts, in published SDs, a row per table.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, a single one.
        """
        from armperturb.plots.scores import plot_scores

        return plot_scores(self.to_frame().rename(columns={"z_neutral": "z"}), LIMITS, figure)


def compare_starts(paths: Sequence[Path], *, structures: Sequence[str] = STRUCTURES) -> StartScores:
    """Fit appendix C to everybody's recordings from each start; some 5 s per person.

    Args:
      paths: of a recording per person.
      structures: those of appendix C that are fitted.

    Raises:
      ValueError: a structure is unknown, or a recording is refused.
      OSError: a file cannot be read.
    """
    fits = {
        start: _fits(paths, AnalysisSettings(structures=tuple(structures), start=start, starts_of=None))
        for start in STARTS
    }
    return StartScores(
        people=len(paths),
        cells={
            start: tuple(
                each
                for each in fitted_cells(of_start)
                if each.cell.table[0] == "C" and math.isfinite(each.published.sd)
            )
            for start, of_start in fits.items()
        },
        unstable={
            start: {
                (task, structure): part
                for task in TASKS
                for structure in structures
                if (part := _unstable(of_start, task, structure)) is not None
            }
            for start, of_start in fits.items()
        },
    )


def _fits(paths: Sequence[Path], settings: AnalysisSettings) -> Appendices:
    """Appendix C of everybody, from one start."""
    first = joined(fit_person(trials_by_condition(load_recording(path, [])), settings).first for path in paths)
    means = means_of(first)
    second = joined(fit_second_step(trials_by_condition(load_recording(path, [])), means).estimates for path in paths)
    return Appendices(first=first, second=second, starts={})


def _unstable(fits: Appendices, task: str, structure: str) -> float | None:
    """Share of the fits with penalty that end unstable [%]; None without fits."""
    some = [fit for (condition, model), fit in fits.second.items() if (condition[:2], model) == (task, structure)]
    n = sum(len(fit.fits) for fit in some)
    return 100.0 * (1.0 - sum(fit.n_stable for fit in some) / n) if n else None


def _near(scored: ScoredCell) -> bool:
    return abs(scored.z) <= 1.0
