"""What a study folder says of how it was made: refused by field and value where it makes no sense."""

import json

import pytest

from armperturb.cohort import draw_cohort
from armperturb.environment import Environment
from armperturb.study.protocol import THESIS
from armperturb.study.recording.manifest import Manifest, read_manifest
from armperturb.study.recording.settings import StudySettings


@pytest.fixture(scope="module")
def made():
    people = draw_cohort(2, 3, muscles="linear")
    return Manifest.of(people, THESIS, StudySettings(seed=3, ideal=True, muscles="linear"))


def test_comes_back_as_it_was_and_draws_its_people(made, tmp_path):
    (tmp_path / "manifest.json").write_text(json.dumps(made.to_dict()))
    found = read_manifest(tmp_path)
    assert found == made
    assert found.draw_people(Environment()) == draw_cohort(2, 3, muscles="linear")


def test_other_people_are_none(made):
    values = {**made.to_dict(), "people": "of another version"}
    assert Manifest.from_dict(values, "here").draw_people(Environment()) is None


def test_no_manifest_is_none(tmp_path):
    assert read_manifest(tmp_path) is None


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("subjects", "a", "subjects = 'a'"),
        ("subjects", -1, "subjects = -1"),
        ("subjects", 1e9, "subjects = 1000000000.0"),
        ("seed", "abc", "seed = 'abc'"),
        ("seed", -3, "seed = -3"),
        ("muscles", "strange", "muscles = 'strange'; expected one of"),
        ("protocol", 7, "protocol"),
        ("versions", [], "versions"),
    ],
)
def test_values_without_sense_are_refused_by_name(made, field, value, told):
    with pytest.raises(ValueError, match=told) as refused:
        Manifest.from_dict({**made.to_dict(), field: value}, "results/manifest.json")
    assert "results/manifest.json" in str(refused.value)


@pytest.mark.parametrize("field", ["versions", "subjects", "seed", "ideal", "muscles", "people", "protocol"])
def test_missing_values_are_named(made, field):
    values = made.to_dict()
    del values[field]
    with pytest.raises(ValueError, match=f"here: no '{field}'"):
        Manifest.from_dict(values, "here")


@pytest.mark.parametrize("text", ["no json", "[]", "7"])
def test_what_is_no_manifest_is_refused(text, tmp_path):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=r"manifest\.json"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ('name = "PT7.5"\ntask = "RT"\nrms_displacement = 0.0075', "'PT7.5': task = 'RT'; expected 'PT'"),
        ('name = "PT0"\ntask = "PT"\nrms_displacement = 0.003', "'PT0': has a multisine = True; expected False"),
    ],
)
def test_a_name_of_the_thesiss_is_for_its_condition(tmp_path, condition, message):
    path = tmp_path / "own.toml"
    path.write_text(f'forces = "practice"\n[[conditions]]\n{condition}\n', encoding="utf-8")
    with pytest.raises(ValueError, match=rf"own.toml: condition {message}.*another name"):
        StudySettings(protocol=path).load_protocol()
    path.write_text(path.read_text(encoding="utf-8").replace("PT7.5", "MINE").replace("PT0", "MINE"), encoding="utf-8")
    assert StudySettings(protocol=path).load_protocol().conditions[0].name == "MINE"
