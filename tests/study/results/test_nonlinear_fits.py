"""Nonlinear fits in a study: kept, told in tables and the report, and judged by pulses that they have not seen."""

import csv
import gzip
import math
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from markupsafe import escape

from armperturb import cli
from armperturb.analysis.measures.pulse import predicted_peaks, pulse_peaks
from armperturb.analysis.nonlinear import estimate as nonlinear_estimate
from armperturb.cohort import draw_person
from armperturb.environment import Environment, Strap
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.joined_recordings import stack_trials
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import Multisine, MultisineThenPulse, Pulse
from armperturb.recording_files import load_recording, save_recording
from armperturb.study.comparison.effects import Effects
from armperturb.study.protocol import THESIS
from armperturb.study.report import sections
from armperturb.study.report.figures import nonlinear as nonlinear_figures
from armperturb.study.report.figures.catalogue import drawings
from armperturb.study.report.nonlinear_tables import (
    linear_parameters,
    nonlinear_parameter_rows,
    nonlinear_pulse_rows,
    nonlinear_summary_rows,
    true_parameters,
)
from armperturb.study.results import analyse, cache
from armperturb.study.results.analyse import analyse_study
from armperturb.study.results.appendix_fits import Fits, SecondStep
from armperturb.study.results.nonlinear_fits import LeftOutPulse, NonlinearFit, fit_nonlinear
from armperturb.study.results.person import PersonResults
from armperturb.subject import RELAX
from tests.invented import SPRINGS, fitted, people_of, study_of
from tests.studies import sketch

PATH = np.outer(np.linspace(0.0, 1.0, 6), [0.03, 0.04])
NO_EFFECTS = Effects(admittance={}, parameters={}, levels={}, rows=(), pairs=(), remarks=())
PT_VALUES = {"m_h": 2.0, "k.shoulder": 20.0, "level.PT22.5": 1.5}
RT_VALUES = {"m_h": 2.0, "k.shoulder": 2.0, "elastic_limit_deg.elbow": 1.0}


def invented_fit(name="S01", task="RT", fitted_deg=(), factor=1.0, **changes):
    """Estimates times a factor, whose intervals reach 10 % to both sides; a pulse of each direction left out."""
    values = {parameter: factor * value for parameter, value in (PT_VALUES if task == "PT" else RT_VALUES).items()}
    if fitted_deg and name == "S01" and task == "RT":
        values["level.RT0"] = factor  # as in the position task, where pulses alone tell some levels
    condition = f"{task}7.5"
    peak = {"linear": 50.0, "skeletal": 60.0, "nonlinear": 90.0 if not fitted_deg else 100.0}
    pulses = [
        LeftOutPulse(
            condition,
            1.0 if task == "RT" else 2.0,
            direction,
            peak,
            {model: share - 1.0 for model, share in peak.items()},
            {"recorded": PATH, **{model: share / 100.0 * PATH for model, share in peak.items()}},
        )
        for direction in (20.0, 200.0)
        if direction not in fitted_deg
    ]
    if not fitted_deg:
        pulses.append(LeftOutPulse(f"{task}0", 1.0, 20.0, {"nonlinear": 80.0}, {"nonlinear": 70.0}, {}))
    fit = NonlinearFit(
        name=name,
        task=task,
        fitted_deg=tuple(fitted_deg),
        directions_deg=(20.0, 200.0),
        reference=condition,
        values=values,
        lower={parameter: value / 1.1 for parameter, value in values.items()},
        upper={parameter: value * 1.1 for parameter, value in values.items()},
        converged=True,
        status="converged",
        remarks=("recovery_time is poorly determined",),
        pulses=tuple(pulses),
    )
    return fit._replace(**changes)


class Ours(SimpleNamespace):
    """An estimate of the shape that a fit gives."""

    def subject(self, task, condition=""):
        assert task == self.person.task
        return self.person

    def interval(self, name):
        return 0.5 * self.values[name], 2.0 * self.values[name]


PERSON = replace(RELAX, muscle=MuscleLaw(short_range_stiffness=10.0, elastic_limit_deg=0.7))


@pytest.fixture(scope="module")
def yielding():
    """Trials without noise of a person who yields: pulses in two directions after a multisine, and one at rest."""
    trials = [
        Trial(
            subject=PERSON,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=number, rms=0.6, duration=12.0, crested=False), peak=20.0, direction_deg=direction
            ),
            condition="RT7.5",
            repetition=number,
            pulse_level=1.0,
        )
        for number, direction in enumerate((20.0, 200.0))
    ]
    at_rest = Trial(
        subject=PERSON,
        perturbation=Pulse(peak=20.0, direction_deg=20.0, onset=5.0, duration=16.0),
        condition="RT0",
        pulse_level=1.0,
    )
    step = 2.5e-3  # that of predictions
    return stack_trials([run_experiment(trials, timestep=step), run_experiment([at_rest], timestep=step)])


