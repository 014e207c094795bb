"""Compiles what the processes of a study need: each part in one of them, where otherwise each would compile it all.

`python -m armperturb.study.results.compiling` does so before the first study, as `make` does when it installs.
"""

from concurrent.futures import ProcessPoolExecutor

import numpy as np

from armperturb.analysis.arm.linear_arm import arm_admittance
from armperturb.analysis.fit.admittance_fit import fit_admittance
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Pulse
from armperturb.planar_arm.skeletal import simulate_skeletal
from armperturb.subject import POSITION

FREQUENCIES = (1.0, 2.0, 4.0)
"""Of the admittance that is fitted [Hz]."""

DURATION = 0.1
"""Of the trial that is recorded [s]."""

RATE = 200.0
"""Of the prediction's samples [Hz]."""


def compile_simulations(engine: str) -> None:
    """Record a short trial by a study's engine and by that of its practice, and predict it."""
    trial = Trial(subject=POSITION, perturbation=Pulse(peak=1.0, direction_deg=20.0, onset=0.0, duration=DURATION))
    for each in {engine, "compiled"}:
        run_experiment([trial], engine=each, instruments=Instruments(), n_threads=1)
    simulate_skeletal(POSITION, Environment(), trial.perturbation.sample(RATE, round(DURATION * RATE)), RATE)


def compile_fits() -> None:
    """Fit an admittance as the thesis does."""
    frequency = np.array(FREQUENCIES)
    admittance = arm_admittance(POSITION, frequency)
    fit_admittance(frequency, admittance, POSITION, "1", Environment(), as_published=True)


def main() -> None:
    """Compile both parts side by side, for studies that MuJoCo simulates."""
    with ProcessPoolExecutor(2) as pool:
        for done in (pool.submit(compile_simulations, "mujoco"), pool.submit(compile_fits)):
            done.result()


if __name__ == "__main__":
    main()
