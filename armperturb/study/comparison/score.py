"""How near a study comes to the thesis's published tables: every cell beside ours, and the headline numbers.

A cell's z is the difference of the means over people, in published SDs. Cells are those of tables 2.1 and F.2 to F.6
(`results.quantities`) and those that the thesis's own estimator fills: C.3 to C.22, all six structures, first
without penalty (C.3 to C.5, C.13 to C.15), then from the group's means with it, and D.3 to E.5, one structure from
several starts. In tables of criterion and VAF, mean and SD are over trials, and N_pos and N_stab are shares of them.
With the penalty, fits that end unstable all the same have diverged and count nowhere; standard errors that are infinite
count nowhere either. A cell that cannot be computed is not reproduced: it counts as one that is far.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.analysis.results import Description, Result, Table
from armperturb.files import write_csv, write_whole
from armperturb.study.comparison.ceiling import OF_PRINTED_ARMS, causes, replicate_share
from armperturb.study.comparison.headlines import Headline, headlines
from armperturb.study.protocol.differences import Difference
from armperturb.study.published import tables as published
from armperturb.study.published.tables import FitEntry, MeanSD
from armperturb.study.results.appendix_fits import FIRST_STEP, Appendices
from armperturb.study.results.quantities import LIMITS, Cell, published_cells
from armperturb.study.results.settings import STARTS_OF
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import PersonMeasures, diverged
from armperturb.study.results.uses import use_of
from armperturb.subject import TASKS
from armperturb.validation import require_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WITHOUT_PENALTY = ("C.3", "C.4", "C.5", "C.13", "C.14", "C.15")
"""Tables of the first step of appendix C."""

ANOTHER = "This study is another experiment than the thesis's"
"""What is said of a study whose protocol differs."""


@dataclass(frozen=True, kw_only=True)
class ScoredCell:
    """A published cell and ours.

    Attributes:
      cell: which.
      published: mean (SD), SI.
      ours: mean (SD) over people, or trials where the table's are, SI; NaN if it cannot be computed.
      reason: why it cannot be; else empty.
    """

    cell: Cell
    published: MeanSD
    ours: MeanSD
    reason: str = ""

    @property
    def z(self) -> float:
        """Difference of the means in published SDs; NaN without a value or a published SD."""
        return (self.ours.mean - self.published.mean) / self.published.sd

    @property
    def sd_ratio(self) -> float:
        """SD between subjects over the published one; NaN without."""
        return self.ours.sd / self.published.sd


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Score(Result):
    """All cells and headline numbers.

    Attributes:
      people: number of people behind it.
      cells: every published one, in the order of the tables.
      headlines: numbers of the running text.
      remarks: what was left out of a cell that was computed, and what of the study is missing; one line each.
      differences: settings of the protocol that are not the thesis's (there), so that cells differ for their sake.
    """

    people: int
    cells: tuple[ScoredCell, ...]
    headlines: tuple[Headline, ...]
    remarks: tuple[str, ...]
    differences: tuple[Difference, ...] = ()

    @property
    def other_settings(self) -> tuple[str, ...]:
        """Keys of the protocol and its conditions that differ, each once."""
        return tuple(dict.fromkeys(each.setting for each in self.differences))

    def describe(self) -> Description:
        """How many cells of each table are near, the numbers of the running text, and what is missing."""
        rows = []
        each = shares(self)
        groups = [name for name in reversed(each) if name not in {scored.cell.table for scored in self.cells}]
        for name, near in ((name, each[name]) for name in dict.fromkeys([*groups, *each])):
            counts = [f"{n} ({100.0 * part:.0f} %)" for n, part in zip(near.within, near.parts, strict=True)]
            rows.append((name, f"{near.computed}/{near.published}", *counts, f"{near.sd_ratio:.2f}"))
        quoted = Table(
            ("number of the text", "published", "ours", "unit", "remark"),
            tuple((line.name, line.published, f"{line.ours:.3g}", line.unit, line.remark) for line in self.headlines),
        )
        within = {name: near.parts_of_computed[1] for name, near in each.items() if near.computed}
        details = [
            *ceiling_lines(self.people),
            *([] if self.differences else causes(within, self.people)),
            "",
            *(line.rstrip() for line in quoted.lines()),
        ]
        if against := [line for line in self.headlines if line.contradiction]:
            details += ["", "numbers of the text that other printed numbers contradict:"]
            details += [f"  {line.name}: {line.contradiction}" for line in against]
        if self.differences:
            details += ["", "settings that differ, of the thesis there and of this study now:"]
            details += [f"  {each}" for each in self.differences]
        if missing := missing_cells(self):
            details += ["", "cells that could not be computed:"]
            details += [f"  {where}: {n} cells: {reason}" for (reason, where), n in missing.items()]
        return Description(
            title=f"{self.people} {'person' if self.people == 1 else 'people'} compared with the published tables",
            facts=(
                *([f"{ANOTHER}: other {', '.join(self.other_settings)} (below)"] if self.differences else []),
                "cells whose mean is within 0.5, 1 and 2 published SDs; SD ratio: between people, ours / published",
            ),
            table=Table(("table", "cells", "0.5 SD", "1 SD", "2 SD", "SD ratio"), tuple(rows)),
            remarks=self.remarks,
            details=tuple(details),
        )

    def to_frame(self) -> pd.DataFrame:
        """One row per published cell, beside ours."""
        return pd.DataFrame(
            [
                {
                    **scored.cell._asdict(),
                    "published_mean": scored.published.mean,
                    "published_sd": scored.published.sd,
                    "ours": scored.ours.mean,
                    "z": scored.z,
                    "ours_sd": scored.ours.sd,
                    "use": use_of(scored.cell),
                    "reason": scored.reason,
                }
                for scored in self.cells
            ]
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw how far each cell is from the published one, in published SDs, one row per table.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, a single one.
        """
        from armperturb.plots.scores import plot_scores

        return plot_scores(self.to_frame(), LIMITS, figure)


