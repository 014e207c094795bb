"""Impedance at the hand against formulas of its own, against a static arm, and against drawn parameters."""

import re
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from scipy.optimize import fsolve

from armperturb.analysis.arm.geometry import mass_matrix
from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.parameters import PARAMETERS, parameter_vector
from armperturb.analysis.measures.endpoint import QUANTITIES, endpoint_impedance, plot_endpoints
from armperturb.plots.style import new_figure
from armperturb.subject import POSITION, RELAX

matplotlib.use("agg")

NOTHING = np.zeros((len(PARAMETERS),) * 2)
FORCE = np.array([14.0, -9.0])
POSTURES = [None, (60.0, 40.0), (-10.0, 120.0)]
WITH_FEEDBACK = replace(POSITION, kf_s=-0.4, kf_se=-0.1, kf_e=-0.3)


def hand(q, arm=POSITION):
    """Position of the hand [m] at angles that may be complex, (axis,)."""
    both = q[0] + q[1]
    return np.array([arm.l_h * np.cos(q[0]) + arm.l_f * np.cos(both), arm.l_h * np.sin(q[0]) + arm.l_f * np.sin(both)])


def differentiated(function, q, step=1e-30):
    """Derivative by complex steps, exact to rounding, (output, joint)."""
    return np.column_stack([function(q + 1j * step * each).imag / step for each in np.eye(2)])


def torque(q, force):
    """J^T f at angles that may be complex, by hand: the moment of a force about each joint."""
    x, y = hand(q)
    elbow = POSITION.l_h * np.array([np.cos(q[0]), np.sin(q[0])])
    return np.array([x * force[1] - y * force[0], (x - elbow[0]) * force[1] - (y - elbow[1]) * force[0]])


def of_posture(posture):
    return np.radians(posture or (POSITION.theta_s_deg, POSITION.theta_e_deg))


@pytest.mark.parametrize("posture", POSTURES)
@pytest.mark.parametrize("force", [None, np.array([-3.0, 20.0])])
def test_matrices_agree_with_an_independent_formula(posture, force):
    found = endpoint_impedance(POSITION, NOTHING, recorded_force=FORCE, posture_deg=posture, force=force)
    recorded, q = of_posture(None), of_posture(posture)
    jacobian = differentiated(hand, q)
    held = FORCE if force is None else force
    joint = POSITION.joint_matrix("k") + differentiated(lambda each: torque(each, FORCE), recorded)
    there = joint - differentiated(lambda each: torque(each, held), q)
    expected = {
        "stiffness": there,
        "static stiffness": there + POSITION.joint_matrix("kp"),
        "damping": POSITION.joint_matrix("b"),
        "inertia": mass_matrix(found.arm),
    }
    assert list(found.matrices) == list(QUANTITIES)
    for name, matrix in expected.items():
        at_hand = np.linalg.solve(jacobian.T, np.linalg.solve(jacobian.T, matrix.T).T)
        np.testing.assert_allclose(found[name].values, at_hand, rtol=1e-8, atol=1e-8 * np.abs(at_hand).max())
        turned, axes, _ = np.linalg.svd(at_hand)
        assert found[name].area == pytest.approx(np.pi * axes[0] * axes[1], rel=1e-8)
        assert found[name].shape == pytest.approx(axes[0] / axes[1], rel=1e-8)
        assert np.tan(np.radians(found[name].orientation_deg)) == pytest.approx(turned[1, 0] / turned[0, 0], rel=1e-8)


@pytest.mark.parametrize("posture", POSTURES)
def test_a_static_arm_is_as_stiff_as_said(posture):
    """Springs at the joints balance a force on the hand, which then changes a little."""
    found = endpoint_impedance(POSITION, NOTHING, recorded_force=FORCE, posture_deg=posture, force=2.0 * FORCE)
    joint = POSITION.joint_matrix("k") + differentiated(lambda each: torque(each, FORCE), of_posture(None))
    q = of_posture(posture)
    slack = q - np.linalg.solve(joint, torque(q, 2.0 * FORCE))

    def reached(change):
        return hand(fsolve(lambda each: joint @ (each - slack) - torque(each, 2.0 * FORCE + change), q, xtol=1e-13))

    compliance = np.column_stack([(reached(1e-3 * e) - reached(-1e-3 * e)) / 2e-3 for e in np.eye(2)])
    np.testing.assert_allclose(np.linalg.inv(compliance), found["stiffness"].values, rtol=1e-5)


def test_static_stiffness_is_that_of_the_admittance_at_rest():
    rigid = replace(WITH_FEEDBACK, k_h=np.inf)
    slow = np.linalg.inv(arm_admittance(rigid, np.array([1e-6]))[0].real)
    np.testing.assert_allclose(endpoint_impedance(rigid, NOTHING)["static stiffness"].values, slow, rtol=1e-6)


