"""The thesis's tables with a study's numbers beside the printed ones, laid out as they are printed."""

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

from armperturb.analysis.fit.structures import unit
from armperturb.study.comparison.score import WITHOUT_PENALTY, Score, ScoredCell, Share, share
from armperturb.study.published.tables import MeanSD, place_of
from armperturb.study.report.words import WORDS

FAR = (1.0, 2.0)
"""Beyond how many published SDs a cell is marked."""


class Entry(NamedTuple):
    """A published cell and ours, in the unit of the row or column.

    Attributes:
      published: mean and SD, which is NaN if none is printed.
      ours: mean and SD; NaN if they cannot be computed.
      z: difference of the means in published SDs; NaN without.
      reason: why there is none of ours; else empty.
    """

    published: MeanSD
    ours: MeanSD
    z: float
    reason: str

    @property
    def mark(self) -> str:
        """How far it is: "", "beyond-1" or "beyond-2" SDs, or "missing"."""
        if not math.isfinite(self.ours.mean):
            return "missing"
        beyond = [limit for limit in FAR if abs(self.z) > limit]
        return f"beyond-{beyond[-1]:g}" if beyond else ""


@dataclass(frozen=True, kw_only=True)
class PublishedTable:
    """A table of the thesis.

    Attributes:
      number: as printed, e.g. "F.2".
      title: what it holds.
      columns: their heads, units included.
      rows: label of each row to its entries, one per column; None where nothing is printed.
      share: how many of its cells are near.
    """

    number: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Entry | None, ...]], ...]
    share: Share


Place = tuple[str, str, float]
"""Row and column of a cell, and the factor from SI to the unit that is shown."""

_JOINT = re.compile(r"(rms|max|peak)_(rotation|velocity)(?:_(min|max|left|right))?_(s|e)")
_FIT = re.compile(r"(?:(SEM) )?(\w+) model (\w+)(?: (\w+))?")


def published_tables(result: Score) -> tuple[PublishedTable, ...]:
    """All tables that are scored, in the order of the thesis: 2.1, C.3 to C.22, D.3 to E.5, F.2 to F.6."""
    tables: dict[str, list[ScoredCell]] = {}
    for scored in result.cells:
        tables.setdefault(scored.cell.table, []).append(scored)
    return tuple(_table(number, tables[number]) for number in sorted(tables, key=place_of))


def _table(number: str, cells: list[ScoredCell]) -> PublishedTable:
    rows: dict[str, dict[str, Entry]] = {}
    for scored in cells:
        row, column, factor = (_fitted_place if number[0] in "CDE" else _measured_place)(scored)
        printed, ours = (MeanSD(factor * mean, factor * sd) for mean, sd in (scored.published, scored.ours))
        rows.setdefault(row, {})[column] = Entry(printed, ours, scored.z, scored.reason)
    # As printed, with pulses last; else as they come.
    order = {label: number for number, (label, _) in enumerate(WORDS["measured"].values())}
    present = dict.fromkeys(column for entries in rows.values() for column in entries)
    columns = tuple(sorted(present, key=lambda column: order.get(column, 0)))
    return PublishedTable(
        number=number,
        title=WORDS["tables"].get(number) or _fit_title(number, cells),
        columns=columns,
        rows=tuple((row, tuple(map(entries.get, columns))) for row, entries in rows.items()),
        share=share(cells),
    )


def _measured_place(scored: ScoredCell) -> Place:
    if scored.cell.quantity in WORDS["measured"]:
        return scored.cell.condition, *WORDS["measured"][scored.cell.quantity]
    match = _JOINT.fullmatch(scored.cell.quantity)
    assert match is not None
    kind, what, pulse, joint = match.groups()
    name = {"rms": "RMS", "max": "largest", "peak": "peak"}[kind]
    shown = "deg" if what == "rotation" else "deg/s"
    row = f"{scored.cell.condition}, {'shoulder' if joint == 's' else 'elbow'}"
    return row, f"{name} {what}{WORDS['pulses'].get(pulse, '')} [{shown}]", math.degrees(1.0)


def _fitted_place(scored: ScoredCell) -> Place:
    match = _FIT.fullmatch(scored.cell.quantity)
    assert match is not None
    _, what, model, start = match.groups()
    column = f"model {model}, start {start.rpartition('_')[2]}" if start else f"model {model}"
    if what in WORDS["fitted"]:
        name, factor = WORDS["fitted"][what]
        return f"{scored.cell.condition}, {name}", column, factor
    shown, factor = WORDS["displayed"].get(what, (unit(what), 1.0))
    return f"{what} [{shown}]", column, factor


def _fit_title(number: str, cells: list[ScoredCell]) -> str:
    """E.g. "Parameters of six structures in PT7.5, with the penalty"."""
    conditions = ", ".join(dict.fromkeys(scored.cell.condition for scored in cells))
    first = cells[0].cell.quantity
    what = "Standard errors" if first.startswith("SEM") else "Parameters"
    if any(scored.cell.quantity.startswith("criterion") for scored in cells):
        what = "Criterion and VAF"
    of = "of six structures" if number.startswith("C") else "from several starts"
    return f"{what} {of} in {conditions}, {'without' if number in WITHOUT_PENALTY else 'with'} the penalty"
