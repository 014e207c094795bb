"""Identification of trials as other laboratories record them: constant forces, pulses at any time, short and noisy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.interpolate import CubicSpline

from armperturb.analysis.arm.geometry import force_stiffness
from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.fit.group import Group, parts_by_condition, pulsed_alike
from armperturb.analysis.fit.identify import identify, identify_conditions
from armperturb.analysis.fit.ladder import choose_structure
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.measures.start_geometry import in_start_geometry
from armperturb.analysis.numerics.periodicity import find_period
from armperturb.analysis.response.estimate import response
from armperturb.analysis.trials import ConditionTrials
from armperturb.environment import Environment
from armperturb.recording import make_recording
from armperturb.subject import POSITION

RATE = 200.0
ENVIRONMENT = Environment(m_env=2.0, b_env=8.0, k_env=100.0)
NO_FEEDBACK = {f"{gain}_{joint}": 0.0 for gain in ("kv", "kp") for joint in ("s", "se", "e")}
RELAXED = replace(
    POSITION,
    **{"m_h": 1.9, "m_f": 1.5, "b_s": 2.2, "b_se": 0.5, "b_e": 1.5, "k_s": 30.0, "k_se": 8.0, "k_e": 24.0},
    **{**NO_FEEDBACK, "kv_s": 1.6, "kv_e": 1.2, "b_h": 40.0, "k_h": 12e3},
    **{"Td_s": 0.033, "Td_e": 0.033, "fact_s": 2.5, "fact_e": 2.5, "theta_s_deg": 35.0, "theta_e_deg": 85.0},
)
VELOCITY = composed(grip="spring", reflex="velocity")


def multisine(rng, seconds):
    """Random phases, other lines along x than along y, RMS 3 N, (time, axis)."""
    time, lines = np.arange(round(seconds * RATE))[:, None] / RATE, np.arange(1, 150) / seconds
    force = np.empty((len(time), 2))
    for axis in range(2):
        mine = lines[axis::2]
        angle = 2.0 * np.pi * time * mine + rng.uniform(0.0, 2.0 * np.pi, len(mine))
        force[:, axis] = (np.maximum(mine, 1.0) ** -0.4 * np.cos(angle)).sum(axis=1)
    return 3.0 * force / force.std(axis=0)


def recorded(n, seconds, *, seed=0, noise=0.8, condition="A", onsets=None, held=(0.0, 0.0), environment=ENVIRONMENT):
    """Trials amid the movement under a multisine of 10 s, with low noise of the hand."""
    rng, n_time, lead = np.random.default_rng(seed), round(seconds * RATE), round(8.0 * RATE)
    signals = {name: np.empty((n, n_time, 2)) for name in ("perturbation", "force", "displacement")}
    for trial in range(n):
        force = np.tile(multisine(rng, 10.0), (round(seconds // 10.0) + 2, 1))[-n_time - lead :]
        slow = signal.lfilter(*signal.butter(2, 3.0, fs=RATE), rng.standard_normal(force.shape), axis=0)
        slow *= noise / slow.std()
        response = simulate_linear(RELAXED, environment, force + slow, RATE)
        gauge, encoder = 0.02 * rng.standard_normal((n_time, 2)), 1e-5 * rng.standard_normal((n_time, 2))
        signals["perturbation"][trial] = force[lead:]
        signals["force"][trial] = (response.force - slow)[lead:] + gauge
        signals["displacement"][trial] = response.displacement[lead:] + encoder
    signals["perturbation"] += held
    signals["force"] += held  # which the person resists all the time
    labels = {"subject": ["S"] * n, "task": ["PT"] * n, "condition": [condition] * n, "repetition": [*range(n)]}
    pulses = np.full(n, np.nan) if onsets is None else np.asarray(onsets)
    labels |= {"pulse_onset": pulses, "pulse_level": np.isfinite(pulses).astype(float)}
    labels |= {"pulse_direction": np.where(np.isfinite(pulses), 20.0, np.nan), "limit_time": [np.nan] * n}
    labels |= {name: [getattr(RELAXED, name)] * n for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")}
    return make_recording(signals, labels, RATE)


@pytest.mark.slow(reason="tries structures")
def test_delays_that_are_far_too_long_lead_no_search_astray():
    choice = choose_structure(Group.prepare(recorded(6, 10.0, seed=4), composed()))
    assert choice.chosen.reflex == "velocity"
    for name in ("k_s", "k_se", "k_e", "kv_s", "kv_e", "Td_s"):
        low, high = choice.estimate.interval(name)
        assert low < getattr(RELAXED, name) < high, name


def test_a_constant_force_in_the_perturbation_hides_neither_period_nor_independence():
    held = recorded(2, 28.0, held=(10.0, -15.0))
    assert find_period(list(held["perturbation"].values), RATE) == pytest.approx(10.0)
    trials = ConditionTrials.prepare(held)
    assert trials.are_independent
    assert trials.is_perturbed(2.0)
    still = held.assign(perturbation=0.0 * held["perturbation"] + 5.0)
    assert not ConditionTrials.prepare(still, is_checked=True).is_perturbed(2.0)


def pulsed_from_rest(onset, n=16, seconds=6.0, noise=0.2):
    """Trials of a half-sine pulse each, in eight directions, of a person who sways a little."""
    rng, time = np.random.default_rng(0), np.arange(round(seconds * RATE)) / RATE
    lead, directions = round(4.0 * RATE), 45.0 * (np.arange(n) % 8)
    pulse = 8.0 * np.sin(np.pi * (time - onset) / 0.1) * ((time >= onset) & (time < onset + 0.1))
    towards = np.stack([np.cos(np.radians(directions)), np.sin(np.radians(directions))], axis=1)
    d = pulse[None, :, None] * towards[:, None]
    led = np.concatenate([np.zeros((n, lead, 2)), d], axis=1)
    sway = signal.lfilter(*signal.butter(2, 3.0, fs=RATE), rng.standard_normal(led.shape), axis=1)
    sway *= noise / sway.std()
    response = simulate_linear(RELAXED, ENVIRONMENT, led + sway, RATE)
    signals = {
        "perturbation": d,
        "force": (response.force - sway)[:, lead:] + 0.02 * rng.standard_normal(d.shape),
        "displacement": response.displacement[:, lead:] + 1e-5 * rng.standard_normal(d.shape),
    }
    labels = {"subject": ["S"] * n, "task": ["RT"] * n, "condition": ["A"] * n, "repetition": [*range(n)]}
    labels |= {"pulse_onset": [onset] * n, "pulse_level": [1.0] * n, "pulse_direction": directions}
    labels |= {"limit_time": [np.nan] * n}
    labels |= {name: [getattr(RELAXED, name)] * n for name in ("l_h", "l_f", "theta_s_deg", "theta_e_deg")}
    return make_recording(signals, labels, RATE)


@pytest.mark.slow(reason="simulates and fits trials")
def test_pulses_alone_tell_of_the_arm():
    recording = pulsed_from_rest(1.5)
    fit = identify(recording, "2").fit
    assert any(remark.startswith("nothing but pulses perturbs") for remark in fit.remarks)
    for name in ("k_s", "k_se", "k_e", "b_s", "b_e"):
        assert abs(fit.values[name] - getattr(RELAXED, name)) < 3.0 * fit.standard_error[name], name
    estimate = response(recording, "noise")
    assert estimate.covers(arm_admittance(RELAXED, estimate.frequency)).mean() > 0.85
    with pytest.raises(ValueError, match=r"pulse_onset of trial 0 of A is 0\.5 s.*at least 1 s before it"):
        identify(pulsed_from_rest(0.5))


def relabelled(signals, like, rate):
    """Signals with the labels of a recording's trials."""
    labels = {name: coord.values for name, coord in like.coords.items() if coord.dims == ("trial",)}
    return ConditionTrials.prepare(make_recording(signals, labels, rate))


