"""Intervals of ARX models whose order was chosen: as wide as the errors of repeated records."""

import numpy as np
import pytest
from scipy import signal

from armperturb.analysis.response.arx import fit_arx
from armperturb.analysis.response.joint_records import admittance_of, variance_of
from armperturb.analysis.trials import TrialRecord

RATE = 100.0
FREQUENCY = np.array([1.0, 2.0, 4.0, 6.0, 9.0, 14.0])


def resonance(frequency, damping):
    """Digital second-order system of unit gain at rest: numerator and denominator."""
    pole = np.exp(2.0 * np.pi * frequency / RATE * (-damping + 1j * np.sqrt(1.0 - damping**2)))
    denominator = np.real(np.poly([pole, pole.conj()]))
    return np.array([denominator.sum()]), denominator


LOW, HIGH = resonance(3.0, 0.3), resonance(8.0, 0.2)


def records(seed, n_samples=1500):
    """x over d is a resonance on each axis; f is what leaves another; noises are coloured otherwise than the system."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n_samples, 2))
    x = np.stack([signal.lfilter(*LOW, d[:, 0]), signal.lfilter(*HIGH, d[:, 1])], axis=1)
    f = d - 0.3 * np.roll(x, 1, axis=0)
    noise = signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=(n_samples, 4)), axis=0)
    y = np.concatenate([f, x], axis=1) + 0.1 * noise
    return [TrialRecord(d[200:], y[200:], RATE)]


def truth():
    z = np.exp(2j * np.pi * FREQUENCY / RATE)
    total = np.zeros((len(z), 2, 2), complex)
    for axis, system in enumerate((LOW, HIGH)):
        total[:, axis, axis] = signal.freqz(*system, 2.0 * np.pi * FREQUENCY / RATE)[1]
    force = np.eye(2) - 0.3 * total / z[:, None, None]
    return np.concatenate([force, total], axis=1)


@pytest.mark.slow(reason="repeats estimates on drawn records")
def test_circles_of_95_percent_hold_the_true_response():
    right = admittance_of("arm", truth())
    inside, orders = [], []
    for seed in range(40):
        model = fit_arx(records(seed), FREQUENCY, highest_order=15)
        joint, noise, spread = model.response(FREQUENCY)
        error = np.abs(admittance_of("arm", joint) - right) ** 2
        inside.append(error <= -np.log(0.05) * variance_of("arm", joint, noise, spread))
        orders.append(model.order)
    assert len(set(orders)) > 1  # they were chosen
    assert 0.9 < np.mean(inside) < 0.98
    assert np.mean(inside, axis=(0, 2, 3)).min() > 0.85


def test_a_given_order_has_its_own_covariance():
    data = records(0)
    chosen, given = (fit_arx(data, FREQUENCY, order=order, highest_order=15) for order in (None, 4))
    for one, two in zip(given.response(FREQUENCY), given.own_response(FREQUENCY), strict=True):
        np.testing.assert_array_equal(one, two)
    highest = fit_arx(data, FREQUENCY, order=15)
    np.testing.assert_allclose(chosen.response(FREQUENCY)[1], highest.response(FREQUENCY)[1], rtol=1e-6)
    np.testing.assert_allclose(chosen.response(FREQUENCY)[2], highest.response(FREQUENCY)[2], rtol=1e-6)
