"""The documentation holds together: links, navigation, commands, symbols, equations; `make docs` builds it."""

import ast
import dataclasses
import html
import importlib.util
import re
import runpy
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

import armperturb
from armperturb import POSITION, Environment, Multisine, MuscleLaw, Strap, Subject, cli, load_recording
from armperturb.controllers.lanes import control_memory
from armperturb.perturbations import Perturbation
from armperturb.recording import MUSCLES, SIGNALS, TRIAL_COORDINATES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
TEXTS = [*PAGES, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "examples/README.md"))]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
HOOKS = runpy.run_path(str(DOCS / "hooks.py"))
COMMANDS, REFERENCE = HOOKS["commands"](), HOOKS["reference"]()


SCRIPTS = [path for folder in ("benchmarks", "docs", "examples") for path in sorted((ROOT / folder).rglob("*.py"))]


def relative(path):
    return path.relative_to(ROOT).as_posix()


def without_code(text):
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.S)


def anchors(path):
    """Anchors of a page's headings, and of the modules that its reference shows."""
    text = path.read_text(encoding="utf-8").replace(HOOKS["PLACE"], REFERENCE)
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M)
    plain = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    return {re.sub(r"[\s]+", "-", heading) for heading in plain} | set(re.findall(r"^::: (\S+)$", text, re.M))


def cells(row):
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", row.strip().strip("|"))]


def table_below(text, heading):
    """Rows of the first table below a heading."""
    part = text.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    rows = [line for line in part.splitlines() if line.startswith("|")]
    return [cells(row) for row in rows[2:]]


@pytest.mark.parametrize("page", TEXTS, ids=relative)
def test_links_and_pictures_lead_somewhere(page):
    for picture, target in re.findall(r"(!?)\[[^\]]*\]\(([^)\s]+)\)", without_code(page.read_text(encoding="utf-8"))):
        if "://" in target:
            assert not picture, f"{target}: the documentation loads nothing from elsewhere"
            continue
        name, _, anchor = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.is_file(), target
        assert not anchor or anchor in anchors(path), target


def test_every_page_is_in_the_navigation_once():
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n", 1)[1].split("\n\n", 1)[0]
    assert sorted(re.findall(r": (\S+\.md)$", nav, re.M)) == sorted(page.relative_to(DOCS).as_posix() for page in PAGES)


def test_site_loads_nothing_from_elsewhere():
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "\n  font: false" in settings
    assert "://" not in settings


def typed_help(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        cli.main([*arguments, "--help"])
    assert end.value.code == 0
    return re.sub(r"(\x1b\[[0-9;]*m|[\s│])+", " ", capsys.readouterr().out)


def test_reference_has_the_commands_that_can_be_typed(capsys):
    offered = re.search(r"\{([a-z,\s]+)\}", typed_help(capsys)).group(1)
    assert set(COMMANDS) == {name.strip() for name in offered.split(",")}
    assert (DOCS / "commands.md").read_text(encoding="utf-8").count(HOOKS["PLACE"]) == 1


@pytest.mark.parametrize("command", list(COMMANDS))
def test_reference_has_all_arguments_of_a_command(command, capsys):
    text = typed_help(capsys, command)
    section = REFERENCE.split(f"## {command}\n", 1)[1].split("\n## ", 1)[0]
    documented = {cells(row)[0].strip("`") for row in section.splitlines() if row.startswith("| `")}
    typed = set(re.findall(r"--[a-z][a-z-]*", text)) - {"--help"}
    assert {name for name in documented if name.startswith("--")} == typed
    for row in section.splitlines():
        if row.startswith("| `"):
            name, values, default, meaning = cells(row)
            assert meaning, name
            assert name.strip("`").lstrip("-").upper() in text.upper(), name
            for value in re.findall(r"`([^`]+)`", values) + re.findall(r"`([^`]+)`", default):
                assert value in text, (name, value)


def commands_shown():
    """Command lines in code blocks, but for synopses with brackets."""
    for page in TEXTS:
        blocks = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.S | re.M)
        lines = re.findall(r"^ {4}(armperturb .*)$", page.read_text(encoding="utf-8"), re.M)
        lines += [line for language, block in blocks if language in ("", "sh") for line in block.splitlines()]
        for line in lines:
            typed = line.lstrip("$ ").partition(" #")[0].strip()
            if typed.startswith("armperturb ") and not re.search(r"[\[|]", typed):
                yield pytest.param(typed.split()[1:], id=f"{page.name}: {typed}")


@pytest.mark.parametrize("arguments", list(commands_shown()))
def test_commands_that_are_shown_can_be_typed(arguments, monkeypatch, capsys):
    def understood(*_):
        raise ValueError("understood")

    for kind in COMMANDS.values():
        monkeypatch.setattr(kind, "run", understood)
    monkeypatch.setattr(cli, "require_simulator", lambda: None)
    samples = {Subject: POSITION, Perturbation: Multisine.draw(seed=0, rms=1.0, crested=False)}
    readers = {kind: lambda _, sample=sample: sample for kind, sample in samples.items()}
    monkeypatch.setattr(cli, "files", lambda: readers)
    assert cli.main(arguments) == 1
    assert capsys.readouterr().err == "armperturb: error: understood\n"


