"""What README and examples show is what happens."""

import json
import re
import runpy
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from armperturb import RELAX, identify, load_perturbation
from armperturb.analysis.response.closed_loop import estimate_multisine
from armperturb.cohort import draw_person
from armperturb.convert import import_recording
from armperturb.recording import REQUIRED_SIGNALS
from armperturb.study.validation.validate import ValidateSettings, simulate_group

ROOT = Path(__file__).parents[1]


def test_readme_prints_what_it_says(capsys):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    code, result = re.search(r"```python\n(.*?)```\n\n```\n(.*?)```", readme, re.S).groups()
    exec(code, {})
    assert capsys.readouterr().out == result


def test_example_runs(tmp_path, capfd):
    runpy.run_path(str(ROOT / "examples" / "simulate_and_identify.py"))["main"](tmp_path / "folder")
    assert "m_tot" in capfd.readouterr().out
    assert (tmp_path / "folder" / "identified" / "fit.json").is_file()


def test_muscle_law_is_drawn(tmp_path, capsys):
    runpy.run_path(str(ROOT / "examples" / "muscle_law.py"))["main"](tmp_path / "law.png")
    assert (tmp_path / "law.png").read_bytes().startswith(b"\x89PNG")
    assert "wrote" in capsys.readouterr().out


def test_effort_and_accuracy_are_traded_off(tmp_path, capsys):
    example = runpy.run_path(str(ROOT / "examples" / "effort_and_accuracy.py"))
    example["main"](tmp_path / "folder", example["FAST"])
    assert (tmp_path / "folder" / "effort_and_accuracy.png").read_bytes().startswith(b"\x89PNG")
    assert "people, published" in capsys.readouterr().out


