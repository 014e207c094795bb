"""What the geometry of the moving arm makes nonlinear, removed: against closed forms, and on foreign arms."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_arms import Arm, admittance, symmetric
from foreign_recordings import Setup, draw_foreign, recording_of

from armperturb.analysis.arm.parameters import parameter_vector
from armperturb.analysis.fit.group import Group, record_likelihood
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.own_structures import composed
from armperturb.analysis.measures.start_geometry import APPLIED, coupling, in_start_geometry
from armperturb.analysis.trials import prepared
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


def known(arm, body):
    """The arm as the package describes it."""
    grip = {} if arm.grip is None else dict(zip(("k_h", "b_h"), arm.grip, strict=True))
    structure = composed(grip="rigid" if arm.grip is None else "spring")
    values = {
        f"i_{joint}": value
        for joint, value in zip(("s", "se", "e"), arm.mass_matrix()[[0, 0, 1], [0, 1, 1]], strict=True)
    }
    values |= {
        f"{name}_{joint}": v for name in "kb" for joint, v in zip(("s", "se", "e"), getattr(arm, name), strict=True)
    }
    return structure.arm(body, np.array([(values | grip)[name] for name in structure.free]))


@pytest.mark.parametrize("grip", [None, (1.5e4, 60.0)], ids=["rigid", "soft"])
def test_an_arm_that_moves_by_centimetres_becomes_linear(grip):
    arm = replace(ARM, grip=grip)
    setup = Setup(arm=arm, period=4.0, duration=5.0, n_trials=1, amid=True, rms=0.02, remnant=0.0, rate=400.0)
    recording = setup.recording()
    arms = None, known(arm, prepared(recording).body)
    frequency = np.arange(1, 81) / 4.0
    theory = admittance(arm, frequency)
    left = []
    for ready in (prepared(recording), *(in_start_geometry(recording, each) for each in arms)):
        force, path = (
            np.fft.rfft(part[0, -1600:], axis=0)[1:81] for part in (ready.force, ready.recorded_displacement)
        )
        left.append(np.linalg.norm(path - (theory @ force[..., None])[..., 0]) / np.linalg.norm(path))
    assert left[0] > 2.0 * left[1] > 20.0 * left[2], left
    assert left[2] < 1e-3


@pytest.mark.parametrize("elbow", [60.0, 90.0, 115.0])
def test_the_inertia_tells_the_coupling_except_at_a_right_angle(elbow):
    arm = replace(ARM, posture_deg=(40.0, elbow))
    setup = Setup(arm=arm, n_trials=1, duration=5.0)
    n = round(5.0 * setup.rate)
    rng = np.random.default_rng(0)
    d, f, x = rng.standard_normal((3, 1, n, 2)) * np.array([1.0, 1.0, 1e-3])[:, None, None, None]
    estimated = coupling(known(arm, prepared(recording_of(setup, d, f, x)).body))
    assert estimated == pytest.approx(arm.inertia()[1], rel=0.2 if elbow == 90.0 else 1e-3)


@pytest.mark.slow(reason="six fits")
def test_foreign_arms_that_move_by_centimetres_are_identified_within_their_errors():
    ratios = []
    for seed in (6, 11):
        setup = draw_foreign(seed, rms=0.02, kind="multisine", reflex="none", period=8.0, n_trials=4, duration=20.0)
        recording, structure, truth, arm = setup.recording(), right_structure(setup.truth), setup.truth, None
        fits = [estimate([Group.prepare(recording, structure)], "record")]
        for _ in range(2):
            fits.append(estimate([Group.prepare(in_start_geometry(recording, arm), structure)], "record"))
            (arm,) = fits[-1].arms.values()
        ratios.append([[(fit.values[n] - truth[n]) / fit.standard_error[n] for n in JUDGED] for fit in fits])
    moving, without_arm, with_arm = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
    assert with_arm < 1.5 < moving, (moving, without_arm, with_arm)


@pytest.mark.slow(reason="simulates noisy trials")
def test_what_the_persons_noise_moves_is_not_taken_for_a_wrong_structure():
    lacks = np.zeros((2, 2))
    free = {"rms": 0.02, "remnant": 0.15, "load": (0.9, 25.0, 0.0), "kind": "noise", "reflex": "none"}
    for seed in range(2):
        setup = draw_foreign(seed, **free, duration=30.0, rate=200.0)
        recording = setup.recording()
        arm = known(setup.arm, prepared(recording).body)
        ready = in_start_geometry(recording, arm)
        for row, drop in enumerate(([], [APPLIED])):
            likelihood = record_likelihood(replace(ready, recording=ready.recording.drop_vars(drop)), 20.0)
            likelihood.weigh(parameter_vector(arm))
            lacks[row] += likelihood.lack_of_fit(parameter_vector(arm))
    (with_applied, dof), (without, _) = lacks
    assert abs(with_applied / dof - 1.0) < 4.0 * np.sqrt(2.0 / dof)
    assert without > 1.2 * with_applied
