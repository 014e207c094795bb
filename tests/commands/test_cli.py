"""The commands as a stranger types them: what they write, and one clear line when they refuse."""

import csv
import errno
import json
import os
import re
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from armperturb import cli
from armperturb.analysis.fit.own_structures import load_structure, save_structure
from armperturb.files import written_whole
from armperturb.perturbations import Multisine, Pulse, save_perturbation
from armperturb.recording_files import load_recording, save_recording
from armperturb.study.recording import record as runner
from armperturb.subject import POSITION, RELAX

RECORDING = Path(__file__).parents[2] / "examples" / "data" / "relax.nc"
"""Four trials of the subject S01 in the condition RT7.5."""


@pytest.fixture(scope="module")
def recording():
    return load_recording(RECORDING)


@pytest.fixture(scope="module")
def single_trial(recording, tmp_path_factory):
    """A file with the first of them."""
    path = tmp_path_factory.mktemp("single") / "r.nc"
    save_recording(recording.isel(trial=[0]), path)
    return path


@pytest.fixture
def inputs(tmp_path):
    POSITION.save(tmp_path / "subject.toml")
    save_perturbation(Multisine.draw(seed=1, rms=3.0, crested=False), tmp_path / "multisine.csv", 200.0)
    save_perturbation(Pulse(peak=20.0, direction_deg=20.0, onset=0.1, duration=0.6), tmp_path / "pulse.csv", 1000.0)
    return tmp_path


def run(*arguments):
    return cli.main([str(argument) for argument in arguments])


def refused(capsys, *arguments):
    """Run a command that must fail and return its one line."""
    assert run(*arguments) == 1
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("armperturb: error: ")
    assert "Traceback" not in captured.out + captured.err
    return lines[0]


def simulate(folder, *options, subject="subject.toml", perturbation="pulse.csv", out="out.nc"):
    paths = ("--subject", folder / subject, "--perturbation", folder / perturbation, "--out", folder / out)
    return ("simulate", *paths, *options)


@pytest.mark.slow(reason="runs whole commands")
def test_a_warning_is_one_line_without_a_place_in_the_code(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli, "show", lambda _: warnings.warn("two\nlines \x1b[2J", RuntimeWarning, stacklevel=1))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run("sidecar", RECORDING.with_name("position.csv"), "--out", tmp_path / "s.json") == 0
    assert capsys.readouterr().err == "armperturb: warning: two lines \\x1b[2J\n"


@pytest.mark.slow(reason="runs whole commands")
def test_a_sidecar_is_advised_as_a_shell_takes_it(tmp_path, capsys):
    assert run("sidecar", RECORDING.with_name("position.csv"), "--out", tmp_path / "two words.json") == 0
    typed = capsys.readouterr().out.partition("for other files with these channels: ")[2].splitlines()[0]
    assert shlex.split(typed) == ["--sidecar", str(tmp_path / "two words.json")]


@pytest.mark.slow(reason="simulates a trial of 30 s and fits it")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_simulate_then_identify(inputs, capsys):
    assert run(*simulate(inputs, "--ideal", perturbation="multisine.csv")) == 0
    assert run("identify", inputs / "out.nc", "--model", "3b", "--out", inputs / "results") == 0
    assert "converged" in capsys.readouterr().out
    with (inputs / "results" / "admittance.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "frequency_hz", "output", "input", "real", "imag", "gain_m_per_N", "phase_deg", "coherence", "condition",
        "subject",
    ]  # fmt: skip
    assert len(rows) == 18 * 4
    for row in rows:
        value = complex(float(row["real"]), float(row["imag"]))
        assert float(row["gain_m_per_N"]) == pytest.approx(abs(value))
        assert float(row["phase_deg"]) == pytest.approx(np.degrees(np.angle(value)))
        assert 0 <= float(row["coherence"]) <= 1
    with (inputs / "results" / "parameters.csv").open() as file:
        parameters = {row["parameter"]: row for row in csv.DictReader(file)}
    assert list(parameters["m_tot"]) == [
        "parameter", "value", "standard_error", "lower_95", "upper_95", "unit", "at_bound", "condition", "subject",
    ]  # fmt: skip
    assert float(parameters["m_tot"]["value"]) == pytest.approx(3.38, rel=0.01)
    for row in parameters.values():
        half = 1.959964 * float(row["standard_error"])
        assert float(row["lower_95"]) == pytest.approx(float(row["value"]) - half)
        assert float(row["upper_95"]) == pytest.approx(float(row["value"]) + half)
    assert parameters["k_s"]["unit"] == "Nm/rad"
    fit = json.loads((inputs / "results" / "fit.json").read_text())
    assert {"status", "criterion", "VAF_x", "VAF_y", "stable", "remarks", "chi2", "dof", "p_value"} <= set(fit)
    assert fit["estimator"] == "record"
    assert fit["correlation"]["parameters"] == list(parameters)
    matrix = np.array(fit["correlation"]["matrix"])
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9)
    np.testing.assert_allclose(np.diag(matrix), 1.0)
    assert fit["stable"] is True
    assert fit["VAF_x"] > 98


