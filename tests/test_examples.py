"""What README and examples show is what happens."""

import re
import runpy
from pathlib import Path

ROOT = Path(__file__).parent.parent


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
