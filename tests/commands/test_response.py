"""The command `response`: what it writes, says and refuses."""

import csv

import numpy as np
import pytest
from test_cli import refused, run
from test_frequency_response import RATE, TRUE, multisine, noise, recorded

from armperturb.convert.exporter import export_recording
from armperturb.recording_files import save_recording


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(1)
    save_recording(recorded(multisine(rng, 2, 32.0), rng, own=0.3, instruments=1.0), folder / "multisine.nc")
    for name, duration in (("noise", 25.0), ("longer", 33.0)):
        save_recording(recorded(noise(rng, 2, duration), rng, own=0.3, instruments=1.0), folder / f"{name}.nc")
    return folder


@pytest.mark.slow(reason="draws figures")
def test_multisines_give_tables_figures_and_the_distortion(folder, tmp_path, capsys):
    assert run("response", folder / "multisine.nc", "--out", tmp_path) == 0
    said = capsys.readouterr().out
    assert "period: 20.48 s" in said
    assert "manipulator 3.27 kg, " in said
    assert "whose force balance was used" in said
    assert "nonlinear distortion: of the response's power" in said
    assert "p = " in said
    assert {path.name for path in tmp_path.iterdir()} == {
        "response.csv", "response.svg", "distortion.csv", "distortion.svg",
    }  # fmt: skip
    table = rows(tmp_path / "response.csv")
    assert list(table[0]) == [
        "frequency_hz", "output", "input", "real", "imag", "gain_m_per_N", "phase_deg", "standard_error", "radius_95",
        "condition", "subject",
    ]  # fmt: skip
    inside = []
    for row in table:
        value = complex(float(row["real"]), float(row["imag"]))
        truth = TRUE["arm"](np.array([float(row["frequency_hz"])]))[0][
            "xy".index(row["output"]), "xy".index(row["input"])
        ]
        inside.append(abs(value - truth) <= float(row["radius_95"]))
        assert float(row["gain_m_per_N"]) == pytest.approx(abs(value))
        # Half the variance is that of the real part; few degrees of freedom widen the circle of sqrt(2 ln 20) errors.
        assert float(row["radius_95"]) > 2.44 * float(row["standard_error"]) > 0
    assert np.mean(inside) > 0.85
    levels = rows(tmp_path / "distortion.csv")
    assert len(levels) == len(table) / 2
    assert {(row["condition"], row["subject"]) for row in levels + table} == {("PT", "load")}


@pytest.mark.slow(reason="estimates from long records")
@pytest.mark.usefixtures("blank_pictures")
def test_fewer_lines_share_a_point_if_asked(folder, tmp_path, capsys):
    counts = []
    for lines in (2, 4):
        out = tmp_path / str(lines)
        assert run("response", folder / "multisine.nc", "--lines-per-average", lines, "--out", out) == 0
        counts.append(len(rows(out / "response.csv")))
    assert counts[0] > 1.5 * counts[1]
    line = refused(
        capsys, "response", folder / "noise.nc", "--method", "noise", "--lines-per-average", 2, "--out", tmp_path / "no"
    )
    assert "lines_per_average = 2; expected none with the method noise" in line


@pytest.mark.slow(reason="estimates from long records")
@pytest.mark.usefixtures("blank_pictures")
def test_records_of_unequal_length_in_other_formats(folder, tmp_path):
    from armperturb.recording_files import load_recording

    export_recording(load_recording(folder / "longer.nc"), tmp_path / "longer.csv")
    files = (folder / "noise.nc", tmp_path / "longer.csv")
    assert run("response", *files, "--method", "noise", "--what", "total", "--out", tmp_path / "out") == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"response.csv", "response.svg"}
    table = rows(tmp_path / "out" / "response.csv")
    found = np.array([complex(float(row["real"]), float(row["imag"])) for row in table]).reshape(-1, 2, 2)
    frequency = np.array([float(row["frequency_hz"]) for row in table[::4]])
    truth = TRUE["total"](frequency)
    used = (frequency > 3.0) & (frequency < 20.0)
    assert np.median(np.abs(found - truth)[used] / np.abs(truth).max(axis=(1, 2), keepdims=True)[used]) < 0.02


@pytest.mark.slow(reason="fits a state space")
@pytest.mark.usefixtures("blank_pictures")
def test_without_covariance_there_are_no_bands(folder, tmp_path, capsys):
    assert run("response", folder / "noise.nc", "--method", "subspace", "--out", tmp_path) == 0
    assert "no uncertainty" in capsys.readouterr().out
    assert {row["standard_error"] for row in rows(tmp_path / "response.csv")} == {""}


@pytest.mark.slow(reason="estimates a response")
@pytest.mark.usefixtures("blank_pictures")
def test_an_earlier_distortion_goes_if_asked(folder, tmp_path, capsys):
    names = ("distortion.csv", "distortion.svg")
    for name in names:
        (tmp_path / name).write_text("old")
    options = ("response", folder / "multisine.nc", "--what", "total", "--out", tmp_path)
    assert "distortion.csv: exists already" in refused(capsys, *options)
    assert all((tmp_path / name).read_text() == "old" for name in names)
    assert run(*options, "--overwrite") == 0
    assert not any((tmp_path / name).exists() for name in names)


@pytest.mark.slow(reason="runs whole commands")
@pytest.mark.usefixtures("blank_pictures")
def test_pulses_alone_name_their_method_and_give_a_response(tmp_path, capsys):
    rng = np.random.default_rng(3)
    pulse = np.zeros((3, round(12.0 * RATE), 2))
    pulse[np.arange(3), 600:620, [0, 1, 0]] = 20.0
    labels = {"pulse_onset": [3.0] * 3, "pulse_direction": [0.0, 90.0, 0.0], "pulse_level": [1.0] * 3}
    recording = recorded(pulse, rng, own=0.3, instruments=1.0)
    save_recording(recording.assign_coords({name: ("trial", each) for name, each in labels.items()}), tmp_path / "p.nc")
    line = refused(capsys, "response", tmp_path / "p.nc", "--out", tmp_path / "out")
    assert "does not repeat within the 10 s from 2 s on" in line
    assert "for noise and pulses there is --method noise" in line
    assert run("response", tmp_path / "p.nc", "--method", "noise", "--out", tmp_path / "out") == 0


@pytest.mark.slow(reason="reads long records many times")
def test_it_refuses_in_one_line(folder, tmp_path, capsys):
    out = ("--out", tmp_path / "out")
    assert "does not repeat" in refused(capsys, "response", folder / "noise.nc", *out)
    assert "does not repeat after 3 s" in refused(capsys, "response", folder / "multisine.nc", "--period", 3, *out)
    assert "expected none with the method arx" in refused(
        capsys, "response", folder / "noise.nc", "--method", "arx", "--period", 3, *out
    )
    assert "no condition 'RT'" in refused(capsys, "response", folder / "noise.nc", "--condition", "RT", *out)
    assert "trial 0 ends at 25 s; expected more than 30 s" in refused(
        capsys, "response", folder / "noise.nc", "--method", "noise", "--window-start", 30, *out
    )
    assert "no such file" in refused(capsys, "response", tmp_path / "none.nc", *out)
    recording = recorded(noise(np.random.default_rng(2), 2, 12.0), np.random.default_rng(2))
    save_recording(recording.assign_coords(condition=("trial", ["PT", "RT"])), tmp_path / "two.nc")
    assert "conditions PT, RT; expected only one (choose a --condition)" in refused(
        capsys, "response", tmp_path / "two.nc", "--method", "noise", *out
    )
    assert not (tmp_path / "out").exists()
