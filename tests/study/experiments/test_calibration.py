"""The calibration of the average person: what it seeks, what it simulates, what it writes."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from armperturb.cohort import average_body, average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.files import read_toml
from armperturb.muscle_law import ELEMENTS
from armperturb.study.experiments import calibration as module
from armperturb.study.experiments.calibration import (
    Calibration,
    calibrate,
    poles,
    save_calibrations,
    schedules,
    simulated_cells,
    steady,
)
from armperturb.study.experiments.candidates import LAWS, Candidate, unknowns
from armperturb.study.recording.practice import linear_displacement
from armperturb.study.results.quantities import Cell, published_cells
from armperturb.study.results.uses import CALIBRATED, HELD_OUT
from armperturb.subject import TASKS


def typical(task, law="full"):
    return {unknown.name: unknown.start for unknown in unknowns(task, law)}


COARSE = 5e-3
"""A step [s] at which linear people are simulated in half the time, off by far less than 1 % in displacement."""


@pytest.fixture(scope="module")
def linear(once):
    """A linear candidate in RT, and its cells without noise."""

    candidate = Candidate.of("RT", typical("RT", "linear"))
    (cells,) = once("linear candidate", lambda _: simulated_cells([candidate], [3], noisy=False, timestep=COARSE))
    return candidate, cells


@pytest.fixture(scope="module")
def calibrations(linear):
    """As if found: the typical people, and cells that are published, but for one."""
    cells = {cell: value.mean for cell, value in published_cells().items()}
    cell = Cell("F.5", "RT0", "peak_rotation_min_s")
    cells[cell] += 1.5 * published_cells()[cell].sd
    return [
        Calibration(
            task=task,
            law="full",
            values=typical(task),
            candidate=Candidate.of(task, typical(task)),
            objective=1.0,
            converged=task == "RT",
            cells=cells,
        )
        for task in TASKS
    ]


def test_unknowns_become_the_person_they_describe():
    values = typical("PT")
    candidate = Candidate.of("PT", values)
    subject, law = candidate.subject, candidate.subject.muscle
    for quantity in ("k", "b", "kv", "kp"):
        expected = [values[f"{quantity}.{element}"] for element in ELEMENTS]
        assert subject.muscle_groups(quantity) == pytest.approx(expected)
    assert law.of_elements("short_range_stiffness") == pytest.approx(
        [values[f"short_range_stiffness.{element}"] for element in ELEMENTS]
    )
    assert law.of_elements("elastic_limit_deg") == (values["elastic_limit_deg"],) * 3
    assert law.of_elements("spindle_saturation") == (values["spindle_saturation"],) * 3
    assert candidate.levels == {name: values[f"level.{name}"] for name in ("PT0", "PT2.5", "PT22.5")}
    assert {name: getattr(subject, name) for name in average_body()} == average_body()
    # The condition's level reaches the person who is perturbed.
    level = {c.name: c.subject_of(candidate.person).k_s / subject.k_s for p in schedules("PT") for c in p.conditions}
    assert level == pytest.approx({**candidate.levels, "PT7.5": 1.0})


@pytest.mark.parametrize("task", TASKS)
def test_laws_leave_out_what_they_lack(task):
    assert Candidate.of(task, typical(task, "linear")).subject.muscle is None
    short_range = Candidate.of(task, typical(task, "short-range")).subject.muscle
    assert min(short_range.of_elements("short_range_stiffness")) > 0
    for off in ("loss_angle_deg", "thinning_velocity", "spindle_saturation"):
        assert short_range.of_elements(off) == (np.inf,) * 3
    counts = [len(unknowns(task, law)) for law in LAWS]
    assert counts == sorted(counts)
    assert len(set(counts)) == 3


@pytest.mark.parametrize("task", TASKS)
def test_search_starts_with_stable_people(task):
    for law in LAWS:
        assert poles(Candidate.of(task, typical(task, law)), Environment()).max() < 0


@pytest.mark.slow(reason="simulates candidates")
def test_the_noise_of_a_calibration_is_the_one_asked_for(monkeypatch):
    seen = []

    def measured(trials, environment, **options):
        seen.extend(trial.noise for of_person in trials for trial in of_person)
        return [{} for _ in trials]

    monkeypatch.setattr(module, "cells_of_trials", measured)
    candidate = Candidate.of("RT", typical("RT", "linear"))
    for options, expected in (
        ({"noisy": False}, None),
        ({}, steady(HUMAN_NOISE["RT"])),
        (
            {"noise": replace(HUMAN_NOISE["RT"], remnant_cutoff=20.0)},
            replace(steady(HUMAN_NOISE["RT"]), remnant_cutoff=20.0),
        ),
    ):
        seen.clear()
        assert simulated_cells([candidate], [3], **options) == [None]
        assert set(seen) == {expected}
    assert steady(HUMAN_NOISE["RT"]).spread_k == 0.0 < HUMAN_NOISE["RT"].spread_k


def test_linear_person_moves_as_theory_says(linear):
    candidate, cells = linear
    protocol = schedules("RT")[0]
    trials = protocol.trials(candidate.person, protocol.given_forces(), 3, 0, noisy=False)
    for condition in ("RT2.5", "RT7.5"):
        theory = [
            linear_displacement(candidate.subject, Environment(), trial.perturbation.multisine)
            for trial in trials
            if trial.condition == condition
        ]
        assert len(theory) == 4
        # Theory has no geometry: some percent where joints turn by degrees.
        rms = np.sqrt(np.mean(np.square(theory)))
        assert cells[Cell("2.1", condition, "rms_displacement")] == pytest.approx(rms, rel=0.03)
    for condition, force in (("RT2.5", 0.6), ("RT7.5", 0.9), ("RT22.5", 1.8)):
        assert cells[Cell("2.1", condition, "rms_force")] == pytest.approx(force, rel=1e-6)


def test_candidates_are_the_same_alone_and_together(linear):
    candidate, cells = linear
    other = Candidate.of("RT", {**typical("RT", "linear"), "k.shoulder": 6.0})
    together = simulated_cells([other, candidate], [3], noisy=False, timestep=COARSE)
    assert together[1] == cells
    assert together[0] != cells


def test_noise_moves_people_further(linear):
    candidate, silent = linear
    (noisy,) = simulated_cells([candidate], [3], timestep=COARSE)
    for condition in ("RT2.5", "RT7.5", "RT22.5"):
        cell = Cell("F.2", condition, "rms_velocity_e")
        assert 1.0 < noisy[cell] / silent[cell] < 1.5


def test_unstable_candidates_have_no_cells():
    wild = {**typical("PT", "linear"), "kv.shoulder": 60.0, "kv.elbow": 60.0}
    assert simulated_cells([Candidate.of("PT", wild)], [3]) == [None]


def test_search_finds_the_person_behind_the_cells(monkeypatch):
    """With cells that are known functions of the unknowns, and published ones that a known person has."""
    cells = [cell for cell in published_cells() if cell.condition.startswith("RT") and cell.quantity != "rms_force"]
    sought = unknowns("RT", "linear")
    mixing = np.random.default_rng(0).normal(size=(len(cells), len(sought)))
    hidden = {
        u.name: u.typical * u.factor**step for u, step in zip(sought, (0.5, -0.4, 0.3, -0.5, 0.2, 0.6), strict=True)
    }

    def known(candidates, seeds, **_):
        answers = []
        for candidate in candidates:
            groups = [*candidate.subject.muscle_groups("k"), *candidate.subject.muscle_groups("b")]
            values = mixing @ np.log(groups)
            answers.append(dict(zip(cells, np.expm1(0.1 * values).tolist(), strict=True)))
        return answers

    (truth,) = known([Candidate.of("RT", hidden)], [0])
    precise = {
        cell: value._replace(mean=truth.get(cell, value.mean), sd=1e-4) for cell, value in published_cells().items()
    }
    monkeypatch.setattr(module, "simulated_cells", known)
    monkeypatch.setattr(module, "published_cells", lambda: precise)
    found = calibrate("RT", "linear")
    assert found.values == pytest.approx(hidden, rel=0.01)
    assert max(map(abs, found.deviations(CALIBRATED).values())) < 1.0


def test_agreement_counts_cells(calibrations):
    rows = {(row["task"], row["cells"]): row for found in calibrations for row in found.agreement()}
    assert rows["RT", "calibrated"]["within_0.5_sd"] == 1.0
    assert rows["RT", "held out"]["n"] == 16
    assert rows["RT", "held out"]["within_1_sd"] == pytest.approx(15 / 16)
    assert rows["RT", "held out"]["within_2_sd"] == 1.0
    assert rows["RT", "held out"]["rms_deviation"] == pytest.approx(1.5 / 4)
    assert rows["PT", "calibrated"]["n"] + rows["RT", "calibrated"]["n"] == 84


def test_it_describes_itself(calibrations):
    (relaxed,) = (found for found in calibrations if found.task == "RT")
    said = repr(relaxed).splitlines()
    assert len(said) <= 25
    assert said[0] == "Average person in RT, full law: 14 unknowns, objective 1"
    assert said[2].startswith("16 cells held out: 94% within 0.5, 94% within 1, 100% within 2 SD; RMS 0.37")
    frame = relaxed.to_frame().set_index(["table", "condition", "quantity"])
    assert frame["z"].drop(("F.5", "RT0", "peak_rotation_min_s")).abs().max() < 1e-9
    assert frame.loc[("F.5", "RT0", "peak_rotation_min_s"), "z"] == pytest.approx(1.5)
    axes = relaxed.plot()
    assert [text.get_text() for text in axes.get_yticklabels()] == list(dict.fromkeys(relaxed.to_frame()["table"]))


def test_person_is_written_and_read_back(calibrations, tmp_path, monkeypatch):
    path = tmp_path / "average_person.toml"
    save_calibrations(path, calibrations)
    monkeypatch.setattr("armperturb.cohort.packaged_table", lambda _, name: read_toml(tmp_path / name, ""))
    person = average_person.__wrapped__()
    for found in calibrations:
        expected = replace(found.candidate.subject, name="average")
        assert person.subjects[found.task].to_dict()["k_s"] == pytest.approx(expected.k_s, rel=1e-6)
        assert person.subjects[found.task].to_dict().keys() == expected.to_dict().keys()
    assert person.levels == calibrations[TASKS.index("PT")].candidate.levels
    written = tomllib.loads(path.read_text())
    assert {(row["table"], row["calibrated"]) for row in written["cells"]} == {
        *((table, True) for table in CALIBRATED),
        *((table, False) for table in HELD_OUT),
    }
    with pytest.raises(ValueError, match="none of the full law in RT"):
        save_calibrations(path, calibrations[:1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("XT",), "task = 'XT'; expected one of PT, RT"),
        (("RT", "hill"), "law = 'hill'; expected one of linear, short-range, full"),
    ],
)
def test_what_is_unknown_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        calibrate(*arguments)


def test_numbers_out_of_range_are_refused():
    with pytest.raises(ValueError, match="n_multisines = 0; expected"):
        calibrate("RT", n_multisines=0)
    with pytest.raises(ValueError, match=r"max_iterations = 10{30}; expected"):
        calibrate("RT", max_iterations=10**30)
    with pytest.raises(ValueError, match="seed = -1; expected"):
        calibrate("RT", seed=-1)
    with pytest.raises(ValueError, match="engine = 'bullet'; expected one of mujoco, compiled"):
        calibrate("RT", engine="bullet")


def test_shipped_person_is_what_was_calibrated():
    person = average_person()
    assert set(person.subjects) == set(TASKS)
    assert all(subject.muscle is not None for subject in person.subjects.values())
    assert all(name.startswith("PT") for name in person.levels)


def test_a_search_that_used_up_its_steps_says_so(calibrations):
    said = {each.task: " ".join(each.describe().remarks) for each in calibrations}
    assert "used up its steps before a minimum" in said["PT"]
    assert said["RT"] == ""
