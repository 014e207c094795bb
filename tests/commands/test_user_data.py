"""A user's own files are never lost: no command writes to what it has read, and none replaces a file unasked."""

import errno
import os
import shutil
import subprocess
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from laboratory import table, write

from armperturb import cli
from armperturb.commands import compare, design, identify, response, validate
from armperturb.commands.selection import select_trials
from armperturb.convert.importer import import_recording
from armperturb.recording import make_recording
from armperturb.recording_files import load_recording, save_recording
from armperturb.subject import POSITION

RELAX = Path(__file__).parents[2] / "examples" / "data" / "relax.nc"
PLAN = ["--goal", "mass", "--force", "5", "--displacement", "0.01", "--duration", "9.2", "--trials", "1"]


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A laboratory's file with its sidecar, and its recording."""
    path = write(tmp_path_factory.mktemp("lab"))
    save_recording(import_recording([path]).recording, path.with_suffix(".nc"))
    return path.parent


@pytest.fixture
def folder(lab, tmp_path):
    return shutil.copytree(lab, tmp_path / "lab")


def test_notes_of_a_file_name_it_where_there_are_several(tmp_path):
    sound, weak = table(), table()
    weak[:, 4:6] *= 0.9  # the force
    files = [write(tmp_path, each, name=name) for name, each in (("a", sound), ("b", weak))]
    _, notes = select_trials(files, None, None, None, single_condition=False)
    assert [note.partition(": ")[0] for note in notes if "10 % too small" in note] == [str(files[1])]
    _, notes = select_trials(files[1:], None, None, None, single_condition=False)
    assert [note.partition(" ")[0] for note in notes if "10 % too small" in note] == ["force"]


def refused(capsys, *arguments):
    """The one line in which a command is refused."""
    assert cli.main(list(map(str, arguments))) == 1
    (line,) = capsys.readouterr().err.splitlines()
    return line


def content_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("asked", ["", "--overwrite"])
@pytest.mark.parametrize("ending", [".csv", ".mat"])
def test_inputs_and_sidecars_stay(folder, capsys, ending, asked):
    source, before = next(folder.glob("*.csv")), content_of(folder)
    line = refused(capsys, "convert", source, "--out", source.with_suffix(ending), *([asked] if asked else []))
    assert "is an input of this command" in line
    assert content_of(folder) == before


@pytest.mark.slow(reason="runs commands")
def test_existing_outputs_are_replaced_only_where_that_is_asked_for(folder, capsys):
    source, before = next(folder.glob("*.csv")), content_of(folder)
    recording = source.with_suffix(".nc")
    assert "exists already" in refused(capsys, "convert", source, "--out", recording)
    assert "exists already" in refused(capsys, "convert", recording, "--out", source.with_suffix(".mat"))
    assert content_of(folder) == before
    recording.write_bytes(b"old")
    assert cli.main(["convert", str(source), "--out", str(recording), "--overwrite"]) == 0
    assert load_recording(recording).sizes["trial"] == 2