def symbols():
    """Names in code of the glossary, without quotes."""
    rows = [line for line in (DOCS / "glossary.md").read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", cells(row)[1])}


def test_symbols_name_code_that_exists():
    kinds = (Subject, MuscleLaw, Environment, Strap)
    names = {f"{kind.__name__}.{field.name}" for kind in kinds for field in dataclasses.fields(kind)}
    names |= {f"memory.{name}" for name in control_memory(1, 1, 1).dtype.names}
    names |= {f'recording["{name}"]' for name in (*SIGNALS, *TRIAL_COORDINATES)}
    assert symbols() <= names


def test_every_parameter_has_a_symbol():
    text = {Subject: {"task", "name", "muscle"}, Environment: {"workspace"}, Strap: set(), MuscleLaw: set()}
    for kind, others in text.items():
        assert {
            f"{kind.__name__}.{field.name}" for field in dataclasses.fields(kind) if field.name not in others
        } <= symbols()


def test_every_term_is_defined_once():
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    terms = [row[0] for heading in ("Tasks and conditions", "Terms") for row in table_below(text, heading)]
    assert len(terms) > 40
    assert len(set(terms)) == len(terms)


@pytest.mark.parametrize("page", ["docs/verification.md", "CONTRIBUTING.md"])
def test_files_that_are_named_exist(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    names = re.findall(r"\b((?:tests|armperturb|docs|examples)/[\w./-]+\.(?:py|md|html|toml))\b", text)
    names += [name.replace(".", "/") + ".py" for name in re.findall(r"python -m (benchmarks\.\w+)", text)]
    assert len(names) > 10
    assert [name for name in names if not (ROOT / name).is_file()] == []


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 800


def test_citation_is_of_this_version():
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {"cff-version: 1.2.0", f"version: {project['version']}", f"license: {project['license']}"} <= set(lines)
    assert armperturb.__version__ == project["version"]


EQUATION = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", re.S)


@pytest.mark.slow("starts a browser")
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH: equations are not drawn")
def test_equations_are_drawn(tmp_path):
    equations = [
        (page.name, *found) for page in PAGES for found in EQUATION.findall(without_code(page.read_text("utf-8")))
    ]
    assert len(equations) > 150
    places = "".join(
        f'<{tag} class="arithmatex">\\({html.escape(display or inline)}\\)</{tag}>'
        for _, display, inline in equations
        for tag in (["div"] if display else ["span"])
    )
    scripts = "".join(
        f'<script src="{(DOCS / "katex" / name).as_uri()}"></script>' for name in ("katex.min.js", "equations.js")
    )
    (tmp_path / "page.html").write_text(f"<!DOCTYPE html><meta charset=utf-8><body>{places}{scripts}", encoding="utf-8")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", (tmp_path / "page.html").as_uri()]
    drawn = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert drawn.count('class="katex"') == len(equations)
    assert re.findall(r'class="katex-error"[^>]*title="([^"]*)"', drawn) == []


def test_recording_format_is_that_of_the_code():
    text = (DOCS / "format.md").read_text(encoding="utf-8")
    signals = {row[0].strip("`"): row[1:3] for row in table_below(text, "Variables")}
    assert signals == {name: [", ".join(("trial", *dims)), unit] for name, (dims, unit, _) in SIGNALS.items()}
    along = {row[0].strip("`"): row[1] for row in table_below(text, "Coordinates along `trial`")}
    assert set(along) == set(TRIAL_COORDINATES)
    for name, (unit, _) in TRIAL_COORDINATES.items():
        assert not unit or along[name] == unit
    assert [name for name in re.findall(r"`(\w+)`", text.split("Muscles, in order:")[1])][: len(MUSCLES)] == [*MUSCLES]


def test_page_on_the_report_names_every_section_table_and_figure():
    text = (DOCS / "report.md").read_text(encoding="utf-8")
    report = ROOT / "armperturb" / "study" / "report"
    templates = "".join(path.read_text(encoding="utf-8") for path in sorted((report / "templates").glob("*.html")))
    shown = re.findall(r'call (?:figure|table)\("(\w+)"', templates)
    assert len(shown) > 30
    for name in shown:
        rest = r"[\w*]+" if name.endswith("_") else r"(?:\*|PT)?"  # some go on with the task
        assert re.search(rf"`(?:tables/)?{name}{rest}`|`tables/{name}\.csv`", text), name
    for title in re.findall(r'title="([^"]+)"', (report / "sections.py").read_text(encoding="utf-8")):
        assert re.search(rf"^## .*{title}", text, re.M | re.I), title


def python_blocks(name):
    return re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), re.S)


def test_recording_of_ones_own_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = python_blocks("format.md")
    exec(code, {})
    assert np.allclose(load_recording("S01.nc")["force"], 0.1 * load_recording("S01.nc")["perturbation"])


@pytest.mark.slow(reason="runs a block of the documentation")
def test_first_files_are_written(tmp_path, monkeypatch):
    from armperturb import load_perturbation

    monkeypatch.chdir(tmp_path)
    exec(python_blocks("index.md")[0], {})
    assert Subject.load("position.toml").task == "PT"
    assert load_perturbation("multisine_2.csv")


def test_versions_of_the_documentation_are_pinned():
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"][
        "docs"
    ]
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    names = {line.partition("==")[0].lower() for line in pinned}
    assert {re.match(r"[\w-]+", package).group().lower() for package in extra} <= names
    assert pinned == sorted(pinned, key=str.lower)


@pytest.mark.slow(reason="imports what scripts import")
def test_scripts_import_what_there_is():
    """They run by hand, seldom, and after a change of names would fail unnoticed."""
    missing = []
    for path in SCRIPTS:
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
        for node in [node for node in imports if node.module.split(".")[0] == "armperturb"]:
            module = importlib.import_module(node.module)
            missing += [f"{relative(path)}: {alias.name}" for alias in node.names if not _has(module, alias.name)]
    assert not missing


def _has(module, name):
    is_package = hasattr(module, "__path__")
    return hasattr(module, name) or (is_package and importlib.util.find_spec(f"{module.__name__}.{name}") is not None)
