"""Protocol, runner and tables of the study."""

import csv

import numpy as np
import pytest

from armperturb.envs.experiment import Trial, run_experiment
from armperturb.perturbations import Pulse
from armperturb.recording import load_recording
from armperturb.study import published
from armperturb.study.protocol import CONDITIONS, PULSE_UNIT, draw_multisines, trials_of
from armperturb.study.runner import StudySettings, _identify, run_study
from armperturb.study.tables import condition_rows, parameter_rows, parameter_summary_rows, write_tables
from armperturb.subject import POSITION, RELAX


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return run_study(StudySettings(subjects=1, seed=3), tmp_path_factory.mktemp("study"), show_progress=False)


def test_conditions_are_those_of_table_2_1():
    for condition in CONDITIONS:
        assert condition.rms_force == published.applied_force(condition.name).mean
    assert {condition.name: condition.n_trials() for condition in CONDITIONS} == {"PT7.5": 8, "RT7.5": 4}


def test_every_trial_has_its_own_disturbance_and_pulse():
    condition = CONDITIONS[0]
    multisines = draw_multisines(condition, seed=1)
    trials = trials_of(condition, POSITION, multisines, seed=1)
    assert len({multisine.phases.tobytes() for multisine in multisines}) == 8
    pulses = {(trial.perturbation.pulse.peak, trial.perturbation.pulse.direction_deg) for trial in trials}
    assert pulses == {(level * PULSE_UNIT, direction) for level in (1, 2) for direction in (20.0, 200.0)}
    assert len({trial.seed for trial in trials}) == 8
    assert all(trial.perturbation.pulse.onset == 32.0 for trial in trials)


def test_study_recovers_its_people(study):
    rows = {(row["condition"], row["parameter"]): row for row in parameter_rows(study)}
    for (condition, name), row in rows.items():
        if name[0] in "bk" and not name.startswith("kp"):
            # Estimates from averages over clusters, with instrument noise; the humerus' mass moves them in RT.
            limit = 25 if condition == "RT7.5" else 10
            assert abs(row["error_percent"]) < limit, (condition, name)
    assert all(case.identification.fit.stable for case in study.cases)


def test_same_seed_gives_the_same_recording(study, tmp_path):
    again = run_study(StudySettings(subjects=1, seed=3), tmp_path, show_progress=False)
    first, second = (load_recording(result.cases[0].recording) for result in (study, again))
    assert first.identical(second)


def test_tables_hold_published_true_and_estimated(study, tmp_path):
    write_tables(study, tmp_path)
    with (tmp_path / "parameters_summary.csv").open() as file:
        rows = {(row["condition"], row["parameter"]): row for row in csv.DictReader(file)}
    assert len(rows) == 23
    assert float(rows["PT7.5", "k_s"]["published_mean"]) == 161.4
    assert float(rows["RT7.5", "k_h"]["published_mean"]) == 8200.0
    assert len(parameter_summary_rows(parameter_rows(study))) == 23
    for row in condition_rows(study):
        assert row["force_N_mean"] == pytest.approx(row["published_force_N_mean"], rel=1e-6)
        assert 0.4 < row["displacement_m_mean"] / row["published_displacement_m_mean"] < 2.5


def test_trials_at_the_workspace_limit_are_left_out_by_name(tmp_path):
    condition = CONDITIONS[1]
    hard = Pulse(peak=600.0, direction_deg=20.0, onset=0.1, duration=1.0)
    recording = run_experiment([Trial(subject=RELAX, perturbation=hard, condition=condition.name)])
    case = _identify(condition, RELAX, recording, tmp_path / "r.nc")
    assert case.identification is None
    assert case.left_out[0].startswith("trial 0 of relax in RT7.5 reached the workspace limit at 0.")
    assert np.isfinite(recording["limit_time"].values).all()
