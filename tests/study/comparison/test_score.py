"""A study beside the published tables: every cell, the headline numbers, and what cannot be computed and why."""

import csv
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.cuts import of_condition
from armperturb.analysis.fit.thesis import fit_trials, join_estimates
from armperturb.analysis.results import LINES
from armperturb.analysis.trials import ConditionTrials, trials_by_condition
from armperturb.cli import main
from armperturb.environment import Environment
from armperturb.plots.style import new_figure
from armperturb.recording_files import load_recording
from armperturb.study.comparison.cohorts import CohortScores
from armperturb.study.comparison.headlines import PULSED, headlines
from armperturb.study.comparison.score import (
    Score,
    ScoredCell,
    missing_cells,
    score,
    share,
    shares,
    write_score,
)
from armperturb.study.protocol import THESIS
from armperturb.study.published import tables as published
from armperturb.study.published.tables import MeanSD
from armperturb.study.recording.folder import find_recordings
from armperturb.study.results import analyse
from armperturb.study.results import trial_measures as measure
from armperturb.study.results.appendix_fits import Appendices
from armperturb.study.results.cases import identify_person
from armperturb.study.results.quantities import Cell, measured_cells, published_cells
from armperturb.study.results.trial_measures import PersonMeasures, TrialMeasures, measure_person
from armperturb.subject import POSITION

HEADER = "table,condition,quantity,published_mean,published_sd,ours,z,ours_sd,use,reason"


@pytest.fixture(scope="module")
def folder(study):
    return study.of("PT7.5")[0].recording.parents[1]


@pytest.fixture(scope="module")
def result(study):
    return score(study)


def of(result):
    return {one.cell: one for one in result.cells}


def named(result):
    return {one.name: one for one in result}


def test_every_published_cell_is_there_once(result):
    assert len(result.cells) == len(of(result)) == 126 + len(published.fit_entries())
    assert published_cells().keys() <= of(result).keys()
    assert all(math.isfinite(one.ours.mean) != bool(one.reason) for one in result.cells)


def test_cells_are_means_over_people(study, result):
    each = [measured_cells(load_recording(case.recording)) for case in study.of("PT7.5")]
    for cell in (Cell("2.1", "PT7.5", "rms_displacement"), Cell("F.3", "PT7.5", "peak_velocity_max_e")):
        values = [cells[cell] for cells in each]
        one = of(result)[cell]
        assert one.ours == pytest.approx((np.mean(values), np.std(values, ddof=1)))
        assert one.z == pytest.approx((np.mean(values) - one.published.mean) / one.published.sd)


def test_what_is_missing_has_a_reason(result):
    reasons = {cell: one.reason for cell, one in of(result).items() if one.reason}
    assert reasons[Cell("F.2", "RT2.5", "rms_velocity_s")] == "RT2.5 was not recorded"
    assert reasons[Cell("2.1", "PT0", "peak_displacement_max")] == "nobody's trials give it"
    assert reasons[Cell("C.8", "PT7.5", "k_s model 3")] == "nobody's trials could be fitted"
    assert reasons[Cell("C.16", "RT2.5", "k_s model 1")] == "RT2.5 was not recorded"
    text = result.summary()
    assert "2.1, RT2.5: 3 cells: RT2.5 was not recorded" in text
    of_c_16 = [one.cell for one in result.cells if (one.cell.table, one.cell.condition) == ("C.16", "RT2.5")]
    assert f"C.16, RT2.5: {len(of_c_16)} cells: RT2.5 was not recorded" in text
    assert sum(missing_cells(result).values()) == len(reasons)
    assert "S01: trial" in text
    assert "after its pulse began; expected more than 1 s in RT" in text


def test_files(result, tmp_path):
    path = write_score(result, tmp_path / "new" / "score")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert ",".join(rows[0]) == HEADER
    assert len(rows) == len(result.cells)
    for row, one in zip(rows, result.cells, strict=True):
        assert Cell(row["table"], row["condition"], row["quantity"]) == one.cell
        assert float(row["z"]) == pytest.approx(one.z, nan_ok=True)
        assert row["reason"] == one.reason
    assert (path.parent / "headlines.csv").read_text().startswith("name,published,ours,unit,remark,contradiction\n")
    assert (path.parent / "score.txt").read_text() == result.summary() + "\n"


