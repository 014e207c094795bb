"""What an analysis takes: checked recordings of one person in one condition, and nothing else."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

import armperturb as ap
from armperturb.analysis.fit.structures import STRUCTURES
from armperturb.analysis.nonlinear import identify as nonlinear
from armperturb.analysis.trials import ConditionTrials
from armperturb.convert.importer import Imported

N_TIME = 40
A_DATASET = r"expected a Dataset as load_recording or import_recording\(...\).recording give it"


class Pair(NamedTuple):
    """Two things that belong together, as what an import gives."""

    recording: object
    notes: tuple


def made(**labels):
    """Two trials of one person in one condition, but for some labels."""
    signals = {name: np.random.default_rng(0).normal(size=(2, N_TIME, 2)) for name in ("force", "displacement")}
    same = {"subject": "Ann", "task": "PT", "condition": "PT7.5", "repetition": 0, "pulse_level": 0.0}
    same |= {"pulse_direction": np.nan, "pulse_onset": np.nan, "limit_time": np.nan}
    same |= {"l_h": 0.3, "l_f": 0.3, "theta_s_deg": 20.0, "theta_e_deg": 80.0}
    trials = {name: labels.get(name, [value] * 2) for name, value in same.items()}
    return ap.make_recording(signals | {"perturbation": signals["force"]}, trials, 200.0)


ONE_CONDITION = (ap.response, ap.best_linear, ap.compare, ap.identify)
ANY = (*ONE_CONDITION, ap.identify_conditions, ap.stack_trials)


@pytest.mark.parametrize("analyse", ONE_CONDITION, ids=lambda function: function.__name__)
@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("subject", ["Ann", "Bob"], r"\(Ann, Bob\); expected .* \(choose a --subject;.*"),
        ("task", ["PT", "RT"], r"\(PT, RT\); expected .* \(choose a --condition;.*"),
        ("condition", ["PT7.5", "PT22.5"], r"\(PT7.5, PT22.5\); expected .* \(choose a --condition;.*"),
        ("theta_e_deg", [80.0, 95.0], r"\(80.0, 95.0\); expected .* posture$"),
    ],
)
def test_trials_that_differ_are_not_pooled(analyse, name, values, message):
    recording = made(**{name: values})
    for given in (recording, [recording.isel(trial=[0]), recording.isel(trial=[1])]):
        with pytest.raises(ValueError, match=f"recording: {name} has several values {message}"):
            analyse(given)


def test_a_posture_that_is_unknown_is_one_value():
    for unknown in ([np.nan, np.nan], [np.nan, 0.3]):
        recording = made(l_h=unknown)
        with pytest.raises(ValueError, match="trial") as refused:
            ap.response(recording)
        assert "several values" not in str(refused.value)
        with pytest.raises(ValueError, match="l_h is unknown"):
            ConditionTrials.prepare(recording).body  # noqa: B018


@pytest.mark.parametrize("analyse", ANY, ids=lambda function: function.__name__)
def test_what_is_no_recording_is_named(analyse):
    recording = made()
    for given, named in (
        (None, "recordings = None"),
        ("rec.nc", "recordings = 'rec.nc'"),
        (Imported(recording, ()), r"recordings = Imported\(recording=<xarray.Dataset>"),
        (recording["force"], "recording = <xarray.DataArray 'force'"),
        ([recording, None], "recording = None"),
    ):
        with pytest.raises(TypeError, match=f"^{named}.*; {A_DATASET}$"):
            analyse(given)
    with pytest.raises(ValueError, match=r"^recordings is empty; expected at least one$"):
        analyse([])


@pytest.mark.parametrize("analyse", ANY, ids=lambda function: function.__name__)
def test_datasets_that_are_no_recording_are_refused(analyse):
    recording = made()
    for given, message in (
        (recording.drop_vars("task"), "coordinate 'task' along trial is missing"),
        (recording.drop_vars("subject"), "coordinate 'subject' along trial is missing"),
        (recording.isel(trial=[]), "there are no trials"),
        (recording.isel(trial=0), r"there are no trials; .* 'trial' \(recording\.isel\(trial=\[0\]\) keeps it\)$"),
    ):
        with pytest.raises(ValueError, match=message):
            analyse(given)


def test_files_and_nonlinear_fits_take_recordings_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(nonlinear, "load_compiled_arm", lambda: None)
    for write in (ap.identify_nonlinear, ap.identify_joint, ap.envelopes, lambda it: ap.identify_varying(it, "time"),
                  lambda it: ap.save_recording(it, tmp_path / "a.nc"),
                  lambda it: ap.export_recording(it, tmp_path / "a.csv")):  # fmt: skip
        with pytest.raises(TypeError, match=f"recording = None; {A_DATASET}"):
            write(None)
    for threads, message in ((-1, "threads = -1; expected .* at least 1"), (1.5, "threads = 1.5; expected a whole")):
        with pytest.raises((TypeError, ValueError), match=message):
            ap.identify_nonlinear(made(), threads=threads)
    with pytest.raises(ValueError, match="law = 'choose' with parts = 32; expected a law"):
        ap.identify_nonlinear(made(), "choose", parts=32)
    assert not list(tmp_path.iterdir())


def test_what_conditions_hold_is_checked():
    with pytest.raises(TypeError, match=f"recordings = 'PT'; {A_DATASET}"):
        ap.identify_conditions({"PT7.5": "PT"})
    with pytest.raises(ValueError, match=r"trials of 'relaxed' are of condition '.+'; expected that as their key"):
        ap.identify_conditions({"relaxed": [made()]})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window_start": np.nan}, "window_start = nan; expected a finite number at least 0"),
        ({"window_start": -1.0}, r"window_start = -1.0; expected a finite number at least 0"),
        ({"estimator": "frequency", "lines_per_average": 2.5}, "lines_per_average = 2.5; expected a whole number"),
        ({"lines_per_average": 0}, "lines_per_average = 0; expected a finite number at least 1"),
    ],
)
def test_options_of_identify_are_refused_by_name(options, message):
    with pytest.raises((TypeError, ValueError), match=f"identify: {message}"):
        ap.identify(made(), "1", **options)


def test_trials_are_stacked_if_they_are_alike():
    recording = made()
    assert ap.stack_trials([recording, recording]).sizes["trial"] == 4
    faster = recording.assign_coords(time=recording["time"] / 2).assign_attrs(rate=400.0)
    short = recording.isel(time=slice(20))
    extra = recording.assign(joint_angle=(("trial", "time", "joint"), np.zeros((2, N_TIME, 2)), {"units": "rad"}))
    extra = extra.assign_coords(joint=["shoulder", "elbow"])
    for other, message in (
        (faster, r"trials of 0\.2 s at 200 Hz and 0\.1 s at 400 Hz; expected one rate and duration"),
        (short, r"trials of 0\.1 s at 200 Hz and 0\.2 s at 200 Hz; expected one rate and duration"),
        (extra, r"joint_angle \(40, 2\), .*; expected the same signals in all"),
    ):
        with pytest.raises(ValueError, match=f"recordings: .*{message}"):
            ap.stack_trials([recording, other])


def test_variance_is_accounted_for_in_the_same_trials():
    x = np.random.default_rng(0).normal(size=(3, 40, 2))
    for recorded, predicted, options, message in (
        (x, x[:1], {}, r"recorded has shape \(3, 40, 2\), predicted \(1, 40, 2\); expected the same"),
        (x, x[0], {}, r".*predicted \(40, 2\); expected the same"),
        (x[0, 0], x[0, 0], {}, r"recorded has shape \(2,\)"),
        (x[:, :12], x[:, :12], {}, "12 samples; expected at least 13"),
        (x, x, {"highpass": 100.0}, "highpass = 100.0; expected .* below 100"),
    ):
        with pytest.raises(ValueError, match=f"variance_accounted_for: {message}"):
            ap.variance_accounted_for(recorded, predicted, 200.0, **options)
    np.testing.assert_allclose(ap.variance_accounted_for(x[:, :13], x[:, :13], 200.0), 100.0)


def test_an_unknown_parameter_has_no_interval():
    fit = SimpleNamespace(values={"k_s": 1.0, "k_e": 2.0})
    for of in (ap.identify.__globals__["ArmFit"], nonlinear.NonlinearEstimate):
        with pytest.raises(ValueError, match="interval: name = 'zz'; expected one of k_s, k_e"):
            of.interval(fit, "zz")


def test_a_structure_has_a_text_for_a_name():
    with pytest.raises(TypeError, match="Structure: name = 3; expected a text"):
        STRUCTURES["3"].named(3)
