"""The documentation holds together: links, navigation, commands and symbols; `make docs` builds it."""

import dataclasses
import importlib
import re
import runpy
import tomllib
from pathlib import Path

import numpy as np
import pytest

from armperturb import POSITION, Multisine, Subject, cli, load_recording
from armperturb.perturbations import Perturbation
from armperturb.recording import MUSCLES, SIGNALS, TRIAL_COORDINATES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
TEXTS = [*PAGES, ROOT / "README.md"]
HOOKS = runpy.run_path(str(DOCS / "hooks.py"))
COMMANDS, REFERENCE = HOOKS["commands"](), HOOKS["reference"]()


def relative(path):
    return path.relative_to(ROOT).as_posix()


def without_code(text):
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.S)


def anchors(path):
    """Anchors of a page's headings, and of the modules that its reference shows."""
    text = path.read_text(encoding="utf-8")
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.S), re.M)
    kept = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    return {re.sub(r"[\s]+", "-", one) for one in kept} | set(re.findall(r"^::: (\S+)$", text, re.M))


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
    assert sorted(re.findall(r": (\S+\.md)$", nav, re.M)) == [page.relative_to(DOCS).as_posix() for page in PAGES]


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
    assert set(COMMANDS) == {one.strip() for one in offered.split(",")}
    assert (DOCS / "commands.md").read_text(encoding="utf-8").count(HOOKS["PLACE"]) == 1


@pytest.mark.parametrize("command", list(COMMANDS))
def test_reference_has_all_arguments_of_a_command(command, capsys):
    text = typed_help(capsys, command)
    section = REFERENCE.split(f"## {command}\n", 1)[1].split("\n## ", 1)[0]
    documented = {cells(row)[0].strip("`") for row in section.splitlines() if row.startswith("| `")}
    typed = set(re.findall(r"--[a-z][a-z-]*", text)) - {"--help"}
    assert {one for one in documented if one.startswith("--")} == typed
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
    monkeypatch.setattr(cli, "FILES", {kind: lambda _, sample=sample: sample for kind, sample in samples.items()})
    assert cli.main(arguments) == 1
    assert capsys.readouterr().err == "armperturb: error: understood\n"


def resolved(name):
    """What a dotted name of the package stands for; fields of dataclasses and named tuples count."""
    parts = ["armperturb", *name.split(".")]
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            if dataclasses.is_dataclass(found) and part in {field.name for field in dataclasses.fields(found)}:
                return found
            found = getattr(found, part)
        return found
    raise AssertionError(name)


def symbol_rows():
    for line in (DOCS / "symbols.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("| ") and not line.startswith("| symbol"):
            yield cells(line)


def test_symbols_name_code_that_exists():
    names = [name for row in symbol_rows() for name in re.findall(r"`([^`]+)`", row[1])]
    assert len(names) > 90
    for name in names:
        if variable := re.fullmatch(r'recording\["(\w+)"\]', name):
            assert variable.group(1) in {**SIGNALS, **TRIAL_COORDINATES}, name
        else:
            assert resolved(name) is not None, name


def test_page_on_the_report_names_code_that_exists():
    names = re.findall(r"`((?:study|analysis)\.[\w.]+)`", (DOCS / "report.md").read_text(encoding="utf-8"))
    assert len(names) > 15
    for name in names:
        assert resolved(name) is not None, name


def test_every_parameter_of_a_person_and_the_manipulator_has_a_symbol():
    from armperturb.environment import Environment, Strap
    from armperturb.subject import Subject

    named = " ".join(row[1] for row in symbol_rows())
    text = {Subject: {"task", "name", "muscle"}, Environment: {"workspace"}, Strap: set()}
    for kind, others in text.items():
        for field in dataclasses.fields(kind):
            assert field.name in others or f".{kind.__name__}.{field.name}`" in named, field.name


def test_every_parameter_of_a_muscle_law_has_a_symbol():
    from armperturb.controllers.muscle import MuscleState
    from armperturb.muscle_law import MuscleLaw

    rows = table_below((DOCS / "muscle.md").read_text(encoding="utf-8"), "Equations")
    named = [row[1].strip("`").removeprefix("MuscleState.") for row in rows]
    of_law = [field.name for field in dataclasses.fields(MuscleLaw)]
    assert set(named) - set(of_law) <= set(MuscleState.__annotations__)
    assert set(of_law) <= set(named)


def test_symbols_have_sources():
    for symbol, name, meaning, _, source in symbol_rows():
        assert meaning, (symbol, name)
        assert source, (symbol, name)


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
    study = ROOT / "armperturb" / "study"
    templates = "".join(path.read_text(encoding="utf-8") for path in sorted((study / "templates").glob("*.html")))
    shown = re.findall(r'call (?:figure|table)\("(\w+)"', templates)
    assert len(shown) > 30
    for name in shown:
        rest = r"[\w*]+" if name.endswith("_") else r"(?:\*|PT)?"  # some go on with the task
        assert re.search(rf"`(?:tables/)?{name}{rest}`|`tables/{name}\.csv`", text), name
    for title in re.findall(r'title="([^"]+)"', (study / "sections.py").read_text(encoding="utf-8")):
        assert re.search(rf"^## .*{title}", text, re.M | re.I), title


def python_blocks(name):
    return re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(encoding="utf-8"), re.S)


def test_recording_of_ones_own_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = python_blocks("format.md")
    exec(code, {})
    assert np.allclose(load_recording("S01.nc")["force"], 0.1 * load_recording("S01.nc")["perturbation"])


def test_first_files_are_written(tmp_path, monkeypatch):
    from armperturb import Subject, load_perturbation

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
    assert {re.match(r"[\w-]+", one).group().lower() for one in extra} <= names
    assert pinned == sorted(pinned, key=str.lower)
