"""Parameters that change: known courses are estimated from numbers made without the simulator, and bad input."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline

from armperturb.analysis.joint.model import JointStructure, ReflexPath, drive_of
from armperturb.analysis.joint.signals import joint_signals
from armperturb.analysis.varying.estimate import identify_varying
from armperturb.analysis.varying.likelihood import VaryingLikelihood
from armperturb.analysis.varying.model import VaryingModel, finer, splines
from armperturb.analysis.varying.result import Curve
from armperturb.analysis.varying.solution import Maximum, mixed
from armperturb.analysis.varying.starts import THRESHOLDS, search_starts
from armperturb.perturbations.one_axis import random_steps
from armperturb.recording import make_recording

RATE = 250.0
INERTIA, DAMPING = 0.015, 0.9


def recorded(angle, torque, servo="position", *, angular=True, **more):
    """A recording of one axis, of signals (trial, time)."""
    n_trials = len(angle)
    names = ("pulse_level", "pulse_direction", "pulse_onset", "limit_time", "l_h", "l_f", "theta_s_deg", "theta_e_deg")
    labels = {name: np.full(n_trials, np.nan) for name in names} | {"repetition": range(n_trials)}
    labels |= {name: [word] * n_trials for name, word in (("subject", "A"), ("task", "PT"), ("condition", "PT"))}
    signals = {name: values[..., None] for name, values in {"force": torque, "displacement": angle, **more}.items()}
    return make_recording(signals, labels, RATE, servo=servo, joint="ankle", angular=angular)


def derivative(signal):
    time = np.arange(signal.shape[1]) / RATE
    return CubicSpline(time, signal, axis=1)(time, 1)


def reflex_torque(angle, kind, gain=1.0):
    """Torque of a reflex path with a delay of 40 ms and dynamics of 5 Hz, (trial, time)."""
    velocity = derivative(angle)
    drive = velocity if kind == "linear" else drive_of(velocity, "half-wave", 0.1, side=-1)
    return gain * ReflexPath(angle.shape[1], RATE).torque(drive, 0.04, 5.0, 0.8)


def measured(stiffness, n_trials, duration, noise, seed=0):
    """Angles and torques of a joint without reflexes, with white noise, (trial, time) each."""
    rng = np.random.default_rng(seed)
    angle = np.stack(
        [random_steps(seed=i, duration=duration, rate=RATE, size=0.06, hold=0.1, cutoff=8.0) for i in range(n_trials)]
    )
    velocity = derivative(angle)
    torque = INERTIA * derivative(velocity) + DAMPING * velocity + stiffness * angle
    return angle, torque + noise * rng.standard_normal(torque.shape)


def test_splines_sum_to_one_and_a_single_one_is_constant():
    place = np.linspace(-2.0, 3.0, 50)
    for n_basis in (1, 4, 5, 9):
        values = splines(place, n_basis, -1.0, 2.0)
        assert values.shape == (n_basis, 50)
        np.testing.assert_allclose(values.sum(axis=0), 1.0)


def test_half_the_distance_of_knots_contains_what_was_there():
    place = np.linspace(0.0, 1.0, 200)
    for n_basis in (1, 4, 7):
        coarse, fine = splines(place, n_basis, 0.0, 1.0), splines(place, finer(n_basis), 0.0, 1.0)
        _, left, *_ = np.linalg.lstsq(fine.T, coarse.T)
        assert np.all(left < 1e-20)


@pytest.mark.parametrize("threshold", [0.1, -0.1])
def test_derivatives_are_those_of_differences(threshold):
    signals = joint_signals(recorded(*measured(100.0, 2, 4.0, 0.0)))
    time = np.broadcast_to(np.arange(signals.angle.shape[1]) / signals.rate, signals.angle.shape)
    orders = {"stiffness": 4, "damping": 1, "gain": 5}
    model = VaryingModel(
        structure=JointStructure(side=-1), signals=signals, variable=time, orders=orders, low=0.0, high=4.0
    )
    dynamics = np.array([0.04, 3.0, 0.8, threshold])
    values = np.concatenate([[INERTIA], np.linspace(80.0, 120.0, 4), [DAMPING], np.linspace(1.0, 3.0, 5), dynamics])
    columns = [column for quantity in orders for column in model.columns(quantity, values)]
    exact = [signals.acceleration, *columns, *model.slopes(values)]
    assert len(exact) == len(values)
    for place, slope in enumerate(exact):
        step = 1e-5 * abs(values[place]) * np.eye(len(values))[place]
        change = (model.torque(values + step) - model.torque(values - step)) / (2.0 * step[place])
        assert np.abs(change - slope).max() < 2e-3 * np.abs(slope).max(), place


@pytest.mark.slow(reason="chooses among many numbers of splines")
def test_a_reflex_of_long_latency_has_the_gain_of_its_sign():
    angle, torque = measured(100.0, 16, 1.5, 0.1)
    late = 3.0 * ReflexPath(angle.shape[1], RATE).torque(derivative(angle), 0.12, 3.0, 0.8)
    estimate = identify_varying(recorded(angle, torque + late), reflex="linear")
    assert estimate.dynamics["reflex_delay"] == pytest.approx(0.12, abs=0.01)
    assert np.median(estimate.curves["gain"].value) == pytest.approx(3.0, rel=0.15)
    assert not any("sits on a bound" in remark for remark in estimate.remarks)


def test_what_cannot_be_estimated_is_refused_with_its_cause():
    angle, torque = measured(100.0, 5, 1.5, 0.3)
    limited = recorded(angle, torque)
    limited = limited.assign_coords(limit_time=("trial", [np.nan, np.nan, 1.4, 1.4, 1.4]))
    with pytest.raises(ValueError, match=r"recording: 2 trials; expected an ensemble of at least 4 .*limit"):
        identify_varying(limited)
    still = recorded(angle, torque, scheduling=np.ones_like(angle))
    with pytest.raises(ValueError, match="recording: scheduling is 1 throughout; expected one that changes"):
        identify_varying(still, "scheduling")
    moving = recorded(angle, torque, scheduling=np.cumsum(np.ones_like(angle), axis=1))
    with pytest.raises(ValueError, match=r"fit_until = 1.45; expected a finite number above 0 and at most 1.29"):
        identify_varying(moving, "scheduling", fit_until=1.45)
    with pytest.raises(ValueError, match="n_points = 0; expected a finite number at least 2"):
        identify_varying(limited, n_points=0)


@pytest.mark.slow(reason="chooses among many numbers of splines")
def test_stiffness_over_time_is_estimated_with_bands_and_constants_stay_constant():
    time = np.arange(round(1.5 * RATE)) / RATE
    true = 100.0 + 40.0 * np.sin(np.pi * time)
    estimate = identify_varying(recorded(*measured(true, 24, 1.5, 0.3)), reflex="none", n_points=150)
    true = 100.0 + 40.0 * np.sin(np.pi * estimate.grid)
    curve, (lower, upper) = estimate.curves["stiffness"], estimate.interval("stiffness")
    assert np.sqrt(np.mean((curve.value - true) ** 2)) < 0.05 * true.mean()
    assert np.mean((lower < true) & (true < upper)) > 0.8
    assert estimate.curves["stiffness"].n_basis > 1
    assert estimate.inertia == pytest.approx(INERTIA, rel=0.05)
    assert estimate.curves["damping"].value.mean() == pytest.approx(DAMPING, rel=0.05)
    assert set(estimate.to_xarray()) == {"stiffness", "stiffness_error", "damping", "damping_error"}
    assert len(estimate.to_frame()) == 2 * 150
    assert estimate.to_frame().iloc[0, -3:].to_dict() == {"condition": "PT", "subject": "A", "joint": "ankle"}
    assert re.match(r"Joint of A, PT, \d+ trials \(ankle\), over time", estimate.summary())
    assert len(repr(estimate).splitlines()) <= 25
    assert len(estimate.plot()) == 2


@pytest.mark.slow(reason="chooses among many numbers of splines")
def test_stiffness_over_a_scheduling_variable_predicts_what_was_held_out():
    time = np.arange(round(40.0 * RATE)) / RATE
    slow = 0.2 * np.sin(2 * np.pi * 0.13 * time)
    true = 80.0 + 200.0 * slow
    angle, torque = measured(true, 1, 40.0, 0.1)
    record = recorded(angle, torque + 10.0 * slow**2, scheduling=slow[None])
    estimate = identify_varying(record, "scheduling", reflex="none", fit_until=20.0)
    np.testing.assert_allclose(estimate.curves["stiffness"].value, 80.0 + 200.0 * estimate.grid, rtol=0.05)
    assert estimate.held_out_vaf > 95.0


@pytest.fixture(scope="module")
def reflexive():
    """A function of a kind of reflex: six repetitions of a joint that has it, and the estimate that chooses one."""

    @cache
    def made(kind):
        angle, torque = measured(100.0, 6, 1.2, 0.02)
        record = recorded(angle, torque if kind == "none" else torque + reflex_torque(angle, kind))
        return record, identify_varying(record)

    return made


@pytest.mark.parametrize(
    "kind", [pytest.param("none", marks=pytest.mark.slow(reason="looks for what is not there")), "linear", "half-wave"]
)
def test_left_out_repetitions_choose_the_reflex_path(kind, reflexive):
    _, estimate = reflexive(kind)
    assert estimate.structure.reflex == kind
    assert len(estimate.tried) == 4
    assert all(each.score > estimate.tried[0].score for each in estimate.tried[1:])
    assert f"structure chosen by left-out data: {estimate.structure.name}" in estimate.summary()
    assert estimate.curves["stiffness"].value.mean() == pytest.approx(100.0, rel=0.02)
    if kind != "none":
        assert estimate.curves["gain"].value.mean() == pytest.approx(1.0, rel=0.15)
        assert estimate.dynamics["reflex_delay"] == pytest.approx(0.04, abs=0.001)
    if kind == "half-wave":
        assert estimate.structure.side == -1


def test_maxima_that_trials_do_not_tell_apart_count_together():
    curves = [
        {"gain": Curve(np.array([value, 1.0]), np.array([error, 0.2]), 4)} for value, error in ((2.0, 0.1), (3.0, 0.5))
    ]
    alike = [Maximum(7.0, None, each, (0.0, 0.1)) for each in curves]
    gain = mixed(alike)["gain"]
    np.testing.assert_allclose(gain.value, [2.5, 1.0])
    np.testing.assert_allclose(gain.standard_error, [np.sqrt(0.5 * (0.1**2 + 0.5**2) + 0.25), 0.2])
    apart = [alike[0], alike[1]._replace(objective=27.0)]
    np.testing.assert_allclose(mixed(apart)["gain"].value, [2.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(mixed(apart)["gain"].standard_error, [0.1, 0.2], atol=1e-3)


def test_searches_of_a_half_wave_start_at_several_thresholds():
    angle, torque = measured(100.0, 4, 4.0, 0.02)
    signals = joint_signals(recorded(angle, torque + reflex_torque(angle, "half-wave")))
    time = np.broadcast_to(np.arange(signals.angle.shape[1]) / signals.rate, signals.angle.shape)
    for reflex, thresholds in (("half-wave", 3), ("linear", 1)):
        structure = JointStructure(reflex=reflex, side=-1) if reflex == "half-wave" else JointStructure(reflex=reflex)
        orders = {"stiffness": 1, "damping": 1, "gain": 1}
        model = VaryingModel(structure=structure, signals=signals, variable=time, orders=orders, low=0.0, high=4.0)
        starts = search_starts(VaryingLikelihood(model, ensemble=True))
        if thresholds > 1:
            tried = np.array(starts)[:, -1] / signals.velocity_scale
            np.testing.assert_allclose(np.unique(tried.round(9)), THRESHOLDS)
        assert all(np.isfinite(start).all() for start in starts)


@pytest.mark.slow(reason="estimates an ensemble")
def test_the_structure_that_is_chosen_is_estimated_as_if_asked_for(reflexive):
    record, chosen = reflexive("linear")
    asked = identify_varying(record, reflex="linear")
    pd.testing.assert_frame_equal(chosen.to_frame(), asked.to_frame())
    assert "structure as asked for: intrinsic path, linear reflex" in asked.summary()


@pytest.mark.slow(reason="estimates of many ensembles")
def test_bands_of_few_repetitions_are_students():
    """Those of the normal distribution hold 77 %."""
    time = np.arange(round(2.0 * RATE)) / RATE
    stiffness = 40.0 + 16.0 * np.sin(np.pi * time)
    held = []
    for seed in range(20):
        estimate = identify_varying(recorded(*measured(stiffness, 5, 2.0, 0.3, seed=seed)), reflex="none")
        lower, upper = estimate.interval("stiffness")
        truth = np.interp(estimate.grid, time, stiffness)
        held.append(np.mean((lower <= truth) & (truth <= upper)))
    assert np.mean(held) > 0.85


@pytest.mark.slow(reason="fits a recording")
def test_units_are_those_of_the_recording():
    angle, torque = measured(100.0, 6, 1.5, 0.1)
    estimates = [identify_varying(recorded(angle, torque, angular=each), reflex="none") for each in (True, False)]
    said = {
        angular: (estimate.to_frame()["unit"].unique().tolist(), estimate.to_xarray()["damping"].attrs["units"])
        for angular, estimate in zip((True, False), estimates, strict=True)
    }
    assert said == {True: (["Nm/rad", "Nms/rad"], "Nms/rad"), False: (["N/m", "Ns/m"], "Ns/m")}
    for estimate, mass, driven in zip(estimates, (" kg m^2;", " kg;"), ("of the torque", "of the force"), strict=True):
        assert mass in estimate.summary()
        assert driven in estimate.summary()
    line = replace(estimates[1], variable="scheduling")
    assert line.to_xarray()["scheduling"].attrs["units"] == "m"
    assert line.plot()[-1].get_xlabel() == "scheduling variable (m)"
    assert [panel.get_ylabel() for panel in line.plot()] == ["stiffness (N/m)", "damping (Ns/m)"]
    reflex = {"reflex_damping_ratio": 0.8, "reflex_threshold": -0.2}
    assert "reflex_damping_ratio 0.8, reflex_threshold -0.2 m/s" in replace(line, dynamics=reflex).summary()


@pytest.mark.slow(reason="fits an ensemble")
def test_an_ensemble_may_be_of_a_length_at_which_an_offset_is_exactly_nothing():
    angle, torque = measured(100.0, 6, 1.2, 0.1)  # 200 samples count: sums over periods are zero without rounding
    assert identify_varying(recorded(angle, torque), reflex="none").vaf > 99.0


@pytest.mark.slow(reason="fits an ensemble")
def test_repetitions_that_met_the_workspace_limit_are_left_out():
    angle, torque = measured(100.0, 6, 1.2, 0.1)
    met = ("trial", [1.0, *[np.nan] * 5])
    estimate = identify_varying(recorded(angle, torque).assign_coords(limit_time=met), reflex="none")
    assert estimate.n_trials == 5
    assert "1 of 6 trials met the workspace limit (limit_time) and are left out" in estimate.summary()


@pytest.mark.slow(reason="fits an ensemble")
def test_between_two_postures_nothing_is_known():
    angle, torque = measured(100.0, 2, 6.0, 0.0)
    posture = np.broadcast_to([[0.0], [0.05]], angle.shape)
    estimate = identify_varying(recorded(angle, torque, scheduling=posture), "scheduling", reflex="none")
    for curve in estimate.curves.values():
        assert np.abs(curve.value).max() < 110.0
        assert np.isinf(curve.standard_error[1:-1]).all()
    np.testing.assert_allclose(estimate.curves["stiffness"].value[[0, -1]], 100.0, rtol=0.01)


@pytest.mark.slow(reason="fits an ensemble")
def test_a_drift_of_the_torque_is_not_counted():
    angle, torque = measured(100.0, 2, 6.0, 0.1)
    slow = 0.2 * np.sin(np.arange(angle.shape[1]) / RATE + [[0.0], [2.0]])
    shares = []
    for drift in (0.0, 50.0):
        record = recorded(angle, torque + drift * np.linspace(0.0, 1.0, angle.shape[1]), scheduling=slow)
        shares.append(identify_varying(record, "scheduling", reflex="none").vaf)
    assert shares[0] > 99.0
    assert shares[1] == pytest.approx(shares[0], abs=0.1)


def test_bad_input_is_refused():
    angle, torque = measured(100.0, 4, 1.0, 0.1)
    good = recorded(angle, torque)
    with pytest.raises(ValueError, match="no scheduling signal"):
        identify_varying(good, "scheduling")
    with pytest.raises(ValueError, match="3 trials; expected an ensemble"):
        identify_varying(good.isel(trial=[0, 1, 2]))
    with pytest.raises(ValueError, match=r"condition has several values \(PT, RT\).*condition.values == 'PT'"):
        identify_varying(good.assign_coords(condition=("trial", ["PT", "PT", "RT", "RT"])))
    with pytest.raises(ValueError, match="servo = 'force'"):
        identify_varying(recorded(angle, torque, servo="force", perturbation=torque))
    with pytest.raises(ValueError, match=r"fit_until = 0.5 with variable = 'time'; expected None.*'scheduling'"):
        identify_varying(good, fit_until=0.5)
    with pytest.raises(ValueError, match="reflex = 'cubic'"):
        identify_varying(good, reflex="cubic")
    with pytest.raises(ValueError, match="angle of a trial is constant"):
        identify_varying(recorded(0 * angle, torque))
    noise = 2e-5 * np.random.default_rng(1).standard_normal(angle.shape)
    equal = angle[:1] + np.array([[0.0], [1.0], [2.0], [3.0]]) * 0.01 + noise
    with pytest.raises(ValueError, match=r"% of the velocity's variance differs between.*expected a different one"):
        identify_varying(recorded(equal, torque))


def test_a_small_perturbation_of_a_movement_that_repetitions_share_is_taken():
    angle, torque = measured(100.0, 6, 1.2, 0.02)
    reach = np.sin(2 * np.pi * 0.8 * np.arange(angle.shape[1]) / RATE)[None]
    reach *= 10.0 * derivative(angle).std() / derivative(reach).std()
    estimate = identify_varying(recorded(angle + reach, torque + 3.0 * reach), reflex="none")
    assert estimate.curves["stiffness"].value.mean() == pytest.approx(100.0, rel=0.05)
    assert not estimate.remarks


def test_curves_of_noise_are_said_to_be():
    angle, torque = measured(100.0, 6, 1.2, 0.02)
    estimate = identify_varying(recorded(angle, np.random.default_rng(3).standard_normal(torque.shape)), reflex="none")
    assert any("% of the torque: what it leaves is taken to be noise" in remark for remark in estimate.remarks)


def test_the_gain_is_not_known_where_the_reflex_has_not_acted_yet():
    angle, torque = measured(100.0, 6, 1.2, 0.02)
    estimate = identify_varying(recorded(angle, torque + reflex_torque(angle, "linear")), reflex="linear")
    late = estimate.grid > estimate.grid[-1] - 0.04 - 1.0 / (2 * np.pi * 5.0) + 0.01
    assert np.isinf(estimate.curves["gain"].standard_error[late]).all()
    assert np.isfinite(estimate.curves["gain"].standard_error[estimate.grid < estimate.grid[-1] - 0.1]).all()
    assert np.isfinite(estimate.curves["stiffness"].standard_error).all()
    gain = next(row for row in estimate.describe().table.rows if row[0] == "gain")
    assert 0.5 < float(gain[1]) <= float(gain[2]) < 1.5
    assert np.isnan(estimate.plot()[2].lines[0].get_ydata()[-1])
