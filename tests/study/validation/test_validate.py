import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.fit.truth import true_values
from armperturb.analysis.results import LINES
from armperturb.cli import main
from armperturb.muscle_law import MuscleLaw
from armperturb.plots.style import new_figure
from armperturb.study.validation.report import title, write_validation
from armperturb.study.validation.validate import (
    Judged,
    ValidateSettings,
    Validation,
    run_group,
    simulate_group,
    validate,
)
from armperturb.subject import POSITION

RECORD = ValidateSettings(groups=10, trials=1, estimators=("record",))
"""So many groups because the errors of a group's parameters are correlated: those of four can be half the bound."""

pytestmark = pytest.mark.slow(reason="repeats estimates on many simulated groups of trials")


@pytest.fixture(scope="module")
def right(once) -> Validation:
    return once("validation", lambda _: validate(RECORD, workers=1, show_progress=False))


@pytest.fixture(scope="module")
def half() -> Validation:
    """Somebody with half the noise."""
    return validate(replace(RECORD, groups=1, noise=0.5), workers=1, show_progress=False)


def judged(values, error=(1.0, 1.0), suspicious=False, converged=1.0) -> Judged:
    values, error = np.array(values, dtype=float), np.array(error)
    return Judged(
        values=values,
        error=error,
        covered=np.abs(values - [10.0, 0.0]) < 1.96 * error,
        converged=converged,
        stable=1.0,
        is_global=1.0,
        suspicious=suspicious,
    )


def hand_made(*groups: Judged) -> Validation:
    return Validation(
        settings=ValidateSettings(groups=len(groups), estimators=("record",)),
        names=("k_s", "kp_s"),
        truth=np.array([10.0, 0.0]),
        bound=np.array([1.0, 2.0]),
        judged={"record": groups},
    )


def test_whole_records_come_near_the_bound_and_their_intervals_hold_the_truth(right):
    ratio = right.to_frame()["rms_error_over_bound"]
    assert 0.6 < np.median(ratio) < 1.4
    assert max(ratio) < 2.5
    (summary,) = right.estimators_frame().to_dict("records")
    assert summary["coverage_percent"] > 90.0
    assert summary["converged_percent"] == summary["stable_percent"] == summary["global_percent"] == 100.0


def test_the_thesis_is_judged_beside_and_is_far_from_the_bound():
    settings = replace(RECORD, groups=2, trials=2, estimators=("thesis", "record"))
    found = validate(settings, workers=1, show_progress=False)
    thesis, record = (
        [r for r in found.to_frame().to_dict("records") if r["estimator"] == name] for name in ("thesis", "record")
    )
    assert [r["parameter"] for r in thesis] == [r["parameter"] for r in record]
    assert [r["bound"] for r in thesis] == [r["bound"] for r in record]
    median = [np.median([r["rms_error_over_bound"] for r in rows]) for rows in (thesis, record)]
    assert median[0] > 3.0 * median[1]
    assert np.isnan(found.estimators_frame()["flagged_percent"][0])


def test_half_the_noise_halves_the_bound(right, half):
    stiffness = [right.names.index(name) for name in ("k_s", "k_se", "k_e")]
    assert half.bound[stiffness] == pytest.approx(0.5 * right.bound[stiffness], rel=0.15)


# A wrong delay leaves a tenth of what a missing force feedback does; with all the noise, eight trials hardly show it.
@pytest.mark.parametrize(("wrong", "trials"), [("delay", 8), ("force-feedback", 2)])
def test_a_wrong_structure_is_biased_and_flagged_and_has_the_bound_of_the_right_one(wrong, trials, half):
    settings = replace(half.settings, trials=trials, wrong=wrong)
    found = validate(settings, workers=1, show_progress=False)
    (summary,) = found.estimators_frame().to_dict("records")
    assert summary["biased_percent"] == summary["flagged_percent"] == summary["flagged_of_biased_percent"] == 100.0
    # The bound falls with the root of the trials, whatever is wrong; the force feedback is part of the truth.
    assert np.median(found.bound / half.bound) == pytest.approx(np.sqrt(RECORD.trials / trials), rel=0.1)


def test_the_right_structure_is_not_flagged(right):
    (summary,) = right.estimators_frame().to_dict("records")
    assert summary["flagged_percent"] == summary["biased_percent"] == 0.0


def test_groups_differ_and_the_seed_sets_them(right):
    values = np.array([one.values for one in right.judged["record"]])
    assert (values.std(axis=0) > 0.0).all()
    again, other = (simulate_group(replace(RECORD, seed=seed), 0)["force"].values for seed in (0, 1))
    assert np.array_equal(again, simulate_group(RECORD, 0)["force"].values)
    assert not np.allclose(again, other, rtol=1e-3)


def test_no_muscle_law_makes_another_arm_of_the_truth(tmp_path):
    paths = [tmp_path / name for name in ("law.toml", "none.toml")]
    for path, muscle in zip(paths, (MuscleLaw(), None), strict=True):
        replace(POSITION, muscle=muscle).save(path)
    settings = replace(RECORD, multibody=True, engine="compiled")
    of_law, of_none = (simulate_group(replace(settings, subject=path), 0)["displacement"].values for path in paths)
    np.testing.assert_array_equal(of_law, of_none)