def case_of(*stable):
    """A case whose trials were fitted by the arm without its law."""
    rng = np.random.default_rng(0)
    estimate = SimpleNamespace(
        environment=Environment(), fits=tuple(replace(fitted(SPRINGS, rng, one), arm=RELAX) for one in stable)
    )
    condition = next(condition for condition in THESIS.conditions if condition.name == "RT7.5")
    found = SimpleNamespace(fit=SimpleNamespace(arm=RELAX))
    return SimpleNamespace(
        condition=condition, name="relax", identification=found, identified=found, thesis_estimate=estimate
    )


@pytest.fixture
def fit_is_truth(monkeypatch):
    """Fits give the person who was simulated; holds what they were given."""
    asked = []

    def fit(sets, arms, *, initial, checkpoint):
        assert checkpoint is None
        asked.append((sets, arms, initial))
        return Ours(
            person=PERSON,
            values={"m_h": 2.0, "level.RT0": 1.0},
            at_bound=(),
            converged=True,
            message="converged",
            remarks=("a remark",),
        )

    monkeypatch.setattr(nonlinear_estimate, "fit", fit)
    return asked


@pytest.mark.slow(reason="predicts many pulses")
def test_the_true_person_predicts_all_of_a_pulse_and_linear_ones_as_elsewhere(yielding, fit_is_truth):
    found = fit_nonlinear(yielding, "RT", [case_of(True, True)])
    assert found.failed == ""
    assert [(pulse.condition, pulse.level, pulse.direction_deg) for pulse in found.pulses] == [
        ("RT7.5", 1.0, 20.0),
        ("RT7.5", 1.0, 200.0),
        ("RT0", 1.0, 20.0),
    ]
    for pulse in found.pulses:
        # A pulse has corners, which the samples of a recording round off.
        assert pulse.peak["nonlinear"] == pytest.approx(100.0, abs=0.5)
        assert pulse.vaf["nonlinear"] > 99.95
    here = yielding.isel(trial=[0, 1])
    linear = predicted_peaks(here, RELAX, Environment()) / pulse_peaks(here).displacement
    assert [pulse.peak["linear"] for pulse in found.pulses[:2]] == pytest.approx(100.0 * linear, rel=2e-3)
    # Muscle that is softer than the person's: it moves further.
    assert min(pulse.peak["skeletal"] for pulse in found.pulses[:2]) > 101.0
    assert max(pulse.vaf["skeletal"] for pulse in found.pulses[:2]) < 99.5
    # No multisine, no linear fit.
    assert found.pulses[2].peak.keys() == found.pulses[2].vaf.keys() == {"nonlinear"}
    drawn = {"recorded", "linear", "skeletal", "nonlinear"}
    assert [set(pulse.paths) for pulse in found.pulses] == [drawn, drawn, set()]
    assert (found.directions_deg, found.reference) == ((20.0, 200.0), "RT7.5")
    assert found.others_deg == ((200.0,), (20.0,))


def test_pulses_of_the_other_direction_are_fitted_and_not_judged(yielding, fit_is_truth):
    found = fit_nonlinear(yielding, "RT", [case_of(True, False)], (20.0,), {"m_h": 2.0})
    assert [pulse.direction_deg for pulse in found.pulses] == [200.0]
    assert found.pulses[0].peak.keys() == {"nonlinear"}  # the trial's linear fit is unstable
    ((sets, arms, start),) = fit_is_truth
    ends = {(one.label, one.n_trials): one.end / one.rate for one in sets}
    assert ends["RT0", 1] > 5.0
    assert sorted(one.end / one.rate > 12.0 for one in sets if one.label == "RT7.5") == [False, True]
    assert arms == {"RT7.5": RELAX}
    assert start == {"m_h": 2.0}


def test_a_trial_that_is_lost_before_its_pulse_costs_no_other(yielding, fit_is_truth):
    lost = yielding.assign_coords(limit_time=("trial", [6.0, math.nan, math.nan]))
    found = fit_nonlinear(lost, "RT", [case_of(True)])
    assert [(pulse.condition, pulse.direction_deg) for pulse in found.pulses] == [("RT7.5", 200.0), ("RT0", 20.0)]
    assert found.pulses[0].vaf["nonlinear"] > 99.95


