"""Which published cells people were made with, and which say something about them."""

from armperturb.study.published import tables as published
from armperturb.study.results.quantities import Cell, published_cells
from armperturb.study.results.uses import use_of


def test_measured_cells_are_calibrated_but_those_of_pulses_rotations():
    used = {cell.table for cell in published_cells() if use_of(cell) == "calibrated"}
    assert used == {"2.1", "F.2", "F.3", "F.4"}


def test_fitted_cells_are_held_out_but_those_that_people_were_set_on():
    cells = [
        Cell(
            entry.table,
            entry.condition,
            f"{entry.parameter or entry.quantity} model {entry.model} {entry.start}".rstrip(),
        )
        for entry in published.fit_entries()
        if entry.quantity != "SEM"
    ]
    used = [(cell.table, cell.condition, cell.quantity) for cell in cells if use_of(cell) == "calibrated"]
    grip, masses = ("b_h", "k_h"), ("m_h", "m_f")
    assert sorted(used) == sorted(
        [
            *(("C.12", f"PT{x}", f"VAF_{axis} model 3") for x in ("2.5", "7.5", "22.5") for axis in "xy"),
            *(("C.12", f"PT{x}", "criterion model 3") for x in ("2.5", "7.5", "22.5")),
            *(("C.22", f"RT{x}", f"VAF_{axis} model 1") for x in ("2.5", "7.5", "22.5") for axis in "xy"),
            *(("C.18", "RT7.5", f"{name} model 1") for name in grip + masses),
            *(("D.3", "PT7.5", f"{name} model 3 theta_i6") for name in grip),
        ]
    )
