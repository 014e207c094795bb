"""How near a study comes to the thesis's published tables: every cell beside ours, and the headline numbers.

A cell's z is the difference of the means over people, in published SDs. Cells are those of tables 2.1 and F.2 to F.6
(`armperturb.study.cells`) and of C.3 to C.22, which the thesis's own estimator fills: all six structures, first without
penalty (C.3 to C.5, C.13 to C.15), then from the group's means with it. In tables of criterion and VAF, mean and SD are
over trials, and N_pos and N_stab are shares of them. With the penalty, fits that end unstable all the same have
diverged and count nowhere; standard errors that are infinite count nowhere either.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from armperturb.analysis.export import write_csv
from armperturb.analysis.thesis import ThesisEstimate, join_estimates
from armperturb.files import written_whole
from armperturb.study import published
from armperturb.study.cells import Cell, published_cells
from armperturb.study.headlines import Headline, headlines
from armperturb.study.measure import FIRST_STEP, Fits, PersonMeasures, fit_first, fit_second, measure_person
from armperturb.study.published import FitEntry, MeanSD
from armperturb.study.runner import worker_count
from armperturb.study.store import find_recordings
from armperturb.study.workers import Workers, completed, workers_for
from armperturb.validation import require_number

Array = NDArray[np.float64]
Estimates = Mapping[tuple[str, str], ThesisEstimate]
Unit = TypeVar("Unit")
Result = TypeVar("Result")

LIMITS = (0.5, 1.0, 2.0)
"""Within how many published SDs cells are counted."""

NOT_ASKED = "appendix C was not asked for"
"""Why its tables are empty unless they are wanted."""

WITHOUT_PENALTY = ("C.3", "C.4", "C.5", "C.13", "C.14", "C.15")
"""Tables of the first step of appendix C."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """All cells and headline numbers.

    Attributes:
      people: number of people behind it.
      cells: every published one, in the order of the tables.
      headlines: numbers of the running text.
      remarks: what was left out of a cell that was computed, and what of the study is missing; one line each.
    """

    people: int
    cells: tuple[ScoredCell, ...]
    headlines: tuple[Headline, ...]
    remarks: tuple[str, ...]


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


def score(folder: Path, *, appendix_c: bool = False, workers: int | None = None, show_progress: bool = True) -> Score:
    """Compare the recordings of a study with the published tables.

    Args:
      folder: of the study, which may be incomplete; nothing in it is changed.
      appendix_c: whether to fill the tables of appendix C too, which takes a core some two minutes per person.
      workers: number of processes; None for about one per core. No effect on the result.
      show_progress: whether to draw progress bars on the terminal.

    Raises:
      TypeError: workers is no number.
      ValueError: workers is below 1, or a file is no recording of one person.
      RuntimeError: workers die again and again.
      OSError: the folder holds no recording, or a file cannot be read.
    """
    if workers is not None:
        require_number("score", "workers", workers, at_least=1)
    paths, remarks = find_recordings(folder)
    with workers_for(worker_count(workers, len(paths)), None) as crew:

        def each(function: Callable[[Unit], Result], units: Sequence[Unit], label: str) -> list[Result]:
            return _each(function, units, crew, label, show_progress)

        people = sorted(each(measure_person, paths, "measure"), key=lambda person: person.name)
        for person in people:
            remarks += person.left_out
        cells = _measured_cells(people)
        first: Estimates | None = None
        second: Estimates | None = None
        if appendix_c:
            first = _by_task(each(fit_first, paths, "fit, step 1"), remarks)
            starts = {(condition[:2], model): estimate.start() for (condition, model), estimate in first.items()}
            second = _by_task(each(fit_second, [(path, starts) for path in paths], "fit, step 2"), remarks)
    for entry in published.appendix_c():
        of_step = first if entry.table in WITHOUT_PENALTY else second
        cells.append(_fitted_cell(entry, of_step, people))
    if second is not None:
        remarks += _diverged(second)
    return Score(people=len(people), cells=tuple(cells), headlines=headlines(people), remarks=tuple(remarks))


def _each(
    function: Callable[[Unit], Result], units: Sequence[Unit], crew: Workers | None, label: str, show_progress: bool
) -> list[Result]:
    results = []
    with tqdm(total=len(units), desc=label, unit="subject", disable=None if show_progress else True) as bar:
        for result in map(function, units) if crew is None else completed(function, units, crew, bar.refresh):
            results.append(result)
            bar.update()
    return results


def _by_task(fits: Iterable[Fits], remarks: list[str]) -> Estimates:
    """Condition and structure to the fits of all people, who stand in one order however they come; adds remarks."""
    people = sorted(fits, key=lambda person: person.name)
    for person in people:
        remarks += person.left_out
    keys = dict.fromkeys(key for person in people for key in person.estimates)
    return {key: join_estimates([one.estimates[key] for one in people if key in one.estimates]) for key in keys}


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


def _fitted_cell(entry: FitEntry, fits: Estimates | None, people: Sequence[PersonMeasures]) -> ScoredCell:
    what = {"parameter": entry.parameter, "SEM": f"SEM {entry.parameter}"}.get(entry.quantity, entry.quantity)
    cell = Cell(entry.table, entry.condition, f"{what} model {entry.model}")
    ours, reason = MeanSD(math.nan, math.nan), ""
    step_1 = next(condition for task, condition in FIRST_STEP.items() if entry.condition.startswith(task))
    if fits is None:
        reason = NOT_ASKED
    elif (entry.condition, entry.model) in fits:
        ours = _fitted_value(entry, fits[entry.condition, entry.model])
        reason = "" if math.isfinite(ours.mean) else "no trial gives a finite value"
    elif not any(entry.condition in person.conditions for person in people):
        reason = f"{entry.condition} was not recorded"
    elif entry.table not in WITHOUT_PENALTY and not any(step_1 in person.conditions for person in people):
        reason = f"{step_1} was not recorded, from which the fits start"
    else:
        reason = "nobody's trials could be fitted"
    return ScoredCell(cell=cell, published=entry.value, ours=ours, reason=reason)


def _fitted_value(entry: FitEntry, estimate: ThesisEstimate) -> MeanSD:
    stable = estimate.stable
    if entry.quantity == "N_pos":
        return MeanSD(estimate.n_positive / len(estimate.fits), math.nan)
    if entry.quantity == "N_stab":
        return MeanSD(estimate.n_stable / len(estimate.fits), math.nan)
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


def _diverged(fits: Estimates) -> list[str]:
    return [
        f"{condition}, model {model}: {len(estimate.fits) - estimate.n_stable} of {len(estimate.fits)} fits diverged "
        "(unstable on the manipulator in spite of the penalty) and are left out of appendix C"
        for (condition, model), estimate in fits.items()
        if estimate.n_stable < len(estimate.fits)
    ]


def _mean_sd(values: Sequence[float]) -> MeanSD:
    sd = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
    return MeanSD(float(np.mean(values)) if len(values) else math.nan, sd)


def share(cells: Iterable[ScoredCell]) -> Share:
    """How many of some cells are near; those without a published SD do not count."""
    judged = [one for one in cells if math.isfinite(one.published.sd)]
    z = np.abs([one.z for one in judged if math.isfinite(one.z)])
    ratios = [one.sd_ratio for one in judged if math.isfinite(one.sd_ratio)]
    return Share(
        published=len(judged),
        computed=len(z),
        within=tuple(int(np.sum(z <= limit)) for limit in LIMITS),
        sd_ratio=float(np.median(ratios)) if ratios else math.nan,
    )


def shares(result: Score) -> dict[str, Share]:
    """Share of each table, and of groups of them: measured (2.1 and F, and of these each task) and fitted (C)."""
    tables = dict.fromkeys(one.cell.table for one in result.cells)
    of = {table: share(one for one in result.cells if one.cell.table == table) for table in tables}
    measured = [one for one in result.cells if not one.cell.table.startswith("C")]
    groups = {
        "2.1 and F, PT": [one for one in measured if one.cell.condition.startswith("PT")],
        "2.1 and F, RT": [one for one in measured if one.cell.condition.startswith("RT")],
        "2.1 and F": measured,
        "C": [one for one in result.cells if one.cell.table.startswith("C")],
        "total": list(result.cells),
    }
    return of | {name: share(cells) for name, cells in groups.items()}


def score_text(result: Score) -> str:
    """Shares, headline numbers and what is missing, for a terminal."""
    lines = [f"{result.people} people beside the published tables; SDs are the published ones", ""]
    lines.append(f"{'table':14} {'cells':>9} {'0.5 SD':>12} {'1 SD':>12} {'2 SD':>12} {'SD ratio':>9}")
    skipped = {cell.cell.table for cell in result.cells if cell.reason == NOT_ASKED}
    for name, one in shares(result).items():
        if name not in skipped:
            counts = [f"{n} ({100.0 * n / one.computed:.0f} %)" if one.computed else "-" for n in one.within]
            of = f"{one.computed}/{one.published}"
            lines.append(f"{name:14} {of:>9} " + " ".join(f"{count:>12}" for count in counts) + f" {one.sd_ratio:9.2f}")
    lines += ["", f"{'number of the text':46} {'published':>14} {'ours':>9}  unit"]
    for line in result.headlines:
        remark = f"  ({line.remark})" if line.remark else ""
        lines.append(f"{line.name:46} {line.published:>14} {line.ours:9.3g}  {line.unit}{remark}")
    missing = Counter(
        (cell.reason, "C.3 to C.22" if cell.reason == NOT_ASKED else f"{cell.cell.table}, {cell.cell.condition}")
        for cell in result.cells
        if cell.reason
    )
    if missing:
        lines += ["", "cells that could not be computed:"]
        lines += [f"  {where}: {n} cells: {reason}" for (reason, where), n in missing.items()]
    if result.remarks:
        lines += ["", "left out:", *(f"  {remark}" for remark in result.remarks)]
    return "\n".join(lines)


def write_score(result: Score, folder: Path) -> Path:
    """Write `score.csv`, `headlines.csv` and `score.txt`, which tells what is missing and why.

    Args:
      result: of `score`.
      folder: is made if it is not there; files of an earlier score in it are replaced.

    Returns:
      The path of `score.csv`.

    Raises:
      OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rows = [
        {
            "table": one.cell.table,
            "condition": one.cell.condition,
            "quantity": one.cell.quantity,
            "published_mean": one.published.mean,
            "published_sd": one.published.sd,
            "ours": one.ours.mean,
            "ours_sd": one.ours.sd,
            "z": one.z,
        }
        for one in result.cells
    ]
    write_csv(rows, folder / "score.csv")
    write_csv([vars(one) for one in result.headlines], folder / "headlines.csv")
    with written_whole(folder / "score.txt") as temporary:
        temporary.write_text(score_text(result) + "\n", encoding="utf-8")
    return folder / "score.csv"
