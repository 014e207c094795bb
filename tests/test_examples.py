"""What README, tutorials and examples show is what happens."""

import ast
import json
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import armperturb
from armperturb import RELAX
from armperturb.analysis.response.multisines import estimate_multisine
from armperturb.cohort import draw_person
from armperturb.pages.page import Picture
from armperturb.perturbations import multisine
from armperturb.recording import REQUIRED_SIGNALS
from armperturb.study.report.figures import rig as rig_figures

ROOT = Path(__file__).parents[1]
EXAMPLES, TUTORIALS = ROOT / "examples", ROOT / "docs" / "tutorials"
MAKE = runpy.run_path(str(TUTORIALS / "make.py"))


@pytest.fixture(scope="module", autouse=True)
def each_once():
    """Several of them read the same files, identify the same trials and draw the same multisines: once suffices."""
    read, identify, lower = armperturb.import_recording, armperturb.identify, multisine.reduce_crest
    recordings, identified, lowered = {}, {}, {}

    def read_once(paths, *, sidecar=None):
        key = (*(Path(path).resolve() for path in paths), sidecar)
        if key not in recordings:
            recordings[key] = read(paths, sidecar=sidecar)
        return recordings[key]

    def identify_once(recording, model):
        key = id(recording), model
        if key not in identified:
            identified[key] = recording, identify(recording, model)  # which keeps the recording, and so its id
        return identified[key][1]

    def lower_once(*arrays):
        key = b"".join(array.tobytes() for array in arrays)
        if key not in lowered:
            lowered[key] = lower(*arrays)
        return lowered[key].copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(armperturb, "import_recording", read_once)
        patch.setattr(armperturb, "identify", identify_once)
        patch.setattr(multisine, "reduce_crest", lower_once)
        yield


