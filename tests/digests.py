"""Digests of recordings and vector environments: `python tests/digests.py > FILE` writes those of an installation."""

import hashlib
import json
import sys
import warnings
from collections.abc import Iterable

import gymnasium as gym
import numpy as np

import armperturb  # noqa: F401 - registers the environments
from armperturb.cohort import average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Strap
from armperturb.envs.lab.emg import Emg
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.subject import POSITION, RELAX

LABORATORIES = {
    "truth": {},
    "instruments": {"instruments": Instruments(emg=Emg(), marker_noise=1e-3)},
    "strap and rope": {"strap": Strap(), "rope": "pendulum", "instruments": Instruments(emg=None, antialias=None)},
}
DECISIONS = 30
"""More than a trial of the vector environment has, so that some begin anew."""


def trials() -> list[Trial]:
    """Noisy people, linear and nonlinear, under a multisine and a pulse."""
    person = average_person().subjects
    return [
        Trial(
            subject=subject,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=seed, rms=rms, duration=1.2, crested=False),
                peak=20.0,
                direction_deg=20.0,
                tail=0.4,
            ),
            seed=seed,
            noise=HUMAN_NOISE[subject.task],
        )
        for seed, (subject, rms) in enumerate(((POSITION, 5.0), (RELAX, 0.5), (person["PT"], 5.0), (person["RT"], 0.5)))
    ]


def digest(arrays: Iterable[np.ndarray]) -> str:
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()


def digests(n_threads: int) -> dict[str, str]:
    """Name to digest of each signal of each laboratory, and of all that a vector environment gives."""
    result = {}
    for laboratory, options in LABORATORIES.items():
        recording = run_experiment(trials(), n_threads=n_threads, **options)
        for name, signal in recording.data_vars.items():
            result[f"{laboratory}: {name}"] = digest([signal.values])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # version 0 stays as it is
        env = gym.make_vec(
            "ArmPerturb/Pulse-v0", num_envs=4, n_threads=n_threads, duration=0.4, onset_window=(0.1, 0.2)
        )
    env.action_space.seed(0)
    seen = [env.reset(seed=0)[0]]
    for _ in range(DECISIONS):
        observations, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
        seen += [observations, rewards, terminated, truncated, infos["joint_angle"], infos["force"]]
    env.close()
    return result | {"vector environment": digest(seen)}


if __name__ == "__main__":
    json.dump(digests(n_threads=0), sys.stdout, indent=1)