def test_what_cannot_be_fitted_is_told(yielding, monkeypatch):
    assert fit_nonlinear(yielding, "PT", [case_of(True, True)]).failed == (
        "no linear arm was identified in PT, where the fit would start"
    )

    def fit(*_, **__):
        raise ValueError("initial: the arm is unstable")

    monkeypatch.setattr(nonlinear_estimate, "fit", fit)
    found = fit_nonlinear(yielding, "RT", [case_of(True, True)], (20.0,))
    assert found == NonlinearFit("relax", "RT", (20.0,), failed="initial: the arm is unstable")
    assert found.label == "RT, pulses at 20\u00b0 fitted too"
    assert found.others_deg == ()


def invented(*fits, cohort=()):
    return replace(study_of(people_of(("S01", "S02"))), nonlinear=fits, cohort=cohort)


def test_truth_is_relative_to_the_level_of_the_reference():
    person = draw_person(0, 0)
    study = invented(invented_fit(task="PT"), cohort=(person,))
    truth = true_parameters(study, study.nonlinear[0])
    in_condition = {one.name: one.subject_of(person) for one in THESIS.conditions}
    assert truth["k.shoulder"] == in_condition["PT7.5"].k_s - in_condition["PT7.5"].k_se
    for name in ("PT0", "PT2.5", "PT22.5"):
        assert truth["k.elbow"] * truth[f"level.{name}"] == pytest.approx(in_condition[name].muscle_groups("k")[2])
    assert true_parameters(study, study.nonlinear[0]._replace(name="S99")) == {}
    strapped = replace(study, protocol=replace(study.protocol, strap=Strap()))
    assert true_parameters(strapped, study.nonlinear[0]) == {}


def test_tables_hold_estimates_against_truth_and_linear_arms():
    people = [draw_person(0, number) for number in range(2)]
    true = [person.subjects["RT"].m_h for person in people]
    fits = [
        invented_fit(person.name)._replace(
            values={"m_h": factor * mass}, lower={"m_h": mass * factor / 1.1}, upper={"m_h": mass * factor * 1.1}
        )
        for person, mass, factor in zip(people, true, (1.05, 1.25), strict=True)
    ]
    study = invented(*fits, cohort=tuple(people))
    rows = nonlinear_parameter_rows(study)
    assert [row["ratio"] for row in rows] == pytest.approx([1.05, 1.25])
    assert [row["true"] for row in rows] == true
    # All arms of the invented cases are the preset's.
    assert all(len(set(values)) == 1 for values in linear_parameters(study, "S01", "RT").values())
    assert rows[0]["linear_least"] == rows[0]["linear_most"] == study.cases[0].identified.fit.arm.m_h
    (summary,) = nonlinear_summary_rows(rows)
    assert summary["median_ratio"] == pytest.approx(1.15)
    assert summary["median_abs_error_percent"] == pytest.approx(15.0)
    assert summary["coverage_95_percent"] == 50.0
    assert summary["median_width_percent"] == pytest.approx(50.0 * (1.1 - 1.0 / 1.1))
    assert summary["true_mean"] == pytest.approx(np.mean(true))


def test_pulses_are_told_apart_by_what_was_fitted():
    study = invented(invented_fit(), invented_fit(fitted_deg=(20.0,)), invented_fit(fitted_deg=(200.0,)))
    rows = {(row["condition"], row["model"]): row for row in nonlinear_pulse_rows(study)}
    assert [condition for condition, _ in rows] == ["RT0"] + ["RT7.5"] * 4
    shares = {model: (row["pulses"], row["median_peak_percent"]) for (c, model), row in rows.items() if c == "RT7.5"}
    assert shares == {
        "linear": (2, 50.0),
        "skeletal": (2, 60.0),
        "nonlinear": (2, 90.0),
        "nonlinear, other pulses": (2, 100.0),
    }
    assert rows["RT7.5", "linear"]["median_vaf_percent"] == 49.0
    assert rows["RT0", "nonlinear"]["median_peak_percent"] == 80.0