@pytest.mark.slow("simulates eight trials")
def test_readme_prints_what_it_says(capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = re.findall(r"```python\n(.*?)```\n\n```\n(.*?)```", readme, re.S)
    assert len(shown) == 3
    for code, result in shown:
        exec(code, {})
        assert capsys.readouterr().out == result


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_examples_need_the_public_names_alone(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        assert not (isinstance(node, ast.ImportFrom) and (node.module or "").startswith("armperturb")), path
        if isinstance(node, ast.Import):
            assert not [alias.name for alias in node.names if alias.name.startswith("armperturb.")]


@pytest.mark.parametrize("name", MAKE["NAMES"])
def test_tutorial_has_the_cells_of_its_script(name):
    cells = MAKE["cells"](name)
    page = (TUTORIALS / f"{name}.md").read_text(encoding="utf-8")
    assert re.findall(r"```python\n(.*?)\n```", page, re.S) == [cell.source for cell in cells if cell.kind == "code"]
    place = 0
    for cell in cells:
        place = page.index(cell.source, place)
    assert (TUTORIALS / f"{name}.ipynb").read_text(encoding="utf-8") == MAKE["notebook"](name)
    pictures = set(re.findall(r"!\[[^\]]+\]\((\S+)\)", page))
    assert pictures == {path.name for path in TUTORIALS.glob(f"{name}_*.png")}


def test_pictures_of_the_documentation_are_small():
    assert sum(path.stat().st_size for path in TUTORIALS.glob("*.png")) < 1e6


NUMBER = r"[-+]?\d+(?:\.(\d+))?(?:e([-+]\d+))?"


def assert_is_on_the_page(name, printed, *, with_numbers):
    """The page has these words, and numbers that differ by 1 % or two of their last digit, as between machines."""
    page = (TUTORIALS / f"{name}.md").read_text(encoding="utf-8")
    shown, printed = (
        re.sub(r"\S+ MB|\s+", " ", text)  # the report's pictures are not drawn
        for text in ("\n".join(re.findall(r"```text\n(.*?)```", page, re.S)), printed)
    )
    assert re.sub(NUMBER, "#", printed).split() == re.sub(NUMBER, "#", shown).split()
    for here, there in zip(re.finditer(NUMBER, printed), re.finditer(NUMBER, shown), strict=True):
        last = 10.0 ** (int(there[2] or 0) - len(there[1] or ""))
        assert not with_numbers or float(here[0]) == pytest.approx(float(there[0]), rel=0.01, abs=2.1 * last), here[0]


@pytest.fixture
def tutorial(monkeypatch):
    """What the cells of a tutorial print when it runs, as one text; its figures are made, but not drawn."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)

    def run(name, *, with_numbers=True):
        printed = "".join(output.text for output in MAKE["run"](name))
        assert_is_on_the_page(name, printed, with_numbers=with_numbers)
        return printed

    return run


@pytest.mark.slow("two fits and their figures")
def test_fit_of_a_recording_finds_the_truth(tutorial):
    printed = tutorial("fit_my_recording")
    assert "as it would if the sign of force were turned" in printed
    rows = re.findall(r"^ *(\w+) .* (True|False)$", printed, re.M)
    assert len(rows) == 13
    assert dict(rows)["m_tot"] == "False"  # as the text says
    assert sum(inside == "True" for _, inside in rows) >= 10  # 99.6 % of the time, were all independent


@pytest.mark.slow("simulates six trials and a study")
def test_study_of_the_tutorial_is_reported_and_finds_the_truth(tutorial, studies, monkeypatch):
    # Figures are made, but not drawn as SVG, which is most of a small report's time and tested with the report.
    monkeypatch.setattr(rig_figures, "render", studies.plain_picture)
    monkeypatch.setattr(Picture, "of", lambda figure: Picture("<svg/>", *map(float, figure.get_size_inches())))
    printed = tutorial("simulate_a_laboratory")
    low, high, true, share = map(
        float, re.search(r"linear muscles: k_s = (\S+) to (\S+) .* (\S+); .* (\S+)%", printed).groups()
    )
    assert low < true < high
    assert share < 1.0
    assert float(re.search(r"nonlinear muscles: .* (\S+)%", printed).group(1)) > 4.0
    assert "study/report.html" in printed


@pytest.mark.slow("optimises a multisine")
def test_plan_promises_more_than_the_thesis(tutorial):
    printed = tutorial("plan_an_experiment")
    needed = {
        name: (int(usual), int(better))
        for name, usual, better in re.findall(r"^(\w+) .* after +(\d+) .*, +(\d+) opt", printed, re.M)
    }
    assert len(needed) == 6
    assert all(better <= usual for usual, better in needed.values())
    assert needed["kp_s"][1] < 0.5 * needed["kp_s"][0]
    assert 6.0 < float(re.search(r"RMS displacement .*: (\S+) mm", printed).group(1)) < 7.5 * 1.02  # 1.6 periods


@pytest.mark.slow("trains for eight generations")
def test_agent_learns(tutorial):
    printed = tutorial("train_an_agent", with_numbers=False)  # which learning makes of differences in the last digit
    nothing, before, learnt = (
        float(re.search(rf"^{name} +(\S+)$", printed, re.M).group(1))
        for name in ("does nothing", "before training", "learnt")
    )
    assert nothing < before < learnt
    gain, error = map(float, re.search(r"learnt - before: (\S+), standard error (\S+)", printed).groups())
    assert gain > 2.0 * error


@pytest.mark.slow("integrates textbook experiments")
def test_muscle_law_is_drawn(tmp_path, capsys):
    runpy.run_path(str(ROOT / "docs" / "figures" / "muscle_law.py"))["main"](tmp_path / "law.png")
    assert (tmp_path / "law.png").read_bytes().startswith(b"\x89PNG")
    assert "wrote" in capsys.readouterr().out


@pytest.mark.slow("optimises levels in simulations")
def test_effort_and_accuracy_are_traded_off(tmp_path, capsys):
    example = runpy.run_path(str(ROOT / "docs" / "figures" / "effort_and_accuracy.py"))
    example["main"](tmp_path / "folder", example["FAST"])
    assert (tmp_path / "folder" / "effort_and_accuracy.png").read_bytes().startswith(b"\x89PNG")
    assert "people, published" in capsys.readouterr().out


DATA = EXAMPLES / "data"
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
        assert [*tmp_path.glob("*.png")]
        return capsys.readouterr().out, functions

    return call


def numbers(text, begins):
    """Numbers of the line that begins so."""
    line = next(line for line in text.splitlines() if line.strip().startswith(begins))
    return [
        float(number) for number in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?!\w)", line.strip().removeprefix(begins))
    ]


def truth_of(data):
    return json.loads((DATA / "truth.json").read_text(encoding="utf-8"))[data]


@pytest.fixture(scope="module")
def formats():
    return {
        name: armperturb.import_recording([DATA / file for file in files], sidecar=sidecar)
        for name, (files, sidecar) in FORMATS.items()
    }


@pytest.mark.slow("reads four formats")
def test_data_are_read_without_a_note_and_are_what_their_readme_says(formats):
    person = draw_person(8, 0, muscles="linear").subjects["PT"]
    for imported in formats.values():
        assert imported.notes == ()
        assert imported.recording.sizes["trial"] == 2
        assert imported.recording.sizes["time"] == 6400
        np.testing.assert_allclose(imported.recording["l_f"], person.l_f, rtol=1e-8)
    relax = armperturb.import_recording([DATA / "relax.nc"]).recording
    assert (relax.sizes["trial"], relax.sizes["time"]) == (4, 6700)
    assert relax["pulse_onset"].values.tolist() == [32.0] * 4
    assert truth_of("position")["m_tot"] == pytest.approx(person.m_h + person.m_f)
    assert sum(path.stat().st_size for path in DATA.iterdir() if path.is_file()) < 3e6


@pytest.mark.slow("identifies the trials of four formats")
def test_formats_that_hold_the_same_trials_give_the_same_estimates(formats):
    expected = formats["CSV"].recording
    fit = armperturb.identify(expected, "3b").fit
    error = np.array([*fit.standard_error.values()])
    for name in ("MATLAB v5", "MATLAB v7.3", "C3D"):
        recording = formats[name].recording
        for signal in REQUIRED_SIGNALS:  # single precision; C3D has the handle's place in the room besides
            np.testing.assert_allclose(recording[signal], expected[signal], rtol=1e-7, atol=2e-8)
        np.testing.assert_allclose(
            estimate_multisine(recording).response, estimate_multisine(expected).response, rtol=1e-4, atol=1e-9
        )
        off = np.array([*armperturb.identify(recording, "3b").fit.values.values()]) - [*fit.values.values()]
        assert np.abs(off / error).max() < 1e-2


@pytest.mark.slow("simulates the control")
def test_nonlinear_person_is_not_linear_and_the_control_is(run):
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


@pytest.mark.slow("simulates five groups of trials")
def test_textbook_estimator_is_right_without_the_persons_noise_and_is_exposed_with_it(run):
    printed, functions = run("validate_my_pipeline", "--fast")
    values, _ = functions["my_estimator"](functions["simulate"](0, noise=None))
    for name, value in zip(functions["NAMES"], values, strict=True):
        true = getattr(RELAX, name)
        assert value == pytest.approx(true, rel=0.03)
        shown, bias, rms, reported, coverage = numbers(printed, f"package   {name}")
        assert shown == true
        assert abs(bias) <= rms < 4 * reported  # four groups
        assert coverage >= 50
    for name in ("k_s", "k_se", "k_e"):
        _, bias, _, reported, coverage = numbers(printed, f"mine      {name}")
        assert abs(bias) > 5 * reported
        assert coverage == 0
    assert numbers(printed, "mine      k_s")[1] < 0
