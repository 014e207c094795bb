"""Arm model structures: the thesis's against its tables, a user's own, and refusals."""

import csv
import pickle
from importlib import resources

import numpy as np
import pytest

from armperturb.analysis.arm.linear_arm import LinearArm, total_admittance
from armperturb.analysis.arm.parameters import PARAMETERS, parameter_vector
from armperturb.analysis.fit.structures import STRUCTURES, Structure, neutral_start, start_in, structure_of, unit
from armperturb.environment import Environment
from armperturb.subject import POSITION, RELAX

ENVIRONMENT = Environment()
FREQUENCY = np.geomspace(0.2, 40.0, 12)
SI = {"kN/m": 1e3, "ms": 1e-3}
PLAIN = dict(
    name="plain",
    bounds={"k_s": (0.0, 500.0)},
    initial={"k_s": 100.0},
    fixed={
        task: dict(m_h=1.6, m_f=1.7, b_s=5.0, b_se=5.0, b_e=5.0, k_se=50.0, k_e=90.0, b_h=50.0, k_h=2e4)
        for task in ("PT", "RT")
    },
)


def published(table, model, quantity="parameter", start=""):
    text = resources.files("armperturb.study").joinpath("published", "parameters.csv").read_text(encoding="utf-8")
    return {
        row["parameter"]: SI.get(row["unit"], 1.0) * float(row["mean"])
        for row in csv.DictReader(text.splitlines())
        if (row["table"], row["model"], row["quantity"], row["start"]) == (table, model, quantity, start)
    }


@pytest.mark.parametrize(("model", "table"), [("1", "C.13"), *((number, "C.3") for number in "23456")])
def test_structures_of_table_c1_start_where_the_thesis_did_without_penalty(model, table):
    assert STRUCTURES[model].initial == pytest.approx(published(table, model), rel=1e-12)


@pytest.mark.parametrize(("model", "start"), [("3a", "vartheta_i1"), ("3b", "vartheta_i5")])
def test_structures_of_appendix_e_start_at_its_initial_vectors(model, start):
    assert STRUCTURES[model].initial == pytest.approx(published("E.3", model, "initial", start), rel=1e-12)


def test_structures_have_the_feedback_of_table_c1():
    quantities = {
        name: {parameter.partition("_")[0] for parameter in structure.free} & {"kf", "ka", "kv", "kp"}
        for name, structure in STRUCTURES.items()
    }
    assert quantities == {
        "1": set(),
        "2": {"kv"},
        "3": {"kv", "kp"},
        "4": {"kf", "kv", "kp"},
        "5": {"ka", "kv", "kp"},
        "6": {"kf", "ka", "kv", "kp"},
        "3a": {"kv", "kp"},
        "3b": {"kv", "kp"},
    }
    assert [len(STRUCTURES[name].free) for name in "123456"] == [10, 17, 20, 23, 23, 26]
    assert len(STRUCTURES["3b"].free) == 13
    assert STRUCTURES["3a"].bounds["kp_s"] == (-1e3, 1e3)
    assert STRUCTURES["3b"].bounds["kp_s"] == (0.0, 1e3)
    assert unit("ka_se") == "Nms^2/rad"


def test_arm_and_parameters_agree():
    for structure in STRUCTURES.values():
        values = np.array(list(structure.initial.values()))
        for body in (POSITION, RELAX):
            arm = structure.arm(body, values)
            np.testing.assert_array_equal(parameter_vector(arm), structure.parameters(body.task, values))
            assert arm.posture.tolist() == body.posture.tolist()
    arm = STRUCTURES["3b"].arm(POSITION, list(STRUCTURES["3b"].initial.values()))
    assert (arm.m_h, arm.m_f) == pytest.approx((0.49 * 2.96, 0.51 * 2.96))
    assert STRUCTURES["1"].arm(POSITION, list(STRUCTURES["1"].initial.values())).kv_s == 0.0