@pytest.mark.slow(reason="simulates four trials")
def test_ideal_records_the_truth_and_the_seed_its_noise(inputs):
    for options, name in ((("--ideal",), "a"), (("--seed", 1), "b"), (("--seed", 2), "c"), (("--seed", 2), "d")):
        assert run(*simulate(inputs, *options, out=f"{name}.nc")) == 0
    a, b, c, d = (load_recording(inputs / f"{name}.nc") for name in "abcd")
    assert not a["force"].equals(b["force"])
    assert not b["force"].equals(c["force"])
    assert c.identical(d)
    assert a.attrs["rate"] == 200.0


@pytest.mark.slow(reason="simulates two trials")
def test_pendulum_rope_changes_the_recording(inputs):
    assert run(*simulate(inputs, "--ideal", out="a.nc")) == 0
    assert run(*simulate(inputs, "--ideal", "--rope", "pendulum", out="b.nc")) == 0
    a, b = (load_recording(inputs / name)["displacement"] for name in ("a.nc", "b.nc"))
    assert not a.equals(b)


EDITS = {
    "unknown key": ("subject.toml", lambda text: text + "k_x = 1.0\n", "unknown key 'k_x'"),
    "missing key": ("subject.toml", lambda text: text.replace("k_h", "#k_h"), "missing key 'k_h'"),
    "negative mass": ("subject.toml", lambda text: text.replace("m_h = 1", "m_h = -1"), "m_h = -1"),
    "no length": ("subject.toml", lambda text: text.replace("l_f = 0.34", "l_f = 0.0"), "l_f = 0.0"),
    "no delay": ("subject.toml", lambda text: text.replace("Td_s = 0.03", "Td_s = 0.0"), "Td_s = 0.0"),
    "short delay": ("subject.toml", lambda text: text.replace("Td_s = 0.03", "Td_s = 0.0002"), "Td_s = 0.0002"),
    "text": ("subject.toml", lambda text: text.replace("m_h = 1", 'm_h = "1" #'), "m_h = '1'; expected a number"),
    "unstable": ("subject.toml", lambda text: text.replace("kv_s = 15.7", "kv_s = 80"), "unstable"),
    "no masses": (
        "subject.toml",
        lambda text: re.sub(r"(m_[hf]) = .*", r"\1 = 0.0", text) + "i_s = 0.3\ni_se = 0.08\ni_e = 0.05\n",
        "i_s, i_se, i_e = 0.3, 0.08, 0.05; expected 0 in a simulation",
    ),
    "rigid grip": (
        "subject.toml",
        lambda text: re.sub("k_h = .*", "k_h = inf", text),
        "k_h = inf; expected a finite grip stiffness in a simulation",
    ),
    "no TOML": ("subject.toml", lambda text: "m_h: 3", "not a TOML file"),
    "NaN": (
        "pulse.csv",
        lambda text: text.replace("0.05,0,0", "0.05,nan,0").replace("0.05,0.0,0.0", "0.05,nan,0.0"),
        "nan",
    ),
    "gap": ("pulse.csv", lambda text: "\n".join(t for t in text.splitlines() if not t.startswith("0.2")), "expected"),
    "columns": ("pulse.csv", lambda text: text.replace("d_y_N", "d_z_N"), "d_y_N"),
    "line break": ("subject.toml", lambda text: text.replace('"position"', '"a\\u0000b"'), "printable"),
    "empty": ("pulse.csv", lambda text: "", "expected"),
}


@pytest.mark.parametrize("name", EDITS)
def test_bad_files_are_refused_in_one_line(name, inputs, capsys):
    path, edit, message = EDITS[name]
    before = (inputs / path).read_text()
    (inputs / path).write_text(edit(before))
    assert (inputs / path).read_text() != before
    line = refused(capsys, *simulate(inputs))
    assert message in line
    assert path in line
    assert sorted(p.name for p in inputs.iterdir()) == ["multisine.csv", "pulse.csv", "subject.toml"]


