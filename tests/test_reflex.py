"""The reflex controller against an independent integration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from armperturb.controllers.reflex import activate, initial_activation, reflex_gains, spindle_excitation
from armperturb.subject import POSITION, RELAX

SUBJECTS = [POSITION, replace(POSITION, fact_s=1.7, fact_e=6.0, zeta_act=1.0), RELAX]


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
        omega, fine = 2 * np.pi * cutoff, np.arange(0, time[-1] + 1e-5, 1e-5)
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
