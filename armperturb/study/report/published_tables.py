"""The thesis's tables with a study's numbers beside the printed ones, laid out as they are printed."""

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from armperturb.analysis.fit.structures import unit
from armperturb.study.comparison.score import WITHOUT_PENALTY, Score, ScoredCell, Share, share

FAR = (1.0, 2.0)
"""Beyond how many published SDs a cell is marked."""


class Entry(NamedTuple):
    """A published cell and ours, in the unit of the row or column.

    Attributes:
      published: mean.
      published_sd: NaN if none is printed.
      ours: mean; NaN if it cannot be computed.
      ours_sd: NaN if there is none.
      z: difference of the means in published SDs; NaN without.
      reason: why there is none of ours; else empty.
    """

    published: float
    published_sd: float
    ours: float
    ours_sd: float
    z: float
    reason: str

    @property
    def mark(self) -> str:
        """How far it is: "", "beyond-1" or "beyond-2" SDs, or "missing"."""
        if not math.isfinite(self.ours):
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


class _Place(NamedTuple):
    """Where a cell stands, and what turns SI into the unit that is shown."""

    row: str
    column: str
    factor: float


TITLES = {
    "2.1": "Force and displacement, per axis, and peaks after pulses",
    "F.2": "Velocities of the joints during the multisine",
    "F.3": "Peak velocities of the joints after pulses of either level",
    "F.4": "Rotations of the joints during the multisine",
    "F.5": "Peak rotations of the joints after pulses of either level",
    "F.6": "Peak rotations of the joints after pulses to either side",
}
"""Of the measured tables; those of fits follow from what they hold."""

_MEASURED = {
    "rms_force": ("RMS force [N]", 1.0),
    "rms_displacement": ("RMS displacement [mm]", 1e3),
    "peak_displacement_min": ("peak displacement, level 1 [cm]", 1e2),
    "peak_displacement_max": ("peak displacement, level 2 [cm]", 1e2),
}
_JOINT = re.compile(r"(rms|max|peak)_(rotation|velocity)(?:_(min|max|left|right))?_(s|e)")
_FIT = re.compile(r"(?:(SEM) )?(\w+) model (\w+)(?: (\w+))?")
_DISPLAYED = {"k_h": ("kN/m", 1e-3), "Td_s": ("ms", 1e3), "Td_e": ("ms", 1e3)}
"""Parameters that are shown in another unit than that of the SI."""


def published_tables(result: Score) -> tuple[PublishedTable, ...]:
    """All tables that are scored, in the order of the thesis: 2.1, C.3 to C.22, D.3 to E.5, F.2 to F.6."""
    tables: dict[str, list[ScoredCell]] = {}
    for scored in result.cells:
        tables.setdefault(scored.cell.table, []).append(scored)

    def place(number: str) -> tuple[str, int]:
        chapter, _, count = number.partition(".")
        return chapter, int(count)

    return tuple(_table(number, tables[number]) for number in sorted(tables, key=place))


def _table(number: str, cells: list[ScoredCell]) -> PublishedTable:
    places: list[Callable[[ScoredCell], _Place]] = [_measured_place, _fitted_place]
    where = [(places[number[0] in "CDE"](scored), scored) for scored in cells]
    # As printed, with pulses last; else as they come.
    order = {label: number for number, (label, _) in enumerate(_MEASURED.values())}
    columns = tuple(sorted({place.column: None for place, _ in where}, key=lambda column: order.get(column, 0)))
    entries = {(place.row, place.column): _entry(scored, place.factor) for place, scored in where}
    rows = dict.fromkeys(place.row for place, _ in where)
    return PublishedTable(
        number=number,
        title=TITLES.get(number) or _fit_title(number, [scored for _, scored in where]),
        columns=columns,
        rows=tuple((row, tuple(entries.get((row, column)) for column in columns)) for row in rows),
        share=share(cells),
    )


def _entry(scored: ScoredCell, factor: float) -> Entry:
    return Entry(
        published=factor * scored.published.mean,
        published_sd=factor * scored.published.sd,
        ours=factor * scored.ours.mean,
        ours_sd=factor * scored.ours.sd,
        z=scored.z,
        reason=scored.reason,
    )


def _measured_place(scored: ScoredCell) -> _Place:
    if scored.cell.quantity in _MEASURED:
        return _Place(scored.cell.condition, *_MEASURED[scored.cell.quantity])
    match = _JOINT.fullmatch(scored.cell.quantity)
    assert match is not None
    kind, what, pulse, joint = match.groups()
    level = {"min": ", level 1", "max": ", level 2", "left": ", to the left", "right": ", to the right"}
    name = {"rms": "RMS", "max": "largest", "peak": "peak"}[kind]
    shown = "deg" if what == "rotation" else "deg/s"
    row = f"{scored.cell.condition}, {'shoulder' if joint == 's' else 'elbow'}"
    return _Place(row, f"{name} {what}{level.get(pulse or '', '')} [{shown}]", math.degrees(1.0))


def _fitted_place(scored: ScoredCell) -> _Place:
    match = _FIT.fullmatch(scored.cell.quantity)
    assert match is not None
    _, what, model, start = match.groups()
    column = f"model {model}, start {start.rpartition('_')[2]}" if start else f"model {model}"
    if what in ("criterion", "VAF_x", "VAF_y", "N_pos", "N_stab"):
        name, factor = {
            "criterion": ("criterion [-]", 1.0),
            "VAF_x": ("VAF x [%]", 1.0),
            "VAF_y": ("VAF y [%]", 1.0),
            "N_pos": ("trials with a positive VAF [%]", 100.0),
            "N_stab": ("stable trials [%]", 100.0),
        }[what]
        return _Place(f"{scored.cell.condition}, {name}", column, factor)
    shown, factor = _DISPLAYED.get(what, (unit(what), 1.0))
    return _Place(f"{what} [{shown}]", column, factor)


def _fit_title(number: str, cells: Iterable[ScoredCell]) -> str:
    """E.g. "Parameters of six structures in PT7.5, with the penalty"."""
    cells = list(cells)
    conditions = ", ".join(dict.fromkeys(scored.cell.condition for scored in cells))
    first = cells[0].cell.quantity
    what = "Standard errors" if first.startswith("SEM") else "Parameters"
    if any(scored.cell.quantity.startswith("criterion") for scored in cells):
        what = "Criterion and VAF"
    of = "of six structures" if number.startswith("C") else "from several starts"
    return f"{what} {of} in {conditions}, {'without' if number in WITHOUT_PENALTY else 'with'} the penalty"