def test_appendix_c_is_what_the_estimator_gives(study, result):
    def trials(condition):
        recordings = [load_recording(case.recording) for case in study.of("PT7.5")]
        return [ConditionTrials.prepare(of_condition(recording, condition)).multisine for recording in recordings]

    first = join_estimates([fit_trials(one, "1", use_penalty=False) for one in trials("RT7.5")])
    second = join_estimates([fit_trials(one, "1", initial=first.means()) for one in trials("RT22.5")])
    cells = of(result)
    place = first.parameters.index("k_se")
    for table, condition, estimate in (("C.13", "RT7.5", first), ("C.20", "RT22.5", second)):
        mean, sd = estimate.over_subjects(estimate.values)
        assert cells[Cell(table, condition, "k_se model 1")].ours == pytest.approx((mean[place], sd[place]))
        sem = estimate.over_subjects(estimate.sem)[0][place]
        next_table = f"C.{int(table[2:]) + 1}"
        assert cells[Cell(next_table, condition, "SEM k_se model 1")].ours.mean == pytest.approx(sem)
    criterion = second.criterion
    assert cells[Cell("C.22", "RT22.5", "criterion model 1")].ours == pytest.approx(
        (criterion.mean(), criterion.std(ddof=1))
    )
    assert cells[Cell("C.22", "RT22.5", "VAF_y model 1")].ours.mean == pytest.approx(second.mean_vaf()[0][1])
    assert cells[Cell("C.22", "RT22.5", "N_pos model 1")].ours.mean == second.n_positive / 2
    assert (
        cells[Cell("C.15", "RT7.5", "N_stab model 1")].published.mean
        == published.goodness_of_fit("N_stab", "C.15", model="1", condition="RT7.5") / 40
    )


def test_estimates_that_cannot_be_joined():
    with pytest.raises(ValueError, match="estimates of structures none; expected one structure"):
        join_estimates([])


def test_steps_say_what_is_missing(study):
    """Those who were not recorded where the fits start."""
    people = tuple(replace(one, conditions=("RT22.5",)) for one in study.people)
    cells = of(score(replace(study, appendices=Appendices(), people=people)))
    assert cells[Cell("C.20", "RT22.5", "k_s model 1")].reason == "RT7.5 was not recorded, from which the fits start"
    assert cells[Cell("C.13", "RT7.5", "k_s model 1")].reason == "RT7.5 was not recorded"


def test_appendices_d_and_e_are_those_of_each_start(thesis_study):
    cells = of(score(thesis_study))
    entries = [entry for entry in published.fit_entries() if entry.table[0] in "DE"]
    assert {entry.table for entry in entries} == {f"{a}.{n}" for a in "DE" for n in (3, 4, 5)}
    starts = thesis_study.appendices.starts
    assert starts.keys() == {entry.start for entry in entries}
    for entry in entries:
        if entry.quantity == "parameter":
            fits = starts[entry.start]
            mine = cells[Cell(entry.table, "PT7.5", f"{entry.parameter} model {entry.model} {entry.start}")].ours
            of_people = {}
            for name, fit in zip(fits.subjects, fits.fits, strict=True):
                if fit.stable:
                    of_people.setdefault(name, []).append(fit.values[entry.parameter])
            means = [np.mean(values) for values in of_people.values()]
            assert mine == pytest.approx((np.mean(means), np.std(means, ddof=1)))