def test_bias_error_coverage_and_their_interval_are_those_of_the_definition():
    found = hand_made(judged([11.0, 0.0]), judged([13.0, -4.0]))
    k, kp = found.to_frame().to_dict("records")
    assert (k["bias"], k["rms_error"]) == (2.0, pytest.approx(np.sqrt(5.0)))
    assert k["rms_error_percent"] == pytest.approx(10.0 * np.sqrt(5.0))
    assert np.isnan(kp["rms_error_percent"])
    assert kp["rms_error_over_bound"] == pytest.approx(np.sqrt(8.0) / 2.0)
    assert k["coverage_percent"] == kp["coverage_percent"] == 50.0
    # chi2 with two degrees of freedom: minus twice the logarithm of the chance to be above.
    assert (k["rms_error_over_bound_high"] / k["rms_error_over_bound"]) ** 2 == pytest.approx(-1 / np.log(0.975))
    assert (k["rms_error_over_bound_low"] / k["rms_error_over_bound"]) ** 2 == pytest.approx(-1 / np.log(0.025))


def test_the_flagged_are_counted_among_the_biased_alone():
    sharp, blunt = (0.1, 0.1), (9.0, 9.0)
    found = hand_made(
        judged([12.0, 0.0], sharp, suspicious=True),
        judged([12.0, 0.0], sharp, suspicious=False, converged=0.0),
        judged([12.0, 0.0], blunt, suspicious=True),
        judged([12.0, 0.0], blunt, suspicious=False),
    )
    (summary,) = found.estimators_frame().to_dict("records")
    assert summary["biased_percent"] == summary["flagged_percent"] == summary["flagged_of_biased_percent"] == 50.0
    assert summary["converged_percent"] == 75.0


def test_the_text_has_a_line_for_each_parameter_and_estimator():
    text = hand_made(judged([11.0, 0.0]), judged([13.0, -4.0])).summary()
    k, kp = (line for line in text.splitlines() if line.startswith(("k_s", "kp_s")))
    assert k.split() == ["k_s", "10", "Nm/rad", "10.0", "%", "20.0", "2.24", "50"]
    # Where the truth is zero there is no percentage.
    assert kp.split() == ["kp_s", "0", "Nm/rad", "2.00", "-2.00", "1.41", "50"]
    assert title(hand_made(judged([11.0, 0.0]))).startswith("'position' (PT), model 3b, 1 group of 8 trials, linear")


def test_true_values_are_those_of_the_person():
    structure = ValidateSettings(model="3").structure()
    truth = dict(zip(structure.free, true_values(POSITION, structure), strict=True))
    assert len(truth) == 20
    assert truth == pytest.approx({name: getattr(POSITION, name) for name in structure.free})
    shared = ValidateSettings().structure()
    assert true_values(POSITION, shared)[shared.free.index("m_tot")] == pytest.approx(POSITION.m_h + POSITION.m_f)


