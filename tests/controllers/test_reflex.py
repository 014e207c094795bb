"""The reflex controller against an independent integration."""

from dataclasses import replace

import numpy as np
import pytest
from armperturb.controllers.reflex import (
    MemoryReflexes,
    activate,
    initial_activation,
    reflex_gains,
    spindle_excitation,
)
from scipy import signal
from tones import PERIOD, Tones

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.response.spectra import line_spectra
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
    gains, state = reflex_gains(SUBJECTS, timestep), initial_activation(len(SUBJECTS))
    time = np.arange(round(duration / timestep)) * timestep
    out = []
    for t in time:
        excitation = np.sin(2 * np.pi * 5 * t) * np.ones((len(SUBJECTS), 2))
        active, state = activate(gains, state, excitation)
        out.append(active)
    return time, np.array(out)


def exact(subject, time):
    responses = []
    for cutoff in (subject.fact_s, subject.fact_e):
        omega, fine = 2 * np.pi * cutoff, np.arange(0, time[-1] + 1e-4, 1e-4)
        system = ([omega**2], [1, 2 * subject.zeta_act * omega, omega**2])
        _, y, _ = signal.lsim(system, np.sin(2 * np.pi * 5 * fine), fine)
        responses.append(np.interp(time, fine, y))
    return np.stack(responses, axis=-1)


def test_activation_is_the_filter_of_eq_b19():
    time, active = activated(1e-3)
    for number, subject in enumerate(SUBJECTS):
        np.testing.assert_allclose(active[:, number], exact(subject, time), atol=3e-4)


def test_activation_is_second_order_accurate():
    errors = []
    for timestep in (4e-3, 2e-3):
        time, active = activated(timestep)
        errors.append(np.abs(active[:, 0] - exact(POSITION, time)).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_excitation_is_eq_2_8():
    rng = np.random.default_rng(0)
    angle, velocity = rng.normal(size=(2, 3, 2))
    excitation = spindle_excitation(reflex_gains(SUBJECTS, 1e-3), angle, velocity)
    for number, subject in enumerate(SUBJECTS):
        stretch = angle[number] - subject.posture
        expected = subject.joint_matrix("kv") @ velocity[number] + subject.joint_matrix("kp") @ stretch
        np.testing.assert_allclose(excitation[number], expected, rtol=1e-12)
    np.testing.assert_array_equal(excitation[2], 0.0)


@pytest.mark.slow(reason="lets slow transients of six trials pass")
def test_force_and_acceleration_feedback_give_the_admittance_of_theory():
    # So small that the arm's geometry stays linear to 1e-3; the slowest transient has gone by e^-10 after 15 s.
    people, settled = (FORCE, ACCELERATION, ALL), 15.0
    trials = [
        Trial(subject=subject, perturbation=Tones(rms=2e-3, duration=settled + PERIOD, axes=(axis,)))
        for subject in people
        for axis in range(2)
    ]
    recording = run_experiment(trials, timestep=1.25e-3)
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
    assert not MemoryReflexes([POSITION, RELAX], 1e-3).needed
    perturbation = Multisine.draw(seed=1, rms=3.0, duration=0.5, crested=False)
    alone, beside = (
        run_experiment([Trial(subject=subject, perturbation=perturbation) for subject in subjects])
        for subjects in ([POSITION], [ALL, POSITION])
    )
    for name in ("force", "displacement", "joint_angle"):
        np.testing.assert_array_equal(alone[name].values[0], beside[name].values[1])
        assert (beside[name].values[0] != beside[name].values[1]).any()


def test_active_torque_comes_back_after_its_delay():
    arm = replace(
        RELAX, b_s=0.0, b_se=0.0, b_e=0.0, k_s=0.0, k_se=0.0, k_e=0.0, kf_s=1.0, kf_e=1.0, Td_s=0.0025, Td_e=0.004
    )
    memory, rest = MemoryReflexes([RELAX, arm], 1e-3), np.array([RELAX.posture, arm.posture])
    seen = []
    for step in range(12):
        excitation = np.zeros((2, 2))
        memory.add_excitation(excitation, rest, np.zeros((2, 2)))
        seen.append(excitation)
        memory.remember(np.full((2, 2), float(step)))
    seen = np.array(seen)
    assert not seen[:, 0].any()
    np.testing.assert_allclose(seen[4:, 1, 0], np.arange(4, 12) - 2.5)
    np.testing.assert_allclose(seen[4:, 1, 1], np.arange(4, 12) - 4.0)