def test_a_start_amid_the_movement_is_none_at_rest_at_any_rate():
    amid = recorded(2, 12.0)
    time = np.arange(amid.sizes["time"]) / RATE
    for rate in (RATE, 5.0 * RATE, 10.0 * RATE):
        fine = np.arange(round(time[-1] * rate)) / rate
        signals = {name: CubicSpline(time, values.values, axis=1)(fine) for name, values in amid.data_vars.items()}
        signals["displacement"] -= signals["displacement"][:, :1]
        assert not relabelled(signals, amid, rate).from_rest


@pytest.mark.parametrize("noise", [0.0, 2e-5, 1e-4])
@pytest.mark.parametrize("seconds", [0.0, 1.0])
@pytest.mark.parametrize("from_first", [False, True])
def test_a_start_at_rest_is_one_whatever_the_force_and_the_noise(noise, seconds, from_first):
    amid, rng = recorded(4, 12.0), np.random.default_rng(2)
    force = np.stack([multisine(rng, 12.0) for _ in range(4)])
    force *= np.clip(np.arange(force.shape[1]) / (seconds * RATE or 1.0), seconds == 0.0, 1.0)[:, None]
    response = simulate_linear(RELAXED, ENVIRONMENT, force, RATE)
    path = response.displacement + noise * rng.standard_normal(force.shape)
    if from_first:  # the first sample, with its noise, is the origin
        path -= path[:, :1]
    assert relabelled({"perturbation": force, "force": response.force, "displacement": path}, amid, RATE).from_rest


def test_a_slow_movement_is_no_rest():
    amid, rng = recorded(2, 12.0), np.random.default_rng(0)
    soft = replace(RELAXED, k_s=10.0, k_se=2.0, k_e=7.0, b_h=60.0, kv_s=0.0, kv_e=0.0)
    force = np.stack([multisine(rng, 20.0) for _ in range(2)])
    response = simulate_linear(soft, Environment(m_env=2.0, b_env=15.0, k_env=0.0), force, RATE)
    later = slice(-round(12.0 * RATE), None)
    signals = {"perturbation": force[:, later], "force": response.force[:, later]}
    path = response.displacement[:, later]
    assert not relabelled(signals | {"displacement": path - path[:, :1]}, amid, RATE).from_rest


