"""How often the 95 % intervals of `identify` hold, of synthetic people with all noise who differ from trial to trial.

Run `python -m benchmarks.coverage --task PT --groups 16 [--muscles nonlinear]`; some 5 s of processor time a group.
People with linear muscles have true parameters: each gives one group of eight trials, and their mass is shared out over
the segments as the position task's structure has it (eqs 2.14, 2.15). A person with nonlinear ones has
a best linear approximation, which depends on the perturbation: its truth is what all groups of one person, each with
trials of its own, yield together. Target: 90 to 98 % of all parameters, the worst 85 %.
"""

import argparse
from dataclasses import replace

import numpy as np
import xarray as xr

from armperturb.analysis.defaults import LINEAR_MODELS
from armperturb.analysis.fit.identify import identify
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.fit.truth import true_values
from armperturb.analysis.measures.start_geometry import in_start_geometry
from armperturb.cohort import Person, draw_person
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.study.protocol import THESIS
from armperturb.study.recording.record import practised_trials
from armperturb.study.recording.settings import StudySettings
from armperturb.subject import HUMERUS_MASS_SHARE, Subject

TRIALS = 8
"""Of a group."""


def recorded(settings: StudySettings, condition: str, number: int, n_trials: int) -> tuple[Person, xr.Dataset]:
    """A person and as many trials of one condition, without pulses."""
    asked = replace(THESIS.condition(condition), pulse_levels=(), repetitions=n_trials)
    protocol = replace(THESIS, conditions=(asked,), pulse_unit_condition="")
    environment = Environment()
    person = draw_person(settings.seed, number, environment, muscles=settings.muscles)
    if settings.muscles == "linear":
        person = replace(person, subjects={task: shared_out(subject) for task, subject in person.subjects.items()})
    multisines = protocol.draw_multisines(settings.seed)
    (trials,) = practised_trials([(number, person)], protocol, settings, multisines, 0)
    instruments = Instruments(marker_noise=None, emg=None)
    return person, run_experiment(trials, environment, instruments=instruments, engine=settings.engine)


def shared_out(subject: Subject) -> Subject:
    """The subject with its mass in the thesis's proportion."""
    total = subject.m_h + subject.m_f
    return replace(subject, m_h=HUMERUS_MASS_SHARE * total, m_f=(1.0 - HUMERUS_MASS_SHARE) * total)


def main() -> None:
    """Print for each parameter how often its intervals hold, and errors over standard errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=tuple(LINEAR_MODELS), default="PT")
    parser.add_argument("--groups", type=int, default=16)
    parser.add_argument("--muscles", choices=("linear", "nonlinear"), default="linear")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start-geometry", action="store_true", help="without what the moving arm makes nonlinear")
    asked = parser.parse_args()
    settings = StudySettings(seed=asked.seed, muscles=asked.muscles, engine="compiled")
    model, condition = LINEAR_MODELS[asked.task], f"{asked.task}7.5"
    names = structure_of(model).free
    groups = []
    if asked.muscles == "linear":
        for number in range(asked.groups):
            person, recording = recorded(settings, condition, number, TRIALS)
            groups.append((recording, true_values(person.subjects[asked.task], structure_of(model))))
    else:
        _, whole = recorded(settings, condition, 0, TRIALS * asked.groups)
        of_all = identify(whole, model).fit
        truth = np.array([of_all.values[name] for name in names])
        for first in range(0, whole.sizes["trial"], TRIALS):
            groups.append((whole.isel(trial=slice(first, first + TRIALS)), truth))
    held, ratios = [], []
    for recording, truth in groups:
        fit = identify(recording, model).fit
        if asked.start_geometry:
            fit = identify(in_start_geometry(recording, fit.arm), model).fit
        low, high = np.transpose([fit.interval(name) for name in names])
        held.append((low <= truth) & (truth <= high))
        errors = np.array([fit.values[name] for name in names]) - truth
        ratios.append(errors / np.array([fit.standard_error[name] for name in names]))
    for name, share, ratio in zip(names, np.mean(held, axis=0), np.transpose(ratios), strict=True):
        error = f"mean {ratio.mean():6.2f}, RMS {np.sqrt(np.mean(ratio**2)):5.2f}"
        print(f"{name:8}{100.0 * share:6.0f} %   error over standard error: {error}")
    print(f"all     {100.0 * np.mean(held):6.1f} % of {np.size(held)}; target 90 to 98 %, the worst 85 %")


if __name__ == "__main__":
    main()
