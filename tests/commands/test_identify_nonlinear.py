"""`identify --model nonlinear` from the command line."""

import csv
import json
import sys
from functools import partial

import nonlinear_trials as made
import numpy as np
import pytest

from armperturb import cli, workers
from armperturb.analysis.nonlinear import estimate, identify
from armperturb.analysis.results import PARAMETER_COLUMNS
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.recording_files import save_recording
from armperturb.subject import RELAX


@pytest.fixture(autouse=True, scope="module")
def compiled(once):
    once("compiled arms", made.compile_arms)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Fits in the presence of little drawn noise."""
    few = partial(identify.identify_nonlinear, n_pairs=1, n_pairs_of_errors=2)
    monkeypatch.setattr(identify, "identify_nonlinear", few)
    monkeypatch.setattr(workers, "cpu_count", lambda: 1)


def perturbed():
    """Two trials in each of two conditions, all with a pulse, to one side and the other."""
    trials = [
        Trial(
            subject=RELAX,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=seed, rms=rms, crested=False), peak=25.0, direction_deg=20.0 + 180.0 * i, tail=1.8
            ),
            condition=condition,
            repetition=i,
            pulse_level=1.0,
            seed=seed,
            noise=HUMAN_NOISE["RT"],
        )
        for seed, (condition, rms, i) in enumerate(
            (condition, rms, i) for condition, rms in (("RT7.5", 0.9), ("RT22.5", 1.8)) for i in range(2)
        )
    ]
    return run_experiment(trials, timestep=2.5e-3, instruments=Instruments(emg=None), n_threads=1)


@pytest.fixture
def path(once, tmp_path):
    save_recording(once("recording for nonlinear fits", lambda _: perturbed()), tmp_path / "r.nc")
    return tmp_path / "r.nc"


def run(path, *options, out="out"):
    arguments = ["identify", path, "--model", "nonlinear", "--out", path.parent / out, *options]
    return cli.main([str(argument) for argument in arguments])


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow(reason="simulates trials and fits them")
@pytest.mark.usefixtures("blank_pictures")
def test_a_search_that_is_interrupted_goes_on_and_writes_what_it_found(path, capsys, monkeypatch):
    out, save = path.parent / "out", estimate.save_position
    with monkeypatch.context() as patch:

        def at_once(*_, **__):
            raise KeyboardInterrupt

        patch.setattr(estimate, "save_position", at_once)
        assert run(path, "--law", "linear") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "armperturb: interrupted"  # nothing to continue from
    assert not out.exists()
    with monkeypatch.context() as patch:

        def interrupted(checkpoint, digest, position):
            save(checkpoint, digest, position)
            if position.n_steps == 2:
                raise KeyboardInterrupt

        patch.setattr(estimate, "save_position", interrupted)
        assert run(path, "--law", "linear") == 130
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == "armperturb: interrupted; the same command continues from here"
    assert said[-2].startswith("step 2 (noisy, stage 2 of 4): cost ")
    assert [file.name for file in out.iterdir()] == ["checkpoint.json.gz"]

    assert run(path, "--law", "linear") == 0
    captured = capsys.readouterr()
    assert captured.err.startswith("step 3 (")
    assert captured.out.startswith("Muscles of relax in RT: linear law, maximum likelihood of raw trials in 2 ")
    assert "\nconverged after " in captured.out
    assert sorted(file.name for file in out.iterdir()) == [
        "correlations.csv", "fit.json", "identify.html", "parameters.csv", "predictions.csv", "pulses.svg",
    ]  # fmt: skip
    page = (out / "identify.html").read_text()
    assert "Muscles of relax" in page
    assert all(f'id="{section}"' in page for section in ("parameters", "pulses", "data", "traces", "remarks", "method"))
    parameters = {row["parameter"]: row for row in rows(out / "parameters.csv")}
    assert tuple(next(iter(parameters.values()))) == PARAMETER_COLUMNS
    for name, true, unit in (("m_f", RELAX.m_f, "kg"), ("k.shoulder", RELAX.muscle_groups("k")[0], "Nm/rad")):
        row = parameters[name]
        assert row["unit"] == unit
        assert float(row["lower_95"]) < float(row["value"]) < float(row["upper_95"])
        assert float(row["value"]) == pytest.approx(true, rel=0.25)
    correlations = rows(out / "correlations.csv")
    assert [row["parameter"] for row in correlations] == list(parameters)
    assert float(correlations[2]["k.elbow"]) == pytest.approx(
        float(next(row for row in correlations if row["parameter"] == "k.elbow")[correlations[2]["parameter"]])
    )
    predictions = rows(out / "predictions.csv")
    assert {row["model"] for row in predictions} == {"nonlinear", "linear", "skeletal"}
    assert len(predictions) == 3 * 4
    # The person is linear: all models predict the pulse well.
    assert float(np.median([float(r["vaf_percent"]) for r in predictions if r["model"] == "skeletal"])) > 90.0
    summary = json.loads((out / "fit.json").read_text())
    assert summary["law"] == "linear"
    assert summary["converged"]
    assert summary["lack_of_fit"].keys() == {"RT7.5", "RT22.5"}
    assert summary["left_out_pulses"]["nonlinear"]["n"] == 4
    assert summary["choice"] is None


@pytest.mark.slow(reason="simulates trials")
def test_settings_that_do_not_go_together_are_refused(path, capsys):
    def refused(*options):
        assert run(path, *options) == 1
        return capsys.readouterr().err.strip()

    assert "identify: estimator = 'thesis'; expected 'record' with --model nonlinear" in refused(
        "--estimator", "thesis"
    )
    assert "identify: share = ('mass',); expected () with --model nonlinear" in refused("--share", "mass")
    assert "free: 'zeta_act'; expected some of Td, fact" in refused("--free", "zeta_act")
    assert "pulses: no pulse in the direction 77 deg; expected some of 20, 200" in refused("--pulses", "77")
    assert "no subject 'S99'; expected one of" in refused("--subject", "S99")
    assert "all pulses come before 45 s, or nothing perturbs the trials before them" in refused("--window-start", "45")
    assert not (path.parent / "out").exists()
    linear = ["identify", str(path), "--model", "1", "--out", str(path.parent / "o")]
    assert cli.main([*linear, "--law", "full"]) == 1
    assert "identify: law = 'full'; expected None without --model nonlinear" in capsys.readouterr().err


@pytest.mark.slow(reason="simulates trials")
def test_without_the_compiler_the_extra_is_named(path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "armperturb.planar_arm.compiled", raising=False)
    assert run(path) == 1
    assert "armperturb[nonlinear]" in capsys.readouterr().err
    assert not (path.parent / "out").exists()
