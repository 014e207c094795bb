"""What is free, fixed, tied and shared, and whom the values make."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from armperturb.analysis.nonlinear.model import (
    BOUNDS,
    Model,
    Parameters,
    coordinate,
    person,
    true_values,
    value_at,
)
from armperturb.cohort import draw_person
from armperturb.muscle_law import ELEMENTS
from armperturb.subject import POSITION, RELAX, at_level

CONDITIONS = {"PT": ("PT7.5", "PT2.5"), "RT": ("RT7.5",)}


def parameters(model, *tasks):
    bodies = {task: {"PT": POSITION, "RT": RELAX}[task] for task in tasks}
    return Parameters(model, bodies, {task: CONDITIONS[task] for task in tasks})


def test_the_full_law_of_relaxed_people_has_these_parameters():
    names = parameters(Model(), "RT").names
    three = [f"{name}.{e}" for name in ("k", "b", "short_range_stiffness", "elastic_limit_deg") for e in ELEMENTS]
    common = ["elastic_limit_spread", "loss_angle_deg", "recovery_time", "thinning_velocity"]
    assert names == ["m_h", "m_f", "k_h", "b_h", *three, *common]


def test_smaller_laws_have_fewer():
    full, short, linear = (set(parameters(Model(law=law), "PT").names) for law in ("full", "short-range", "linear"))
    assert full - short == {"loss_angle_deg", "recovery_time", "thinning_velocity", "spindle_saturation"}
    half_wave = set(parameters(Model(law="half-wave"), "PT").names)
    assert half_wave - full == {"spindle_direction", "spindle_threshold"}
    assert parameters(Model(law="half-wave"), "RT").names == parameters(Model(), "RT").names  # without reflexes
    assert {name.partition(".")[0] for name in short - linear} == {
        "short_range_stiffness", "elastic_limit_deg", "elastic_limit_spread",
    }  # fmt: skip
    assert "level.PT2.5" in linear
    assert "level.PT7.5" not in linear  # the first one's level is 1
    assert not {"Td", "fact"} & full
    assert {"Td", "fact"} <= set(parameters(Model(free=("Td", "fact")), "PT").names)


def test_both_tasks_share_the_body_and_what_is_asked_for():
    names = parameters(Model(shared=("m_h", "m_f", "k_h")), "PT", "RT").names
    assert {"m_h", "m_f", "k_h", "b_h [PT]", "b_h [RT]", "k.elbow [PT]", "k.elbow [RT]", "kv.elbow [PT]"} <= set(names)
    assert not {"m_h [PT]", "k_h [RT]", "kv.elbow [RT]"} & set(names)


def test_fixed_and_tied_parameters_have_the_values_they_are_given():
    tied = {"elastic_limit_deg.elbow": "elastic_limit_deg.shoulder"}
    model = Model(fixed={"b": 0.7, "k_h": 8000.0, "loss_angle_deg": np.inf}, tied=tied)
    of_model = parameters(model, "RT")
    assert not {"b.elbow", "k_h", "elastic_limit_deg.elbow", "loss_angle_deg"} & set(of_model.names)
    point = np.log(1.0 + 0.01 * np.arange(len(of_model.names)))
    values = of_model.values("RT", point)
    assert values["b.two-joint"] == 0.7
    assert values["k_h"] == 8000.0
    limits = of_model.person("RT", point, "RT7.5").muscle.of_elements("elastic_limit_deg")
    assert limits[2] == limits[0] == pytest.approx(1.0 + 0.01 * of_model.names.index("elastic_limit_deg.shoulder"))
    assert limits[1] != limits[0]
    assert of_model.person("RT", point, "RT7.5").muscle.of_elements("loss_angle_deg") == (np.inf,) * 3


def test_groups_may_be_negative_and_are_told_on_a_logarithmic_scale_where_they_are_large():
    for value in (-66.0, -1e-3, 0.0, 1e-3, 66.0):
        assert value_at("kp.shoulder [PT]", coordinate("kp.shoulder [PT]", value)) == pytest.approx(value, abs=1e-12)
    assert coordinate("kp.elbow", 70.0) == pytest.approx(np.log(70.0), abs=1e-3)
    assert coordinate("m_h", 2.0) == np.log(2.0)
    assert value_at("m_h", np.log(2.0)) == pytest.approx(2.0)
    with np.errstate(all="raise"):
        assert value_at("m_h", 1e4) == -value_at("k.elbow", -1e4) == np.inf


def test_only_dampers_that_thin_must_be_positive():
    lower = {law: dict(zip(p.names, p.lower, strict=True)) for law in ("linear", "short-range", "full")
             for p in [parameters(Model(law=law), "PT")]}  # fmt: skip
    for law in lower:
        assert value_at("b.elbow", lower[law]["b.elbow"]) == pytest.approx(0.02 if law == "full" else -100.0)
        assert value_at("kp.elbow", lower[law]["kp.elbow"]) == pytest.approx(-500.0)


@pytest.mark.parametrize("task", ["PT", "RT"])
def test_a_person_is_made_again_from_their_true_values(task):
    truth = draw_person(0, 4)
    subject = truth.subjects[task]
    values = true_values(subject, truth.levels)
    body = replace(RELAX if task == "RT" else POSITION, muscle=None)
    body = replace(body, **{name: getattr(subject, name) for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")})
    made = person(body, "full", values, f"{task}2.5", {})
    expected = at_level(subject, truth.levels.get(f"{task}2.5", 1.0))
    for quantity in ("k", "b", "kv", "kp"):
        np.testing.assert_allclose(made.joint_triple(quantity), expected.joint_triple(quantity), rtol=1e-12)
    for field, value in asdict(expected.muscle).items():
        np.testing.assert_allclose(getattr(made.muscle, field), value, rtol=1e-12)
    for name in ("m_h", "m_f", "k_h", "b_h", "Td_s", "Td_e", "fact_s", "fact_e"):
        assert getattr(made, name) == pytest.approx(getattr(expected, name))


def test_effects_of_a_trial_multiply_groups_and_short_range_stiffness():
    values = true_values(draw_person(0, 1).subjects["RT"], {})
    plain, moved = (person(RELAX, "full", values, "RT7.5", e) for e in ({}, {"k": np.log(1.2), "b": np.log(0.9)}))
    np.testing.assert_allclose(np.divide(moved.joint_triple("k"), plain.joint_triple("k")), 1.2)
    np.testing.assert_allclose(np.divide(moved.joint_triple("b"), plain.joint_triple("b")), 0.9)
    assert moved.muscle == plain.muscle.scaled(1.2)


def test_elastic_limits_are_divided_as_finely_as_is_asked_for():
    model = Model(parts=32)
    of_model = parameters(model, "RT")
    point = [coordinate(name, true_values(draw_person(0, 0).subjects["RT"], {})[name]) for name in of_model.names]
    assert of_model.person("RT", np.array(point), "RT7.5").muscle.parts == 32
    with pytest.raises(ValueError, match="parts = 65"):
        Model(parts=65)


def test_what_is_fixed_at_a_point_has_its_values_there():
    of_model = parameters(Model(), "RT")
    point = 0.5 * (of_model.lower + of_model.upper)
    still = of_model.fixed_at(point)
    assert still.names == []
    assert still.values("RT", np.empty(0)) == of_model.values("RT", point)
    assert len(of_model.names) > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"law": "hill"}, "law = 'hill'; expected one of linear, short-range, full"),
        ({"fixed": {"stiffness": 1.0}}, f"fixed: unknown parameter 'stiffness'; expected {', '.join(BOUNDS)}"),
        ({"shared": ("mass",)}, "shared: unknown parameter 'mass'"),
        ({"free": ("k",)}, "free: 'k'; expected some of Td, fact, as all else is free or off"),
    ],
)
def test_names_that_are_none_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Model(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": {"kv": 1.0}}, "fixed: 'kv' is no parameter of the law 'full' in these trials"),
        ({"fixed": {"k.wrist": 1.0}}, "fixed: 'k.wrist' is no parameter"),
        ({"law": "linear", "fixed": {"loss_angle_deg": 3.0}}, "is no parameter of the law 'linear'"),
        ({"tied": {"k.elbow": "k.wrist"}}, "tied: 'k.elbow' to 'k.wrist'; expected a parameter that is not tied"),
    ],
)
def test_names_that_are_of_no_parameter_of_these_trials_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        parameters(Model(**options), "RT")