def test_shares():
    def cell(z, sd=1.0, ours_sd=1.0, table="2.1"):
        return ScoredCell(
            cell=Cell(table, "PT7.5", f"{z}"), published=MeanSD(10.0, sd), ours=MeanSD(10.0 + z * sd, ours_sd)
        )

    missing = ScoredCell(
        cell=Cell("2.1", "PT0", "a"), published=MeanSD(1.0, 1.0), ours=MeanSD(math.nan, math.nan), reason="gone"
    )
    without_sd = cell(0.0, sd=math.nan)
    cells = (cell(0.4), cell(-0.6, ours_sd=3.0), cell(1.5, sd=2.0), cell(-7.0), missing, without_sd)
    assert share(cells) == (5, 4, (1, 2, 3), 1.0)
    assert share(cells).parts == (0.2, 0.4, 0.6)  # what is missing is not reproduced
    assert share(cells).parts_of_computed == (0.25, 0.5, 0.75)
    assert math.isnan(share([missing]).parts_of_computed[1])
    result = Score(people=1, cells=(*cells, cell(0.1, table="C.8")), headlines=(), remarks=())
    found = shares(result)
    assert found["2.1 and F"] == found["2.1 and F, PT"] == found["2.1"]
    assert found["2.1 and F"].parts == (0.2, 0.4, 0.6)
    assert found["2.1 and F, RT"][:2] == (0, 0)
    assert found["C"].within == (1, 1, 1)
    assert found["total"][:2] == (6, 5)
    assert found["calibrated"] == found["2.1"]
    assert found["held out"] == found["C"]
    assert share([missing]).within == (0, 0, 0)


def test_scores_of_several_cohorts_are_means_with_their_spread(result):
    other = replace(result, headlines=tuple(replace(line, ours=2.0 * line.ours) for line in result.headlines))
    both = CohortScores(scores=(result, other))
    frame = both.to_frame()
    assert frame.loc[("total", 0)].to_list() == frame.loc[("total", 1)].to_list()
    assert frame.loc[("2.1 and F", 0), "within_1_sd"] == pytest.approx(100.0 * shares(result)["2.1 and F"].parts[1])
    assert "2.1" not in frame.index.levels[0]
    line = next(line for line in result.headlines if math.isfinite(line.ours) and line.ours)
    mean, spread = 1.5 * line.ours, abs(line.ours) / math.sqrt(2.0)
    (shown,) = [row for row in both.summary().splitlines() if row.split()[:1] == [line.name]]
    assert f"{mean:.3g} ({spread:.2g})" in shown
    assert len(repr(both).splitlines()) <= LINES
    assert both.plot(new_figure(3.0)).has_data()


def test_a_study_without_a_computed_cell_is_left_out_of_means(result):
    def nothing(scored):
        return replace(scored, ours=MeanSD(math.nan, math.nan), reason="not recorded")

    empty = replace(result, cells=tuple(map(nothing, result.cells)))
    relaxed = replace(
        result, cells=tuple(nothing(each) if each.cell.condition[:2] == "PT" else each for each in result.cells)
    )
    three = CohortScores(scores=(result, empty, relaxed))
    alone = CohortScores(scores=(result,)).to_frame()
    assert three.to_frame().loc[("total", 1)].isna().all()
    assert three.to_frame().loc[("2.1 and F, PT", 0)].to_list() == alone.loc[("2.1 and F, PT", 0)].to_list()
    text = three.summary()
    assert "study 2 has no computed cell: left out of all means" in text
    assert "study 3 has no computed cell of 2.1 and F, PT; D; E: left out of these means" in text
    assert "study 1 has no computed cell of D; E: left out of these means" in text  # there is no such fit of the study


def test_settings_that_are_not_the_thesiss_are_listed_and_causes_left_out(study, result):
    text = result.summary()
    assert text.splitlines()[1].startswith("This study is another experiment than the thesis's: other pulse_levels, ")
    assert result.other_settings[-3:] == ("multisine_duration", "trial_duration", "onset_window")
    assert '  forces is "practice" there and "published" now' in text
    assert "  conditions[PT7.5].reached is 0.83 there and 1.0 now" in text
    assert not any("missing" in each.says for each in result.differences)
    assert "our people's" not in text
    fewer = tuple(each for each in THESIS.conditions if each.name != "RT0")
    own = replace(THESIS.condition("RT0"), name="own")
    repeated = score(replace(study, protocol=replace(THESIS, conditions=(own, *fewer))))
    assert repeated.differences == ()
    assert "our people's" in repeated.summary()


def test_the_summary_says_what_can_be_reached(result):
    text = result.summary()
    assert "as many other people of the published population would have" in text
    assert "admittance_amplitude_factor_pt: mean parameters of tables C.6 and C.10 give 1.3 to 1.4" in text