def test_figures_show_the_shares_and_the_first_persons_paths():
    study = invented(
        invented_fit(failed="why", pulses=()),
        invented_fit("S02"),
        invented_fit("S02", fitted_deg=(20.0,)),
        cohort=(draw_person(0, 0), draw_person(0, 1)),
    )
    assert nonlinear_figures.drawn_pulses(study, "RT").keys() == {20.0, 200.0}
    (ax,) = nonlinear_figures.prediction(study).axes
    assert sorted(ax.containers[0].lines[0].get_ydata()) == pytest.approx([50.0, 60.0, 80.0, 90.0, 100.0])
    above, *over_time = nonlinear_figures.trajectories(study, "RT").axes
    ends = sorted({round(float(line.get_ydata()[-1]), 6) for line in above.lines if len(line.get_xdata()) == len(PATH)})
    assert ends == [2.0, 2.4, 3.6, 4.0]  # half, 60, 90 and 100 % of the recorded 4 cm
    for axis, ax in enumerate(over_time):
        recorded = ax.lines[0]
        assert recorded.get_ydata() == pytest.approx(100.0 * PATH[:, axis])
        assert recorded.get_xdata() == pytest.approx(np.linspace(0.0, 1.0, len(PATH)))
    held = nonlinear_figures.parameters(study, "RT").axes[0]
    assert [label.get_text() for label in held.get_yticklabels()] == [
        "mass of the upper arm",
        "stiffness, shoulder",
        "elastic limit, elbow",
    ]


def test_estimates_beyond_the_axis_stand_at_its_end():
    fit = invented_fit("S01")
    true = true_parameters(invented(fit, cohort=(draw_person(0, 0),)), fit)
    values = {"m_h": true["m_h"], "k.shoulder": -true["k.shoulder"], "elastic_limit_deg.elbow": 1e3}
    study = invented(fit._replace(values=values, lower=values, upper=values), cohort=(draw_person(0, 0),))
    ax = nonlinear_figures.parameters(study, "RT").axes[0]
    low, high = ax.get_xlim()
    points = [(line.get_marker(), float(line.get_xdata()[0])) for line in ax.lines if line.get_marker() != "None"]
    assert points == [("o", 1.0), ("<", pytest.approx(low)), (">", pytest.approx(high))]
    drawn = drawings(study, NO_EFFECTS)
    names = {name for name in drawn if name.startswith("nonlinear")}
    assert names == {"nonlinear_parameters_RT", "nonlinear_prediction", "nonlinear_trajectories_RT"}


@pytest.fixture(scope="module")
def recorded(yielding, tmp_path_factory):
    """Recordings of two people of whom nothing is known."""
    root = tmp_path_factory.mktemp("recorded")
    (root / "recordings").mkdir()
    for name in ("S01", "S02"):
        named = yielding.assign_coords(subject=("trial", [name] * yielding.sizes["trial"]))
        save_recording(named, root / "recordings" / f"{name}.nc")
    return root


def invent_linear_analysis(monkeypatch):
    """The linear analysis takes no time."""
    measures = {person.name: person for person in people_of(("S01", "S02"))}

    def analyse_person(recording, *_):
        name = str(recording["subject"].values[0])
        return PersonResults(cases=(), measures=measures[name], fits=Fits(name, {}, {}, ()), missing=())

    monkeypatch.setattr(analyse, "analyse_person", analyse_person)
    monkeypatch.setattr(analyse, "fit_second_step", lambda *_: SecondStep({}, ()))


def invent_nonlinear_fits(monkeypatch):
    """Nonlinear fits take no time; gives what is fitted. S02 has no pulses that can be fitted at 200 degrees."""
    calls = []

    def fit(recording, task, cases, fitted_deg, start, checkpoint):
        checkpoint.touch()
        name = str(recording["subject"].values[0])
        calls.append((name, task, fitted_deg, start))
        assert cases == ()
        if (name, fitted_deg) == ("S02", (200.0,)):
            return NonlinearFit(name, task, fitted_deg, failed="the arm is <unstable>")
        return invented_fit(name, task, fitted_deg)

    monkeypatch.setattr(analyse, "fit_nonlinear", fit)
    return calls


@pytest.fixture
def folder(recorded, tmp_path, monkeypatch):
    """These recordings; nothing is analysed yet."""
    invent_linear_analysis(monkeypatch)
    return shutil.copytree(recorded, tmp_path / "recorded")


@pytest.fixture
def asked(monkeypatch):
    """What is fitted."""
    return invent_nonlinear_fits(monkeypatch)


def section(page):
    (found,) = re.findall(r'<section id="nonlinear">(.*?)</section>', page, flags=re.S)
    return found


