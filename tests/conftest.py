"""Recordings that several tests read."""

import pytest

from armperturb.envs.experiment import Trial, run_experiment
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.subject import POSITION, RELAX


def perturbed(subject, rms, n_trials, **options):
    trials = [
        Trial(
            subject=subject,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=seed, rms=rms, crested=False), peak=30.0, direction_deg=20.0, tail=1.0
            ),
            condition=f"{subject.task}7.5",
            repetition=seed,
            pulse_level=1.0,
            seed=seed,
        )
        for seed in range(n_trials)
    ]
    return run_experiment(trials, **options)


@pytest.fixture(scope="session")
def relax_recording():
    """Four ideal trials of the relaxed preset."""
    return perturbed(RELAX, 0.3, 4)


@pytest.fixture(scope="session")
def position_recording():
    """Four ideal trials of the preset that keeps position."""
    return perturbed(POSITION, 3.0, 4)
