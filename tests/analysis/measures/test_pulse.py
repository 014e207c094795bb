"""Peaks of pulse responses, and their prediction, against closed forms and an integration of its own."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from armperturb.analysis.arm.geometry import hand_jacobian, mass_matrix
from armperturb.analysis.measures.pulse import cut_peaks, predicted_peaks, pulse_peaks, pulse_prediction, pulse_span
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.recording import make_recording
from armperturb.subject import POSITION, RELAX

RATE = 200.0
ONSET = 4.0


def recorded(task, perturbation, force, displacement, *, onset=ONSET, limit=math.nan):
    labels = dict(
        **dict(subject="A", task=task, condition=f"{task}7.5", repetition=0, order=0, pulse_level=1.0),
        **dict(pulse_direction=20.0, pulse_onset=onset, l_h=RELAX.l_h, l_f=RELAX.l_f, limit_time=limit),
        **dict(theta_s_deg=RELAX.theta_s_deg, theta_e_deg=RELAX.theta_e_deg),
    )
    signals = {"perturbation": perturbation, "force": force, "displacement": displacement}
    return make_recording(
        {name: np.asarray(values)[None] for name, values in signals.items()},
        {name: [value] for name, value in labels.items()},
        RATE,
    )


@pytest.fixture
def growing():
    """The handle goes away from its start at 0.1 m/s, along 3-4-5; the force is 10 N/s along y."""
    time = np.arange(1200) / RATE
    away = 0.1 * np.multiply.outer(time, [0.6, -0.8])
    return np.zeros_like(away), np.multiply.outer(time, [0.0, 10.0]), away


@pytest.mark.parametrize(("task", "window"), [("PT", 0.3), ("RT", 1.0)])
def test_peaks_are_norms_in_the_window_of_the_task(growing, task, window):
    peaks = pulse_peaks(recorded(task, *growing))
    assert peaks.displacement == pytest.approx(0.1 * (ONSET + window))
    assert peaks.force == pytest.approx(10.0 * (ONSET + window))
    assert peaks.admittance == pytest.approx(0.01)


def test_a_peak_that_the_window_cuts_is_named(growing):
    d, f, x = growing
    recording = recorded("PT", d, f, x)
    (line,) = cut_peaks(recording)
    assert line.startswith("PT7.5: after 1 of 1 pulses the handle is farthest at the end of the 0.3 s")
    back = x.copy()
    back[859:] *= 0.9
    assert cut_peaks(recorded("PT", d, f, back)) == []


def test_the_window_holds_both_ends(growing):
    assert pulse_span(recorded("PT", *growing), 0) == slice(800, 861)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"onset": math.nan}, "trial 0 has no pulse"),
        ({"onset": 5.8}, r"ends 0\.2 s after its pulse began; expected more than 0\.3 s in PT"),
        ({"limit": 4.3}, r"reached the workspace limit at 4\.300 s, 0\.300 s after"),
        ({"limit": 3.0}, r"reached the workspace limit at 3\.000 s, 1\.000 s before its pulse began"),
    ],
)
def test_a_window_that_is_not_there_is_refused_and_gives_nan(growing, options, message):
    recording = recorded("PT", *growing, **options)
    with pytest.raises(ValueError, match=message):
        pulse_span(recording, 0)
    assert np.isnan(pulse_peaks(recording).admittance).all()
    assert np.isnan(pulse_prediction(recording, POSITION, Environment())).all()


def test_an_unknown_task_is_refused(growing):
    with pytest.raises(ValueError, match="task = 'XT'; expected one of PT, RT"):
        pulse_span(recorded("XT", *growing), 0)


def test_a_limit_after_the_window_does_no_harm(growing):
    assert np.isfinite(pulse_peaks(recorded("PT", *growing, limit=4.4)).force).all()


@pytest.mark.slow(reason="integrates the equations directly")
def test_prediction_is_that_of_a_direct_integration():
    """Two segments, grip and environment written down once more, pushed by a sine and then by a pulse."""
    arm, environment = RELAX, Environment()
    jacobian, mass = hand_jacobian(arm), mass_matrix(arm)
    damping = np.array([[arm.b_s, arm.b_se], [arm.b_se, arm.b_e]])
    stiffness = np.array([[arm.k_s, arm.k_se], [arm.k_se, arm.k_e]])
    direction = np.array([math.cos(math.radians(20.0)), math.sin(math.radians(20.0))])

    time = np.arange(round((ONSET + 1.2) * RATE)) / RATE
    before = np.stack([0.5 * np.sin(2 * np.pi * time), 0.3 * np.sin(np.pi * time)], axis=-1) * (time < ONSET)[:, None]
    pulse = 50.0 * np.sin(np.pi * np.clip(time - ONSET, 0.0, 0.08) / 0.08)
    pushed = before + np.multiply.outer(pulse, direction)

    def push(moment):  # straight between the samples
        return np.array([np.interp(moment, time, of_axis) for of_axis in pushed.T])

    def slope(time, state):
        q, q_dot, x, x_dot = state.reshape(4, 2)
        force = arm.k_h * (x - jacobian @ q) + arm.b_h * (x_dot - jacobian @ q_dot)
        q_dot_dot = np.linalg.solve(mass, jacobian.T @ force - damping @ q_dot - stiffness @ q)
        x_dot_dot = (push(time) - force - environment.b_env * x_dot - environment.k_env * x) / environment.m_env
        return np.concatenate([q_dot, q_dot_dot, x_dot, x_dot_dot])

    solved = solve_ivp(slope, (0.0, time[-1]), np.zeros(8), t_eval=time, max_step=0.002, rtol=1e-8, atol=1e-10).y
    path = solved[4:6].T
    force = arm.k_h * (path - solved[:2].T @ jacobian.T) + arm.b_h * (solved[6:].T - solved[2:4].T @ jacobian.T)
    recording = recorded("RT", pushed, force, path)
    assert predicted_peaks(recording, arm, environment) == pytest.approx(pulse_peaks(recording).displacement, rel=1e-5)
    assert pulse_prediction(recording, arm, environment) == pytest.approx(100.0, rel=1e-5)
    # From rest at the onset it would be another.
    at_rest = recording.assign(perturbation=recording["perturbation"].where(recording["time"] >= ONSET, 0.0))
    assert abs(pulse_prediction(at_rest, arm, environment)[0] - 100.0) > 1.0


def test_linear_people_are_predicted():
    trials = [
        Trial(
            subject=subject,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=2, rms=rms, duration=6.0, crested=False), peak=peak, direction_deg=200.0, tail=1.2
            ),
            pulse_level=1.0,
        )
        for subject, rms, peak in ((POSITION, 5.4, 54.0), (RELAX, 0.9, 54.0))
    ]
    recording = run_experiment(trials, linear=True)
    for trial, arm in enumerate((POSITION, RELAX)):
        of_trial = recording.isel(trial=[trial])
        assert pulse_prediction(of_trial, arm, Environment()) == pytest.approx(100.0, abs=0.5)
    # Twice as stiff, half as far.
    stiff = replace(RELAX, **{name: 2 * getattr(RELAX, name) for name in ("k_s", "k_se", "k_e")})
    assert pulse_prediction(recording.isel(trial=[1]), stiff, Environment())[0] < 95.0


def test_an_unstable_arm_has_no_bound(growing):
    recording = recorded("PT", *growing)
    wild = replace(POSITION, kv_s=-500.0)
    assert predicted_peaks(recording, wild, Environment()) == np.inf
