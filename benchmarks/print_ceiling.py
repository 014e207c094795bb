"""What the score of appendices C to E can reach: people who are the published tables' own mean arms, or a person.

Run by `python -m benchmarks.print_ceiling`; some 1 min of one core per replicate. The arms are linear: in each
condition that of its published mean parameters for one structure per task (tables C.6, C.8, C.10, C.16, C.18, C.20).
They are noisy as people are, and perturbed by the published mean forces. All fits of appendices C to E are made of
their trials, and scored as those of a study. Nothing else about these people can be wrong, so that what they miss is
in the experiment, in the noise, or in print: parameters of different structures and starts are not those of one arm.

`--people average` scores the calibrated average person in the same way, without practice or other people.
"""

import argparse
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.trials import trials_by_condition
from armperturb.cohort import Person, average_body, average_person
from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.perturbations.multisine import PERIOD
from armperturb.study.comparison.score import fitted_cells, share
from armperturb.study.protocol import THESIS, with_published_forces
from armperturb.study.published import tables as published
from armperturb.study.results.appendix_fits import Appendices, fit_person, fit_second_step, joined, means_of
from armperturb.study.results.settings import AnalysisSettings, Start
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from benchmarks.noise_options import add_noise_options, noise_of

TABLES = {"PT2.5": "C.6", "PT7.5": "C.8", "PT22.5": "C.10", "RT2.5": "C.16", "RT7.5": "C.18", "RT22.5": "C.20"}
"""Condition to the table of its mean parameters."""

AFTER = 0.4
"""Length of a trial after its pulse began [s]."""


def arms_of_tables(models: Mapping[str, str]) -> dict[str, Subject]:
    """Condition to the arm of its published mean parameters.

    Args:
      models: task to the structure.
    """
    arms = {}
    for condition, table in TABLES.items():
        task = condition[:2]
        structure = structure_of(models[task])
        body = replace({"PT": POSITION, "RT": RELAX}[task], **average_body())
        values = [published.estimate(name, table, model=models[task]).mean for name in structure.free]
        arms[condition] = structure.arm(body, np.array(values))
    return arms


def arms_of(person: Person) -> dict[str, Subject]:
    """Condition to the arm of a person in it, of the tasks that the person has."""
    return {name: THESIS.condition(name).subject_of(person) for name in TABLES if name[:2] in person.subjects}


def fits_of(
    arms: Mapping[str, Subject], noise: Mapping[str, HumanNoise], seed: int, n: int, start: Start
) -> Appendices:
    """Fits of appendices C to E to the trials of n people with the same arms.

    Args:
      arms: condition to the arm in it, of one task or both.
      noise: task to how noisy they are.
      seed: of multisines and noise.
      n: number of people.
      start: of the fits of appendix C.
    """
    onset = WINDOW_START + PERIOD
    protocol = with_published_forces([THESIS.condition(name) for name in arms], onset, onset + AFTER)
    subjects = {task: arms[f"{task}7.5"] for task in TASKS if f"{task}7.5" in arms}
    person = Person(name="S01", height=1.8, mass=75.0, subjects=subjects)
    everybody, fits = [], []
    for number in range(n):
        trials = [
            replace(
                trial,
                subject=replace(arms[trial.condition], name=f"S{number + 1:02d}"),
                noise=noise[trial.subject.task],
            )
            for trial in protocol.trials(person, protocol.given_forces(), seed, number)
        ]
        recording = run_experiment(trials, engine="compiled", instruments=Instruments(marker_noise=None, emg=None))
        everybody.append(trials_by_condition(recording))
        fits.append(fit_person(everybody[-1], AnalysisSettings(start=start)))
    first, starts = (joined(getattr(each, name) for each in fits) for name in ("first", "starts"))
    means = means_of(first)
    second = joined(fit_second_step(conditions, means).estimates for conditions in everybody)
    return Appendices(first=first, second=second, starts=starts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", default="3", help="structure of the position task, 1 to 6, or average")
    parser.add_argument("--relaxed", default="1", help="structure of the relax task, 1 to 6")
    add_noise_options(parser)
    parser.add_argument("--n", type=int, default=3, help="replicates, of 20 trials each")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--start", default="neutral", choices=["neutral", "published", "scattered"])
    options = parser.parse_args()
    if options.people == "average":
        arms = arms_of(average_person())
    else:
        arms = arms_of_tables({"PT": options.people, "RT": options.relaxed})
    noise = {**HUMAN_NOISE, "PT": noise_of(options, "PT")}
    before = time.process_time()
    cells = fitted_cells(fits_of(arms, noise, options.seed, options.n, options.start))
    print(f"{options}, {time.process_time() - before:.0f} s of the processor")
    groups = {
        "C, PT": [each for each in cells if each.cell.table[0] == "C" and each.cell.condition[:2] == "PT"],
        "C, RT": [each for each in cells if each.cell.table[0] == "C" and each.cell.condition[:2] == "RT"],
        **{appendix: [each for each in cells if each.cell.table[0] == appendix] for appendix in "CDE"},
        "C.12, C.22": [each for each in cells if each.cell.table in ("C.12", "C.22")],
    }
    for name, some in groups.items():
        near = share(some)
        print(f"{name:10} {near.published:5} cells", *(f"{100.0 * part:4.0f} %" for part in near.parts))


if __name__ == "__main__":
    main()
