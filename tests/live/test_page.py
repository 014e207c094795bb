"""The live laboratory: one small offline page whose arm is that of the package."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from importlib import resources

import pytest

from armperturb.cli import main
from armperturb.cohort import average_person
from armperturb.live.page import PEOPLE, arm_values, live_page
from armperturb.subject import POSITION, RELAX
from tests.live.arms import REVIVE, compared, require_agreement, too_fast, values_of

MOST_BYTES = 300_000
NODE = shutil.which("node")


@pytest.fixture(scope="module")
def page():
    return live_page({"mine": replace(RELAX, name="mine")})


def data_of(page):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, flags=re.S)[1])


@pytest.mark.slow(reason="makes the page")
def test_is_small_and_asks_for_nothing(page):
    assert len(page.encode()) < MOST_BYTES
    assert set(re.findall(r'(?:src|href)="([^"]*)"', page)) <= {"data:,", "#"}
    assert not re.search(r"@import|url\(|https?:", page)


def test_has_people_of_both_tasks_and_the_given_arm_first(page):
    presets = data_of(page)["presets"]
    assert next(iter(presets)) == "mine"
    assert presets["mine"]["k_s"] == RELAX.k_s
    assert sum(name.endswith("relaxing") and name.startswith("S") for name in presets) == PEOPLE
    average = average_person()
    held = presets["average person, holding as in PT22.5"]
    assert held["k_e"] == pytest.approx(average.levels["PT22.5"] * average.subjects["PT"].k_e)


def test_infinite_values_are_none():
    muscle = arm_values(average_person().subjects["RT"])["muscle"]
    assert muscle["spindle_saturation"] == [None] * 3
    assert [len(parts) for parts in muscle["shape"]] == [8] * 3


@pytest.mark.slow(reason="starts node")
@pytest.mark.skipif(NODE is None, reason="no node on PATH: tests/live/test_browser.py compares in a browser")
def test_javascript_has_the_admittance_poles_and_movements_of_python():
    folder = resources.files("armperturb.live") / "templates"
    model = "\n".join((folder / name).read_text(encoding="utf-8") for name in ("eigenvalues.js", "model.js"))
    ask = 'console.log(JSON.stringify(answers(JSON.parse(require("fs").readFileSync(0, "utf8")))))'
    subjects = [*compared(), *too_fast()]
    given = json.dumps([values_of(subject) for subject in subjects])
    script = f"{model}\n{REVIVE}\n{ask}"
    said = subprocess.run([NODE, "-e", script], input=given, capture_output=True, text=True, check=True)
    require_agreement(subjects, json.loads(said.stdout))


def test_refuses_what_it_does_not_have():
    with pytest.raises(ValueError, match=r"kf_e = -0\.2; expected 0 in the live laboratory"):
        arm_values(replace(POSITION, kf_e=-0.2))
    with pytest.raises(ValueError, match="expected a finite grip stiffness"):
        arm_values(replace(POSITION, k_h=float("inf")))
    with pytest.raises(ValueError, match=r"delay = 0\.002 s; expected at least three steps of 0\.0025 s"):
        arm_values(replace(POSITION, Td_e=0.002))


@pytest.mark.slow(reason="reads in child processes")
def test_command_writes_the_page_with_arms_from_files(tmp_path, capsys):
    RELAX.save(tmp_path / "arm.toml")
    assert main(["live", "--out", str(tmp_path / "live.html"), "--arms", str(tmp_path / "arm.toml")]) == 0
    assert capsys.readouterr().out == f"live laboratory: {tmp_path / 'live.html'}\n"
    assert str(tmp_path / "arm") in data_of((tmp_path / "live.html").read_text(encoding="utf-8"))["presets"]
    assert main(["live", "--out", str(tmp_path / "live.html")]) == 1
    assert "live.html: exists already; expected a new name (--overwrite replaces" in capsys.readouterr().err
    assert main(["live", "--out", str(tmp_path / "arm.toml"), "--arms", str(tmp_path / "arm.toml"), "--overwrite"]) == 1
    assert "arm.toml: is an input of this command" in capsys.readouterr().err
    assert main(["live", "--out", str(tmp_path / "live.html"), "--overwrite"]) == 0
