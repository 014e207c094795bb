"""What the geometry of the moving arm makes nonlinear, removed: against closed forms, and on foreign arms."""

import numpy as np
import pytest
from foreign_arms import Arm, symmetric
from foreign_recordings import Setup, draw_foreign, recording_of

from armperturb.analysis.fit.identify import identify
from armperturb.analysis.measures.start_geometry import in_start_geometry
from benchmarks.foreign_arms import JUDGED, right_structure

RATE = 500.0
ARM = Arm()


def springs():
    """Springs and dampers at massless joints on a manipulator, moving by some centimetres: signals in closed form."""
    setup = Setup(arm=ARM, rate=RATE, n_trials=1)
    time = np.arange(round(20.0 * RATE)) / RATE
    frequency, phase = np.array([0.3, 0.7, 1.9]), np.random.default_rng(0).uniform(0.0, 2 * np.pi, (2, 3))
    s = 2j * np.pi * frequency
    lines = np.array([0.10, 0.06, 0.02]) * np.exp(1j * phase + s * time[:, None, None])
    q, w, a = (np.real(lines * s**power).sum(axis=2) for power in range(3))
    angles = np.cumsum(np.radians(ARM.posture_deg) + q, axis=1)
    rates, slopes = np.cumsum(w, axis=1), np.cumsum(a, axis=1)
    turning = np.exp(1j * angles) * ARM.length  # segments as complex numbers
    hand = turning.sum(axis=1)
    v = (1j * rates * turning).sum(axis=1)
    acceleration = ((1j * slopes - rates**2) * turning).sum(axis=1)
    x = hand - (np.exp(1j * np.cumsum(np.radians(ARM.posture_deg))) * ARM.length).sum()
    torque = q @ symmetric(ARM.k) + w @ symmetric(ARM.b)
    columns = 1j * np.stack([hand, turning[:, 1]], axis=-1)
    jacobian = np.stack([columns.real, columns.imag], axis=1)
    f = np.linalg.solve(jacobian.swapaxes(1, 2), torque[..., None])[..., 0]
    x, v, acceleration = (np.column_stack([part.real, part.imag]) for part in (x, v, acceleration))
    mass, damping, stiffness = setup.load
    d = f + mass * acceleration + damping * v + stiffness * x
    return recording_of(setup, d[None], f[None], x[None]), q, w, a, torque


def test_springs_are_linear_at_the_hand():
    recording, q, *_, torque = springs()
    start = ARM.jacobian()
    assert np.abs(recording["displacement"].values).max() > 0.05
    found = in_start_geometry(recording)
    np.testing.assert_allclose(found.recorded_displacement[0], q @ start.T, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.force[0] @ start, torque, rtol=0.0, atol=1e-9)
    changed = np.abs(found.force - recording["force"].values).max()
    assert changed > 0.05 * np.abs(recording["force"].values).max()


def test_the_manipulator_is_moved_as_before():
    recording, q, w, a, _ = springs()
    found = in_start_geometry(recording)
    start, held = ARM.jacobian(), found.environment
    load = (held.m_env * a + held.b_env * w + held.k_env * q) @ start.T
    inside = slice(round(RATE), -round(RATE))
    left = (found.perturbation - found.force)[0] - load
    assert np.abs(left[inside]).max() < 2e-3 * np.abs(load).max()


@pytest.mark.slow(reason="fits of six recordings")
def test_foreign_arms_that_move_by_centimetres_are_identified_within_their_errors():
    ratios = []
    for seed in (6, 11, 19):
        setup = draw_foreign(seed, rms=0.02, kind="multisine", reflex="none", period=8.0, n_trials=4, duration=20.0)
        recording, structure, truth = setup.recording(), right_structure(setup.truth), setup.truth
        fits = [identify(trials, structure).fit for trials in (recording, in_start_geometry(recording))]
        ratios.append([[(fit.values[n] - truth[n]) / fit.standard_error[n] for n in JUDGED] for fit in fits])
    moving, constant = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
    assert constant < 1.5 < moving