@pytest.mark.parametrize("model", ["3", "6", "3b"])
def test_gradients_by_free_parameters_equal_finite_differences(model):
    structure = STRUCTURES[model]
    values = np.array(list(structure.initial.values()))
    gradient = (
        LinearArm(POSITION, FREQUENCY).total_and_gradient(structure.parameters("PT", values), ENVIRONMENT)[1]
        @ structure.mixing
    )
    for column, name in enumerate(structure.free):
        step = 1e-5 * max(abs(values[column]), 0.1)
        moved = [
            total_admittance(
                structure.arm(POSITION, values + sign * step * np.eye(len(values))[column]), ENVIRONMENT, FREQUENCY
            )
            for sign in (1, -1)
        ]
        slope = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(
            gradient[..., column], slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max(), err_msg=name
        )


def test_variants_take_a_line_each():
    one_delay = STRUCTURES["3"].fixing(fact_s=3.5, fact_e=3.5).tying(Td_e={"Td_s": 1.0}).named("3, one delay")
    assert one_delay.name == "3, one delay"
    assert set(STRUCTURES["3"].free) - set(one_delay.free) == {"fact_s", "fact_e", "Td_e"}
    arm = one_delay.arm(POSITION, list(one_delay.initial.values()))
    assert arm.Td_e == arm.Td_s == one_delay.initial["Td_s"]
    assert arm.fact_e == 3.5
    fixed = one_delay.fixing(Td_s=0.04)
    assert fixed.arm(POSITION, list(fixed.initial.values())).Td_e == 0.04

    other_grip = STRUCTURES["3b"].fixing(b_h=80.0, k_h=3e4, Td_s=0.025, Td_e=0.025)
    assert other_grip.free == STRUCTURES["3b"].free
    for body in (POSITION, RELAX):
        assert other_grip.arm(body, list(other_grip.initial.values())).k_h == 3e4

    with_delay = STRUCTURES["3b"].freeing(Td_s=(0.02, 0.03, 0.06)).tying(Td_e={"Td_s": 1.0})
    assert with_delay.free == (*STRUCTURES["3b"].free, "Td_s")
    known_mass = STRUCTURES["3b"].fixing(m_tot=4.0)
    assert known_mass.arm(POSITION, list(known_mass.initial.values())).m_h == pytest.approx(0.49 * 4.0)
    assert "m_tot" not in known_mass.free


def test_what_a_structure_does_not_name_is_a_subjects_default():
    arm = Structure(**PLAIN).arm(POSITION, [70.0])
    assert (arm.k_s, arm.kv_s, arm.kp_e, arm.Td_s, arm.fact_e) == (70.0, 0.0, 0.0, 0.030, 3.5)


def test_structures_travel_to_workers():
    for structure in STRUCTURES.values():
        copy = pickle.loads(pickle.dumps(structure))
        assert copy.free == structure.free
        np.testing.assert_array_equal(copy.mixing, structure.mixing)


def test_every_parameter_has_a_unit():
    assert {unit(name) for name in PARAMETERS} == {
        "kg", "Nms/rad", "Nm/rad", "Nms^2/rad", "-", "s", "Hz", "Ns/m", "N/m", "kg m^2",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bounds": {"k_s": (500.0, 0.0)}}, "model plain: bounds of k_s = 500.0 to 0.0; expected a lower and a higher"),
        ({"bounds": {"k_s": (0.0, np.inf)}}, "bounds of k_s = 0.0 to inf; expected .* finite"),
        ({"bounds": {"k_s": (-1.0, 5.0)}}, "bounds of k_s = -1.0 to 5.0; expected a lower bound at least 0"),
        ({"bounds": {"k_s": (0.0, 50.0)}}, "initial value of k_s = 100.0; expected 0 to 50"),
        ({"initial": {"k_s": np.nan}}, "initial value of k_s = nan; expected 0 to 500"),
        ({"initial": {}}, "no initial value for k_s; expected 0 to 500"),
        ({"initial": {"k_s": 1.0, "k_e": 1.0}}, "initial value of 'k_e', which is not free; expected k_s"),
        ({"bounds": {}, "initial": {}}, "k_s is neither free nor tied nor fixed"),
        ({"bounds": {"k_x": (0.0, 1.0)}}, "free parameter 'k_x' is unknown; expected one of m_h"),
        ({"tied": {"k_s": {"k_s": 1.0}}}, "k_s is both free and tied"),
        ({"tied": {"kp_s": {"kp_e": 1.0}}}, "kp_s is tied to 'kp_e', which is not free; expected k_s"),
        ({"tied": {"kp_x": {"k_s": 1.0}}}, "tied parameter 'kp_x' is unknown"),
        ({"tied": {"kp_s": {"k_s": np.nan}}}, "kp_s is tied to nan times k_s; expected a finite number"),
        ({"tied": {"k_e": {"k_s": 1.0}}}, "k_e is both tied and fixed"),
        ({"fixed": {"PT": {}, "RT": {}}}, "m_h is neither free nor tied nor fixed"),
        ({"fixed": {"PT": {}}}, "no fixed values for the task RT"),
        ({"fixed": {"XT": {}}}, "fixed values for the task 'XT'; expected PT, RT"),
    ],
)
def test_bad_structures_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        Structure(**{**PLAIN, **change})


