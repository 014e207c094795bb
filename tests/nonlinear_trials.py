"""Short trials of people with and without a muscle law, simulated by MuJoCo, for the tests of nonlinear fits."""

from dataclasses import replace

import numpy as np

from armperturb.analysis.smoother import NoiseLevels
from armperturb.analysis.trials import ConditionTrials
from armperturb.cohort import average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Sampled
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances

RATE, DURATION = 100.0, 14.0


def compile_arms(_):
    """Compile what simulates arms, so that other processes find it on disk."""
    disturbances = Disturbances(np.zeros((1, 4, 2)), RATE)
    person = average_person().subjects["RT"]
    disturbances.responses(lane_table([person], [Environment()], disturbances.timestep), np.zeros(1, dtype=int))


def push(seed, rms, duration=DURATION, rate=RATE, top=8.0):
    """Forces with lines up to a frequency, fading in and out [N], (time, axis)."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(duration * rate)) / rate
    frequency = np.arange(1, round(top * duration)) / duration
    angle = 2 * np.pi * (frequency[:, None] * time[:, None, None] + rng.random((len(frequency), 2)))
    force = (np.sin(angle) / (1.0 + frequency[:, None])).sum(axis=1)
    return rms * force / force.std() * np.minimum(1.0, np.minimum(time, time[-1] - time))[:, None]


def record(person, pushes, *, noisy=False, condition="RT7.5", timestep=2.5e-3, rate=RATE, environment=None):
    """What MuJoCo's arm does."""
    trials = [
        Trial(
            subject=person,
            perturbation=Sampled(force=force, rate=rate),
            condition=condition,
            repetition=i,
            seed=i,
            noise=HUMAN_NOISE[person.task] if noisy else None,
        )
        for i, force in enumerate(pushes)
    ]
    return run_experiment(trials, environment, timestep=timestep, rate=rate, n_threads=1)


def trial_set(recording, environment=None):
    """The trials as a fit takes them, with a manipulator that is known."""
    instruments = environment or Environment(), NoiseLevels(0.01, 1e-5)
    return replace(ConditionTrials.prepare(recording), given=instruments)