@pytest.mark.slow(reason="writes three reports")
def test_fits_are_kept_and_shown_later_without_being_asked_for(folder, asked, tmp_path):
    page = sketch(analyse_study(folder, workers=1, show_progress=False), tmp_path / "before", ("peak_displacement",))
    assert asked == []
    assert "armperturb report DIR --nonlinear RT PT" in page
    assert 'id="nonlinear"' not in page

    study = analyse_study(folder, workers=1, nonlinear=["RT"], show_progress=False)
    assert asked == [(name, "RT", (), None) for name in ("S01", "S02")] + [
        (name, "RT", pulses, RT_VALUES) for name in ("S01", "S02") for pulses in ((200.0,), (20.0,))
    ]
    again = analyse_study(folder, workers=1, show_progress=False)
    assert len(asked) == 6
    assert [one.label for one in again.nonlinear] == [one.label for one in study.nonlinear]
    told = "S02 was not identified nonlinearly in RT, pulses at 200\u00b0 fitted too: the arm is <unstable>"
    assert again.remarks[-1] == told
    page = sketch(again, tmp_path / "after", figures=("nonlinear_parameters_RT", "nonlinear_prediction"))
    assert "S02 (RT, pulses at 200\u00b0 fitted too): the arm is &lt;unstable&gt;." in section(page)
    assert "recovery_time is poorly determined" in section(page)
    with (tmp_path / "after" / "tables" / "nonlinear_fits.csv").open(encoding="utf-8", newline="") as file:
        statuses = [row["status"] for row in csv.DictReader(file)]
    assert statuses.count("converged") == 5
    assert statuses.count("the arm is <unstable>") == 1

    # Nothing is known of these people; were they, the report would set them beside the truth.
    assert "median error" not in section(page)
    assert "figure-nonlinear_parameters" not in page
    assert "figure-nonlinear_prediction" in page
    rows = nonlinear_parameter_rows(again)
    assert len(rows) == 17
    assert all(math.isnan(row["true"]) and math.isnan(row["ratio"]) for row in rows)
    known = replace(again, cohort=(draw_person(0, 0), draw_person(0, 1)))
    page = sketch(known, tmp_path / "known", figures=("nonlinear_parameters_RT",))
    assert "median error" in section(page)
    assert "figure-nonlinear_parameters_RT" in page


@pytest.mark.slow(reason="fits the laws of two people")
def test_a_search_that_was_interrupted_goes_on(folder, asked, monkeypatch):
    fit, found = analyse.fit_nonlinear, []

    def interrupted(recording, task, cases, fitted_deg, start, checkpoint):
        found.append((checkpoint.name, checkpoint.exists()))
        fit(recording, task, cases, fitted_deg, start, checkpoint)
        if len(found) == 4:
            raise KeyboardInterrupt
        return invented_fit("S01", task, fitted_deg)

    monkeypatch.setattr(analyse, "fit_nonlinear", interrupted)
    with pytest.raises(KeyboardInterrupt):
        analyse_study(folder, workers=1, nonlinear=["RT"], show_progress=False)
    analyse_study(folder, workers=1, nonlinear=["RT"], show_progress=False)
    first, last = (("S01-nonlinear-RT-200.checkpoint.gz", False), ("S02-nonlinear-RT-20.checkpoint.gz", False))
    assert found[2] == first
    assert found[4] == (found[3][0], True)  # what was found before is not searched again
    assert found[-1] == last
    assert len(found) == 7
    assert not list(folder.rglob("*.checkpoint.gz"))


def analysed(folder, nonlinear=()):
    return analyse_study(folder, workers=1, nonlinear=nonlinear, show_progress=False)


def unused(folder, name, reason):
    return (
        f"the nonlinear fit analysis/{name}.json.gz is not used: {reason}; "
        f"to make it anew: armperturb report {folder} --nonlinear RT"
    )


@pytest.fixture(scope="module")
def once_fitted(recorded, tmp_path_factory):
    root = shutil.copytree(recorded, tmp_path_factory.mktemp("fitted") / "study")
    with pytest.MonkeyPatch.context() as patch:
        invent_linear_analysis(patch)
        invent_nonlinear_fits(patch)
        analysed(root, ["RT"])
    return root


@pytest.fixture
def fitted_folder(once_fitted, tmp_path, monkeypatch):
    """A folder in which everybody is identified nonlinearly in RT."""
    invent_linear_analysis(monkeypatch)
    return shutil.copytree(once_fitted, tmp_path / "fitted")


FOLLOWS = "it follows from a fit that is not used"