def trial(condition, level, displacement, admittance, predicted, **changes):
    recorded = dict(repetition=0, pulse_direction_deg=0.0, force=displacement / admittance)
    return TrialMeasures(
        condition=condition,
        pulse_level=level,
        displacement=displacement,
        predicted_linear=predicted,
        **recorded,
        **changes,
    )


def person(name, factor=1.0, **changes):
    """Somebody whose numbers are those of the text."""
    admittance = {
        **{("PT0", "min"): 1.0, ("PT0", "max"): 1.3, ("PT2.5", "max"): 1.2, ("PT7.5", "min"): 0.6},
        **{("PT7.5", "max"): 0.9, ("PT22.5", "max"): 0.8},
        **{("RT0", "min"): 4.0, ("RT2.5", "min"): 4.1, ("RT7.5", "min"): 4.6, ("RT22.5", "min"): 5.4},
    }
    draw = np.random.default_rng(sum(map(ord, name)))
    measured = PersonMeasures(
        name=name,
        conditions=tuple(published.conditions()),
        cells={
            Cell("F.5", condition, f"peak_rotation_{level}_{joint}"): factor * value
            for condition in ("PT0", "PT7.5")
            for joint in "se"
            for level, value in (("min", 0.1), ("max", 0.2))
        },
        true_cells={},
        estimates={},
        low_gain={
            condition: factor * gain * np.array([[1.0, 2.0], [3.0, 4.0]])
            for condition, gain in {
                **{"PT2.5": 1.5, "PT7.5": 1.2, "PT22.5": 1.0},
                **{"RT2.5": 10.0, "RT7.5": 21.6, "RT22.5": 38.0},
            }.items()
        },
        trials=tuple(
            trial(
                condition,
                {"min": 1.0, "max": -2.0}[level],
                peak := factor * (0.21 if condition.startswith("RT") else 0.06),
                factor * value * (1.0 + 0.02 * draw.standard_normal()),
                {"PT2.5": 0.4, "RT22.5": 0.8}.get(condition, 0.5) * peak,
            )
            for (condition, level), value in admittance.items()
        ),
        left_out=(),
    )
    return replace(measured, **changes)


def test_headlines_of_people_who_are_as_the_text_says():
    found = named(
        headlines([person(name, factor) for name, factor in zip("ABCDE", (0.5, 1.0, 1.5, 2.0, 1.2), strict=True)])
    )
    for name in ("admittance_ratio_rt7.5_pt7.5", "admittance_amplitude_factor_pt", "admittance_amplitude_factor_rt"):
        assert found[name].ours == pytest.approx(float(found[name].published))
    assert found["pulse_admittance_ratio_max_min_pt0"].ours == pytest.approx(1.3, rel=0.05)
    assert found["pulse_admittance_ratio_max_min_pt7.5"].ours == pytest.approx(1.5, rel=0.05)
    assert found["p_pulse_admittance_level_pt7.5"].ours < 0.05
    assert found["peak_displacement_ratio_rt_pt_min_level"].ours == pytest.approx(3.5)
    assert found["pulse_prediction_low"].ours == pytest.approx(40.0)
    assert found["pulse_prediction_high"].ours == pytest.approx(80.0)
    assert found["pulse_excess_max"].ours == pytest.approx(2.5)
    assert found["pulse_underprediction_factor"].ours == pytest.approx((2.5 + 1.25 + 5 * 2.0) / 7)
    assert found["pulse_prediction_increase_rt2.5_rt22.5_min"].ours == pytest.approx(30.0)
    assert found["pulse_admittance_PT22.5_over_PT0"].ours < 1 < found["pulse_admittance_RT2.5_over_RT0"].ours
    assert found["p_pulse_admittance_anova_rt"].ours < 0.05
    assert found["p_pulse_admittance_pt0_pt2.5"].published == "ns"
    assert found["peak_rotation_ratio_max_min"].ours == pytest.approx(2.0)
    assert found["pulse_mean_displacement"].ours == pytest.approx(100 * 1.24 * (0.06 + 0.21) / 2)
    assert all(math.isfinite(one.ours) for one in found.values())


