"""What a user of a laboratory's own recording is refused, and the option or field that each refusal names."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from foreign_arms import Arm
from foreign_recordings import Setup, write_csv
from test_cli import refused, run

SETUP = Setup(arm=Arm(), seed=3, n_trials=2, duration=20.0, rate=100.0, linear=True)
LENGTHS = ("l_h", "l_f", "theta_s_deg", "theta_e_deg")
RESPONSE = ("response",)
IDENTIFY = ("identify", "--model", "1")


@pytest.fixture(scope="module")
def signals():
    return SETUP.record()


@pytest.fixture(scope="module")
def folder(signals, tmp_path_factory):
    """A laboratory's table with its sidecar, that of its force turned, and sidecars that lack something."""
    folder = tmp_path_factory.mktemp("laboratory")
    write_csv(SETUP, *signals, folder)
    sidecar = json.loads((folder / "foreign.json").read_text(encoding="utf-8"))
    (folder / "fitting.json").write_text(json.dumps(sidecar))
    for name in LENGTHS:
        del sidecar["labels"][name]
    (folder / "lengthless.json").write_text(json.dumps(sidecar))
    sidecar["signals"]["force"]["exerted_by"] = "hand"
    (folder / "turned.json").write_text(json.dumps(sidecar))
    del sidecar["signals"]["force"]["exerted_by"]
    (folder / "silent.json").write_text(json.dumps(sidecar))
    return folder


def asked(folder, out, command, sidecar, *options):
    name, *more = command
    return (name, folder / "foreign.csv", *more, "--sidecar", folder / f"{sidecar}.json", "--out", out, *options)


REFUSALS = {
    "whose force": (RESPONSE, "silent", (), r"force.exerted_by is missing; expected handle \(.*\) or hand \("),
    "wrong sign": (RESPONSE, "turned", (), r"exerted_by of the sidecar: the other of handle and hand\)"),
    "wrong sign, identified": (IDENTIFY, "turned", (), r"exerted_by of the sidecar: the other of handle and hand\)"),
    "no lengths": (IDENTIFY, "lengthless", (), r"l_h is unknown .*labels.l_h of .* l_h, l_f, theta_s_deg, theta_e_deg"),
    "late window": (
        RESPONSE,
        "fitting",
        ("--window-start", "16"),
        r"period of 10 s \(an earlier --window-start\)",
    ),
    "wrong period": (RESPONSE, "fitting", ("--period", "7"), r"\(without --period it is found; .* --method noise\)"),
    "wrong period, identified": (IDENTIFY, "fitting", ("--period", "7"), r"\(without --period it is found;"),
    "uneven period": (RESPONSE, "fitting", ("--period", "7.0012"), r"\(it is 700.12; convert --rate resamples\)"),
    "condition": (IDENTIFY, "fitting", ("--condition", "PT"), "no condition 'PT'; expected one of multisine"),
    "free inertia": (IDENTIFY, "fitting", ("--body", "male", "1.8", "80"), r"\(--fix m=0 --free i\)"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refusals_name_what_mends_them(name, folder, tmp_path, capsys):
    command, sidecar, options, message = REFUSALS[name]
    out = tmp_path / "results"
    line = refused(capsys, *asked(folder, out, command, sidecar, *options))
    assert re.search(message, line)
    assert not out.exists()


def test_noise_names_its_method(tmp_path, capsys):
    noise = replace(SETUP, kind="noise", n_trials=1, duration=12.0)
    line = refused(capsys, "response", write_csv(noise, *noise.record(), tmp_path), "--out", tmp_path / "r")
    assert re.search(r"does not repeat within .* \(for noise and pulses there is --method noise; .*: --period;", line)


@pytest.mark.slow(reason="identifies trials")
@pytest.mark.usefixtures("blank_pictures")
def test_what_is_missing_in_a_table_names_the_repair(signals, tmp_path, capsys):
    d, f, x = (part[:1].copy() for part in signals)
    x[0, 500:505] = np.nan
    path = write_csv(SETUP, d, f, x, tmp_path)
    line = refused(capsys, "response", path, "--out", tmp_path / "r")
    assert "(convert --repair gaps" in line
    assert run("convert", path, "--out", tmp_path / "mended.nc", "--repair", "gaps") == 0
    assert run("response", tmp_path / "mended.nc", "--out", tmp_path / "r") == 0


@pytest.mark.slow(reason="estimates responses")
@pytest.mark.usefixtures("blank_pictures")
def test_a_response_needs_no_lengths_and_the_manipulator_is_printed(folder, tmp_path, capsys):
    frames = []
    for sidecar in ("lengthless", "fitting"):
        assert run(*asked(folder, tmp_path / sidecar, RESPONSE, sidecar)) == 0
        assert "manipulator 1.6 kg, 12 Ns/m, 60" in capsys.readouterr().out
        frames.append((tmp_path / sidecar / "response.csv").read_text())
    assert frames[0] == frames[1]
    assert run(*asked(folder, tmp_path / "spectral", RESPONSE, "lengthless", "--method", "spectral")) == 0
    assert "manipulator 1.6 kg, 12 Ns/m, 60" in capsys.readouterr().out


@pytest.mark.slow(reason="tries all structures on a recording")
@pytest.mark.usefixtures("blank_pictures")
def test_two_commands_lead_from_files_to_parameters_page_and_ellipse(tmp_path, capsys):
    setup = replace(SETUP, n_trials=3, period=5.0, duration=14.0, lines="clusters")
    files = []
    for number, (d, f, x) in enumerate(zip(*setup.record(), strict=True)):
        files.append(tmp_path / f"t{number}.csv")
        time = np.arange(len(d)) / setup.rate
        table = np.column_stack([time, d, f, 1e3 * x])
        np.savetxt(files[-1], table, delimiter=",", header="t,Dx,Dy,Fx,Fy,X_mm,Y_mm", comments="")
    assert run("sidecar", files[0]) == 0
    said = capsys.readouterr().out
    assert f"for other files with these channels: --sidecar {tmp_path / 't0.json'}" in said
    options = (
        *("--sidecar", f"{tmp_path / 't0.json'}", "--out", f"{tmp_path / 'r'}"),
        *("--period", "5.0", "--estimator", "frequency"),
    )
    assert run("identify", *files, *options) == 0
    assert ": manipulator 1.6 kg, 12 Ns/m, 60" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "r").iterdir()} == {
        "admittance.csv", "arm.toml", "endpoint.csv", "endpoint.svg", "fit.json", "identify.html", "parameters.csv",
        "structure.toml",
    }  # fmt: skip
    page = (tmp_path / "r" / "identify.html").read_text(encoding="utf-8")
    typed = page[page.index("<pre>") + 5 : page.index("</pre>")].split()
    assert typed[:5] == ["armperturb", "identify", *map(str, files)]
    assert set(typed[5:]) == set(options)