def test_what_is_wrong_is_fixed_beside_the_truth():
    arms = {
        wrong: ValidateSettings(wrong=wrong).structure().arm(POSITION, np.ones(13))
        for wrong in ("nothing", "delay", "grip")
    }
    assert arms["nothing"].Td_s == POSITION.Td_s
    assert (arms["delay"].Td_s, arms["delay"].Td_e) == pytest.approx((0.040, 0.040))
    assert arms["grip"].k_h == pytest.approx(0.8 * POSITION.k_h)
    settings = ValidateSettings(wrong="force-feedback")
    assert settings.truth().kf_s == settings.truth().kf_e == -0.5
    assert settings.structure().arm(POSITION, np.ones(13)).kf_s == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "XT"}, "task = 'XT'; expected one of PT, RT"),
        ({"model": "7"}, "model = '7'; expected one of 1, 2"),
        ({"groups": 0}, "groups = 0; expected a finite number at least 1"),
        ({"trials": 1.5}, "trials = 1.5; expected a whole number"),
        ({"estimators": ()}, "expected at least one, each once"),
        ({"estimators": ("record", "record")}, "expected at least one, each once"),
        ({"estimators": ("guess",)}, "estimators = 'guess'; expected some of thesis, frequency, record"),
        ({"noise": -1.0}, "noise = -1.0; expected a finite number at least 0"),
        ({"force": 0.0}, "force = 0.0; expected a finite number above 0"),
        ({"wrong": "all"}, "wrong = 'all'; expected one of nothing, delay"),
        ({"seed": -1}, "seed = -1; expected a finite number at least 0"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises((ValueError, TypeError)) as refused:
        ValidateSettings(**change)
    assert message in str(refused.value)


def test_a_person_beyond_the_bounds_of_the_model_is_refused(tmp_path):
    replace(POSITION, k_s=1500.0, name="stiff").save(tmp_path / "stiff.toml")
    with pytest.raises(ValueError, match="k_s = 1500 Nm/rad in 'stiff'; expected 0 to 1000"):
        validate(ValidateSettings(subject=tmp_path / "stiff.toml"), workers=1)


@pytest.mark.parametrize(
    ("task", "model", "reason"),
    [
        *(("RT", model, "Td_s, Td_e, fact_s, fact_e cannot be identified") for model in "23456"),
        *(("PT", model, r"cannot be identified: a change of .* ka_s .* Td_e") for model in "56"),
    ],
)
def test_a_model_that_the_person_does_not_determine_is_refused_before_anything_is_simulated(task, model, reason):
    settings = ValidateSettings(task=task, model=model, groups=100_000)
    with pytest.raises(ValueError, match=f"validate: model = '{model}' for .*{reason}.*as in --model 3b"):
        validate(settings, workers=1, show_progress=False)


def test_the_bound_of_what_a_model_leaves_out_is_that_of_the_person():
    settings = replace(RECORD, groups=1, estimators=("frequency",))
    whole, part = (replace(settings, model=model) for model in ("3", "1"))
    kept = [whole.structure().free.index(name) for name in part.structure().free]
    information, of_part = (run_group(each, 0)[2] for each in (whole, part))
    np.testing.assert_allclose(of_part, information[np.ix_(kept, kept)], rtol=1e-6)


def test_the_bound_of_a_person_without_noise_holds_what_the_unknown_manipulator_costs():
    settings = replace(RECORD, task="RT", model="1", groups=1, trials=2, noise=0.0)
    quiet = validate(settings, workers=1, show_progress=False)
    # With the manipulator known, the errors that the estimator reports are seven times the bound.
    ratio = quiet.to_frame()["mean_standard_error"] / quiet.bound
    assert 0.9 < np.exp(np.mean(np.log(ratio))) < 1.2


def test_a_person_whom_the_model_cannot_be_is_remarked_upon(tmp_path):
    found = replace(hand_made(judged([11.0, 0.0])), settings=replace(RECORD, groups=1, model="1"))
    assert "- model 1 leaves out kv, kp of 'position'" in found.summary()
    write_validation(found, tmp_path)
    (remark,) = json.loads((tmp_path / "settings.json").read_text())["remarks"]
    assert remark.startswith("model 1 leaves out kv, kp of 'position'")
    assert "Remarks" not in hand_made(judged([11.0, 0.0])).summary()


def test_no_wrong_delay_where_nothing_is_delayed():
    with pytest.raises(ValueError, match="wrong = 'delay'; expected another for 'relax'"):
        ValidateSettings(task="RT", wrong="delay").structure()


def test_the_command_writes_what_it_says(tmp_path, capsys):
    words = ["--model", "1", "--task", "RT", "--trials", "1", "--workers", "1", "--estimators", "frequency", "record"]
    assert main(["validate", "--out", str(tmp_path / "new"), "--groups", "2", *words]) == 0
    assert "'relax' (RT), model 1, 2 groups of 1 trial, linear arm" in capsys.readouterr().out
    with (tmp_path / "new/tables/validation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["estimator"], row["parameter"]) for row in rows][9:11] == [("frequency", "k_h"), ("record", "m_h")]
    with (tmp_path / "new/tables/validation_summary.csv").open() as file:
        assert [row["groups"] for row in csv.DictReader(file)] == ["2", "2"]
    assert (tmp_path / "new/figures/validation.svg").read_text().startswith("<?xml")
    made = json.loads((tmp_path / "new/settings.json").read_text())
    assert made["settings"]["estimators"] == ["frequency", "record"]
    assert made["truth"]["name"] == "relax"
    assert "numpy" in made["versions"]


def test_the_command_refuses_in_one_line(tmp_path, capsys):
    assert main(["validate", "--out", str(tmp_path / "new"), "--groups", "0"]) == 1
    assert capsys.readouterr().err == (
        "armperturb: error: validate: groups = 0; expected a finite number at least 1 and at most 100000\n"
    )
    assert not (tmp_path / "new").exists()


def test_a_validation_reads_as_a_table_and_plots(tmp_path):
    found = hand_made(judged([11.0, 0.0]), judged([13.0, -4.0]))
    assert len(repr(found).splitlines()) <= LINES
    assert "model 3b, 2 groups of 8 trials" in repr(found)
    assert "flagged" in found.summary()
    assert "<table>" in found._repr_html_()
    frame = found.to_frame()
    array = found.to_xarray()
    assert array["estimate"].dims == ("estimator", "group", "parameter")
    bias = (array["estimate"].mean("group") - array["true"]).values.ravel()
    np.testing.assert_allclose(bias, frame["bias"])
    np.testing.assert_allclose(100.0 * array["covered"].mean("group").values.ravel(), frame["coverage_percent"])
    ax = found.plot(figure=new_figure(1.0))
    ratios = next(line for line in ax.get_lines() if line.get_marker() == "D")
    np.testing.assert_array_equal(ratios.get_xdata(), frame["rms_error_over_bound"])
    bars = ax.collections[0].get_segments()
    np.testing.assert_allclose([bar[1, 0] for bar in bars], frame["rms_error_over_bound_high"])
