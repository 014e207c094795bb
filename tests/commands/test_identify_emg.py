"""`identify --emg`: what EMG adds to a fit, and what is said where it cannot be used."""

import json
from dataclasses import replace

import numpy as np
import one_joint
import pandas as pd
import pytest
from test_cli import refused, run

from armperturb.analysis.emg.envelope import envelopes, remark_on_duration
from armperturb.commands.identify import Identify
from armperturb.commands.selection import select_trials, with_emg_files
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.joined_recordings import of_one_length
from armperturb.recording_files import save_recording
from armperturb.subject import POSITION

MODEL = ("--model", "3", "--estimator", "frequency")


@pytest.fixture(scope="module")
def recording(studies):
    # What people vary from trial to trial is in errors with EMG and without, and hides what EMG adds.
    noise = replace(HUMAN_NOISE["PT"], spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)
    return run_experiment(studies.perturbed(POSITION, 5.4, 3, noise=noise), instruments=Instruments(marker_noise=None))


@pytest.fixture(scope="module")
def path(recording, tmp_path_factory):
    path = tmp_path_factory.mktemp("emg") / "person.nc"
    save_recording(recording, path)
    return path


@pytest.fixture(scope="module")
def trial(recording):
    """The first trial until its multisine has repeated once after the transient, and no pulse has come."""
    without_pulse = {"pulse_level": 0.0, "pulse_direction": np.nan, "pulse_onset": np.nan}
    cut = recording.isel(trial=[0], time=slice(5800), emg_time=slice(58_000))
    return cut.assign_coords({name: ("trial", [value]) for name, value in without_pulse.items()})


def table(folder):
    return pd.read_csv(folder / "parameters.csv").set_index("parameter")


@pytest.mark.slow(reason="simulates three trials with EMG")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_reflexes_become_better_known(path, tmp_path, capsys):
    for name, options in (("moved", ()), ("active", ("--emg",))):
        assert run("identify", path, *MODEL, *options, "--out", tmp_path / name) == 0
    assert "EMG is not used" not in capsys.readouterr().out
    moved, active = table(tmp_path / "moved"), table(tmp_path / "active")
    assert list(active.index) == list(moved.index)
    gained = active["standard_error"] / moved["standard_error"]
    assert (gained[["kp_s", "kp_se", "kp_e"]] < 0.5).all()
    # The common size of the gains is known from the movement alone, so that these gain less.
    assert (gained[["kv_s", "kv_se", "kv_e"]] < 0.85).all()
    assert (gained[["Td_s", "Td_e"]] < 0.85).all()
    for name in ("kv_s", "kv_e", "kp_s", "kp_e", "Td_s", "Td_e"):
        assert abs(active["value"][name] - getattr(POSITION, name)) < 4.0 * active["standard_error"][name], name


@pytest.mark.slow(reason="simulates three trials with EMG")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_without_emg_the_movement_is_identified_alone(trial, tmp_path, capsys):
    silent = trial.assign(emg=trial["emg"] * np.float32(0.0))
    silent["emg"].attrs = trial["emg"].attrs
    for name, changed, message in (
        ("none", trial.drop_dims("emg_time"), "EMG is missing: the recording has no variable 'emg'"),
        ("silent", silent, "EMG is not used: all channels are zero; expected voltages"),
        ("sound", trial, "EMG is not used: model 1 has no reflexes"),
    ):
        save_recording(changed, tmp_path / f"{name}.nc")
        asked = ("--model", "1", "--estimator", "frequency", "--emg", "--out", tmp_path / name)
        assert run("identify", tmp_path / f"{name}.nc", *asked) == 0
        said = capsys.readouterr().out
        assert message in said
        assert "the movement alone is used" in said
        assert (tmp_path / name / "parameters.csv").exists()


@pytest.mark.slow(reason="simulates three trials with EMG")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_text_tells_what_the_recording_does(text, tmp_path):
    for name in ("person.nc", "person.csv"):
        assert run("identify", text / name, "--model", "3", "--emg", "--out", tmp_path / f"of {name}") == 0
    ours, theirs = (table(tmp_path / f"of person{ending}")["value"] for ending in (".nc", ".csv"))
    assert with_emg_files([text / "person.csv"], None) == [text / f"person{end}.csv" for end in ("", "_emg")]
    assert with_emg_files([text / "person.nc"], None) == [text / "person.nc"]
    np.testing.assert_allclose(theirs, ours, rtol=1e-3)


@pytest.fixture(scope="module")
def text(trial, tmp_path_factory):
    """Six seconds of the trial, every other muscle, as a recording and as text, as a laboratory may have it."""
    folder = tmp_path_factory.mktemp("text")
    part = trial.isel(time=slice(1200), emg_time=slice(12_000), muscle=slice(None, None, 2))
    save_recording(part, folder / "person.nc")
    assert run("convert", folder / "person.nc", "--out", folder / "person.csv") == 0
    return folder


