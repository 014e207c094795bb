"""What the average person and people's noise were set on: cells of the thesis that are no evidence for either."""

from typing import Literal

from armperturb.study.results.quantities import Cell

Use = Literal["calibrated", "held out"]
"""Whether a cell was used to make people, or says something about them."""

CALIBRATED = ("2.1", "F.2", "F.3", "F.4")
"""Tables whose means the calibration of the average person sees."""

HELD_OUT = ("F.5", "F.6")
"""Tables of the same kind that it does not see."""

_VAF = ("VAF_x", "VAF_y")

_SET = {
    **{("C.12", f"{name} model 3"): "noise of the position task" for name in ("criterion", *_VAF)},
    **{("C.22", f"{axis} model 1"): "noise of the relax task" for axis in _VAF},
    **{("C.18", f"{name} model 1"): "grip of relaxed people" for name in ("b_h", "k_h")},
    **{("C.18", f"{name} model 1"): "ratio of the masses, by that of cuff and handle" for name in ("m_h", "m_f")},
    **{("D.3", f"{name} model 3 theta_i6"): "grip in the position task" for name in ("b_h", "k_h")},
}
"""(Table, quantity) of further cells to what was set on them, as docs/calibration.md lists."""


def use_of(cell: Cell) -> Use:
    """Whether people were made with knowledge of a cell."""
    known = cell.table in CALIBRATED or (cell.table, cell.quantity) in _SET
    return "calibrated" if known else "held out"
