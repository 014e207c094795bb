"""Joint rotations and velocities from a handle's path: closed forms, and the joints of simulated people."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.measures.kinematics import (
    hand_path,
    hand_position,
    joint_angles,
    joint_rotations,
    joint_velocities,
    start_posture,
    true_rotations,
    within_reach,
)
from armperturb.environment import Strap
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.subject import POSITION, RELAX

RATE = 200.0


def pulsed(task, **options):
    return Trial(
        subject=replace(task, **options),
        perturbation=MultisineThenPulse.join(
            Multisine.draw(seed=1, rms=5.4 if task is POSITION else 0.9, duration=4.0, crested=False),
            peak=100.0 if task is POSITION else 50.0,
            direction_deg=20.0,
            tail=1.5,
        ),
        pulse_level=1.0,
    )


@pytest.fixture(scope="module")
def recording(once):
    trials = [pulsed(POSITION), pulsed(RELAX)]
    return once("pulsed", lambda _: run_experiment(trials, instruments=Instruments(emg=None)))


def test_postures_that_need_no_formula():
    np.testing.assert_allclose(hand_position([0.0, 0.0], 0.3, 0.2), [0.5, 0.0], atol=1e-15)
    np.testing.assert_allclose(joint_angles([0.3, 0.2], 0.3, 0.2), [0.0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(joint_angles([0.3, -0.2], 0.3, 0.2, flexed=False), [0.0, -np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(joint_angles([0.0, 0.5], 0.3, 0.2), [np.pi / 2, 0.0], atol=1e-7)


@given(st.floats(-3.1, 3.1), st.floats(0.02, 3.1), st.booleans(), st.floats(0.1, 0.5), st.floats(0.1, 0.5))
def test_inverse_takes_forward_back(shoulder, elbow, flexed, l_h, l_f):
    angle = np.array([shoulder, elbow if flexed else -elbow])
    hand = hand_position(angle, l_h, l_f)
    found = joint_angles(hand, l_h, l_f, flexed=flexed)
    np.testing.assert_allclose(hand_position(found, l_h, l_f), hand, atol=1e-10)
    assert np.hypot(*hand) < 1e-3 or found[1] == pytest.approx(angle[1], abs=1e-5)


def test_small_rotations_are_those_of_the_jacobian(recording):
    small = recording.isel(trial=[0])
    small = small.assign(displacement=1e-5 * small["displacement"])
    expected = small["displacement"].values @ np.linalg.inv(hand_jacobian(POSITION)).T
    np.testing.assert_allclose(joint_rotations(small), expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.slow(reason="simulates trials")
def test_each_trial_has_a_body_of_its_own():
    bodies = [pulsed(POSITION), pulsed(POSITION, l_h=0.25, theta_s_deg=40.0, theta_e_deg=60.0)]
    recording = run_experiment(bodies)
    together = joint_rotations(recording)
    for trial in range(2):
        np.testing.assert_array_equal(together[[trial]], joint_rotations(recording.isel(trial=[trial])))
    assert not together[:, 0].any() or np.abs(together[:, 0]).max() < 1e-12
    np.testing.assert_allclose(
        hand_path(recording)[1, 0], [*hand_position(start_posture(recording)[1], 0.25, POSITION.l_f)]
    )


@pytest.mark.parametrize("trial", [0, 1])
def test_rotations_are_those_of_the_joints_but_for_the_grip(recording, trial):
    """A stiff grip would leave nothing: what is left is what its deflection turns the joints by."""
    subject = (POSITION, RELAX)[trial]
    true = recording["joint_angle"].values[trial] - start_posture(recording)[trial]
    found = joint_rotations(recording)[trial]
    grip = recording["force"].values[trial] / subject.k_h  # its damping is small
    angles = true + start_posture(recording)[trial]
    shoulder, both = angles[:, 0], angles.sum(axis=1)
    humerus = subject.l_h * np.stack([-np.sin(shoulder), np.cos(shoulder)], axis=-1)
    forearm = subject.l_f * np.stack([-np.sin(both), np.cos(both)], axis=-1)
    jacobian = np.stack([humerus + forearm, forearm], axis=-1)
    by_grip = np.linalg.solve(jacobian, grip[..., None])[..., 0]
    assert np.abs(found - true).max() > np.radians(0.1)
    off = np.abs(found - true - by_grip).max()
    assert off < 0.15 * np.abs(by_grip).max() + np.radians(0.02)


def test_error_is_that_of_the_grip(recording):
    """At most the deflection of the grip, times what the inverse of the Jacobian makes of it anywhere on the way."""
    peak = np.abs(joint_rotations(recording) - true_rotations(recording)).max(axis=1)
    for trial, subject in enumerate((POSITION, RELAX)):
        deflection = np.linalg.norm(recording["force"].values[trial], axis=-1).max() / subject.k_h
        postures = np.degrees(recording["joint_angle"].values[trial, ::20])
        jacobians = [hand_jacobian(replace(subject, theta_s_deg=s, theta_e_deg=e)) for s, e in postures]
        stretch = 1.0 / min(np.linalg.svd(jacobian)[1][-1] for jacobian in jacobians)
        assert 0.1 * stretch * deflection < peak[trial].max() < 1.1 * stretch * deflection


@pytest.mark.slow(reason="simulates trials")
def test_the_marker_puts_a_moving_shoulder_right(recording):
    moving = run_experiment([pulsed(POSITION), pulsed(RELAX)], strap=Strap())
    marker = moving["shoulder_marker"].values
    np.testing.assert_allclose(hand_path(moving) - hand_path(moving, shoulder=marker), marker, atol=1e-12)
    held = joint_rotations(recording) - true_rotations(recording)
    fixed, put_right = (joint_rotations(moving, shoulder=path) - true_rotations(moving) for path in (None, marker))
    rms = [np.sqrt(np.mean(error**2, axis=1)) for error in (held, fixed, put_right)]
    assert (rms[2] < 1.1 * rms[0]).all()
    assert (np.abs(put_right).max(axis=1) < 1.1 * np.abs(held).max(axis=1)).all()
    assert (rms[1] > [[2.0, 2.0], [1.3, 1.3]] * rms[2]).all()


def test_refuses_no_truth_and_another_shoulder(recording):
    with pytest.raises(ValueError, match="no joint_angle; expected one that was simulated"):
        true_rotations(recording.drop_vars("joint_angle"))
    with pytest.raises(ValueError, match=r"shoulder of shape \(2,\); expected \(2, 1100, 2\)"):
        joint_rotations(recording, shoulder=[0.0, 0.0])


@pytest.mark.slow(reason="simulates trials")
def test_velocities_are_those_of_the_joints():
    """With a grip that hardly gives, encoders and filter alone are left."""
    stiff = [pulsed(POSITION, k_h=400e3, b_h=600.0), pulsed(RELAX, k_h=400e3, b_h=600.0)]
    recording = run_experiment(stiff, timestep=2.5e-4, instruments=Instruments(emg=None, antialias=None))
    true = recording["joint_angle"].values
    # Fourth order in the step, from true angles.
    true = (8 * (true[:, 3:-1] - true[:, 1:-3]) - (true[:, 4:] - true[:, :-4])) * RATE / 12
    found = joint_velocities(joint_rotations(recording), RATE)[:, 2:-2]
    rms = np.sqrt(np.mean(true**2, axis=1))
    np.testing.assert_allclose(np.sqrt(np.mean(found**2, axis=1)), rms, rtol=0.015)
    np.testing.assert_allclose(np.abs(found).max(axis=1), np.abs(true).max(axis=1), rtol=0.03)


def test_differentiates_a_sine():
    time = np.arange(4000) / RATE
    angle = np.stack([np.sin(2 * np.pi * time), 0.1 * np.sin(2 * np.pi * 10 * time)], axis=-1)
    inner = slice(200, -200)
    found = joint_velocities(angle, RATE)[inner]
    expected = 2 * np.pi * np.stack([np.cos(2 * np.pi * time), np.cos(2 * np.pi * 10 * time)], axis=-1)[inner]
    np.testing.assert_allclose(found, expected, atol=0.02 * 2 * np.pi)


def test_leaves_the_noise_that_is_said():
    step = 3e-5
    noise = step * np.random.default_rng(1).standard_normal((200_000, 2))
    for cutoff in (15.0, 40.0):
        expected = 2 * np.pi * step * np.sqrt(2 * cutoff**3 / (3 * RATE))
        assert 0.7 * expected < joint_velocities(noise, RATE, cutoff=cutoff).std() < expected
    assert joint_velocities(noise, RATE, cutoff=None).std() == pytest.approx(step * RATE / np.sqrt(2), rel=0.02)


def test_refuses_what_no_arm_reaches(recording):
    assert within_reach([[0.5, 0.0], [0.51, 0.0], [0.05, 0.0], [np.nan, 0.0]], 0.3, 0.2).tolist() == [True] + 3 * [
        False
    ]
    with pytest.raises(ValueError, match=r"0\.600 m from the shoulder at \(1,\); expected 0\.100 to 0\.500 m"):
        joint_angles([[0.4, 0.0], [0.6, 0.0]], 0.3, 0.2)
    with pytest.raises(ValueError, match="nan m from the shoulder"):
        joint_angles([np.nan, 0.0], 0.3, 0.2)
    far = recording.assign(displacement=recording["displacement"] + 1.0)
    with pytest.raises(ValueError, match=r"m from the shoulder at \(0, 0\); expected"):
        joint_rotations(far)


@pytest.mark.parametrize(("options", "message"), [({"cutoff": 100.0}, "cutoff = 100"), ({"cutoff": 0.0}, "cutoff = 0")])
def test_refuses_a_cutoff(options, message):
    with pytest.raises(ValueError, match=message):
        joint_velocities(np.zeros((100, 2)), RATE, **options)