def test_a_start_at_rest_under_a_constant_force_is_none_from_nothing():
    amid, force = recorded(1, 12.0), multisine(np.random.default_rng(0), 12.0)
    force *= np.minimum(np.arange(len(force)) / RATE, 1.0)[:, None]
    response = simulate_linear(RELAXED, ENVIRONMENT, force[None], RATE)
    signals = {"perturbation": force[None], "force": response.force, "displacement": response.displacement}
    assert relabelled(signals, amid, RATE).from_rest
    held = np.array([10.0, 0.0])
    signals |= {name: signals[name] + held for name in ("perturbation", "force")}
    assert not relabelled(signals, amid, RATE).from_rest


@pytest.mark.slow(reason="fits that follow the moving arm")
def test_a_constant_force_changes_no_fit_but_by_its_turning_which_is_named():
    """The arm is linear, so that only trials that follow the moving arm could tell what its joints add to that."""
    plain, held = (recorded(2, 14.0, held=force) for force in ((0.0, 0.0), (30.0, -45.0)))
    fits = [identify(each, "2").fit for each in (plain, held, in_start_geometry(held))]
    values = np.array([list(fit.values.values()) for fit in fits])
    np.testing.assert_allclose(values[1], values[0], rtol=1e-4)
    turned = -force_stiffness(fits[0].arm, fits[1].force)
    joints = [list(fits[0].values).index(name) for name in ("k_s", "k_se", "k_e")]
    assert np.abs(values[2] - values[0])[joints].max() < 0.1 * np.abs(turned).min()
    np.testing.assert_allclose(fits[1].force, (30.0, -45.0), atol=0.5)
    assert [any("the mean force on the hand" in remark for remark in fit.remarks) for fit in fits] == [
        False,
        True,
        True,
    ]
    assert f"makes {turned[0, 0]:.3g} of k_s" in " ".join(fits[1].remarks)


@pytest.mark.slow(reason="identifies several recordings")
def test_what_is_not_used_is_named():
    short, shorter = recorded(3, 7.5, condition="short"), recorded(1, 24.0, condition="long", seed=1)
    both = identify_conditions([short, recorded(2, 28.0, condition="long", onsets=[27.0, 20.0]), shorter], "2")
    assert list(both) == ["long"]
    assert both["long"].n_trials == 3  # of any length
    line = "short is not identified, as a trial of it ends or is pulsed before 8 s (an earlier --window-start)"
    assert line in both["long"].fit.remarks
    # So much noise that mean periods are unlikely, and no more likely in the geometry where nothing is periodic.
    pulsed = identify(recorded(3, 28.0, onsets=[27.0, 20.0, 25.0], noise=8.0), VELOCITY, estimator="frequency")
    assert any(
        remark.startswith("3 trials are used up to 20 s, where the earliest pulse begins, of 24 s")
        for remark in pulsed.fit.remarks
    )
    assert not any("used up to" in remark for remark in both["long"].fit.remarks)


@pytest.mark.slow(reason="fits six trials")
def test_each_trial_is_used_up_to_its_pulse_and_no_search_ends_at_unusual_delays():
    onsets = [15.46, 14.01, 18.0, 24.06, 23.76, 18.61]
    recording = recorded(6, 30.0, seed=4, onsets=onsets)
    alike = pulsed_alike(ConditionTrials.prepare(recording))
    assert sum(part.n_trials for part in alike) == 6
    assert sum(part.n_trials * part.first_onset for part in alike) > 0.93 * RATE * sum(onsets)
    used = estimate([Group.prepare(recording, VELOCITY)])
    # A second maximum lies at a delay of 0.13 s and a k_s of 38.
    for name in ("k_s", "k_se", "k_e", "kv_s", "kv_e", "Td_s", "Td_e"):
        assert abs(used.values[name] - getattr(RELAXED, name)) < 3.0 * used.standard_error[name], name


@pytest.mark.slow(reason="identifies from several recordings")
@pytest.mark.parametrize("changes", [{"m_env": 4.0, "b_env": 30.0, "k_env": 0.0}, {"k_env": 250.0}])
def test_sessions_with_other_manipulators_are_taken_each_with_its_own(changes):
    other = replace(ENVIRONMENT, **changes)
    sessions = [recorded(2, 20.0, noise=0.4), recorded(2, 20.0, seed=1, noise=0.4, environment=other)]
    first, second = parts_by_condition(sessions)["A"]
    assert second.environment.k_env == pytest.approx(other.k_env, abs=5.0)
    assert first.environment.m_env == pytest.approx(2.0, rel=0.02)
    (together,) = parts_by_condition([sessions[0], recorded(2, 20.0, seed=2, noise=0.4)])["A"]
    assert together.n_trials == 4
    fit = identify_conditions(sessions, "2")["A"].fit
    assert any(remark.startswith("recorded with several manipulators") for remark in fit.remarks)
    for name in ("k_s", "k_e", "b_s", "b_e"):
        low, high = fit.interval(name, 0.999)
        assert low < getattr(RELAXED, name) < high, name