def test_too_fast_perturbations_are_refused(inputs, capsys):
    time = np.arange(4000) / 4000
    rows = [f"{t:.6f},{np.sin(2 * np.pi * 500 * t):.6f},0" for t in time]
    (inputs / "fast.csv").write_text("time_s,d_x_N,d_y_N\n" + "\n".join(rows) + "\n")
    assert "expected at most 180 Hz" in refused(capsys, *simulate(inputs, perturbation="fast.csv"))


def test_workspace_limit_is_reported(inputs, capsys):
    RELAX.save(inputs / "relax.toml")
    save_perturbation(Pulse(peak=600.0, direction_deg=20.0, onset=0.1, duration=1.0), inputs / "hard.csv", 1000.0)
    line = refused(capsys, *simulate(inputs, subject="relax.toml", perturbation="hard.csv"))
    assert "reached the workspace limit at 0." in line
    assert not (inputs / "out.nc").exists()


def test_missing_files_and_folders_are_named(inputs, capsys):
    assert "none.toml" in refused(capsys, *simulate(inputs, subject="none.toml"))
    assert "none.csv" in refused(capsys, *simulate(inputs, perturbation="none.csv"))
    assert "does not exist" in refused(capsys, *simulate(inputs, out="no/folder/out.nc"))
    assert "no such file" in refused(capsys, "identify", inputs / "none.nc", "--model", "1", "--out", inputs / "r")
    assert not (inputs / "r").exists()