class Share(NamedTuple):
    """How many cells of a table are near.

    Attributes:
      published: number of cells with an SD.
      computed: of these, those that we have.
      within: of these, those within each of `LIMITS`.
      sd_ratio: median SD between subjects over the published one [-].
    """

    published: int
    computed: int
    within: tuple[int, ...]
    sd_ratio: float

    @property
    def parts(self) -> tuple[float, ...]:
        """Share within each of `LIMITS` [-]; a cell that cannot be computed is not within."""
        return tuple(n / self.published for n in self.within)

    @property
    def parts_of_computed(self) -> tuple[float, ...]:
        """The same of the cells that we have; NaN without any."""
        return tuple(n / self.computed if self.computed else math.nan for n in self.within)


def ceiling_lines(people: int) -> tuple[str, ...]:
    """What shares can be reached, in words.

    Args:
      people: number of people behind the score.
    """
    each = ", ".join(f"{100.0 * replicate_share(limit, people):.0f}" for limit in LIMITS)
    of_arms = ", ".join(f"{name} {low} to {high}" for name, (low, high) in OF_PRINTED_ARMS.items())
    return (
        f"as many other people of the published population would have {each} % of cells within these SDs",
        f"people who are the mean arms of the tables have within 1 SD [%]: {of_arms}",
    )


def score(study: StudyResult) -> Score:
    """Compare an analysed study with the published tables.

    Raises:
      TypeError: study is no analysed one.
    """
    require_type("score: study", study, StudyResult, "an analysed study (analyse_study of its folder)")
    return Score(
        people=len(study.people),
        cells=(*_measured_cells(study.people), *fitted_cells(study.appendices, study.people)),
        headlines=headlines(study.people),
        remarks=(*study.missing, *study.remarks, *_diverged(study.appendices)),
        differences=study.unlike_thesis,
    )


def fitted_cells(fits: Appendices, people: Sequence[PersonMeasures] = ()) -> tuple[ScoredCell, ...]:
    """Cells of appendices C to E.

    Args:
      fits: everybody's.
      people: who was recorded, for the reasons why cells cannot be computed.
    """
    return tuple(_fitted_cell(entry, fits, people) for entry in published.fit_entries())


def _measured_cells(people: Sequence[PersonMeasures]) -> list[ScoredCell]:
    scored = []
    recorded = {condition for person in people for condition in person.conditions}
    for cell, printed in published_cells().items():
        values = [person.cells[cell] for person in people if cell in person.cells]
        reason = ""
        if not values:
            reason = "nobody's trials give it" if cell.condition in recorded else f"{cell.condition} was not recorded"
        scored.append(ScoredCell(cell=cell, published=printed, ours=_mean_sd(values), reason=reason))
    return scored


def _fitted_cell(entry: FitEntry, fits: Appendices, people: Sequence[PersonMeasures]) -> ScoredCell:
    what = {"parameter": entry.parameter, "SEM": f"SEM {entry.parameter}"}.get(entry.quantity, entry.quantity)
    cell = Cell(entry.table, entry.condition, f"{what} model {entry.model} {entry.start}".rstrip())
    ours, reason = MeanSD(math.nan, math.nan), ""
    estimate = _estimate(entry, fits)
    step_1 = FIRST_STEP[entry.condition[:2]]
    if estimate is not None:
        ours = _fitted_value(entry, estimate)
        reason = "" if math.isfinite(ours.mean) else "no trial gives a finite value"
    elif not any(entry.condition in person.conditions for person in people):
        reason = f"{entry.condition} was not recorded"
    elif not any(step_1 in person.conditions for person in people):
        reason = f"{step_1} was not recorded, from which the fits start"
    else:
        reason = "nobody's trials could be fitted"
    return ScoredCell(cell=cell, published=entry.value, ours=ours, reason=reason)


