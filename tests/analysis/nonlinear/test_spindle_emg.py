"""EMG in nonlinear fits: outputs made in the time domain, by code that shares nothing with the likelihood."""

from dataclasses import replace

import nonlinear_trials as made
import numpy as np
import pytest

from armperturb.analysis.emg.outputs import ReflexOutputs
from armperturb.analysis.nonlinear.estimate import fit
from armperturb.analysis.nonlinear.model import Model, true_values
from armperturb.analysis.nonlinear.spindle_emg import N_REFLEX, EmgInFit, SpindleEmg, reflex_values
from armperturb.cohort import average_person
from armperturb.subject import POSITION

PERSON = average_person().subjects["PT"]
RATE, DELAY = 200.0, 6
"""Rate [Hz], and samples of the neural delay: 30 ms."""

GAINS = (0.08, 0.09, 0.06, 0.07)
"""Of shoulder, elbow, and two-joint muscles at both joints [1/(Nm)]."""


def rotations(n_trials, seed, seconds=30.0, top=12.0):
    """Smooth rotations of both joints that begin and end in the usual posture, and velocities, (trial, time, joint)."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(10 * seconds * RATE)) / (10 * RATE)  # finely, so that velocities are right
    lines = np.arange(2, round(top * seconds))
    phase = rng.uniform(0, 2 * np.pi, (len(lines), n_trials, 2))
    spectrum = np.zeros((n_trials, len(time) // 2 + 1, 2), dtype=complex)
    spectrum[:, lines] = np.moveaxis(np.exp(1j * phase), 0, 1) / (1.0 + (lines[:, None] / seconds) ** 1.5)
    angle = np.fft.irfft(spectrum, len(time), axis=1)
    fade = np.minimum(1.0, np.minimum(time, time[-1] - time))[None, :, None]
    angle *= 0.08 * fade / angle.std()
    velocity = np.gradient(angle, 0.1 / RATE, axis=1)
    return angle[:, ::10], velocity[:, ::10]


def outputs_of(person, angle, velocity, rng, noise=0.02):
    """Differences between antagonists, with white noise."""
    stretch = np.stack([angle[..., 0], angle.sum(axis=-1), angle[..., 1]], axis=-1)
    speed = np.stack([velocity[..., 0], velocity.sum(axis=-1), velocity[..., 1]], axis=-1)
    limit = person.muscle.of_elements("spindle_saturation")[0] if person.muscle else np.inf
    seen = person.muscle_groups("kv") * speed / (1.0 + np.abs(speed) / limit) + person.muscle_groups("kp") * stretch
    torque = np.stack([seen[..., 0] + seen[..., 1], seen[..., 1] + seen[..., 2]], axis=-1)
    late = np.zeros_like(torque)
    late[:, DELAY:] = torque[:, :-DELAY]
    g_s, g_e, g_bs, g_be = GAINS
    difference = np.stack([g_s * late[..., 0], g_e * late[..., 1], late @ [g_bs, g_be]], axis=-1)
    difference += noise * rng.normal(size=difference.shape)
    return ReflexOutputs(
        groups=("s", "e", "se"), difference=difference, rotation=angle, grip_load=None, rate=RATE, averaging=1e-6
    )


def at(person, n_trials):
    return np.tile(reflex_values(person), (n_trials, 1))


@pytest.mark.parametrize("person", [PERSON, replace(PERSON, muscle=None)], ids=["saturating", "linear"])
def test_slopes_are_those_of_the_cost(person):
    emg = SpindleEmg(outputs_of(person, *rotations(2, 0), np.random.default_rng(0)), POSITION, 0.0)
    reflexes = at(person, 2)
    emg.weigh_at(reflexes)
    changes = np.zeros((N_REFLEX, 2, N_REFLEX))
    steps = 1e-4 * np.maximum(np.abs(reflexes[0]), 1e-2)
    changes[range(N_REFLEX), :, range(N_REFLEX)] = 1.0
    _, slope = emg.normal_at(reflexes, changes)
    for place in range(N_REFLEX):
        ends = [emg.cost_at(reflexes + sign * steps[place] * np.eye(N_REFLEX)[place]) for sign in (1, -1)]
        expected = -0.5 * (ends[0] - ends[1]) / (2.0 * steps[place])
        assert slope[place] == pytest.approx(expected, rel=1e-3, abs=1e-4 * np.abs(slope).max()), place


@pytest.mark.slow(reason="repeats estimates on many records")
def test_errors_are_as_large_as_the_information_says():
    """Of position feedback, saturation and delay; the common size of feedback and gains is not known, and held."""
    angle, velocity = rotations(2, 7, seconds=20.0)
    free = [3, 4, 5, 6, 7, 8]
    changes = np.zeros((len(free), 2, N_REFLEX))
    changes[range(len(free)), :, free] = 1.0
    errors = []
    for seed in range(60):
        emg = SpindleEmg(outputs_of(PERSON, angle, velocity, np.random.default_rng(seed)), POSITION, 0.0)
        reflexes = at(PERSON, 2)
        for _ in range(3):
            emg.weigh_at(reflexes)
            information, slope = emg.normal_at(reflexes, changes)
            reflexes[:, free] += np.linalg.solve(information, slope)
        errors.append((reflexes[0] - reflex_values(PERSON))[free] / np.sqrt(np.diag(np.linalg.inv(information))))
    size = np.sqrt(np.mean(np.square(errors), axis=0))
    assert size.mean() == pytest.approx(1.0, abs=0.15)
    assert size.max() < 1.4
    assert np.abs(np.mean(errors, axis=0)).max() < 0.5


def test_an_electromechanical_delay_is_not_a_neural_one():
    emg = SpindleEmg(outputs_of(PERSON, *rotations(2, 2), np.random.default_rng(0)), POSITION, 0.010)
    costs = {}
    for delay in (0.030, 0.040):
        reflexes = at(replace(PERSON, Td_s=delay, Td_e=delay), 2)
        emg.weigh_at(at(PERSON, 2))
        costs[delay] = emg.cost_at(reflexes)
    assert costs[0.040] < costs[0.030]


@pytest.mark.slow(reason="simulates and fits two trials")
def test_emg_makes_reflexes_better_known_and_lack_of_fit_with_it_names_its_timing(monkeypatch):
    monkeypatch.setattr("armperturb.analysis.nonlinear.estimate.SUSPICIOUS", 1.1)  # any p is a lack of fit
    true = true_values(PERSON, {})
    sought = ("kp.shoulder", "kp.two-joint", "kp.elbow", "Td", "spindle_saturation")
    names = Model(free=("Td",)).names("PT", ("PT7.5",))
    fixed = {name: true[name] for name in names if name not in sought}
    pushes = [made.push(seed, 5.0, 14.0, rate=RATE) for seed in range(2)]
    recording = made.record(PERSON, pushes, noisy=True, condition="PT7.5", rate=RATE)
    trials = made.trial_set(recording)
    angle = recording["joint_angle"].values - recording["joint_angle"].values[:, :1]
    outputs = outputs_of(PERSON, angle, np.gradient(angle, 1.0 / RATE, axis=1), np.random.default_rng(5))
    arms = {"PT7.5": replace(PERSON, muscle=None)}
    model = Model(fixed=fixed, free=("Td",))
    alone, both = (
        fit([trials], arms, model, n_pairs=0, emg=emg) for emg in (None, {"PT7.5": EmgInFit(outputs=outputs)})
    )
    for name in sought:
        assert both.coordinate_error[name] < 0.7 * alone.coordinate_error[name]
        assert abs(both.values[name] - true[name]) < 4.0 * both.standard_error[name]
    named = [any(remark.startswith("EMG that is early or late") for remark in each.remarks) for each in (alone, both)]
    assert named == [False, True]
