"""Phases in figures: followed without jumps, whatever the noise."""

import numpy as np
import pytest

from armperturb.plots.panels import PHASES, admittance_panels, plot_admittance, unwrapped

FREQUENCY = np.geomspace(0.2, 30.0, 200)
DELAY = 0.04
DELAYED = np.exp(-2j * np.pi * FREQUENCY * DELAY)


def test_a_delay_has_the_phase_of_a_delay():
    assert unwrapped(DELAYED) == pytest.approx(-360.0 * FREQUENCY * DELAY)
    assert unwrapped(-DELAYED) == pytest.approx(-180.0 - 360.0 * FREQUENCY * DELAY)
    # Beyond a turn below, only noise goes.
    late = unwrapped(DELAYED**3)
    assert PHASES[0] <= late.min()
    assert late.max() < PHASES[1]
    assert np.exp(1j * np.radians(late)) == pytest.approx(DELAYED**3)


def test_noise_stays_near_what_it_is_of():
    rng = np.random.default_rng(0)
    coarse = FREQUENCY[::11]
    noise = np.exp(2j * np.pi * rng.uniform(-0.45, 0.45, coarse.size))
    noisy = unwrapped(DELAYED[::11] * noise, coarse, (FREQUENCY, DELAYED))
    assert noisy == pytest.approx(-360.0 * coarse * DELAY + np.degrees(np.angle(noise)), abs=1e-6)


def test_axes_show_all_turns():
    _, panels = admittance_panels()
    admittance = np.ones((FREQUENCY.size, 2, 2), dtype=complex)
    admittance[:, 1, 1] = DELAYED
    plot_admittance(panels, FREQUENCY, admittance)
    low, high = panels[0, 0][1].get_ylim()
    assert (low, high) == (-450.0, 90.0)
    assert panels[1, 1][1].lines[0].get_ydata().min() == pytest.approx(-360.0 * 30.0 * DELAY)