DATA = ROOT / "examples" / "data"
FORMATS = {
    "CSV": (["position.csv"], None),
    "MATLAB v5": (["position_v5.mat"], None),
    "MATLAB v7.3": (["position_v73.mat"], None),
    "C3D": (["position_1.c3d", "position_2.c3d"], DATA / "position_c3d.json"),
}


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example as from a terminal; returns what it printed and the functions that it has."""

    def call(name, *options):
        path = ROOT / "examples" / f"{name}.py"
        monkeypatch.setattr(sys, "argv", [str(path), "--out", str(tmp_path), *options])
        functions = runpy.run_path(str(path), run_name="__main__")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        return capsys.readouterr().out, functions

    return call


def numbers(text, begins):
    """Numbers of the line that begins so."""
    line = next(line for line in text.splitlines() if line.strip().startswith(begins))
    return [float(one) for one in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?!\w)", line.strip().removeprefix(begins))]


def truth_of(data):
    return json.loads((DATA / "truth.json").read_text(encoding="utf-8"))[data]


@pytest.fixture(scope="module")
def formats():
    return {
        name: import_recording([DATA / file for file in files], sidecar=sidecar)
        for name, (files, sidecar) in FORMATS.items()
    }


def test_data_are_read_without_a_note_and_are_what_their_readme_says(formats):
    person = draw_person(8, 0, muscles="linear").subjects["PT"]
    for found in formats.values():
        assert found.notes == ()
        assert found.recording.sizes["trial"] == 2
        assert found.recording.sizes["time"] == 6400
        np.testing.assert_allclose(found.recording["l_f"], person.l_f, rtol=1e-8)
    relax = import_recording([DATA / "relax.nc"]).recording
    assert (relax.sizes["trial"], relax.sizes["time"]) == (4, 6700)
    assert relax["pulse_onset"].values.tolist() == [32.0] * 4
    assert truth_of("position")["m_tot"] == pytest.approx(person.m_h + person.m_f)
    assert sum(path.stat().st_size for path in DATA.iterdir() if path.is_file()) < 3e6


def test_formats_that_hold_the_same_trials_give_the_same_estimates(formats):
    expected = formats["CSV"].recording
    fit = identify(expected, "3b").fit
    error = np.array([*fit.standard_error.values()])
    for name in ("MATLAB v5", "MATLAB v7.3", "C3D"):
        found = formats[name].recording
        for signal in REQUIRED_SIGNALS:  # single precision; C3D has the handle's place in the room besides
            np.testing.assert_allclose(found[signal], expected[signal], rtol=1e-7, atol=2e-8)
        np.testing.assert_allclose(
            estimate_multisine(found).response, estimate_multisine(expected).response, rtol=1e-4, atol=1e-9
        )
        off = np.array([*identify(found, "3b").fit.values.values()]) - [*fit.values.values()]
        assert np.abs(off / error).max() < 1e-2


def test_fit_of_a_recording_finds_the_truth(run):
    printed, _ = run("fit_my_own_recording")
    truth = truth_of("position")
    names = [name for name in truth if re.fullmatch(r"(b|k|kv|kp)_(s|se|e)", name)]
    assert len(names) == 12
    inside = 0
    for name in names:
        estimate, low, high, told = numbers(printed, name)
        assert told == pytest.approx(truth[name], abs=0.005)
        assert low < estimate < high
        inside += low <= truth[name] <= high
    assert inside >= 10  # 99.6 % of the time, were all independent
    mass, damping, stiffness = numbers(printed, "manipulator:")
    assert (mass, damping, stiffness) == pytest.approx((3.27, 0.55, 22.03), rel=0.02)  # as set
    assert "no faults" in printed


def test_fit_of_a_recording_with_the_wrong_sign_ends_in_one_line(run, tmp_path):
    (tmp_path / "mine.csv").symlink_to(DATA / "position.csv")
    sidecar = (DATA / "position.json").read_text(encoding="utf-8")
    (tmp_path / "other.json").write_text(sidecar.replace('"hand"', '"handle"'), encoding="utf-8")
    with pytest.raises(SystemExit, match="if the sign of force were turned") as refused:
        run("fit_my_own_recording", str(tmp_path / "mine.csv"), "--sidecar", str(tmp_path / "other.json"))
    assert "\n" not in str(refused.value)


def test_the_one_who_yields_is_not_linear_and_the_linear_one_is(run):
    printed, _ = run("how_nonlinear_is_my_subject")
    recording, control = printed.split("linear person:")
    for axis, truth in zip("xy", truth_of("relax")["distortion share"], strict=True):
        share, _, error = numbers(recording, f"{axis}:")
        assert share == pytest.approx(100 * truth, abs=2.5 * error)
        assert share > 2 * error
        share, _, error = numbers(control, f"{axis}:")
        assert abs(share) < 2.5 * error
    assert ": not linear" in recording
    assert "no sign of nonlinearity" in control
    _, predicted = numbers(control, "pulses:")
    assert predicted < 80.0  # a linear arm would predict all of it


def test_plan_keeps_its_limits_and_promises_more_than_the_thesis(run, tmp_path):
    printed, _ = run("plan_an_experiment", "--fast")
    (factor,) = numbers(printed, "geometric mean of the SEM of *:")
    worth, other = numbers(printed, "as from")
    assert 0.0 < other <= factor < 1.0  # people who are quieter under less load are not known worse
    assert worth == pytest.approx(factor**-2, rel=0.05)
    played = load_perturbation(tmp_path / "plan" / "perturbations" / "trial_01.csv")
    period = played.force[: round(20.48 * played.rate)]
    assert np.sqrt(np.mean(period**2, axis=0)).max() <= 5.4 * 1.001
    # What the plan says of the thesis's perturbation is near what the fit of such trials says of itself.
    pilot = identify(import_recording([DATA / "position.csv"]).recording, "3b").fit
    for name in ("kv_s", "kv_se", "kv_e", "kp_se", "kp_e"):
        value, usual, *_ = numbers(printed, name)
        assert usual * value / 100 == pytest.approx(np.sqrt(2) * pilot.standard_error[name], rel=0.5)
    # A standard error of 60 % after one trial is one of 10 % after 36.
    _, usual, better, *_ = numbers(printed, "kp_s")
    needed = numbers(printed.split("until the standard error")[1], "kp_s")
    assert needed == pytest.approx([(usual / 10) ** 2 + 0.5, (better / 10) ** 2 + 0.5], abs=0.7)


def test_textbook_estimator_is_right_without_the_persons_noise_and_is_found_out_with_it(run):
    printed, functions = run("validate_my_pipeline", "--fast")
    calm = ValidateSettings(task="RT", model="1", trials=1, noise=0.0)
    values, _ = functions["my_estimator"](simulate_group(calm, 0))
    for name, value in zip(functions["NAMES"], values, strict=True):
        true = getattr(RELAX, name)
        assert value == pytest.approx(true, rel=0.03)
        told, bias, rms, says, coverage = numbers(printed, f"package   {name}")
        assert told == true
        assert abs(bias) <= rms < 4 * says  # four groups
        assert coverage >= 50
    for name in ("k_s", "k_se", "k_e"):
        _, bias, _, says, coverage = numbers(printed, f"mine      {name}")
        assert abs(bias) > 5 * says
        assert coverage == 0
    assert numbers(printed, "mine      k_s")[1] < 0


def test_agent_learns_and_its_rewards_are_the_environments(run):
    printed, functions = run("train_an_agent", "--fast")
    before, learnt = (numbers(printed, name)[0] for name in ("before training", "learnt "))
    assert numbers(printed, "does nothing")[0] < before < learnt
    policy = np.array([0.4, 0.3, 0.2, 0.3, 0.1])
    mad = np.array([0.0, 0.0, 0.0, -3.0, -3.0])  # pushes along, until the workspace ends
    found = functions["rewards"](np.array([mad, policy]), range(3, 4))
    for place, one in enumerate((mad, policy)):
        env = gym.make("ArmPerturb/Position-v0", **functions["TASK"])
        senses, _ = env.reset(seed=3)
        total, over = 0.0, False
        while not over:
            senses, reward, terminated, truncated, _ = env.step(functions["act"](one[None], senses[None])[0])
            total, over = total + reward, terminated or truncated
        env.close()
        assert found[place, 0] == pytest.approx(total / 100, rel=1e-9)
        assert terminated == (one is mad)