def _estimate(entry: FitEntry, fits: Appendices) -> ThesisEstimate | None:
    """Everybody's fits of which an entry tells."""
    if entry.start:
        return fits.starts.get(entry.start)
    step = fits.first if entry.table in WITHOUT_PENALTY else fits.second
    return step.get((entry.condition, entry.model))


def _fitted_value(entry: FitEntry, estimate: ThesisEstimate) -> MeanSD:
    stable = estimate.stable
    if entry.quantity in ("N_pos", "N_stab"):
        n = estimate.n_positive if entry.quantity == "N_pos" else estimate.n_stable
        return MeanSD(n / len(estimate.fits), math.nan)
    if entry.quantity.startswith("VAF"):
        mean, sd = estimate.mean_vaf()
        axis = "xy".index(entry.quantity[-1])
        return MeanSD(float(mean[axis]), float(sd[axis]))
    counts = np.ones_like(stable) if entry.table in WITHOUT_PENALTY else stable
    if entry.quantity == "criterion":
        return _mean_sd(estimate.criterion[counts].tolist())
    of_trials = estimate.values if entry.quantity == "parameter" else estimate.sem
    values = of_trials[:, estimate.parameters.index(entry.parameter)]
    counts = counts & np.isfinite(values)
    names = np.array(estimate.subjects)
    return _mean_sd([float(values[counts & (names == name)].mean()) for name in dict.fromkeys(names[counts].tolist())])


def _diverged(fits: Appendices) -> list[str]:
    named = {f"{condition}, model {model}": estimate for (condition, model), estimate in fits.second.items()}
    named |= {f"{STARTS_OF}, start {start}": estimate for start, estimate in fits.starts.items()}
    return [line for name, estimate in named.items() for line in diverged(name, estimate)]


def _mean_sd(values: Sequence[float]) -> MeanSD:
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return MeanSD(float(np.mean(values)) if len(values) else math.nan, sd)


def share(cells: Iterable[ScoredCell]) -> Share:
    """How many of some cells are near; those without a published SD do not count."""
    judged = [scored for scored in cells if math.isfinite(scored.published.sd)]
    z = np.abs([scored.z for scored in judged if math.isfinite(scored.z)])
    ratios = [scored.sd_ratio for scored in judged if math.isfinite(scored.sd_ratio)]
    return Share(
        published=len(judged),
        computed=len(z),
        within=tuple(int(np.sum(z <= limit)) for limit in LIMITS),
        sd_ratio=float(np.median(ratios)) if ratios else math.nan,
    )


def shares(result: Score) -> dict[str, Share]:
    """Share of each table, and of groups of cells.

    Groups are what is measured (2.1 and F, and of these each task), what is fitted (C to E), and all cells that people
    were set on (calibrated) or not (held out), see `study.results.uses`.
    """
    tables = dict.fromkeys(scored.cell.table for scored in result.cells)
    of = {table: share(scored for scored in result.cells if scored.cell.table == table) for table in tables}
    measured = [scored for scored in result.cells if scored.cell.table.startswith(("2", "F"))]
    groups = {
        **{
            f"2.1 and F, {task}": [scored for scored in measured if scored.cell.condition[:2] == task] for task in TASKS
        },
        "2.1 and F": measured,
        **{appendix: [scored for scored in result.cells if scored.cell.table[0] == appendix] for appendix in "CDE"},
        **{
            use: [scored for scored in result.cells if use_of(scored.cell) == use] for use in ("calibrated", "held out")
        },
        "total": list(result.cells),
    }
    return of | {name: share(cells) for name, cells in groups.items()}


def missing_cells(result: Score) -> dict[tuple[str, str], int]:
    """How many cells could not be computed, by reason and by table and condition."""
    return Counter(
        (scored.reason, f"{scored.cell.table}, {scored.cell.condition}") for scored in result.cells if scored.reason
    )


def write_score(result: Score, folder: Path) -> Path:
    """Write `score.csv`, `headlines.csv` and `score.txt`: the summary, with what is missing and why.

    Args:
      result: of `score`.
      folder: is made if it is not there; files of an earlier score in it are replaced.

    Returns:
      The path of `score.csv`.

    Raises:
      OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(result.to_frame(), folder / "score.csv")
    write_csv(map(vars, result.headlines), folder / "headlines.csv")
    write_whole(folder / "score.txt", result.summary() + "\n")
    return folder / "score.csv"
