"""`armperturb simulate --mjcf`: the laboratory around another model's arm."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_models import MUSCLE_ARM, TWO_LINK

import armperturb as ap
from armperturb import cli
from armperturb.analysis.trials import ConditionTrials


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "two_link.xml").write_text(TWO_LINK, encoding="utf-8")
    (tmp_path / "muscles.xml").write_text(MUSCLE_ARM, encoding="utf-8")
    pulse = ap.Pulse(peak=10.0, direction_deg=30.0, onset=0.05, duration=0.3)
    ap.save_perturbation(pulse, tmp_path / "pulse.csv", rate=200.0)
    return tmp_path


def simulate(folder, *options):
    return cli.main(
        ["simulate", "--perturbation", str(folder / "pulse.csv"), "--out", str(folder / "out.nc"), *options]
    )


@pytest.mark.slow(reason="runs whole commands")
def test_a_muscle_driven_arm_is_recorded(folder, capsys):
    options = ("--activation", "0.2", "--lock", "wrist", "--posture-deg", "q2=-10", "--reflex", "1", "0.1", "0.03")
    assert simulate(folder, "--mjcf", str(folder / "muscles.xml"), "--hand", "palm", *options) == 0
    printed = capsys.readouterr().out
    assert "muscles: 6, activation 0.199 on average" in printed
    recording = ap.load_recording(folder / "out.nc")
    assert recording["condition"].values == "activation 0.2"
    assert recording["theta_e_deg"].values == pytest.approx(
        80.0 + np.degrees(np.arctan2(0.05 * np.sin(np.radians(10)), 0.39)), abs=0.1
    )
    assert np.abs(recording["displacement"].values).max() > 1e-3


@pytest.mark.slow(reason="runs whole commands")
def test_a_person_is_recorded_as_fast_as_asked(folder, capsys):
    ap.RELAX.save(folder / "relax.toml")
    options = ("--subject", str(folder / "relax.toml"), "--rate", "1000")
    assert simulate(folder, *options) == 1
    assert "(the option timestep = 0.001 goes with this rate)" in capsys.readouterr().err
    assert simulate(folder, *options, "--timestep", "0.001") == 0
    assert "elbow" not in capsys.readouterr().out
    recording = ap.load_recording(folder / "out.nc")
    assert (recording.attrs["rate"], recording.sizes["time"]) == (1000.0, 300)


@pytest.mark.parametrize("of_model", [False, True])
def test_another_manipulator_is_what_the_recording_shows(folder, capsys, of_model):
    ap.RELAX.save(folder / "relax.toml")
    model = ("--mjcf", str(folder / "two_link.xml"), "--hand", "palm")
    arm = model if of_model else ("--subject", str(folder / "relax.toml"))
    multisine = ap.Multisine.draw(seed=0, rms=1.0, duration=8.0, crested=False)
    ap.save_perturbation(multisine, folder / "pulse.csv", rate=200.0)
    assert simulate(folder, *arm, "--ideal", "--manipulator", "5", "20", "100") == 0
    found = ConditionTrials.prepare(ap.load_recording(folder / "out.nc")).environment
    assert (found.m_env, found.b_env, found.k_env) == pytest.approx((5.0, 20.0, 100.0), rel=2e-3)
    assert simulate(folder, *arm, "--overwrite", "--manipulator", "-5", "20", "100") == 1
    assert "m_env = -5.0; expected" in capsys.readouterr().err


def test_an_elbow_past_straight_is_named(folder, capsys):
    replace(ap.RELAX, theta_e_deg=30.0).save(folder / "straight.toml")
    ap.save_perturbation(
        ap.Pulse(peak=200.0, direction_deg=60.0, onset=0.05, duration=0.6), folder / "pulse.csv", rate=200.0
    )
    assert simulate(folder, "--subject", str(folder / "straight.toml")) == 0
    assert "the elbow was bent from -" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--mjcf", "{}/two_link.xml"), "expected --hand SITE with --mjcf"),
        (("--hand", "palm"), "expected either --subject FILE or --mjcf FILE"),
        (("--subject", "{}/p.toml", "--gravity"), "--gravity without --mjcf"),
        (("--mjcf", "{}/two_link.xml", "--hand", "thumb"), "hand_site = 'thumb'; expected a site of the model (palm)"),
        (("--mjcf", "{}/two_link.xml", "--hand", "palm", "--activation", "0.1"), "for a model without muscles"),
        (("--mjcf", "{}/two_link.xml", "--hand", "palm", "--handle", "3", "0", "1"), "that the hand can reach"),
        (("--mjcf", "{}/two_link.xml", "--hand", "palm", "--posture-deg", "q1"), "expected JOINT=ANGLE in degrees"),
        (
            ("--mjcf", "{}/two_link.xml", "--hand", "palm", "--posture-deg", "q1=20", "q2=5", "q1=30"),
            "posture-deg has 'q1' twice; expected each joint once",
        ),
        (("--mjcf", "{}/none.xml", "--hand", "palm"), "none.xml"),
        (("--mjcf", "{}/two_link.xml", "--hand", "palm", "--out", "{}/o.csv"), "o.csv: ending '.csv'; expected .nc"),
        (
            ("--mjcf", "{}/two_link.xml", "--hand", "palm", "--rate", "160"),
            "rate = 160 Hz; expected above 160 Hz, as a filter of 80 Hz precedes the recorder (--ideal",
        ),
    ],
)
def test_refusals_are_one_line(folder, capsys, options, message):
    assert simulate(folder, *(option.format(folder) for option in options)) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (folder / "out.nc").exists()


def test_a_recording_of_a_joint_has_the_ending_of_its_format(tmp_path, capsys):
    assert cli.main(["joint", "--out", str(tmp_path / "o.mat")]) == 1
    assert "o.mat: ending '.mat'; expected .nc (convert makes .csv or .mat of it)" in capsys.readouterr().err


def test_a_recording_of_a_joint_has_a_rate_that_identify_takes(tmp_path, capsys):
    assert cli.main(["joint", "--rate", "10", "--out", str(tmp_path / "o.nc")]) == 1
    assert "joint: rate = 10.0; expected a finite number at least 50" in capsys.readouterr().err
