"""The reflex controller against an independent integration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from tones import PERIOD, Tones

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.response.spectra import line_spectra
from armperturb.controllers.arm_control import ArmControl
from armperturb.controllers.lanes import activation_filter
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.subject import POSITION, RELAX

SUBJECTS = [POSITION, replace(POSITION, fact_s=1.7, fact_e=6.0, zeta_act=1.0), RELAX]

FORCE = replace(POSITION, name="force", kf_s=-0.7, kf_se=-0.3, kf_e=-0.4, Td_s=0.0455)
ACCELERATION = replace(POSITION, name="acceleration", ka_s=0.6, ka_se=0.3, ka_e=0.9)
ALL = replace(FORCE, name="all", ka_s=0.5, ka_se=0.2, ka_e=0.7, kp_s=40.0)


def activated(timestep, duration=1.0):
    """Response of each subject's filters to an excitation that is known between the steps, (time, trial, joint)."""
    time = np.arange(round(duration / timestep)) * timestep
    excitation = np.sin(2 * np.pi * 5 * time)
    return time, np.stack(
        [
            [
                signal.lfilter(*activation_filter(cutoff, subject.zeta_act, timestep), excitation)
                for cutoff in (subject.fact_s, subject.fact_e)
            ]
            for subject in SUBJECTS
        ],
    ).transpose(2, 0, 1)


def exact(subject, time):
    responses = []
    for cutoff in (subject.fact_s, subject.fact_e):
        omega, fine = 2 * np.pi * cutoff, np.arange(0, time[-1] + 1e-4, 1e-4)
        system = ([omega**2], [1, 2 * subject.zeta_act * omega, omega**2])
        _, y, _ = signal.lsim(system, np.sin(2 * np.pi * 5 * fine), fine)
        responses.append(np.interp(time, fine, y))
    return np.stack(responses, axis=-1)


@pytest.mark.slow(reason="simulates step by step")
def test_activation_is_the_filter_of_eq_b19():
    time, active = activated(1e-3)
    for number, subject in enumerate(SUBJECTS):
        np.testing.assert_allclose(active[:, number], exact(subject, time), atol=3e-4)


def test_activation_of_a_smooth_excitation_is_right_to_fourth_order():
    errors, frequency = [], np.array([5.0, 20.0])
    s = 2j * np.pi * frequency
    for timestep in (5e-3, 2.5e-3):
        omega = 2 * np.pi * POSITION.fact_s
        expected = omega**2 / (s**2 + 2 * POSITION.zeta_act * omega * s + omega**2)
        filters = activation_filter(POSITION.fact_s, POSITION.zeta_act, timestep)
        _, found = signal.freqz(*filters, 2 * np.pi * frequency * timestep)
        errors.append(np.abs(found / expected - 1.0))
    assert (errors[1] < 1e-4).all()
    np.testing.assert_allclose(errors[0] / errors[1], 16.0, rtol=0.1)


def test_excitation_is_eq_2_8():
    rng = np.random.default_rng(0)
    angle, velocity = rng.normal(size=(2, 3, 2))
    control = ArmControl(SUBJECTS, 2.5e-3)
    _, sent = control.torque(angle, velocity)
    excitation = control.memory["excitation"]
    for number, subject in enumerate(SUBJECTS):
        stretch = angle[number] - subject.posture
        expected = subject.joint_matrix("kv") @ velocity[number] + subject.joint_matrix("kp") @ stretch
        np.testing.assert_allclose(excitation[number], expected, rtol=1e-12)
    np.testing.assert_array_equal(excitation[2], 0.0)
    for number, subject in enumerate(SUBJECTS):
        cutoffs = subject.fact_s, subject.fact_e
        gain = np.array([activation_filter(cutoff, subject.zeta_act, 2.5e-3)[0][0] for cutoff in cutoffs])
        np.testing.assert_allclose(sent[number], -gain * excitation[number], rtol=1e-12)


@pytest.mark.slow(reason="lets slow transients of six trials pass")
def test_force_and_acceleration_feedback_give_the_admittance_of_theory():
    # So small that the arm's geometry stays linear to 1e-3; the slowest transient has gone by e^-10 after 15 s.
    people, settled = (FORCE, ACCELERATION, ALL), 15.0
    trials = [
        Trial(subject=subject, perturbation=Tones(rms=2e-3, duration=settled + PERIOD, axes=(axis,)))
        for subject in people
        for axis in range(2)
    ]
    recording = run_experiment(trials)
    for number, subject in enumerate(people):
        lines = line_spectra(recording.isel(trial=[2 * number, 2 * number + 1]), window_start=settled, period=PERIOD)
        exact = arm_admittance(subject, lines.frequency)
        # No averages: moved along one axis at a time, line by line, the two inputs determine the admittance.
        forces, moves = (np.moveaxis(of, 0, -1) for of in (lines.force, lines.displacement))
        found = moves @ np.linalg.inv(forces)
        error = np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
        assert error[lines.frequency <= 20].max() < 0.003, subject.name
        without = replace(
            subject, **{f"{quantity}_{joint}": 0.0 for quantity in ("ka", "kf") for joint in ("s", "se", "e")}
        )
        plain = arm_admittance(without, lines.frequency)
        assert (np.linalg.norm(plain - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))).max() > 0.3


def test_trials_without_such_feedback_are_the_same_to_the_last_bit_beside_one_that_has_it():
    perturbation = Multisine.draw(seed=1, rms=3.0, duration=0.5, crested=False)
    alone, beside = (
        run_experiment([Trial(subject=subject, perturbation=perturbation) for subject in subjects])
        for subjects in ([POSITION], [ALL, POSITION])
    )
    for name in ("force", "displacement", "joint_angle"):
        np.testing.assert_array_equal(alone[name].values[0], beside[name].values[1])
        assert (beside[name].values[0] != beside[name].values[1]).any()


def test_active_torque_comes_back_after_its_delay():
    """Force feedback of muscles that are nothing but active feels what the filter gave one delay ago."""
    none = dict.fromkeys((f"{quantity}_{joint}" for quantity in "bk" for joint in ("s", "se", "e")), 0.0)
    arm = replace(RELAX, **none, kf_s=1e-9, kf_e=1e-9, kp_s=1.0, kp_e=1.0, Td_s=0.0325, Td_e=0.0137)
    control, sent, seen = ArmControl([RELAX, arm], 2.5e-3), [], []
    for step in range(60):
        time = 2.5e-3 * step
        _, active = control.torque(np.array([arm.posture] * 2) + 0.1 * np.sin(20 * time) ** 2, np.zeros((2, 2)))
        sent.append(-active[1])
        seen.append((control.memory["excitation"][1] - 0.1 * np.sin(20 * time) ** 2) / 1e-9)
        assert not control.memory["excitation"][0].any()
    sent, seen = np.array(sent), np.array(seen)
    np.testing.assert_allclose(seen[20:, 0], sent[20 - 13 : 60 - 13, 0], atol=1e-6 * sent.max())
    # Between steps it runs smoothly.
    expected = np.interp(np.arange(20, 60) - 5.48, np.arange(60), sent[:, 1])
    np.testing.assert_allclose(seen[20:, 1], expected, atol=2e-3 * sent[:, 1].max())