def test_inertia_beyond_the_segments_turns_as_rigid_segments_do():
    """An arm without segments that has the whole inertia of one with them has it in every posture."""
    segments = mass_matrix(POSITION)
    free = replace(POSITION, m_h=0.0, m_f=0.0, i_s=segments[0, 0], i_se=segments[0, 1], i_e=segments[1, 1])
    for posture in POSTURES:
        expected = endpoint_impedance(POSITION, NOTHING, posture_deg=posture)["inertia"].values
        found = endpoint_impedance(free, NOTHING, posture_deg=posture)["inertia"].values
        np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize("arm", [POSITION, WITH_FEEDBACK], ids=["position", "force feedback"])
@pytest.mark.parametrize("posture", [None, (60.0, 40.0)])
def test_covariances_are_those_of_differences(arm, posture):
    rng = np.random.default_rng(1)
    root = rng.normal(size=NOTHING.shape) * 0.01 * parameter_vector(arm)
    covariance = root.T @ root
    found = endpoint_impedance(arm, covariance, recorded_force=FORCE, posture_deg=posture)

    def measures(change):
        changed = dict(zip(PARAMETERS, parameter_vector(arm) + change, strict=True))
        other = endpoint_impedance(replace(arm, **changed), NOTHING, recorded_force=FORCE, posture_deg=posture)
        return {
            name: np.array([np.log(each.area), np.log(each.shape), each.orientation_deg])
            for name, each in other.matrices.items()
        }

    step = 1e-5 * np.maximum(np.abs(parameter_vector(arm)), 1e-2)
    ends = [(measures(row), measures(-row)) for row in np.diag(step)]
    for name, matrix in found.matrices.items():
        slope = np.column_stack([after[name] - before[name] for after, before in ends]) / (2 * step)
        error = np.sqrt(np.diag(slope @ covariance @ slope.T))
        area, shape, orientation = matrix.area_interval(), matrix.shape_interval(), matrix.orientation_interval()
        assert np.log(area.upper / matrix.area) == pytest.approx(1.96 * error[0], rel=1e-3)
        assert np.log(shape.upper / matrix.shape) == pytest.approx(1.96 * error[1], rel=1e-3)
        assert orientation.upper - matrix.orientation_deg == pytest.approx(min(1.96 * error[2], 90.0), rel=1e-3)


@pytest.mark.slow(reason="draws many estimates")
@pytest.mark.parametrize(("arm", "size"), [(POSITION, 0.02), (RELAX, 0.05)], ids=["PT", "RT"])
def test_intervals_hold_the_truth_as_often_as_they_say(arm, size):
    rng = np.random.default_rng(2)
    truth, values = endpoint_impedance(arm, NOTHING), parameter_vector(arm)
    root = rng.normal(size=NOTHING.shape) * size * values / np.sqrt(len(values))
    covariance = root.T @ root
    inside = {name: np.zeros(7) for name in truth.matrices}
    n = 600
    for error in rng.standard_normal((n, len(values))) @ root:
        drawn = replace(arm, **dict(zip(PARAMETERS, values + error, strict=True)))
        found = endpoint_impedance(drawn, covariance)
        for name, exact in truth.matrices.items():
            matrix = found[name]
            low, high = matrix.entry_interval()
            area, shape, turn = matrix.area_interval(), matrix.shape_interval(), matrix.orientation_interval()
            middle, half = (turn.lower + turn.upper) / 2.0, (turn.upper - turn.lower) / 2.0
            away = abs((exact.orientation_deg - middle + 90.0) % 180.0 - 90.0)
            inside[name] += [
                *((low <= exact.values) & (exact.values <= high)).ravel(),
                area.lower <= exact.area <= area.upper,
                shape.lower <= exact.shape <= shape.upper,
                away <= half,
            ]
    for name, counts in inside.items():
        assert (counts > 0.90 * n).all(), (name, counts / n)
        assert (counts < 0.98 * n).all(), (name, counts / n)


def test_a_circle_has_no_orientation():
    jacobian = differentiated(hand, of_posture(None))
    (k_s, k_se), (_, k_e) = 900.0 * jacobian.T @ jacobian
    arm = replace(POSITION, k_s=k_s, k_se=k_se, k_e=k_e, kp_s=0.0, kp_se=0.0, kp_e=0.0)
    found = endpoint_impedance(arm, np.diag((0.05 * parameter_vector(arm)) ** 2))
    stiffness = found["stiffness"]
    assert stiffness.is_circular
    assert stiffness.shape_interval().lower == 1.0
    turn = stiffness.orientation_interval()
    assert turn.upper - turn.lower == pytest.approx(180.0)
    assert any("no orientation" in remark for remark in found.remarks)
    assert "static stiffness" not in found.matrices


@pytest.mark.parametrize("error", [1e-4, 0.003, 0.01, 0.03, 0.05])
def test_inertia_of_tied_masses_has_a_shape_and_an_orientation_without_limits(error):
    masses = np.array([error * getattr(POSITION, name) * (name in ("m_h", "m_f")) for name in PARAMETERS])
    found = endpoint_impedance(POSITION, np.outer(masses, masses))
    inertia = found["inertia"]
    assert not inertia.is_circular
    assert inertia.fixed == ("shape", "orientation")
    assert np.isnan([*inertia.shape_interval(), *inertia.orientation_interval()]).all()
    assert inertia.area_interval().lower < inertia.area < inertia.area_interval().upper
    assert "the structure fixes shape and orientation of inertia: the trials do not tell" in found.remarks
    assert "nan" not in found.summary()


