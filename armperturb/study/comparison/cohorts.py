"""Scores of several cohorts in one, so that one lucky seed is not the result."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from armperturb.analysis.results import Description, Result, Table
from armperturb.study.comparison.score import Score, shares
from armperturb.study.results.quantities import LIMITS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CohortScores(Result):
    """Scores of several studies: means over them, and SDs.

    Attributes:
      scores: one per study; at least one.
    """

    scores: tuple[Score, ...]

    def describe(self) -> Description:
        """Shares of each group of tables and the headline numbers, mean (SD) over the studies."""
        frame = self.to_frame()
        rows = [
            (name, *map(_mean_sd, np.transpose(values.to_numpy())))
            for name, values in frame.groupby(level=0, sort=False)
        ]
        quoted = Table(
            ("number of the text", "published", "ours (SD over studies)", "unit"),
            tuple(
                (lines[0].name, lines[0].published, _mean_sd([line.ours for line in lines]), lines[0].unit)
                for lines in zip(*(score.headlines for score in self.scores), strict=True)
            ),
        )
        people = ", ".join(str(score.people) for score in self.scores)
        return Description(
            title=f"{len(self.scores)} studies ({people} people) compared with the published tables",
            facts=("share of cells within 0.5, 1 and 2 published SDs [%], and SD ratio: mean (SD over studies)",),
            table=Table(("tables", "0.5 SD", "1 SD", "2 SD", "SD ratio"), tuple(rows)),
            remarks=self._left_out(),
            details=tuple(line.rstrip() for line in quoted.lines()),
        )

    def _left_out(self) -> tuple[str, ...]:
        """Which studies have no computed cell of which groups, a line per study."""
        lines = []
        for number, score in enumerate(self.scores, start=1):
            groups = [name for name, of_group in shares(score).items() if _is_group(name) and not of_group.computed]
            if groups:
                of = "" if "total" in groups else f" of {'; '.join(groups)}"
                lines.append(f"study {number} has no computed cell{of}: left out of {'these' if of else 'all'} means")
            if score.differences:
                lines.append(
                    f"study {number} is another experiment than the thesis's: other {', '.join(score.other_settings)}"
                )
        return tuple(lines)

    def to_frame(self) -> pd.DataFrame:
        """One row per group of tables and study: shares within each of `LIMITS` [%], and SD ratio [-].

        NaN where a study has no computed cell of a group.
        """
        of_each = [shares(score) for score in self.scores]
        names = [name for name in of_each[0] if _is_group(name)]
        rows = {
            (name, study): [
                *(100.0 * part if of_study[name].computed else math.nan for part in of_study[name].parts),
                of_study[name].sd_ratio,
            ]
            for name in names
            for study, of_study in enumerate(of_each)
        }
        index = pd.MultiIndex.from_tuples(rows, names=["tables", "study"])
        return pd.DataFrame(list(rows.values()), index, [*(f"within_{limit:g}_sd" for limit in LIMITS), "sd_ratio"])

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw how far each cell is from the published one, all studies together, one row per table.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, a single one.
        """
        from armperturb.plots.scores import plot_scores

        return plot_scores(pd.concat([score.to_frame() for score in self.scores]), LIMITS, figure)


def _is_group(name: str) -> bool:
    """Whether a name of `shares` is that of a group of tables, and not of a single one."""
    return "." not in name or " " in name


def _mean_sd(values: Sequence[float]) -> str:
    known = np.array([value for value in values if math.isfinite(value)])
    if not len(known):
        return "nan"
    spread = f" ({known.std(ddof=1):.2g})" if len(known) > 1 else ""
    return f"{known.mean():.3g}{spread}"
