"""Trials and films of pulses that the report plays."""

import base64
from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.recording_files import load_recording
from armperturb.study.report import films
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.played import played_data, played_person
from tests.studies import plain_film, plain_picture, sketch


@pytest.fixture(scope="module")
def person(study):
    first = study.people[0]
    return played_person(first.name, study.recordings[first.name], ["PT0", "PT7.5", "RT7.5"], first.estimates)


def test_the_first_trial_of_each_pulse_is_played(study, person):
    assert [(trial.condition, trial.level, trial.direction_deg) for trial in person.trials] == [
        ("PT0", 1.0, 20.0),
        ("PT7.5", 1.0, 20.0),
        ("PT7.5", 2.0, 20.0),
    ]  # fmt: skip; of RT7.5 the window after the pulse was not recorded
    recording = load_recording(study.recordings[person.name])
    assert (person.l_h, person.l_f) == (recording["l_h"].values[0], recording["l_f"].values[0])
    for trial, window in zip(person.trials, (0.3, 0.3, 0.3), strict=True):
        assert trial.rate == 100.0
        mine = recording.isel(trial=np.flatnonzero(recording["condition"].values == trial.condition)[trial.trial])
        assert (mine["pulse_level"], mine["pulse_direction"]) == (trial.level, trial.direction_deg)
        onset = round(float(mine["pulse_onset"]) * 200.0)
        shown = slice(onset - 2 * trial.lead, onset + round(200.0 * window) + 1, 2)
        np.testing.assert_array_equal(trial.recorded, mine["displacement"].values[shown])
        np.testing.assert_array_equal(trial.force, mine["perturbation"].values[shown])
        along = trial.force[trial.lead + 4]  # half of the 80 ms
        assert np.degrees(np.arctan2(along[1], along[0])) == pytest.approx(20.0, abs=2.0)


def test_predictions_are_of_the_trials_own_fit(study, person):
    rest, first, *_ = person.trials
    assert rest.predicted.shape == (0, 2)  # no multisine, no fit
    estimate = study.people[0].estimates["PT7.5"]
    recording = load_recording(study.recordings[person.name])
    mine = recording.isel(trial=np.flatnonzero(recording["condition"].values == "PT7.5"))
    driven = mine["perturbation"].values[first.trial]
    arm = estimate.fits[first.trial].arm
    path = simulate_linear(arm, estimate.environment, driven, float(recording.attrs["rate"])).displacement
    start = round(float(mine["pulse_onset"].values[first.trial]) * recording.attrs["rate"])
    assert first.predicted[first.lead :] == pytest.approx(path[start : start + 61 : 2])


def test_pages_hold_whole_numbers(person):
    (written,) = played_data([person])
    trial = written["trials"][1]
    assert pytest.approx(person.trials[1].recorded, abs=0.51e-4) == np.array(trial["recorded"]).T * 1e-4
    assert pytest.approx(person.trials[1].force, abs=0.051) == np.array(trial["force"]).T * 0.1
    assert written["trials"][0]["predicted"] == [[], []]
    assert played_data([person._replace(trials=())]) == []


def test_arms_that_nobody_measured_are_not_drawn(study, tmp_path, monkeypatch):
    recording = load_recording(study.recordings["S01"])
    unknown = recording.assign_coords(l_h=recording["l_h"] * np.nan)
    monkeypatch.setattr("armperturb.study.report.played.load_trials", lambda *_: unknown)
    assert played_person("S01", tmp_path, ["PT0"], {}).trials == ()


def test_films_are_small_and_of_each_task(thesis_report):
    page = (thesis_report / "report.html").read_text(encoding="utf-8")
    for task in ("PT", "RT"):
        content = page.split(f'id="film-{task}"')[1].split('src="data:video/mp4;base64,')[1].split('"')[0]
        assert b"ftyp" in base64.b64decode(content)[:16]
    assert "The same as stills" in page


@pytest.mark.parametrize("error", [ModuleNotFoundError("film: install the extra"), RuntimeError("no <OpenGL> context")])
def test_stills_take_the_place_of_films(study, tmp_path, monkeypatch, error):
    def write_video(*_):
        raise error

    monkeypatch.setattr(rig_figures, "render", plain_picture)
    monkeypatch.setattr(films, "write_video", write_video)
    page = sketch(replace(study, people=()), tmp_path, ("stills",))
    assert "<video" not in page
    assert "No films: " in page
    assert 'id="figure-stills"' in page


def test_a_film_that_is_too_large_is_left_out(study, tmp_path, monkeypatch):
    monkeypatch.setattr(rig_figures, "render", plain_picture)
    monkeypatch.setattr(films, "write_video", plain_film)
    monkeypatch.setattr(films, "MOST_BYTES", 100)
    assert "<video" not in sketch(replace(study, people=()), tmp_path, ("stills",))
