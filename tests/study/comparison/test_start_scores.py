"""Cells of appendix C from three starts: counted side by side, and those apart that the start made."""

import csv
import math

import numpy as np
import pytest

from armperturb.cli import main
from armperturb.plots.style import new_figure
from armperturb.recording_files import load_recording, save_recording
from armperturb.study.comparison.score import ScoredCell
from armperturb.study.comparison.start_scores import STARTS, StartScores, compare_starts
from armperturb.study.published.tables import MeanSD
from armperturb.study.results.quantities import Cell


def cells(*distances):
    """Cells of either task at these distances from what is published."""
    return tuple(
        ScoredCell(
            cell=Cell(table, condition, f"k_s model {number}"),
            published=MeanSD(10.0, 2.0),
            ours=MeanSD(10.0 + 2.0 * distance, 1.0),
        )
        for table, condition in (("C.8", "PT7.5"), ("C.18", "RT7.5"))
        for number, distance in enumerate(distances)
    )


def test_cells_near_from_published_and_far_from_scattered_starts_were_made_by_the_start():
    result = StartScores(
        people=2,
        cells={
            "neutral": cells(3.0, 3.0, 0.0, 3.0),
            "published": cells(0.5, -0.5, 0.1, 2.0),
            "scattered": cells(2.0, 0.5, math.nan, 0.0),
        },
        unstable={"neutral": {("RT", "6"): 25.0, ("PT", "6"): 0.0}, "published": {}, "scattered": {}},
    )
    assert (result.made("PT"), result.made("RT"), result.made()) == (2, 2, 4)
    text = result.summary()
    (shown,) = [row.split() for row in text.splitlines() if row.startswith("C, PT")]
    assert shown == ["C,", "PT", "4", "1", "(25", "%)", "3", "(75", "%)", "2", "(50", "%)", "2", "(50", "%)"]
    assert "neutral, RT, model 6: 25 % of fits with penalty end unstable" in text
    assert "model 6: 0 %" not in text
    assert result.to_frame()["z_scattered"].tolist() == pytest.approx([2.0, 0.5, math.nan, 0.0] * 2, nan_ok=True)
    assert result.plot(new_figure(3.0)).has_data()


@pytest.mark.slow(reason="fits trials of one person from three starts")
def test_recordings_are_fitted_from_each_start(study, tmp_path):
    recording = load_recording(study.of("PT7.5")[0].recording, optional=())
    of_one_condition = recording.isel(trial=np.flatnonzero(recording["condition"].values == "PT7.5"))
    save_recording(of_one_condition, tmp_path / "S01.nc")
    result = compare_starts([tmp_path / "S01.nc"], structures=("1", "2"))
    assert result.people == 1
    names = [[each.cell for each in result.cells[start]] for start in STARTS]
    assert names[0] == names[1] == names[2]
    fitted = [each.cell.quantity for each in result.cells["neutral"] if math.isfinite(each.z)]
    assert fitted
    assert all("model 1" in name or "model 2" in name for name in fitted)
    of = {start: {each.cell: each.ours.mean for each in some} for start, some in result.cells.items()}
    assert len({of[start][Cell("C.3", "PT7.5", "kv_e model 2")] for start in STARTS}) == len(STARTS)
    assert ("PT", "2") in result.unstable["neutral"]


def test_the_command_prints_and_writes_them(study, tmp_path, monkeypatch, capsys):
    def compared(paths):
        return StartScores(people=len(paths), cells={start: cells(0.25) for start in STARTS}, unstable={})

    monkeypatch.setattr("armperturb.study.comparison.start_scores.compare_starts", compared)
    monkeypatch.setattr("armperturb.study.results.analyse.analyse_study", lambda *_, **__: study)
    folder = study.of("PT7.5")[0].recording.parents[1]
    assert main(["score", str(folder), "--out", str(tmp_path), "--workers", "1", "--starts"]) == 0
    assert "appendix C of 2 people from three starts" in capsys.readouterr().out
    with (tmp_path / "starts.csv").open(encoding="utf-8", newline="") as file:
        assert [float(row["z_neutral"]) for row in csv.DictReader(file)] == [0.25, 0.25]
