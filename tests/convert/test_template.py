"""Sidecars that are written from names and numbers: what they guess, what they leave open, and that they work."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from laboratory import MASS, N_TRIALS, RATE, as_text, handle, table
from scipy.io import savemat
from test_convert import in_matlab, truth, v73, write_c3d

from armperturb import cli
from armperturb.analysis.fit.identify import identify
from armperturb.convert.columns import axis_of, columns_of, dialect_of
from armperturb.convert.importer import import_recording
from armperturb.convert.template import write_sidecar
from armperturb.recording import REQUIRED_SIGNALS
from armperturb.subject import POSITION

DATA = Path(__file__).parents[2] / "examples" / "data"
D, F, X = slice(2, 4), slice(4, 6), slice(6, 8)

HEADERS = {
    "trial,t,Dx,Dy,Fx,Fy,X,Y": ("s", "N", "m"),
    "trial_number,time_ms,motor_x_mN,motor_y_mN,gauge_x,gauge_y,pos_x,pos_y": ("ms", "mN", "mm"),
    "run,time [s],x_perturbation [N],y_perturbation [N],F_x (N),F_y (N),HandleX (cm),HandleY (cm)": ("s", "N", "cm"),
    "Trial,timestamp,dist1,dist2,force1,force2,disp1,disp2": ("us", "N", "m"),
    "trial,time_s,d_x_N,d_y_N,f_x_N,f_y_N,x_x_m,x_y_m": ("s", "N", "m"),
}
SCALE = {"N": 1.0, "mN": 1e3, "m": 1.0, "mm": 1e3, "cm": 1e2, "s": 1.0, "ms": 1e3, "us": 1e6}


def as_laboratory(units, by_hand=False):
    values, (time, of_perturbation, length) = table(), units
    values[:, 1] *= SCALE[time]
    values[:, D] *= SCALE[of_perturbation]
    values[:, F] *= -1.0 if by_hand else 1.0
    values[:, X] *= SCALE[length]
    return values


def assert_is_the_laboratory(recording):
    assert recording.attrs["rate"] == RATE
    for name in REQUIRED_SIGNALS:
        np.testing.assert_allclose(recording[name].values, truth(name), atol=1e-9)


TIRING = pytest.mark.slow(reason="each reads a table three times")


@pytest.mark.slow(reason="guesses sidecars and converts")
def test_emg_is_proposed_and_what_is_not_used_is_named(tmp_path):
    volts = 1e-4 * np.random.default_rng(0).standard_normal((len(table()), 2))
    names = ["trial", "t", "Dx", "Dy", "Fx", "Fy", "X", "Y", "EMG BIC [mV]", "biceps_short_head", "temperature"]
    values = np.hstack([as_laboratory(("s", "N", "m")), 1e3 * volts, np.full((len(volts), 1), 21.5)])
    (tmp_path / "a.csv").write_text(as_text(values, names))
    written = write_sidecar(tmp_path / "a.csv")
    emg = json.loads(written.path.read_text())["signals"]["emg"]
    assert emg == {
        "channels": {"BIC": "EMG BIC [mV]", "biceps_short_head": "biceps_short_head"},
        "unit": "mV",
    }
    assert "channels that are not used: temperature" in written.notes
    assert any("in signals.emg.muscles belongs what these do: BIC" in note for note in written.notes)
    recording, _ = import_recording(tmp_path / "a.csv")
    np.testing.assert_allclose(recording["emg"].values.reshape(-1, 2), volts, rtol=1e-5)
    truths = {name: np.moveaxis(truth(name), 0, 1) for name in REQUIRED_SIGNALS}
    fast = 1e-4 * np.random.default_rng(0).standard_normal((6000, N_TRIALS, 5))
    savemat(tmp_path / "b.mat", {"rate": RATE, "emg": fast} | truths)
    written = write_sidecar(tmp_path / "b.mat")
    emg = json.loads(written.path.read_text())["signals"]["emg"]
    assert (emg["channels"]["5"], emg["unit"], emg["rate"]) == ("emg(time,trial,5)", "V", 1000.0)
    found = import_recording(tmp_path / "b.mat").recording["emg"].values
    np.testing.assert_allclose(found, fast.swapaxes(0, 1), rtol=1e-5)


@pytest.mark.slow(reason="guesses a sidecar and converts")
@pytest.mark.parametrize(
    ("header", "by_hand"),
    [
        pytest.param(header, by_hand, marks=() if number < 2 else TIRING)
        for number, (header, by_hand) in enumerate(zip(HEADERS, [False, True, False, True, True], strict=True))
    ],
)
def test_a_table_with_ordinary_names_works_as_it_is(tmp_path, header, by_hand):
    path = tmp_path / "S07_position.csv"
    path.write_text(as_text(as_laboratory(HEADERS[header], by_hand), header.split(",")))
    written = write_sidecar(path)
    assert written.path == tmp_path / "S07_position.json"
    recording, notes = import_recording([path])
    assert_is_the_laboratory(recording)
    assert recording["l_h"].values.tolist() == [POSITION.l_h] * N_TRIALS
    sidecar = json.loads(written.path.read_text())
    assert sidecar["signals"]["force"]["exerted_by"] == ("hand" if by_hand else "handle")
    assert f"move a mass of {MASS:g} kg" in written.notes[-1]
    # Every guess stands in the sidecar, in the notes, and in the note of whoever reads the file.
    guessed = sidecar["guessed"]
    assert {"axes", "labels.l_h", "labels.subject"} <= set(guessed)
    assert ("signals.displacement.unit" in guessed) == header.endswith(("pos_y", ",Y", "disp2"))
    for field, text in guessed.items():
        assert any(note.startswith(f"{field} = ") and note.endswith(text) for note in written.notes)
    assert f"guesses that nobody has confirmed: {', '.join(guessed)} (" in notes[-1]
    del sidecar["guessed"]
    written.path.write_text(json.dumps(sidecar))
    assert import_recording([path]).notes == ()


@pytest.mark.parametrize(
    ("words", "stem", "axis"),
    [
        (("fx", "1"), ("f", "1"), "x"),
        (("fy", "2"), ("f", "2"), "y"),
        (("force", "y", "1"), ("force", "1"), "y"),
        (("fz", "1"), ("fz",), "x"),
        (("mx", "1"), ("mx",), "x"),
        (("x", "1"), ("x",), "x"),
        (("force", "2"), ("force",), "y"),
        (("fx",), ("f",), "x"),
    ],
)
def test_a_letter_before_a_number_is_the_axis(words, stem, axis):
    assert axis_of(words) == (stem, axis)


def test_names_of_a_sensor_of_six_axes_are_read(tmp_path):
    values = table(1)[:1000]
    six = np.column_stack([values[:, F], values[:, 1:2] + 20.0, values[:, :3] / 9.0])
    path = tmp_path / "lab.csv"
    names = ["t", "motor_x", "motor_y", *(f"{name}1" for name in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")), "X", "Y"]
    path.write_text(as_text(np.column_stack([values[:, 1:4], six, values[:, X]]), names))
    signals = json.loads(write_sidecar(path).path.read_text())["signals"]
    channels = {name: [*signals[name]["channels"].values()] for name in signals}
    assert channels == {"perturbation": ["motor_x", "motor_y"], "force": ["Fx1", "Fy1"], "displacement": ["X", "Y"]}


@pytest.mark.slow(reason="converts several files")
def test_labels_in_columns_other_dialects_and_places_in_a_room(tmp_path):
    values = as_laboratory(("s", "N", "m")) + np.array([0, 0, 0, 0, 0, 0, 0.1, 0.4])
    lines = as_text(values, ["trial", "t", "Dx", "Dy", "Fx", "Fy", "X", "Y"], ";", ",").splitlines()
    lines[0] += ";participant;task;condition;pulse_onset_s"
    lines[1:] = [f"{line};P3;RT;{'A' if line[0] == '1' else 'B'};" for line in lines[1:]]
    path = tmp_path / "a.csv"
    path.write_text("A laboratory of arms\n\n" + "\n".join(lines) + "\n")
    written = write_sidecar(path, tmp_path / "side.json")
    sidecar = json.loads(written.path.read_text())
    assert sidecar["csv"] == {"delimiter": ";", "decimal": ",", "skip_lines": 2}
    assert sidecar["signals"]["displacement"]["start"] == "first"
    assert sidecar["labels"]["subject"] == "P3"
    assert sidecar["trials"] == {
        "1": {"condition": "A", "pulse_onset": None},
        "2": {"condition": "B", "pulse_onset": None},
    }
    assert not {"labels.subject", "labels.task"} & set(sidecar["guessed"])
    recording = import_recording([path], sidecar=written.path).recording
    assert recording["task"].values.tolist() == ["RT", "RT"]
    assert recording["condition"].values.tolist() == ["A", "B"]


@pytest.mark.slow(reason="guesses sidecars of several tables")
@pytest.mark.parametrize(
    ("above", "units"),
    [
        ("Experiment 12;;;;;;;\nSubject;31;;;;;;\n", ""),
        ("", ";ms;N;N;N;N;mm;mm\n"),
        ("Experiment 12;;;;;;;\n;;;;;;;\n", "[-];[ms];[N];[N];[N];[N];[mm];[mm]\n"),
        ("A laboratory; of arms\n", "number;ms;N;N;N;N;mm;mm\n"),
    ],
    ids=["titles of a spreadsheet", "units", "titles and units in brackets", "a title and units with a word"],
)
def test_titles_above_the_names_and_units_below_them(tmp_path, above, units):
    names = ["trial", "t", "motor_x", "motor_y", "gauge_x", "gauge_y", "pos_x", "pos_y"]
    values = as_laboratory(("ms", "N", "mm"))
    header, rest = as_text(values, names, ";", ",").split("\n", 1)
    path = tmp_path / "lab.csv"
    path.write_text(f"{above}{header}\n{units}{rest}")
    sidecar = json.loads(write_sidecar(path).path.read_text())
    assert sidecar["csv"] == {"delimiter": ";", "decimal": ",", "skip_lines": above.count("\n")}
    assert ("signals.displacement.unit" in sidecar["guessed"]) == (not units)
    assert_is_the_laboratory(import_recording([path]).recording)


@pytest.mark.slow(reason="converts several files")
def test_units_of_names_are_believed_before_those_below(tmp_path):
    names = ["trial", "t [s]", "motor_x", "motor_y", "gauge_x [N]", "gauge_y [N]", "pos_x_m", "pos_y_m"]
    header, rest = as_text(table(), names).split("\n", 1)
    path = tmp_path / "lab.csv"
    path.write_text(f"{header}\n,ms,N,N,mN,mN,mm,mm\n{rest}")
    sidecar = json.loads(write_sidecar(path).path.read_text())
    assert [sidecar["signals"][name]["unit"] for name in REQUIRED_SIGNALS] == ["N", "N", "m"]
    assert_is_the_laboratory(import_recording([path]).recording)


def test_what_cannot_be_guessed_is_left_open_and_named_when_the_file_is_read(tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text(as_text(table(), ["trial", "c1", "c2", "c3", "Fx", "Fy", "X", "Y"]))
    written = write_sidecar(path)
    assert "units and signs are unchecked" in written.notes[-1]
    assert written.notes[0].startswith('rate = "?" is left open: the sampling rate in Hz')
    with pytest.raises(
        ValueError, match=r"lab.json: rate = '\?' is left open; expected the sampling rate in Hz, .* 2 more"
    ):
        import_recording([path])
    sidecar = json.loads(written.path.read_text())
    sidecar["rate"] = RATE
    written.path.write_text(json.dumps(sidecar))
    message = (
        r"signals.perturbation.channels.x = '\?' is left open; expected the channel of disturbance force d .* "
        r"one of: c1, c2, c3 \("
    )
    with pytest.raises(ValueError, match=message):
        import_recording([path])
    sidecar["signals"]["perturbation"]["channels"] = {"x": "c2", "y": "c3"}
    written.path.write_text(json.dumps(sidecar))
    assert_is_the_laboratory(import_recording([path]).recording)


def test_a_device_that_imposes_movement_in_two_axes_is_said_to_be_unsupported(tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text(as_text(np.delete(table(), [2, 3], axis=1), ["trial", "t", "Fx", "Fy", "X", "Y"]))
    notes = write_sidecar(path).notes
    unsupported = (
        "a device that imposes movement in two axes is not supported; along one it is (servo: position, only x)"
    )
    assert f"no channels of a perturbation in x and y were recognised: {unsupported}, see docs/recordings.md" in notes
    with pytest.raises(ValueError, match=f"for which no column is left .{re.escape(unsupported)}"):
        import_recording([path])


@pytest.mark.slow(reason="converts several files")
def test_two_channels_of_each_signal_are_two_axes_whatever_their_names(tmp_path):
    path = tmp_path / "lab.csv"
    names = ["trial", "t", "cmd_lr", "cmd_fb", "load_lr", "load_fb", "pos_lr", "pos_fb"]
    path.write_text(as_text(as_laboratory(("s", "N", "mm")), names))
    written = write_sidecar(path)
    sidecar = json.loads(written.path.read_text())
    assert "servo" not in sidecar
    assert sidecar["signals"]["force"]["channels"] == {"x": "load_lr", "y": "load_fb"}
    assert {f"signals.{name}.channels" for name in REQUIRED_SIGNALS} <= {*sidecar["guessed"]}
    assert any("two channels that may hold it (cmd_lr and cmd_fb, " in note for note in written.notes)
    assert f"move a mass of {MASS:g} kg" in written.notes[-1]


@pytest.mark.slow(reason="converts several files")
def test_a_rate_that_is_given_closes_the_only_open_field(tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text(as_text(table()[:, [0, 2, 3, 4, 5, 6, 7]], ["trial", "Dx", "Dy", "Fx", "Fy", "X", "Y"]))
    write_sidecar(path, rate=RATE)
    assert_is_the_laboratory(import_recording([path]).recording)


@pytest.mark.slow(reason="converts several files")
def test_columns_of_one_name_and_those_of_none_are_not_used(tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("time,Fx,Fx,x,y\n0,1,2,3,4\n0.01,2,3,4,5\n0.02,2,3,4,5\n")
    with pytest.warns(
        UserWarning, match=r"columns 'Fx' come several times and are not used; .* \(rename all but one\)"
    ):
        assert [column.name for column in columns_of(table, dialect_of(table))] == ["time", "x", "y"]
    table.write_text("time,Fx,Fy,x,y,\n0,1,2,3,4,\n0.01,2,3,4,5,\n0.02,2,3,4,5,\n")
    assert [column.name for column in columns_of(table, dialect_of(table))] == ["time", "Fx", "Fy", "x", "y"]


def test_a_file_that_no_guess_explains_says_so(tmp_path):
    values = table()
    values[:, 4] = values[::-1, 4]
    path = tmp_path / "lab.csv"
    path.write_text(as_text(values))
    written = write_sidecar(path)
    assert "as guessed, " in written.notes[-1]
    assert "d - f does not move a mass" in written.notes[-1]
    assert "signals.force.exerted_by" in json.loads(written.path.read_text())["guessed"]


def test_existing_sidecars_are_never_overwritten_and_other_files_refused(tmp_path):
    path = tmp_path / "lab.csv"
    path.write_text(as_text(table()))
    path.with_suffix(".json").write_text("{}")
    with pytest.raises(FileExistsError, match=r"lab.json exists; expected a new file"):
        write_sidecar(path)
    assert path.with_suffix(".json").read_text() == "{}"
    for name, content, message in (
        ("a.xls", b"", "ending = '.xls'; expected one of .csv"),
        ("a.csv", b"", "no readable table"),
        ("b.csv", b"\xff\xfe\x00", "no readable text"),
        ("a.mat", b"", "no MATLAB file of v5 or later"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message):
            write_sidecar(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="no such file"):
        write_sidecar(tmp_path / "absent.csv")
    for rate in (np.nan, np.inf, 0.0, -1.0, 1e308):
        with pytest.raises(ValueError, match=r"rate = .*; expected a finite number at least 1 and at most 1e"):
            write_sidecar(path, tmp_path / "other.json", rate=rate)
    assert [file.name for file in tmp_path.glob("*.json")] == ["lab.json"]


@pytest.mark.slow(reason="three child processes for each file")
@pytest.mark.parametrize("form", ["structures", "time by trial", "v7.3"])
def test_matlab_files(tmp_path, form):
    path = tmp_path / "lab.mat"
    if form == "structures":
        content, _ = in_matlab(form)
        savemat(path, {**content, "fs": RATE})
    else:
        parts = np.stack(
            [np.concatenate(handle(trial), axis=1) for trial in range(2)], axis=1
        )  # (time, trial, channel)
        content = dict(zip(("Dx", "Dy", "Fx", "Fy", "Xx", "Xy"), np.moveaxis(parts, -1, 0), strict=True))
        if form == "v7.3":
            v73(path, content)
        else:
            savemat(path, {**content, "rate": RATE})
    write_sidecar(path, rate=RATE if form == "v7.3" else None)
    assert_is_the_laboratory(import_recording([path]).recording)


@pytest.mark.slow(reason="three child processes for each file")
@pytest.mark.parametrize("n_trials", [2, 3, 4])
@pytest.mark.parametrize("form", ["variables", "structure", "structure of each"])
def test_x_and_y_are_the_axes_of_trials_however_few(tmp_path, n_trials, form):
    parts = np.stack([np.concatenate(handle(trial % 2), axis=1) for trial in range(n_trials)], axis=1)
    content = dict(zip(("Dx", "Dy", "Fx", "Fy", "X", "Y"), np.moveaxis(parts, -1, 0), strict=True)) | {"fs": RATE}
    if form == "structure of each":
        names = {"pert": ("Dx", "Dy"), "force": ("Fx", "Fy"), "hand": ("X", "Y")}
        content = {each: {"x": content[x], "y": content[y]} for each, (x, y) in names.items()} | {"fs": RATE}
    savemat(tmp_path / "lab.mat", {"data": content} if form == "structure" else content)
    write_sidecar(tmp_path / "lab.mat")
    recording = import_recording([tmp_path / "lab.mat"]).recording
    assert recording.sizes["trial"] == n_trials
    for trial in range(n_trials):
        np.testing.assert_allclose(recording["displacement"].values[trial], handle(trial % 2)[2], atol=1e-12)


@pytest.mark.parametrize(
    ("rates", "rate"),
    [
        ({"fs": RATE, "filter": {"rate": 50.0}}, RATE),
        ({"filter": {"rate": 50.0}, "kin": {"fs": RATE}}, RATE),
        ({"emg": {"fs": 2000.0}, "kin": {"fs": RATE}}, RATE),
        ({"kin": {"fs": RATE}, "camera": {"fs": 50.0}}, "?"),
    ],
)
def test_a_rate_in_a_structure_is_taken_if_it_is_the_only_one(tmp_path, rates, rate):
    signals = dict(zip(("Dx", "Dy", "Fx", "Fy", "Xx", "Xy"), np.concatenate(handle(0), axis=1).T, strict=True))
    savemat(tmp_path / "lab.mat", rates | signals)
    written = json.loads(write_sidecar(tmp_path / "lab.mat").path.read_text())
    assert written["rate"] == rate
    assert ("rate" in written["guessed"]) == ("fs" not in rates)


@pytest.mark.slow(reason="three child processes")
def test_c3d_files(tmp_path):
    write_c3d(tmp_path / "lab.c3d")
    (tmp_path / "lab.json").unlink()
    written = write_sidecar(tmp_path / "lab.c3d")
    assert "displacement in mm move a mass of 3 kg" in written.notes[-1]
    recording = import_recording([tmp_path / "lab.c3d"], rate=200.0).recording
    assert np.abs(recording["displacement"].values[:, 100:-100] - truth("displacement", 1)[:, 100:-100]).max() < 1e-4


def test_the_command_prints_the_guesses_and_the_sidecar(tmp_path, capsys):
    path = tmp_path / "lab.csv"
    path.write_text(as_text(table()))
    assert cli.main(["sidecar", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == 'time.unit = "s" is a guess: from the steps of the times'
    assert lines[1].startswith('axes = {"x": "right", "y": "forward"} is a guess: where x and y point: right')
    assert lines[-1] == f"sidecar: {tmp_path / 'lab.json'}"
    assert cli.main(["sidecar", str(path)]) == 1
    assert capsys.readouterr().err.startswith(f"armperturb: error: {tmp_path / 'lab.json'} exists; expected a new file")


@pytest.mark.slow(reason="identifies a recording")
def test_a_table_becomes_an_identification_without_an_edit(tmp_path):
    shutil.copy(DATA / "position.csv", tmp_path)
    write_sidecar(tmp_path / "position.csv")
    with_guesses = identify(import_recording([tmp_path / "position.csv"]).recording, "3b", estimator="frequency")
    right = identify(import_recording([DATA / "position.csv"]).recording, "3b", estimator="frequency")
    # x points to the left there, which no force shows: all that a wrong guess of it turns is the sign of xy and yx.
    turn = np.array([[1.0, -1.0], [-1.0, 1.0]])
    np.testing.assert_allclose(with_guesses.spectra.arm, right.spectra.arm * turn, rtol=1e-6, atol=1e-12)