def test_headlines_say_what_they_lack():
    lonely = person("A", trials=(), low_gain={}, cells={})
    found = headlines([lonely])
    assert all(math.isnan(one.ours) and one.remark for one in found)
    assert len(found) == len(headlines([person("A")]))
    few = named(headlines([person("A"), person("B"), lonely]))
    assert few["p_pulse_admittance_anova_pt"].remark == "fewer than 3 people"
    assert math.isfinite(few["pulse_admittance_PT2.5_over_PT0"].ours)
    none = person("C")
    none = replace(none, trials=tuple(one for one in none.trials if one.condition != PULSED["RT"][1][0]))
    some = named(headlines([none]))
    assert some["p_pulse_admittance_anova_rt"].remark == "nobody has all of RT0, RT2.5, RT7.5, RT22.5"
    assert "1 of 7 pulses are missing" in some["pulse_underprediction_factor"].remark


def test_pulses_of_a_person(study):
    case, measured = study.of("PT7.5")[0], study.people[0]
    assert measured.name == "S01"
    assert measured.pulses.keys() == {("PT0", "min"), ("PT7.5", "min"), ("PT7.5", "max")}
    assert math.isnan(measured.pulses["PT0", "min"].prediction)
    for level in ("min", "max"):
        pulse = measured.pulses["PT7.5", level]
        assert 50 < pulse.prediction < 200  # a linear person
        assert pulse.excess == pytest.approx(100.0 / pulse.prediction)  # of one trial
        assert pulse.displacement == pytest.approx(measured.cells[Cell("2.1", "PT7.5", f"peak_displacement_{level}")])
    assert len(measured.trials) == load_recording(case.recording).sizes["trial"]
    for one in measured.trials:
        predicted = (one.predicted_linear, one.predicted_skeletal, *one.vaf_linear, *one.vaf_skeletal)
        if one.condition == "PT0":
            assert np.isnan(predicted).all()
        else:
            # A person without muscle law moves on a circle, but not far.
            assert one.vaf_skeletal == pytest.approx(one.vaf_linear, abs=5.0)
            assert min(one.vaf_skeletal) > 0.0
            assert math.isfinite(one.displacement) == math.isfinite(one.predicted_skeletal)
            assert one.predicted_skeletal == pytest.approx(one.predicted_linear, rel=0.1, nan_ok=True)
            assert one.predicted_skeletal != one.predicted_linear
    assert measured.low_gain.keys() == {"PT2.5", "PT7.5", "RT7.5", "RT22.5"}
    arm = case.identified.spectra.arm[:2]
    np.testing.assert_allclose(measured.low_gain["PT7.5"], np.abs(np.diagonal(arm, axis1=1, axis2=2)))


def test_means_are_over_the_trials_that_tell_something():
    trials = (
        trial("PT7.5", 1.0, 0.04, 1e-3, 0.02, predicted_skeletal=0.03),
        trial("PT7.5", -1.0, 0.02, 3e-3, math.nan, predicted_skeletal=math.nan),
        trial("PT7.5", 1.0, 0.06, 5e-3, 0.06, predicted_skeletal=math.nan),
        trial("PT7.5", 1.0, math.nan, math.nan, math.nan),
        trial("PT7.5", 2.0, math.nan, math.nan, math.nan),
        trial("PT22.5", 2.0, 0.05, 2e-3, math.nan),
    )
    pulses = person("A", trials=trials).pulses
    assert pulses.keys() == {("PT7.5", "min"), ("PT22.5", "max")}
    assert pulses["PT7.5", "min"][:5] == pytest.approx((0.04, 3e-3, 75.0, 1.5, 75.0))
    assert pulses["PT22.5", "max"][:5] == pytest.approx((0.05, 2e-3, *[math.nan] * 3), nan_ok=True)


def test_a_skeletal_model_that_leaves_the_workspace_predicts_nothing(study):
    recording = load_recording(study.of("PT7.5")[0].recording)[["perturbation", "force", "displacement"]]
    [first, _] = np.flatnonzero(recording["condition"].values == "PT7.5")
    of_pulse = recording.isel(trial=[first])
    measured = trial("PT7.5", 1.0, 0.05, 1e-3, 0.04)
    wall = Environment(workspace=0.01)
    asked, lines = measure._with_skeletal(measured, of_pulse, slice(0, 2000), POSITION, wall)
    assert [line.partition(" s after the ")[2].partition(" ")[0] for line in lines] == ["multisine", "pulse"]
    assert "PT7.5, repetition 0: the skeletal model left the workspace 0.0" in lines[1]
    assert math.isnan(asked.predicted_skeletal)


