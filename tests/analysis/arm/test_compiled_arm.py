"""The compiled arm and its rightmost pole against the arm of arrays and eigenvalues."""

from dataclasses import replace

import numpy as np
import pytest

from armperturb import POSITION, RELAX, Environment
from armperturb.analysis.arm.compiled_arm import N_PARAMETERS, N_PARTS, put_reflexes, put_response, put_slopes
from armperturb.analysis.arm.linear_arm import LinearArm
from armperturb.analysis.arm.parameters import PARAMETERS, parameter_vector
from armperturb.analysis.arm.rightmost_pole import rightmost_pole

FREQUENCY = np.geomspace(0.1, 40.0, 12)
SENSING = replace(POSITION, ka_s=0.4, ka_se=0.05, ka_e=0.2, kf_s=-0.004, kf_se=0.001, kf_e=-0.003)
BOUNDS = -1.5, 4.5


def varied(rng, arm, spread=0.4):
    return parameter_vector(arm) * rng.uniform(1 - spread, 1 + spread, N_PARAMETERS)


@pytest.mark.parametrize("delay", ["exact", "pade"])
@pytest.mark.parametrize("grip", [None, np.inf])
def test_response_and_slopes_are_those_of_the_arm_of_arrays(delay, grip):
    rng = np.random.default_rng(0)
    arm = LinearArm(SENSING, FREQUENCY, delay)
    values = varied(rng, SENSING)
    if grip is not None:
        values[PARAMETERS.index("k_h")] = grip
    admittance, gradient = arm.admittance_and_gradient(values)
    parts, slope = np.zeros(N_PARTS, dtype=complex), np.zeros((4, N_PARAMETERS))
    for k, s in enumerate(2j * np.pi * FREQUENCY):
        weight = rng.normal(size=(4, 2)) @ [1, 1j]
        put_reflexes(s, values, delay == "exact", parts)
        put_response(s, values, arm.jacobian, arm.inertias, parts)
        put_slopes(s, arm.inertias, parts, weight, np.ones(N_PARAMETERS, dtype=bool), slope)
        np.testing.assert_allclose(parts[:4], admittance[k].ravel(), rtol=1e-11)
        expected = (weight[:, None] * gradient[k].reshape(4, -1)).real
        np.testing.assert_allclose(slope, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max(axis=0).min())


def test_the_rightmost_pole_is_that_of_eigenvalues():
    rng, found, expected = np.random.default_rng(1), [], []
    for arm in (POSITION, RELAX, SENSING):
        for _ in range(150):
            environment = Environment(m_env=rng.uniform(0.8, 3.0), b_env=rng.uniform(0, 40), k_env=rng.uniform(0, 200))
            values, model = varied(rng, arm, 0.9), LinearArm(arm, ())
            poles = model.poles(values, environment)
            pole = poles[np.argmax(poles.real)]
            expected.append(complex(np.clip(pole.real, *BOUNDS), abs(pole.imag)))
            held = np.array([environment.m_env, environment.b_env, environment.k_env])
            found.append(rightmost_pole(values, model.jacobian, model.inertias, held, *BOUNDS))
    found, expected = np.array(found), np.array(expected)
    np.testing.assert_allclose(found.real, expected.real, atol=1e-6)
    between = (expected.real > BOUNDS[0]) & (expected.real < BOUNDS[1])
    assert between.sum() > 60
    assert (expected.real == BOUNDS[0]).sum() > 30
    np.testing.assert_allclose(found[between].imag, expected[between].imag, atol=1e-5)
