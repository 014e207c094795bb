"""Whether linear arms look linear, and nonlinear ones do not: `best_linear`, on people of known muscles.

Run by `python -m benchmarks.distortion [linear] [nonlinear] [short-range] [--conditions NAME ...] [--people N]`;
without arguments all three in four conditions, some 10 min of one core.

People are those of the default cohort at the forces of the thesis's table 2.1, with their noise and the instruments',
trials of 32 s with a multisine of their own each. Linear people are drawn likewise; "short-range" are the default ones
with nothing but the short-range stiffness and its elastic limit left of their muscles' law.

Measured (RT7.5 / RT22.5; p < 0.05 is "detected") on people of seeds from 20000 on, whom nobody had looked at:

    linear, 200 people      detected with 4 trials 7.0 / 7.5 %, 3 trials 9.0 / 8.0 %, 2 trials 5.5 / 5.5 %, 1 trial
                            10.0 / 9.0 %; statistic within 1.96 of zero 93.5 / 93.5 %, level at a frequency within 1.96
                            standard errors of zero 96.0 / 95.7 % (4 trials)
    nonlinear, 100 people   detected with 4 trials 100 / 98 %, 2 trials 97 / 92 %, 1 trial 93 / 78 %
    nonlinear, 40 people    detected with 3 trials 100 / 100 %

In PT7.5 / PT22.5, of 200 linear people 12.5 / 12.6 % are detected with 4 trials, 12.5 / 12.1 % with 3, 9.5 / 9.5 % with
2 and 6.0 / 7.0 % with 1: too many.

In PT7.5 / PT22.5, of 40 nonlinear people 40 / 36 stay inside the workspace in four trials, and 12 / 25 % of them are
detected. Of 20 people with short-range stiffness alone, 20 / 20 are detected with 4 trials, 20 / 19 with 2, 17 / 19
with 1 (RT7.5 / RT22.5).
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from armperturb.analysis.response.best_linear import best_linear
from armperturb.cohort import draw_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import Multisine
from armperturb.study.protocol import THESIS
from armperturb.subject import Subject

DURATION = 32.0
TRIALS = (4, 3, 2, 1)
"""Of each person, the first of which are used."""

FORCES = {"RT7.5": 0.9, "RT22.5": 1.8, "PT7.5": 5.4, "PT22.5": 16.6}
"""Condition to the RMS force per axis [N] of table 2.1."""

N_PEOPLE = {"linear": 200, "nonlinear": 100, "short-range": 50}
FIRST_SEED = 20000
BATCH = 20

SHORT_RANGE = ("short_range_stiffness", "elastic_limit_deg", "elastic_limit_spread", "elastic_limit_slope", "parts")


def subject_of(muscles: str, seed: int, condition: str) -> Subject:
    """Who is perturbed, at the co-contraction of the condition."""
    person = draw_person(seed, 0, muscles="linear" if muscles == "linear" else "nonlinear")
    subject = replace(THESIS.condition(condition).subject_of(person), name=f"{person.name} {seed}")
    if muscles == "short-range" and subject.muscle is not None:
        law = MuscleLaw(**{name: getattr(subject.muscle, name) for name in SHORT_RANGE})
        return replace(subject, muscle=law)
    return subject


def recording_of(muscles: str, condition: str, seeds: range) -> xr.Dataset:
    """Trials of one person for each seed, one after the other."""
    noise = HUMAN_NOISE[condition[:2]]
    trials = []
    for seed in seeds:
        subject = subject_of(muscles, seed, condition)
        for number in range(1000 * seed, 1000 * seed + TRIALS[0]):
            force = Multisine.draw(seed=number, rms=FORCES[condition], duration=DURATION, crested=False)
            trials.append(Trial(subject=subject, perturbation=force, condition=condition, seed=number, noise=noise))
    instruments = Instruments(emg=None, marker_noise=None)
    # The compiled engine moves people as MuJoCo does within 2e-4, and some ten times as fast.
    return run_experiment(trials, linear=muscles == "linear", engine="compiled", instruments=instruments, n_threads=1)


def judge(muscles: str, condition: str, n_people: int) -> None:
    """Detection and levels; trials that reached the workspace limit are left out."""
    began = time.process_time()
    result: dict[int, list] = {n_trials: [] for n_trials in TRIALS}
    last = FIRST_SEED + n_people
    for first in range(FIRST_SEED, last, BATCH):
        recording = recording_of(muscles, condition, range(first, min(first + BATCH, last)))
        for i in range(0, recording.sizes["trial"], TRIALS[0]):
            of_person = recording.isel(trial=slice(i, i + TRIALS[0]))
            inside = np.flatnonzero(np.isnan(of_person["limit_time"].values))
            for n_trials in TRIALS:
                if len(inside) >= n_trials:
                    result[n_trials].append(best_linear(of_person.isel(trial=inside[:n_trials])))
    for n_trials, every in result.items():
        if not every:
            continue
        statistic = np.array([entry.statistic for entry in every])
        level = np.mean([np.abs(entry.distortion) <= 1.96 * entry.distortion_error for entry in every])
        share = np.median([entry.share for entry in every], axis=0)
        print(
            f"  {condition} {muscles}, {n_trials} trials, {len(every)} people: detected (p < 0.05) "
            f"{np.mean([entry.p_value < 0.05 for entry in every]):.1%}; statistic {statistic.mean():.2f}, SD "
            f"{statistic.std():.2f}, within 1.96 of zero {np.mean(np.abs(statistic) < 1.96):.1%}, level at a frequency "
            f"{level:.1%}; median share x, y {share[0]:.3f}, {share[1]:.3f}",
            flush=True,
        )
    print(f"    CPU {time.process_time() - began:.0f} s", flush=True)


def main(arguments: Sequence[str] = ()) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("muscles", nargs="*", help=f"some of {', '.join(N_PEOPLE)}; all by default")
    parser.add_argument("--conditions", nargs="+", choices=list(FORCES), default=list(FORCES))
    parser.add_argument("--people", type=int, default=None, help="of each kind")
    options = parser.parse_args(arguments)
    for muscles in options.muscles or list(N_PEOPLE):
        if muscles not in N_PEOPLE:
            parser.error(f"{muscles!r}; expected some of {', '.join(N_PEOPLE)}")
        for condition in options.conditions:
            judge(muscles, condition, options.people or N_PEOPLE[muscles])


if __name__ == "__main__":
    main(sys.argv[1:])