def test_fits_outlive_changes_of_the_code_and_of_libraries(fitted_folder, asked, monkeypatch):
    monkeypatch.setattr(analyse, "current_versions", lambda: {"armperturb": "99", "scipy": "99"})
    again = analysed(fitted_folder)
    assert asked == []
    assert len(again.nonlinear) == 6
    assert not [line for line in again.missing if "nonlinear" in line]


def test_fits_of_an_earlier_version_are_named_and_made_anew_only_if_asked_for(fitted_folder, asked, monkeypatch):
    path = fitted_folder / "analysis" / "S01-nonlinear-RT.json.gz"
    before = path.read_bytes()
    monkeypatch.setitem(cache.VERSIONS, "nonlinear", cache.VERSIONS["nonlinear"] + 1)
    found = analysed(fitted_folder)
    assert (found.nonlinear, asked) == ((), [])
    then, now = cache.VERSIONS["nonlinear"] - 1, cache.VERSIONS["nonlinear"]
    for name in ("S01-nonlinear-RT", "S02-nonlinear-RT"):
        reason = f"it was made by version {then} of the algorithm, which is now at {now}"
        assert unused(fitted_folder, name, reason) in found.missing
        assert unused(fitted_folder, f"{name}-20", FOLLOWS) in found.missing
    assert len([line for line in found.missing if "nonlinear" in line]) == 6
    assert escape(unused(fitted_folder, "S01-nonlinear-RT-200", FOLLOWS)) in sketch(found, fitted_folder)
    assert path.read_bytes() == before
    assert analysed(fitted_folder, ["PT"]).missing[-6:] == found.missing[-6:]
    asked.clear()
    again = analysed(fitted_folder, ["RT"])
    assert len(asked) == len([fit for fit in again.nonlinear if fit.task == "RT"]) == 6
    assert not [line for line in again.missing if "nonlinear" in line]


@pytest.mark.parametrize(
    "content",
    [b"no archive", gzip.compress(b'{"key": "as written long ago", "value": 1}')],
    ids=["no archive", "another archive"],
)
def test_a_fit_that_cannot_be_read_is_named(fitted_folder, asked, content):
    (fitted_folder / "analysis" / "S02-nonlinear-RT-20.json.gz").write_bytes(content)
    found = analysed(fitted_folder)
    assert len(found.nonlinear) == 5
    [line] = [line for line in found.missing if "nonlinear" in line]
    assert line.startswith("the nonlinear fit analysis/S02-nonlinear-RT-20.json.gz is not used: it cannot be read (")
    assert line.endswith(f"to make it anew: armperturb report {fitted_folder} --nonlinear RT")
    assert (fitted_folder / "analysis" / "S02-nonlinear-RT-20.json.gz").read_bytes() == content
    analysed(fitted_folder, ["RT"])
    assert [(name, pulses) for name, _, pulses, _ in asked] == [("S02", (20.0,))]


def test_fits_to_a_recording_that_has_changed_or_gone_are_named(fitted_folder, asked):
    path = fitted_folder / "recordings" / "S01.nc"
    save_recording(load_recording(path).isel(trial=[0, 1]), path)
    found = analysed(fitted_folder)
    assert {fit.name for fit in found.nonlinear} == {"S02"}
    lines = [line for line in found.missing if "nonlinear" in line]
    assert lines == [
        unused(fitted_folder, "S01-nonlinear-RT-20", FOLLOWS),
        unused(fitted_folder, "S01-nonlinear-RT-200", FOLLOWS),
        unused(fitted_folder, "S01-nonlinear-RT", "the recording has changed since (S01.nc)"),
    ]
    path.unlink()
    lines = [line for line in analysed(fitted_folder).missing if "nonlinear" in line]
    assert lines[-1] == (
        "the nonlinear fit analysis/S01-nonlinear-RT.json.gz is not used: S01 has no whole recording; expected it in "
        "the folder, or the fit removed"
    )
    assert len(lines) == 3


def test_tasks_that_nobody_was_fitted_in_are_named():
    assert sections._nonlinear(invented(invented_fit()))["unasked"] == ["PT"]
    assert sections._nonlinear(invented(invented_fit(), invented_fit(task="PT")))["unasked"] == []


def test_the_command_asks_for_tasks(monkeypatch, tmp_path):
    given = {}
    monkeypatch.setattr(analyse, "analyse_study", lambda folder, **options: given.update(options))
    monkeypatch.setattr("armperturb.study.report.report.write_report", lambda *_, **__: tmp_path)
    cli.main(["report", str(tmp_path), "--nonlinear", "RT", "PT"])
    assert given["nonlinear"] == ("RT", "PT")
