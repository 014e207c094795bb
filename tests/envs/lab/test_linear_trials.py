from dataclasses import replace

import numpy as np
import pytest

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.linear_trials import linear_signals
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.subject import POSITION, RELAX


def trials(subject, n=2, duration=6.0, rms=1e-3, **options):
    return [
        Trial(
            subject=subject,
            perturbation=Multisine.draw(seed=seed, rms=rms, duration=duration, crested=False),
            seed=seed,
            **options,
        )
        for seed in range(n)
    ]


def off(found, expected):
    return np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected**2))


@pytest.mark.slow(reason="long trials in small steps")
@pytest.mark.parametrize("subject", [POSITION, RELAX], ids=lambda subject: subject.task)
def test_a_tiny_perturbation_moves_the_linear_arm_as_the_simulator_moves_its_own(subject):
    linear = run_experiment(trials(subject), linear=True, timestep=1e-3)
    multibody = run_experiment(trials(subject), timestep=5e-4)
    posture = subject.posture
    assert off(linear["displacement"].values, multibody["displacement"].values) < 5e-4
    assert off(linear["joint_angle"].values - posture, multibody["joint_angle"].values - posture) < 5e-4
    # The first samples hold what the jump at the start has beyond half the simulation's rate.
    assert off(linear["force"].values[:, 20:], multibody["force"].values[:, 20:]) < 5e-4


def test_response_is_that_of_the_state_space_where_there_is_no_delay():
    timestep, environment = 5e-4, Environment()
    force = Multisine.draw(seed=3, rms=1.0, crested=False).sample(1 / timestep, 12000, 0.0)
    found = linear_signals(RELAX, environment, force, None, timestep)
    expected = simulate_linear(RELAX, environment, force, 1 / timestep)
    assert off(found[:, 0:2], expected.displacement) < 1e-3
    assert off(found[:, 2:4], expected.joint_angle) < 1e-3
    assert off(found[:, 4:6], expected.force) < 1e-3


def test_a_torque_at_the_joints_obeys_the_laws_of_the_hand_and_of_the_environment():
    """Both joints pushed by a slow torque: stiffness and environment share it as statics says."""
    timestep, environment = 1e-3, Environment(k_env=200.0)
    n_steps = 30000
    torque = np.outer(0.5 - 0.5 * np.cos(np.pi * np.clip(np.arange(n_steps) / 10000, 0, 1)), [0.3, -0.2])
    found = linear_signals(RELAX, environment, np.zeros((n_steps, 2)), torque, timestep)[20000]
    np.testing.assert_allclose(found[4:6], -environment.k_env * found[:2], rtol=1e-2, atol=1e-4)
    balance = RELAX.joint_matrix("k") @ found[2:4] - hand_jacobian(RELAX).T @ found[4:6]
    np.testing.assert_allclose(balance, [0.3, -0.2], rtol=2e-2)


@pytest.mark.slow(reason="simulates")
def test_it_is_as_large_as_the_perturbation_and_the_same_at_any_number_of_threads():
    noisy = trials(POSITION, n=4, duration=4.0, rms=3.0, noise=HUMAN_NOISE["PT"])
    one, many = (run_experiment(noisy, linear=True, instruments=Instruments(), n_threads=n) for n in (1, 4))
    assert one.identical(many)
    alone = run_experiment(noisy[2:3], linear=True, instruments=Instruments(), n_threads=1)
    np.testing.assert_array_equal(alone["force"].values[0], one["force"].values[2])
    weak = run_experiment(trials(POSITION, rms=0.1), linear=True)
    strong = run_experiment(trials(POSITION, rms=10.0), linear=True)
    np.testing.assert_allclose(
        strong["displacement"].values, 100.0 * weak["displacement"].values, rtol=1e-9, atol=1e-15
    )


def test_limits_of_the_workspace_are_noted():
    recording = run_experiment(trials(RELAX, rms=40.0), linear=True)
    first = recording["limit_time"].values
    assert np.isfinite(first).all()
    beyond = np.abs(recording["displacement"].values).max(axis=2) >= Environment().workspace
    assert recording["time"].values[beyond[0].argmax()] == first[0]


def test_what_it_cannot_do_is_refused():
    with pytest.raises(ValueError, match=r"rope = 'pendulum'; expected 'ideal'"):
        run_experiment(trials(RELAX), linear=True, rope="pendulum")
    with pytest.raises(ValueError, match="unstable"):
        run_experiment(trials(replace(POSITION, kv_e=200.0)), linear=True)