def test_what_the_data_do_not_identify_has_no_limits():
    covariance = NOTHING.copy()
    covariance[PARAMETERS.index("k_se"), PARAMETERS.index("k_se")] = np.inf
    found = endpoint_impedance(POSITION, covariance)
    assert found["stiffness"].area_interval() == (0.0, np.inf)
    assert np.isinf(found["stiffness"].entry_interval()[1]).all()
    assert found["damping"].fixed == ("area", "shape", "orientation")
    assert "the structure fixes damping: the trials do not tell" in found.remarks
    unknown = endpoint_impedance(POSITION, np.full_like(NOTHING, np.nan))
    assert np.isnan(unknown["damping"].area_interval()).all()
    assert "nan" not in unknown.summary()


def test_a_matrix_that_may_be_singular_has_no_limits():
    arm = replace(POSITION, m_h=0.0, m_f=0.0, i_s=0.11, i_se=0.0758, i_e=0.0524)
    found = endpoint_impedance(arm, np.diag((0.3 * parameter_vector(arm)) ** 2))
    inertia = found["inertia"]
    assert inertia.area_interval() == (0.0, np.inf)
    assert inertia.shape_interval() == (1.0, np.inf)
    radius, inner, outer = inertia.outline(np.linspace(0.0, np.pi, 100))
    assert np.isfinite(radius).all()
    unlimited = np.isinf(outer)
    assert unlimited.any()
    np.testing.assert_array_equal(inner == 0.0, unlimited)
    assert len(found.plot(new_figure(1.0))) == 3


def test_a_negative_stiffness_is_said():
    found = endpoint_impedance(replace(POSITION, k_se=400.0), NOTHING)
    assert any(remark.startswith("stiffness is negative") for remark in found.remarks)


def test_tables_and_pictures_hold_the_same():
    found = endpoint_impedance(POSITION, np.diag((0.02 * parameter_vector(POSITION)) ** 2), condition="PT7.5")
    relaxed = endpoint_impedance(RELAX, NOTHING, condition="RT7.5")
    frame = found.to_frame()
    row = frame[(frame["quantity"] == "damping") & (frame["measure"] == "area")].iloc[0]
    assert (row["value"], row["lower_95"], row["upper_95"]) == (
        found["damping"].area,
        *found["damping"].area_interval(),
    )
    assert float(found.to_xarray()["value"].sel(quantity="damping", measure="area")) == row["value"]
    axes = plot_endpoints({"PT7.5": found, "RT7.5": relaxed}, new_figure(1.0))
    assert [ax.get_title() for ax in axes] == ["stiffness", "damping", "inertia"]
    hands = {tuple(line.get_xydata()[-1].round(9)) for line in axes[0].get_lines() if len(line.get_xydata()) == 3}
    assert tuple(hand(of_posture(None)).round(9)) in hands
    assert len(found.plot(new_figure(1.0))) == 3


@pytest.mark.parametrize("elbow", [0.0, 0.5, -0.9, 179.5])
def test_a_straight_arm_is_refused(elbow):
    with pytest.raises(ValueError, match=r"theta_e_deg = .*; expected an elbow at least 1 deg from straight"):
        endpoint_impedance(POSITION, NOTHING, posture_deg=(20.0, elbow))


def test_inertia_at_a_right_angle_does_not_tell_that_of_other_postures():
    arm = replace(POSITION, theta_e_deg=90.0, m_h=0.0, m_f=0.0, i_s=0.4, i_se=0.1, i_e=0.1)
    assert endpoint_impedance(arm, NOTHING, posture_deg=(30.0, 90.0))["inertia"].area > 0.0
    with pytest.raises(ValueError, match=r"theta_e_deg = 60.0; expected the recorded 90 deg"):
        endpoint_impedance(arm, NOTHING, posture_deg=(30.0, 60.0))
    assert (
        endpoint_impedance(replace(POSITION, theta_e_deg=90.0), NOTHING, posture_deg=(30.0, 60.0))["inertia"].area > 0
    )


@pytest.mark.parametrize("force", [(1.0,), (1.0, np.nan), 3.0])
def test_a_force_that_is_none_is_refused(force):
    with pytest.raises(ValueError, match="expected two finite numbers"):
        endpoint_impedance(POSITION, NOTHING, force=force)


def test_a_value_has_the_digits_of_its_limits():
    exact = endpoint_impedance(POSITION, np.diag((1e-5 * parameter_vector(POSITION)) ** 2), condition="PT7.5")
    written = re.findall(r"([-+.e\d]+) \(([-+.e\d]+) to ([-+.e\d]+)\)", exact.summary())
    assert len(written) == 12
    for value, lower, upper in written:
        assert float(lower) < float(value) < float(upper)