@pytest.mark.slow(reason="runs five commands")
@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.parametrize(
    ("module", "options", "names"),
    [
        (
            identify,
            ["identify", "lab.nc", "--model", "1", "--estimator", "frequency"],
            "admittance.csv parameters.csv endpoint.csv endpoint.svg fit.json identify.html structure.toml arm.toml",
        ),
        (response, ["response", "lab.nc", "--method", "welch"], "response.csv response.svg"),
        (compare, ["compare", "lab.nc", "--with", "thesis", "--ideal"], "compare.csv compare.svg compare.txt"),
        (
            design,
            ["design", "--subject", "person.toml", *PLAN],
            "tables/design.csv tables/spectrum.csv tables/signals.csv figures/design.svg perturbations/trial_01.csv "
            "settings.json",
        ),
        (
            validate,
            ["validate", "--groups", "1", "--trials", "1", "--estimators", "frequency", "--workers", "1"],
            "tables/validation.csv tables/validation_summary.csv figures/validation.svg settings.json",
        ),
    ],
    ids=["identify", "response", "compare", "design", "validate"],
)
def test_results_are_replaced_only_where_that_is_asked_for(folder, capsys, monkeypatch, module, options, names):
    monkeypatch.chdir(folder)
    save_recording(load_recording(RELAX).isel(trial=[0]), "lab.nc")
    POSITION.save("person.toml")
    for name in names.split():
        (folder / "mine" / name).parent.mkdir(parents=True)
        (folder / "mine" / name).write_text("mine", encoding="utf-8")
        assert f"{name}: exists already" in refused(capsys, *options, "--out", "mine")
        assert (folder / "mine" / name).read_text(encoding="utf-8") == "mine"
        shutil.rmtree("mine")
    if module is design:  # what no earlier plan has written it never replaces
        assert cli.main([*options, "--out", "o"]) == 0
    for name in names.split() if module is not design else ["figures/design.svg", "tables/design.csv"]:
        (folder / "o" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "o" / name).write_text("mine", encoding="utf-8")
    assert cli.main([*options, "--out", "o", "--overwrite"]) == 0
    written = {str(path.relative_to("o")): path.read_bytes() for path in Path("o").rglob("*") if path.is_file()}
    assert written.keys() == set(names.split())
    assert b"mine" not in written.values()
    assert [name for name in written if not any(fnmatch(name, each) for each in module.RESULTS)] == []


def test_a_result_of_the_name_of_an_input_is_refused(folder, capsys):
    structure = folder / "structure.toml"
    structure.write_text('base = "3b"\n', encoding="utf-8")
    recording = next(folder.glob("*.nc"))
    line = refused(capsys, "identify", recording, "--model", structure, "--out", folder)
    assert "structure.toml: is an input of this command" in line
    assert structure.read_text(encoding="utf-8") == 'base = "3b"\n'


def one_axis(folder):
    path = folder / "one_axis.nc"
    labels = {"subject": ["A"], "task": ["PT"], "condition": ["PT"], "repetition": [0], "pulse_level": [0.0]}
    labels |= {name: [np.nan] for name in ("pulse_direction", "pulse_onset", "limit_time")}
    angle = np.random.default_rng(0).normal(size=(1, 500, 1))
    signals = {"force": angle, "displacement": angle}
    save_recording(make_recording(signals, labels, 100.0, servo="position", joint="ankle"), path)
    return path


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (("--window-start", "20"), "window_start = 20.0; expected 8.0 with --model joint"),
        (("--period", "4"), "period = 4.0; expected None with --model joint"),
        (("--free", "k"), "free = ('k',); expected () with --model joint"),
        (("--fix", "m=0"), "expected () with --model joint"),
    ],
)
def test_options_of_arms_are_refused_for_one_axis(folder, capsys, option, said):
    assert said in refused(capsys, "identify", one_axis(folder), *option, "--out", folder / "o")


@pytest.mark.parametrize("earlier", ['{"PT 1": {"model": "2"}, "RT": {"model": "2"}}', '{"model": "2"}', "mine", None])
def test_results_of_an_earlier_run_are_removed_and_other_files_are_not(folder, monkeypatch, earlier):
    names = ("arm.toml", "arm_PT_1.toml", "arm_mine.toml", "structure_RT.toml", "endpoint.csv", "identify.html")
    for name in names:
        (folder / name).write_text("earlier", encoding="utf-8")
    if earlier is not None:
        (folder / "fit.json").write_text(earlier, encoding="utf-8")
    recording = one_axis(folder)

    def identified(command, recordings, notes):
        (command.out / "fit.json").write_text("new", encoding="utf-8")
        return []

    monkeypatch.setattr(identify.Identify, "_identify_joint", identified)
    assert cli.main(["identify", str(recording), "--out", str(folder), "--overwrite"]) == 0
    removed = {"arm.toml", "endpoint.csv", "identify.html"} if earlier and earlier != "mine" else set()
    removed |= {"arm_PT_1.toml", "structure_RT.toml"} if earlier and "RT" in earlier else set()
    assert {name for name in names if not (folder / name).exists()} == removed
    assert (folder / "fit.json").read_text(encoding="utf-8") == "new"


