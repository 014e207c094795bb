"""Figures that are kept: drawn once, and anew when what they show changes."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from armperturb.files import checksum
from armperturb.pages import page as pages
from armperturb.study.comparison.effects import effects
from armperturb.study.report import pictures
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.figures.catalogue import drawings
from armperturb.study.report.pictures import picture_units
from tests.studies import plain_picture, sketch


def sources(study):
    """Figure to what it is drawn from."""
    draws = drawings(study, effects(study))
    checksums = {path.name: checksum(path) for path in study.recordings.values()}
    units = picture_units(draws, checksums, Path())
    return {name: unit.cached.source for name, unit in zip(draws, units, strict=True)}


def changed(before, other):
    """Figures that are drawn from something else in another study."""
    after = sources(other)
    assert before.keys() == after.keys()
    return {name for name in before if before[name] != after[name]}


@pytest.fixture
def moved(study, tmp_path):
    """The same study in a folder of the test's own."""
    paths = {name: Path(shutil.copy(path, tmp_path)) for name, path in study.recordings.items()}
    cases = tuple(replace(case, recording=paths[case.name]) for case in study.cases)
    return replace(study, recordings=paths, cases=cases)


def test_figures_depend_on_what_they_show(study, moved, monkeypatch):
    before = sources(study)
    assert changed(before, replace(moved, missing=("a line",), remarks=("another",))) == set()

    first, *others = (case for case in study.cases if case.condition.name == "PT7.5")
    everybody, of_first, of_others = (
        changed(
            before,
            replace(study, cases=tuple(replace(case, force=1.0) if case in chosen else case for case in study.cases)),
        )
        for chosen in (study.cases, [first], others)
    )
    assert {"admittance_by_task", "coherence", "rig"} <= of_others
    assert of_first - of_others == {"admittance_PT", "fit_PT", "prediction_PT", "perturbation"}
    assert everybody == of_first | {"admittance_RT", "fit_RT", "prediction_RT"}
    assert "pulse_signal" not in everybody

    path = moved.cases[0].recording
    path.write_bytes(path.read_bytes() + b"\0")
    assert {"fit_PT", "prediction_PT", "prediction_RT", "perturbation"} <= changed(before, moved)

    monkeypatch.setattr(pictures, "program", lambda: "another")
    assert not [name for name, source in sources(study).items() if source == before[name]]


@pytest.mark.slow(reason="starts a process")
def test_the_program_is_its_files_and_the_libraries_that_draw(tmp_path, monkeypatch):
    checksum = pictures.program.__wrapped__
    assert checksum() == checksum()
    seen = {checksum()}
    with monkeypatch.context() as patch:
        patch.setattr(pictures.metadata, "version", lambda name: "0")
        seen.add(checksum())
    monkeypatch.setattr(pictures.armperturb, "__file__", str(tmp_path / "__init__.py"))
    for name, text in (("a.py", "1"), ("a.py", "2"), ("b.py", ""), ("__pycache__/a.nbi", "compiled")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        seen.add(checksum())
    assert len(seen) == 5  # not that of what was compiled


def test_a_figure_is_drawn_once(study, tmp_path, monkeypatch):
    drawn = []

    def svg(figure):
        drawn.append(figure)
        return f"<svg>{len(drawn)}</svg>".encode()

    monkeypatch.setattr(pages, "svg", svg)
    monkeypatch.setattr(rig_figures, "render", plain_picture)
    figures = ("prediction_PT", "peak_displacement", "rig", "trajectories_PT")
    page = sketch(study, tmp_path, figures)
    assert len(drawn) == len(figures)
    files = {name: tmp_path / "figures" / f"{name}.svg" for name in figures}
    content = {name: path.read_bytes() for name, path in files.items()}
    files["prediction_PT"].write_text("scribbled on")
    files["rig"].unlink()
    assert sketch(replace(study), tmp_path, figures) == page
    assert len(drawn) == len(figures)
    assert {name: path.read_bytes() for name, path in files.items()} == content

    (tmp_path / "analysis" / "figure-rig.json.gz").write_bytes(b"damaged")
    cases = tuple(replace(case, force=2.0 * case.force) for case in study.cases)
    sketch(replace(study, cases=cases), tmp_path, figures)
    assert len(drawn) == len(figures) + 3  # all but the paths of the first person's handle


def test_what_cannot_be_drawn_is_tried_again(study, tmp_path, monkeypatch):
    def without_library(*args, **options):
        raise RuntimeError("render: no OpenGL context")

    nobody = replace(study, cases=(), people=())
    monkeypatch.setattr(rig_figures, "render", without_library)
    assert "no OpenGL context" in sketch(nobody, tmp_path, ("rig",))
    monkeypatch.setattr(rig_figures, "render", plain_picture)
    assert "no OpenGL context" not in sketch(nobody, tmp_path, ("rig",))
    assert (tmp_path / "figures" / "rig.svg").exists()