@pytest.mark.parametrize(
    ("variant", "message"),
    [
        (lambda s: s.fixing(k_x=1.0), "fixed parameter 'k_x' is unknown"),
        (lambda s: s.fixing(k_s=np.nan), "k_s = nan is fixed"),
        (lambda s: s.freeing(k_s=(0.0, 2.0, 1.0)), "initial value of k_s = 2.0; expected 0 to 1"),
        (lambda s: s.freeing(m_h=(0.0, 1.0, 3.0)), "bounds of m_h = 0.0 to 3.0; expected a lower bound above 0"),
        (
            lambda s: s.tying(kp_s={"k_s": 0.1, "k_e": 0.1}).fixing(k_s=5.0),
            "kp_s is tied to k_s, k_e; expected all of them fixed, or none",
        ),
    ],
)
def test_bad_variants_are_named(variant, message):
    with pytest.raises(ValueError, match=message):
        variant(STRUCTURES["3b"])


@pytest.mark.parametrize(("task", "table"), [("PT", "C.3"), ("RT", "C.13")])
def test_the_neutral_start_is_model_1_without_feedback(task, table):
    intrinsic = published(table, "1")
    for name in "123456":
        start = neutral_start(STRUCTURES[name], task)
        assert list(start) == list(STRUCTURES[name].free)
        assert {parameter: start[parameter] for parameter in intrinsic} == pytest.approx(intrinsic, rel=1e-12)
        others = {parameter: value for parameter, value in start.items() if parameter not in intrinsic}
        assert {value for parameter, value in others.items() if parameter[:2] in ("kf", "ka", "kv", "kp")} <= {0.0}
        assert all(low < start[parameter] < high for parameter, (low, high) in STRUCTURES[name].bounds.items())
    assert neutral_start(STRUCTURES["3b"], task)["m_tot"] == pytest.approx(intrinsic["m_h"] + intrinsic["m_f"])
    with pytest.raises(ValueError, match="task = 'X'"):
        neutral_start(STRUCTURES["3"], "X")


def test_a_published_structure_starts_where_its_task_does():
    for name, structure in STRUCTURES.items():
        its_task, other = ("RT", "PT") if name == "1" else ("PT", "RT")
        assert start_in(structure, its_task) == structure.initial
        assert start_in(structure, other) == neutral_start(structure, other)
        assert start_in(structure.widened(), other) == neutral_start(structure.widened(), other)
    own = STRUCTURES["3"].freeing(k_s=(0.0, 20.0, 400.0)).named("3")
    assert start_in(own, "RT") == own.initial


def test_bounds_of_the_thesis_give_way_to_wide_ones_and_others_stay():
    assert structure_of("3", wide=True).bounds == structure_of(STRUCTURES["3"], wide=True).bounds
    assert structure_of(STRUCTURES["3"]) is STRUCTURES["3"]
    own = STRUCTURES["3"].fixing(fact_s=3.5, fact_e=3.5).freeing(k_h=(1e3, 22.4e3, 50e3))
    wide, widened = structure_of(own, wide=True), own.widened()
    assert wide.bounds == {**widened.bounds, "k_h": (1e3, 50e3)}
    assert (wide.initial, wide.fixed) == (own.initial, own.fixed)