def test_a_limit_harms_what_comes_after_it_alone(study, tmp_path):
    recording = load_recording(study.of("PT7.5")[0].recording)[["perturbation", "force", "displacement"]]
    limits = recording["limit_time"].values.copy()
    first, second = np.flatnonzero(recording["condition"].values == "RT7.5")
    limits[first], limits[second] = 28.7, 20.0  # in the pulse, in the multisine
    changed = recording.assign_coords(limit_time=("trial", limits))
    trials = trials_by_condition(changed)
    multisine = trials["RT7.5"].multisine
    assert multisine.numbers.tolist() == [0]
    assert multisine.n_samples == round(28.6 * 200.0)
    conditions = tuple(study.protocol.condition(name) for name in ("PT2.5", "RT7.5"))
    cases = identify_person(trials, tmp_path, replace(study.protocol, conditions=conditions))
    assert cases[1].left_out == ("trial 1 of S01 in RT7.5 reached the workspace limit at 20.000 s",)
    measured, whole = measure_person(changed, trials, cases), study.people[0]
    assert measured.low_gain.keys() == {"PT2.5", "RT7.5"}
    assert not np.allclose(measured.low_gain["RT7.5"], whole.low_gain["RT7.5"])
    np.testing.assert_array_equal(measured.low_gain["PT2.5"], whole.low_gain["PT2.5"])
    assert ("RT7.5", "min") not in measured.pulses


def test_recordings_that_are_not_whole_are_told(folder, tmp_path):
    copy = tmp_path / "study"
    shutil.copytree(folder / "recordings", copy / "recordings")
    shutil.copy(copy / "recordings" / "S01.nc", copy / "recordings" / "S02.nc")
    paths, remarks = find_recordings(copy)
    assert [path.stem for path in paths] == ["S01"]
    assert remarks == ["S02.nc does not match its checksum; it is left out"]
    shutil.copy(copy / "recordings" / "S01.nc", copy / "recordings" / "P07.nc")
    said = "P07.nc is not among the checksums of the study (recordings/SHA256SUMS); it is left out"
    assert find_recordings(copy)[1] == [said, *remarks]
    (copy / "recordings" / "P07.nc").unlink()
    (copy / "recordings" / "SHA256SUMS").unlink()
    assert find_recordings(copy) == (sorted((copy / "recordings").glob("*.nc")), [])
    (copy / "recordings" / "SHA256SUMS").write_text("")
    assert len(find_recordings(copy)[0]) == 2


def test_command(folder, study, result, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(analyse, "analyse_study", lambda root, workers: study)
    before = sorted(folder.rglob("*"))
    assert main(["score", str(folder), "--out", str(tmp_path / "out"), "--workers", "1"]) == 0
    assert capsys.readouterr().out == f"{result.summary()}\nresults: {tmp_path / 'out'}\n"
    assert (tmp_path / "out" / "score.csv").is_file()
    assert sorted(folder.rglob("*")) == before
    monkeypatch.setattr(analyse, "analyse_study", lambda root, workers: study)
    assert main(["score", str(folder), str(folder), "--out", str(tmp_path)]) == 1
    assert "expected one study with --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [([], "holds no recordings/*.nc; expected the folder of a study"), (["--workers", "0"], "workers = 0; expected")],
)
def test_command_refuses(tmp_path, capsys, arguments, message):
    assert main(["score", str(tmp_path), *arguments]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_score_reads_as_a_table_and_plots(result):
    assert len(repr(result).splitlines()) <= LINES
    assert any(line.startswith("total ") for line in repr(result).splitlines()[:6])
    assert "<table>" in result._repr_html_()
    frame = result.to_frame()
    assert ",".join(frame.columns) == HEADER
    ax = result.plot(figure=new_figure(1.0))
    drawn = sum(len(line.get_xdata()) for line in ax.get_lines() if line.get_marker() in ("o", "<", ">"))
    assert drawn == np.isfinite(frame["z"]).sum()
    assert [label.get_text() for label in ax.get_yticklabels()] == frame["table"].drop_duplicates().tolist()