def test_an_empty_folder_is_not_the_current_one(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    before = content_of(folder)
    line = refused(capsys, "identify", next(folder.glob("*.nc")), "--model", "3b", "--out", "")
    assert "--out '': an empty argument" in line
    assert content_of(folder) == before


def test_a_file_that_no_run_has_written_is_not_removed(folder):
    (folder / "distortion.csv").write_text("mine", encoding="utf-8")
    assert cli.main(["response", str(RELAX), "--method", "welch", "--out", str(folder)]) == 1
    assert (folder / "distortion.csv").read_text(encoding="utf-8") == "mine"


@pytest.mark.slow(reason="simulates trials with EMG")
def test_joins_keep_what_all_have_and_name_the_rest(folder, capsys):
    first = load_recording(next(folder.glob("*.nc")))
    n_time = first.sizes["time"]
    first = first.assign(joint_angle=(("trial", "time", "joint"), np.zeros((2, n_time, 2)), {"units": "rad"}))
    first = first.assign_coords(joint=["shoulder", "elbow"])
    second = first.copy(deep=True)
    second["force"] = second["force"] * 1.001
    paths = [folder / "j1.nc", folder / "j2.nc"]
    for path, recording in zip(paths, (first, second), strict=True):
        save_recording(recording, path)
    out = folder / "j12.nc"
    assert cli.main(["convert", *map(str, paths), "--out", str(out)]) == 0
    capsys.readouterr()
    assert load_recording(out)["joint_angle"].shape == (4, n_time, 2)
    save_recording(second.drop_vars(["joint_angle", "joint"]), paths[1])
    assert cli.main(["convert", *map(str, paths), "--out", str(out), "--overwrite"]) == 0
    assert "left out: joint_angle" in capsys.readouterr().out
    assert "joint_angle" not in load_recording(out)


@pytest.mark.parametrize("make", [lambda path: path.symlink_to("nothing.nc"), os.mkfifo], ids=["link", "pipe"])
def test_what_is_no_file_is_not_replaced_either(folder, capsys, make):
    out = folder / "o.nc"
    make(out)
    assert "exists already" in refused(capsys, "convert", next(folder.glob("*.csv")), "--out", out)
    assert not out.is_file()


@pytest.mark.slow(reason="reads in child processes")
@pytest.mark.parametrize("change", ["format", "rounded", "shorter"])
def test_copies_that_differ_by_rounding_or_their_end_are_copies(folder, capsys, change):
    source = next(folder.glob("*.nc"))
    copy, recording = folder / "copy.nc", load_recording(source)
    if change == "format":
        copy = folder / "copy.mat"
        assert cli.main(["convert", str(source), "--out", str(copy)]) == 0
        capsys.readouterr()
    elif change == "rounded":
        path = recording["displacement"]
        recording["displacement"] = path.round(6)
        save_recording(recording, copy)
    else:
        save_recording(recording.isel(time=slice(0, -10)), copy)
    line = refused(capsys, "response", source, copy, "--out", folder / "results")
    assert "expected each trial in one file only" in line


@pytest.mark.slow(reason="runs whole commands")
def test_trials_of_little_noise_are_no_copies(folder):
    source = next(folder.glob("*.nc"))
    recording, path = load_recording(source), folder / "other.nc"
    noise = np.random.default_rng(0).normal(size=recording["displacement"].shape)
    moved = recording["displacement"]
    recording["displacement"] = (moved + 1e-3 * float(moved.std()) * noise).assign_attrs(moved.attrs)
    save_recording(recording, path)
    assert import_recording([source, path]).recording.sizes["trial"] == 4


@pytest.mark.slow(reason="reads in child processes")
@pytest.mark.parametrize("ending", [".csv", ".nc"])
def test_copies_of_a_trial_do_not_count_as_another(folder, capsys, ending):
    source = next(folder.glob("*.csv"))
    copy = source.with_stem("copy")
    for suffix in (".csv", ".json", ".nc"):
        shutil.copy(source.with_suffix(suffix), copy.with_suffix(suffix))
    files = [source.with_suffix(ending), copy.with_suffix(ending)]
    assert "expected each trial in one file only" in refused(capsys, "convert", *files, "--out", folder / "both.nc")
    for command in ("identify", "response"):
        options = ["--model", "3b"] if command == "identify" else []
        line = refused(capsys, command, *files, *options, "--out", folder / "results")
        assert "expected each trial in one file only" in line
        assert not (folder / "results").exists()


@pytest.mark.slow(reason="runs whole commands")
def test_millimetres_that_are_declared_metres_are_refused(folder, capsys):
    recording = load_recording(next(folder.glob("*.nc")))
    attributes = recording["displacement"].attrs
    recording["displacement"] = (1000.0 * recording["displacement"]).assign_attrs(attributes)
    path = folder / "mm.nc"
    save_recording(recording, path)
    assert "displacement is" in refused(capsys, "identify", path, "--model", "3b", "--out", folder / "results")


@pytest.mark.slow(reason="runs whole commands")
def test_lengths_of_no_arm_are_refused(folder, capsys):
    recording = load_recording(next(folder.glob("*.nc")))
    recording["l_h"] = xr.full_like(recording["l_h"], 1e-300)
    path = folder / "short.nc"
    save_recording(recording, path)
    assert "l_h = 1e-300; expected a finite number at least 0.01" in refused(
        capsys, "identify", path, "--model", "3b", "--out", folder / "results"
    )


@pytest.mark.parametrize("estimator", ["record", "frequency", "thesis"])
def test_a_wrong_period_is_refused_by_every_estimator(tmp_path, capsys, estimator):
    recording = Path(__file__).parents[2] / "examples" / "data" / "relax.nc"
    options = ("--model", "3b", "--estimator", estimator, "--period", 7, "--out", tmp_path / "r")
    assert "period = 7 s; expected the perturbation's own" in refused(capsys, "identify", recording, *options)
    assert not (tmp_path / "r").exists()


def test_checksums_are_printed_as_other_programs_read_them(folder, capsys):
    options = ("convert", str(next(folder.glob("*.csv"))), "--out", str(folder / "o.csv"), "--checksum")
    assert cli.main([*options]) == 0
    sums = "\n".join(capsys.readouterr().out.splitlines()[-2:])
    checked = subprocess.run(["sha256sum", "-c"], input=sums, text=True, capture_output=True, check=True)
    assert checked.stdout == f"{folder / 'o.csv'}: OK\n{folder / 'o.json'}: OK\n"


@pytest.mark.parametrize("ending", [".nc", ".csv", ".mat"])
def test_a_full_disk_names_the_file_and_leaves_nothing(folder, capsys, monkeypatch, ending):
    def full(path, content):
        with path.open("wb") as file:
            file.write(content[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    source, before = next(folder.glob("*.csv")), content_of(folder)
    out = folder / f"o{ending}"
    line = refused(capsys, "convert", source, "--out", out)
    assert "No space left on device" in line
    assert str(folder / "o") in line
    assert content_of(folder) == before


@pytest.mark.slow(reason="runs whole commands")
def test_a_folder_of_results_that_cannot_be_written_does_not_stay(folder, capsys, monkeypatch):
    def full(path, *_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    recording = Path(__file__).parents[2] / "examples" / "data" / "relax.nc"
    monkeypatch.setattr("armperturb.commands.response.write_csv", full)
    assert "No space left" in refused(capsys, "response", recording, "--out", folder / "new" / "r")
    assert not (folder / "new" / "r").exists()