DAMAGE = {
    "no force": (lambda r: r.drop_vars("force"), "variable 'force' is missing"),
    "rate": (lambda r: r.isel(time=slice(None, None, 4)), "rate = 200 Hz"),
    "too short": (lambda r: r.isel(time=slice(800)), "the recording lasts 4 s; expected at least 5 s"),
    "one direction": (lambda r: r.assign(perturbation=r["perturbation"] * [1.0, 0.0]), "along y has no power"),
    "flipped": (lambda r: r.assign(force=-r["force"]), "force must be the reaction force"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_bad_recordings_are_refused_in_one_line(name, recording, tmp_path, capsys):
    damage, message = DAMAGE[name]
    damage(recording.isel(trial=[0])).to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
    line = refused(capsys, "identify", tmp_path / "bad.nc", "--model", "1", "--out", tmp_path / "results")
    assert message in line
    assert "bad.nc" in line
    assert not (tmp_path / "results").exists()


@pytest.mark.slow(reason="identifies recordings")
def test_subject_and_condition_are_picked(tmp_path, capsys):
    common = ("identify", RECORDING, "--model", "1", "--out", tmp_path / "results")
    assert "no subject 'X'; expected one of S01" in refused(capsys, *common, "--subject", "X")
    assert "no condition 'PT0'; expected one of RT7.5" in refused(capsys, *common, "--condition", "PT0")


@pytest.fixture
def two_recordings(recording, tmp_path):
    """A person in two conditions, each in a file of its own."""
    paths = [tmp_path / "a.nc", tmp_path / "b.nc"]
    for path, condition, part in zip(paths, ("RT7.5", "RT22.5"), (slice(2), slice(2, 4)), strict=True):
        trials = recording.isel(trial=part)
        save_recording(trials.assign_coords(condition=("trial", [condition] * 2)), path)
    return paths


@pytest.mark.slow(reason="fits two conditions together")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_several_recordings_are_identified_together(two_recordings, tmp_path, capsys):
    common = ("identify", *two_recordings, "--model", "1", "--out", tmp_path / "r")
    assert run(*common, "--estimator", "frequency", "--share", "mass", "grip") == 0
    printed = capsys.readouterr().out
    assert "RT7.5: converged" in printed
    assert "RT22.5: converged" in printed
    with (tmp_path / "r" / "parameters.csv").open() as file:
        rows = {(row["condition"], row["parameter"]): row["value"] for row in csv.DictReader(file)}
    assert len(rows) == 16
    assert {name for condition, name in rows if condition == "RT7.5+RT22.5"} == {"m_h", "m_f", "b_h", "k_h"}
    alone = {name for condition, name in rows if condition == "RT7.5"}
    assert len(alone) == 6
    assert all(rows["RT7.5", name] != rows["RT22.5", name] for name in alone)
    fits = json.loads((tmp_path / "r" / "fit.json").read_text())
    assert list(fits) == ["RT7.5", "RT22.5"]
    assert fits["RT7.5"]["estimator"] == "frequency"
    assert len(fits["RT7.5"]["correlation"]["parameters"]) == 16


@pytest.mark.slow(reason="fits each trial")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_the_thesis_estimator_can_be_asked_for(two_recordings, tmp_path, capsys):
    whose = ("--subject", "S01", "--condition", "RT7.5")
    arguments = ("identify", two_recordings[0], "--model", "1", "--estimator", "thesis", *whose)
    assert run(*arguments, "--out", tmp_path / "r") == 0
    assert "of 2 trials" in capsys.readouterr().out
    fit = json.loads((tmp_path / "r" / "fit.json").read_text())
    assert (fit["estimator"], fit["n_trials"]) == ("thesis", 2)
    assert "chi2" not in fit


@pytest.mark.slow(reason="reads recordings ten times")
def test_what_cannot_be_identified_together_is_refused(two_recordings, recording, tmp_path, capsys):
    in_other_task = {name: ("trial", [name]) for name in ("subject", "condition")} | {"task": ("trial", ["PT"])}
    single = recording.isel(trial=[0])
    save_recording(single.assign_coords(in_other_task), tmp_path / "p.nc")
    other = single.copy()  # a copy of a trial would be refused
    other["force"] = other["force"].copy(data=1.001 * other["force"].values)
    save_recording(other.isel(time=slice(5800)), tmp_path / "short.nc")
    out = ("--out", tmp_path / "r")
    a, b = two_recordings
    line = refused(capsys, "identify", a, tmp_path / "p.nc", "--model", "1", *out)
    assert "subjects S01, subject; expected only one (choose a --subject)" in line
    line = refused(capsys, "identify", a, tmp_path / "short.nc", "--model", "1", "--estimator", "thesis", *out)
    assert "short.nc" in line
    assert "expected one length with estimator = 'thesis' (--estimator record takes any)" in line
    line = refused(capsys, "identify", a, "--free", "zeta_act", *out)
    assert "free = ('zeta_act',) without a model; expected the one that it changes" in line
    line = refused(capsys, "identify", a, b, "--model", "1", "--estimator", "thesis", "--share", "mass", *out)
    assert "share = mass; expected nothing with estimator = 'thesis'" in line
    line = refused(capsys, "identify", a, b, "--model", "1", "--share", "k_x", *out)
    assert "share: 'k_x' is no free parameter" in line
    assert not (tmp_path / "r").exists()


@pytest.mark.slow(reason="identifies a recording")
def test_a_result_that_cannot_be_written_leaves_the_others_as_they_were(tmp_path, capsys):
    (tmp_path / "results" / "parameters.csv").mkdir(parents=True)
    line = refused(capsys, "identify", RECORDING, "--model", "1", "--out", tmp_path / "results")
    assert "parameters.csv: is a folder" in line
    assert [path.name for path in (tmp_path / "results").iterdir()] == ["parameters.csv"]


def test_bad_study_settings_are_refused(tmp_path, capsys):
    assert "subjects = 0; expected" in refused(capsys, "study", "--out", tmp_path / "s", "--subjects", 0)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("muscles", [None, "nonlinear", "linear"])
def test_study_draws_the_people_that_are_asked_for(tmp_path, monkeypatch, muscles):
    asked = []
    monkeypatch.setattr(runner, "record_study", lambda settings, out, **options: asked.append(settings.muscles))
    options = () if muscles is None else ("--muscles", muscles)
    assert run("study", "--out", tmp_path / "s", "--record-only", *options) == 0
    assert asked == [muscles or "nonlinear"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--model", "9"],
            "identify: model = '9'; expected one of 1, 2, 3, 4, 5, 6, 3a, 3b, nonlinear, joint, or FILE",
        ),
        (["--model", "none.toml"], "none.toml"),
        (["--model", "1", "--free", "k_x"], "free parameter 'k_x' is unknown; expected one of m_h"),
        (["--model", "1", "--bounds", "k_h=5:1"], "bounds of k_h = 5.0 to 1.0; expected a lower and a higher"),
        (["--model", "1", "--prior", "m_f=2+-0"], "prior of m_f = 2.0 +- 0.0; expected a width above 0"),
        (
            ["--model", "1", "--prior", "m_f=2+-1", "--estimator", "thesis"],
            "identify: prior with estimator = 'thesis', which takes none into account; expected --estimator record",
        ),
        (
            ["--model", "1", "--body", "male", "1.8", "75"],
            "body = ('male', 1.8, 75.0) with model 1; expected one whose joint inertia is free (--fix m=0 --free i)",
        ),
        (["--model", "nonlinear", "--fix", "k_h=rigid"], "fix = ('k_h=rigid',); expected () with --model nonlinear"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_structures_end_in_one_line(tmp_path, capsys, options, message):
    assert message in refused(capsys, "identify", RECORDING, *options, "--out", tmp_path / "r")


@pytest.mark.slow(reason="identifies a recording twice")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_a_structure_of_options_is_that_of_its_file(single_trial, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("base = '1'\n[fixed]\nk_h = 'rigid'\n[prior]\nm_f = [1.8, 0.2]\n")
    common = ("identify", single_trial, "--estimator", "frequency", "--out")
    assert run(*common, tmp_path / "a", "--model", mine) == 0
    assert run(*common, tmp_path / "b", "--model", "1", "--fix", "k_h=rigid", "--prior", "m_f=1.8+-0.2") == 0
    tables = [list(csv.DictReader((tmp_path / name / "parameters.csv").read_text().splitlines())) for name in "ab"]
    assert [row["parameter"] for row in tables[0]] == ["m_h", "m_f", "b_s", "b_se", "b_e", "k_s", "k_se", "k_e"]
    for one, other in zip(*tables, strict=True):
        assert (one["value"], one["standard_error"]) == (other["value"], other["standard_error"])
    model = json.loads((tmp_path / "b" / "fit.json").read_text())
    assert "1 with fix k_h=rigid, prior m_f=1.8+-0.2" in str(model)
    # A structure that is written is that of the options, and so identifies as it does.
    written = tmp_path / "b" / "structure.toml"
    save_structure(load_structure(mine).named(load_structure(written).name), tmp_path / "named.toml")
    assert written.read_text() == (tmp_path / "named.toml").read_text()


@pytest.mark.slow(reason="identifies a recording twice")
@pytest.mark.usefixtures("without_page", "blank_pictures")
def test_a_body_from_tables_narrows_the_inertia(single_trial, tmp_path):
    free = ("--model", "1", "--fix", "m=0", "--free", "i")
    common = ("identify", single_trial, "--estimator", "frequency", *free, "--out")
    assert run(*common, tmp_path / "a") == 0
    assert run(*common, tmp_path / "b", "--body", "male", "1.84", "76") == 0
    prior = load_structure(tmp_path / "b" / "structure.toml").prior
    assert list(prior) == ["i_s", "i_se", "i_e"]
    bare, known = (
        {row["parameter"]: row for row in csv.DictReader((tmp_path / name / "parameters.csv").read_text().splitlines())}
        for name in "ab"
    )
    for name, (mean, sd) in prior.items():
        value, error = (float(known[name][column]) for column in ("value", "standard_error"))
        assert error < float(bare[name]["standard_error"])
        assert abs(value - mean) < 3.0 * sd


UNKNOWN = ["identify", "r.nc", "--model", "1", "--estimator", "guess", "--out", "x"]


def test_calibrations_that_could_not_be_written_are_refused_before_they_run(tmp_path, capsys):
    message = refused(capsys, "calibrate", "--out", tmp_path / "person.toml", "--laws", "linear")
    assert "laws = ('linear',); expected 'full' among them" in message
    message = refused(capsys, "calibrate", "--out", tmp_path / "nowhere" / "person.toml")
    assert f"folder {tmp_path / 'nowhere'} does not exist" in message
    message = refused(capsys, "calibrate", "--out", tmp_path)
    assert f"{tmp_path}: is a folder; expected the name of a file to write" in message
    assert not list(tmp_path.iterdir())


WITHOUT_OSMESA = """
import ctypes

load = ctypes.CDLL.__init__

def load_others(self, name, *options, **more):
    if "OSMesa" in str(name):
        raise OSError(name)
    load(self, name, *options, **more)

ctypes.CDLL.__init__ = load_others
"""


STUDY = ("study", "--out", "s", "--subjects", "1")
# On other systems than Linux there is no OSMesa.
ASKED = (
    ("foo", ("identify", "none.nc", "--model", "1", "--out", "r")),
    ("foo", STUDY),
    *([("osmesa", STUDY)] if sys.platform == "linux" else ()),
)


@pytest.mark.slow(reason="a process of its own")
def test_libraries_that_are_unknown_or_do_not_load_are_one_line_and_identify_needs_none(tmp_path):
    unset = ("DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM", "MUJOCO_GL")
    clean = {name: value for name, value in os.environ.items() if name not in unset}
    # As on a machine without OSMesa, whether or not it is there.
    code = f"""{WITHOUT_OSMESA}
import os
from armperturb.cli import main
for backend, command in {ASKED}:
    os.environ["MUJOCO_GL"] = backend
    print(main(command))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=clean, cwd=tmp_path, check=True
    )
    assert done.stdout == "1\n" * len(ASKED)
    assert not list(tmp_path.iterdir())
    analysis, study, *more = done.stderr.splitlines()
    assert analysis.startswith("armperturb: error: none.nc: no such file")
    assert study.startswith("armperturb: error: ")
    assert study.endswith("MUJOCO_GL = 'foo'; expected egl, osmesa, glfw or off, or unset")
    assert len(more) == len(ASKED) - 2
    for line in more:
        assert line.startswith("armperturb: error: ")
        assert line.endswith("with MUJOCO_GL=osmesa; on Debian or Ubuntu: apt-get install libosmesa6")


def test_a_file_that_cannot_be_written_is_named_as_the_user_did(tmp_path, monkeypatch):
    def denied(path, *_):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    gone = pytest.raises(FileNotFoundError, match=r"No such file or directory: '[^']*/a\.nc'$")
    with gone, written_whole(tmp_path / "a.nc") as temporary:
        temporary.unlink()
    monkeypatch.setattr("armperturb.files.os.open", denied)
    with pytest.raises(PermissionError) as caught, written_whole(tmp_path / "a.nc"):
        pytest.fail("nothing is to be written")
    assert caught.value.filename == str(tmp_path / "a.nc")
    assert ".part" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_folders_of_others_stay_where_a_command_fails(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine/empty").mkdir(parents=True)
    new = cli._missing(Path("fresh/.."))
    Path("fresh").mkdir()
    cli._remove_empty(new)
    assert Path("mine/empty").is_dir()
    # Another process has begun to write into the folder that this one found missing.
    new = cli._missing(Path("study"))
    Path("study/recordings").mkdir(parents=True)
    Path("study/.lock").touch()
    cli._remove_empty(new)
    assert Path("study/recordings").is_dir()
    Path("study/.lock").unlink()
    cli._remove_empty(new)
    assert not Path("study").exists()


@pytest.mark.parametrize("columns", [1, 4])
def test_help_ends_on_a_terminal_of_few_characters(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit, match="0"):
        run("sidecar", "--help")
    assert "usage: armperturb sidecar" in capsys.readouterr().out
    assert os.environ["COLUMNS"] == str(columns)


def test_help_and_usage_errors_need_no_standard_streams(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    for options, status in (("--help", 0), ("--nonsense", 2)):
        with pytest.raises(SystemExit) as caught:
            run("sidecar", options)
        assert caught.value.code == status


def test_usage_errors_leave_with_a_status(capsys):
    no_muscles = ["study", "--out", "x", "--muscles", "soft"]
    for arguments in ([], ["fly"], UNKNOWN, no_muscles):
        with pytest.raises(SystemExit) as caught:
            cli.main(arguments)
        assert caught.value.code != 0
    capsys.readouterr()


LIGHT = """
import os, sys
from armperturb.cli import main

heavy = {"numpy", "scipy", "pandas", "xarray", "matplotlib"}
print(sorted(heavy & {*sys.modules}), file=sys.stderr)
for arguments in (["--version"], ["--help"], ["identify", "--help"]):
    try:
        main(arguments)
    except SystemExit:
        pass
    print(sorted(heavy & {*sys.modules}), os.environ["OPENBLAS_NUM_THREADS"], file=sys.stderr)
    print("END")
os.environ["OPENBLAS_NUM_THREADS"] = "3"
main(["--version"])
print(os.environ["OPENBLAS_NUM_THREADS"], file=sys.stderr)
"""


@pytest.mark.slow(reason="runs whole commands")
def test_help_loads_no_heavy_library_and_linear_algebra_takes_one_thread_unless_the_user_says_more():
    unset = {name: value for name, value in os.environ.items() if name not in cli.BLAS_THREADS}
    done = subprocess.run([sys.executable, "-c", LIGHT], env=unset, capture_output=True, text=True, check=True)
    assert all("armperturb" in part for part in done.stdout.split("END\n"))
    assert done.stderr.splitlines() == ["[]", "[] 1", "[] 1", "[] 1", "3"]
