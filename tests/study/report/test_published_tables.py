"""The thesis's tables with ours beside: every cell in its place, with its unit and its mark."""

import math
from dataclasses import replace

import pytest

from armperturb.environment import Environment
from armperturb.study.comparison.score import Score, score
from armperturb.study.protocol import THESIS
from armperturb.study.published.tables import MeanSD
from armperturb.study.report.published_tables import published_tables
from armperturb.study.results.study_result import StudyResult


def nothing():
    """The score of a study in which nothing was recorded."""
    return score(StudyResult(made=None, protocol=THESIS, environment=Environment(), cohort=(), cases=()))


def with_ours(z):
    """Every cell that many published SDs away."""
    cells = [
        replace(one, reason="", ours=MeanSD(one.published.mean + z * one.published.sd, 0.0)) for one in nothing().cells
    ]
    return Score(people=1, cells=tuple(cells), headlines=(), remarks=())


@pytest.fixture(scope="module")
def tables():
    return {table.number: table for table in published_tables(with_ours(1.5))}


def entry(table, row, column):
    return dict(table.rows)[row][table.columns.index(column)]


def test_all_tables_are_there_in_the_order_of_the_thesis(tables):
    assert list(tables) == [
        "2.1",
        *(f"C.{n}" for n in range(3, 23)),
        *(f"D.{n}" for n in range(3, 6)),
        *(f"E.{n}" for n in range(3, 6)),
        *(f"F.{n}" for n in range(2, 7)),
    ]


def test_every_cell_is_there_once(tables):
    entries = [one for table in tables.values() for _, row in table.rows for one in row if one is not None]
    assert len(entries) == len(nothing().cells)


@pytest.mark.parametrize(
    ("number", "row", "column", "mean", "sd"),
    [
        ("2.1", "PT7.5", "RMS displacement [mm]", 7.9, 0.7),
        ("2.1", "RT22.5", "peak displacement, level 1 [cm]", 25.01, 6.27),
        ("F.2", "PT7.5, elbow", "largest velocity [deg/s]", 57.3, 11.1),
        ("C.3", "m_h [kg]", "model 1", 1.49, 0.33),
        ("E.3", "k_s [Nm/rad]", "model 3b, start i5", 161.4, math.nan),
        ("C.12", "PT7.5, trials with a positive VAF [%]", "model 3", math.nan, math.nan),
    ],
)
def test_cells_are_as_printed(tables, number, row, column, mean, sd):
    found = entry(tables[number], row, column)
    if math.isfinite(mean):
        assert found.published.mean == pytest.approx(mean)
    if math.isfinite(sd):
        assert found.published.sd == pytest.approx(sd)


def test_units_that_are_not_those_of_the_si_are_shown_as_printed(tables):
    rows = dict(tables["C.3"].rows)
    assert "k_h [kN/m]" in rows
    assert "Td_s [ms]" in rows
    assert 1.0 < entry(tables["C.3"], "k_h [kN/m]", "model 3").published.mean < 40.0
    assert 25.0 < entry(tables["C.3"], "Td_s [ms]", "model 3").published.mean < 75.0


@pytest.mark.parametrize(("z", "mark"), [(0.5, ""), (-0.9, ""), (1.5, "beyond-1"), (-2.5, "beyond-2")])
def test_cells_beyond_one_and_two_sd_are_marked(z, mark):
    found = {table.number: table for table in published_tables(with_ours(z))}["2.1"]
    one = entry(found, "PT7.5", "RMS force [N]")
    assert one.z == pytest.approx(z)
    assert one.mark == mark


def test_what_is_not_computed_is_marked_and_counts_as_far():
    found = {table.number: table for table in published_tables(nothing())}
    one = entry(found["F.5"], "RT0, elbow", "peak rotation, level 1 [deg]")
    assert one.mark == "missing"
    assert one.reason == "RT0 was not recorded"
    share = found["F.5"].share
    assert share.computed == 0
    assert share.parts == (0.0, 0.0, 0.0)
    assert share.published > 0


def test_titles_tell_what_a_table_holds(tables):
    assert tables["C.4"].title == "Standard errors of six structures in PT7.5, without the penalty"
    assert tables["C.22"].title == "Criterion and VAF of six structures in RT2.5, RT7.5, RT22.5, with the penalty"
    assert tables["D.3"].title == "Parameters from several starts in PT7.5, with the penalty"
