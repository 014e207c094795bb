"""Subjects, presets, files and refusals."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from armperturb.environment import Environment, Strap
from armperturb.muscle_law import MuscleLaw
from armperturb.study.published import tables as published
from armperturb.subject import POSITION, PRESETS, RELAX, Subject
from armperturb.validation import RANGES


@pytest.mark.parametrize("preset", PRESETS.values(), ids=PRESETS)
def test_file_gives_back_the_same_subject(preset, tmp_path):
    preset.save(tmp_path / "subject.toml")
    assert Subject.load(tmp_path / "subject.toml") == preset


def test_every_number_has_a_range():
    others = {Subject: {"task", "muscle", "name"}, MuscleLaw: {"parts"}}
    for kind in (Subject, MuscleLaw, Environment, Strap):
        numbers = {field.name for field in dataclasses.fields(kind)} - others.get(kind, set())
        assert RANGES[kind.__name__].keys() == numbers


def test_presets_hold_the_published_means():
    for subject, condition, total in ((RELAX, "RT7.5", False), (POSITION, "PT7.5", True)):
        table = Path(published.__file__).parent / "parameters.csv"
        wanted = published.PARAMETER_TABLES[condition]
        with table.open(encoding="utf-8") as file:
            rows = [
                row
                for row in csv.DictReader(file)
                if row["quantity"] == "parameter" and all(row[key] == value for key, value in wanted.items())
            ]
        assert len(rows) == (13 if total else 10)
        for row in rows:
            scale = 1e3 if row["unit"] == "kN/m" else 1.0
            value = subject.m_h + subject.m_f if row["parameter"] == "m_tot" else getattr(subject, row["parameter"])
            assert value == pytest.approx(scale * float(row["mean"]), rel=1e-12)
    assert POSITION.m_h / (POSITION.m_h + POSITION.m_f) == pytest.approx(0.49)


def test_joint_matrix_and_muscle_groups():
    np.testing.assert_array_equal(POSITION.joint_matrix("k"), [[161.4, 115.4], [115.4, 206.7]])
    single_s, two, single_e = POSITION.muscle_groups("k")
    two_joint = two * np.ones((2, 2))
    np.testing.assert_allclose(np.diag([single_s, single_e]) + two_joint, POSITION.joint_matrix("k"), rtol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"m_h": 0.0}, r"m_h = 0.0; expected a finite number above 0"),
        ({"m_f": -1.0}, r"m_f = -1.0; expected a finite number above 0"),
        ({"l_h": -0.3}, r"l_h = -0.3; expected a finite number at least 0.01 and at most 2"),
        ({"Td_s": 0.0}, r"Td_s = 0.0; expected a finite number above 0"),
        ({"fact_e": 0.0}, r"fact_e = 0.0; expected a finite number at least 0.01 and at most 1000"),
        ({"k_h": float("nan")}, r"k_h = nan; expected a finite number above 0"),
        ({"k_h": -float("inf")}, r"k_h = -inf; expected a finite number above 0"),
        ({"k_s": float("inf")}, r"k_s = inf; expected a finite number at least 0"),
        ({"c_f": 0.0}, r"c_f = 0.0; expected a finite number above 0 and at most 1"),
        ({"r_h": -0.1}, r"r_h = -0.1; expected a finite number at least 0 and at most 1"),
        ({"i_se": 0.5}, r"i_s, i_se, i_e = 0.0, 0.5, 0.0 give the joint inertia .*; expected a positive definite one"),
        ({"m_h": 0.0, "m_f": 0.0, "i_e": 0.1}, r"give the joint inertia .*; expected a positive definite one"),
        ({"b_s": -0.1}, r"b_s = -0.1; expected a finite number at least 0"),
        ({"kv_s": float("nan")}, r"kv_s = nan; expected a finite number"),
        ({"theta_e_deg": 180.0}, r"theta_e_deg = 180.0; expected a finite number at least 5 and at most 175"),
        ({"l_h": 330.0}, r"l_h = 330.0; expected a finite number at least 0.01 and at most 2"),
        ({"Td_s": 30.0}, r"Td_s = 30.0; expected a finite number above 0 and at most 1"),
        ({"fact_s": 1e-9}, r"fact_s = 1e-09; expected a finite number at least 0.01"),
        ({"m_h": 10**400}, r"m_h = 1000.*; expected a finite number above 0"),
        ({"task": "XT"}, r"task = 'XT'; expected one of PT, RT"),
    ],
)
def test_bad_values_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(RELAX, **change)


def test_a_text_where_a_number_belongs_is_named():
    with pytest.raises(TypeError, match="m_h = '2'; expected a number"):
        dataclasses.replace(RELAX, m_h="2")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text + "k_x = 3.0\n", "unknown key 'k_x'; expected keys are task, m_h"),
        (lambda text: text.replace("m_f = ", "m_F = "), "unknown key 'm_F'"),
        (
            lambda text: "\n".join(line for line in text.splitlines() if not line.startswith("kp_se")),
            "missing key 'kp_se'",
        ),
        (lambda text: text.replace("m_h = 2.06", "m_h = -2.06"), "m_h = -2.06; expected a finite number above 0"),
        (lambda text: text + "m_h = \n", "not a TOML file"),
    ],
)
def test_bad_files_are_named(edit, message, tmp_path):
    RELAX.save(tmp_path / "s.toml")
    (tmp_path / "s.toml").write_text(edit((tmp_path / "s.toml").read_text()))
    with pytest.raises(ValueError, match=message) as caught:
        Subject.load(tmp_path / "s.toml")
    assert str(tmp_path / "s.toml") in str(caught.value)


def test_a_file_of_calibrate_is_named_as_such(tmp_path):
    (tmp_path / "average.toml").write_text('calibrated = ["2.1"]\n[PT]\nm_h = 2.0\n[RT]\nm_h = 2.0\n')
    with pytest.raises(ValueError, match=r"has a table for PT and RT, as calibrate writes them; expected .* one task"):
        Subject.load(tmp_path / "average.toml")


def test_name_and_filter_damping_may_be_left_out():
    values = RELAX.to_dict()
    del values["name"], values["zeta_act"]
    subject = Subject.from_dict(values)
    assert subject.zeta_act == pytest.approx(2**-0.5)
    assert subject.name == Subject.__dataclass_fields__["name"].default


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"m_env": 0.0}, "m_env = 0.0; expected a finite number above 0"),
        ({"b_env": -1.0}, "b_env = -1.0; expected a finite number at least 0"),
        ({"workspace": 0.0}, "workspace = 0.0; expected a finite number above 0"),
    ],
)
def test_bad_environments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Environment(**change)