@pytest.mark.slow(reason="simulates three trials with EMG")
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"unit": None}, "signals.emg.unit is missing; expected the unit of the values"),
        ({"unit": "bananas"}, "signals.emg.unit = 'bananas'; expected a unit: V"),
        ({"rate": 1000.0}, "at emg_rate = 1000 Hz, the other signals"),
        ({"file": "none.csv"}, "none.csv: no such file"),
        ({"channels": {"gluteus": "biceps_short_head_V"}}, "of no muscle is it known what it does"),
    ],
)
def test_wrong_emg_does_not_keep_the_movement_from_being_identified(text, tmp_path, fields, message):
    for file in text.iterdir():
        (tmp_path / file.name).symlink_to(file)
    sidecar = tmp_path / "wrong.json"
    content = json.loads((text / "person.json").read_text())
    emg = content["signals"]["emg"] | fields
    content["signals"]["emg"] = {name: value for name, value in emg.items() if value is not None}
    sidecar.write_text(json.dumps(content))
    command = Identify(recordings=(tmp_path / "person.csv",), out=tmp_path / "o", sidecar=sidecar, emg=True)
    notes = []
    assert command._emg(notes) is None
    assert len(notes) == 1
    assert message in notes[0]
    assert notes[0].endswith("the movement alone is used")
    # What is not asked for is not looked at.
    recordings, _ = select_trials([tmp_path / "person.csv"], sidecar, None, None, single_condition=True)
    assert "emg" not in recordings[0]


@pytest.mark.slow(reason="fits a recording")
@pytest.mark.parametrize("model", [(), ("--model", "joint")])
def test_of_one_axis_the_movement_alone_is_used(tmp_path, capsys, model):
    save_recording(one_joint.recording(one_joint.person("ankle", 3, "none"), 3, duration=8.0), tmp_path / "ankle.nc")
    assert run("identify", tmp_path / "ankle.nc", *model, "--reflex", "none", "--emg", "--out", tmp_path / "o") == 0
    assert "EMG is not used: the joint model" in capsys.readouterr().out
    assert "EMG is not used: the joint model" in (tmp_path / "o" / "identify.html").read_text()


@pytest.mark.slow(reason="simulates three trials with EMG")
def test_a_contraction_of_its_own_length_is_the_reference(recording, tmp_path):
    held = recording.isel(trial=[0], time=slice(1000), emg_time=slice(10_000)).copy()
    held["emg"] = held["emg"] * np.float32(3.0)
    without_pulse = {"condition": "MVC", "pulse_level": 0.0, "pulse_direction": np.nan, "pulse_onset": np.nan}
    held = held.assign_coords({name: ("trial", [value]) for name, value in without_pulse.items()})
    movement = recording.isel(trial=[1], time=slice(5800), emg_time=slice(58_000))
    for name, part in (("moved", movement), ("held", held)):
        save_recording(part, tmp_path / f"{name}.nc")
    files = tuple(tmp_path / f"{name}.nc" for name in ("moved", "held"))
    notes = []
    result = Identify(recordings=files, out=tmp_path / "o", emg=True)._emg(notes)
    assert result is not None, notes
    assert result.envelopes.is_normalised
    expected = envelopes(held).reference_volts
    np.testing.assert_allclose(result.envelopes.reference_volts, expected, rtol=0.05)
    longer = of_one_length([held.assign_coords(condition=("trial", ["PT"])), movement], ("PT7.5",))
    assert [part.sizes["time"] for part in longer] == [1000] * 7
    np.testing.assert_array_equal(longer[-1]["emg"][:, 8_000:], movement["emg"][:, :-2001:-1])


@pytest.mark.slow(reason="simulates three trials with EMG")
def test_emg_that_ends_early_is_said_to(recording):
    assert remark_on_duration(recording) is None
    shorter = recording.isel(emg_time=slice(None, -100))
    assert "EMG lasts 0.05 s less than the other signals" in remark_on_duration(shorter)


@pytest.mark.slow(reason="simulates three trials with EMG")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ("--model", "4", "--emg"),
            "EMG with model 4, which has force feedback; expected one without (e.g. --model 3)",
        ),
        (
            ("--model", "3", "--estimator", "thesis", "--emg"),
            "EMG with estimator = 'thesis'; expected --estimator record",
        ),
        (("--model", "3", "--emg-delay", "0.01", "0.002"), "without EMG; expected it with --emg only"),
        (("--model", "3", "--emg", "--emg-delay", "0.3", "0"), "electromechanical delay: mean = 0.3; expected"),
        (
            ("--model", "nonlinear", "--emg", "--emg-delay", "0.01", "0.002"),
            "expected a known one (--emg-delay 0.01 0)",
        ),
        (("--model", "nonlinear", "--emg", "--law", "half-wave"), "law = 'half-wave' with EMG; expected full"),
    ],
)
def test_what_cannot_be_is_refused(text, tmp_path, capsys, options, message):
    assert message in refused(capsys, "identify", text / "person.nc", *options, "--out", tmp_path / "r")
