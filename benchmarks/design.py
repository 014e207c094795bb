"""Whether a design keeps its promise: measured errors under the optimised multisine over those under the thesis's.

Run by `python -m benchmarks.design`, or with 40 groups by `python -m benchmarks.design 40`. Linear people with the
noise of people, which follows the load, and of instruments are perturbed by the realisations that `armperturb design`
writes, and by the thesis's multisines as strong as the same limits allow; both are identified from whole records.
Measured is the RMS error about the truth over the groups, and the geometric mean of its ratio over the goal's
parameters; its standard error comes from resampling the groups.

Then, without simulation: what the design for the mean person promises other people, drawn around that person, and what
spreading power over the band costs.
"""

import sys
import time
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.fit.group import Group
from armperturb.analysis.fit.maximum_likelihood import estimate
from armperturb.analysis.fit.truth import at_truth
from armperturb.cohort import draw_subject
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, Perturbation
from armperturb.seeds import trial_seed
from armperturb.study.planning.plan import Design, design
from armperturb.study.planning.settings import DesignSettings, NoiseLaw
from armperturb.study.planning.signals import experiment_at
from armperturb.study.validation.validate import ValidateSettings
from armperturb.subject import POSITION, RELAX

Array = NDArray[np.float64]

GROUPS = 200
TRIALS = 4
PEOPLE = 20
OWN = 10
TOLERANCE = 0.15
"""How far the measured factor may be off the predicted one."""

CASES = {
    "PT7.5, reflexes": DesignSettings(
        subject=POSITION, goal="reflex", force=5.4, displacement=7.5e-3, duration=32.0, trials=TRIALS
    ),
    "PT7.5, reflexes, noise follows": DesignSettings(
        subject=POSITION, goal="reflex", force=5.4, displacement=7.5e-3, duration=32.0, trials=TRIALS, noise="follows"
    ),
    "a person of the PT cohort, reflexes": DesignSettings(
        subject=draw_subject("position", 3), goal="reflex", force=5.4, displacement=7.5e-3, duration=32.0, trials=TRIALS
    ),
    "PT7.5, stiffness, damping": DesignSettings(
        subject=POSITION, goal="intrinsic", force=5.4, displacement=7.5e-3, duration=32.0, trials=TRIALS
    ),
    "PT7.5, reflexes, 20 free": DesignSettings(
        subject=POSITION, goal="reflex", force=5.4, displacement=7.5e-3, duration=32.0, trials=TRIALS, model="3"
    ),
    "RT7.5, stiffness, damping": DesignSettings(
        subject=RELAX, goal="intrinsic", force=0.9, displacement=10e-3, duration=32.0, trials=TRIALS
    ),
}


def perturbations(plan: Design) -> dict[str, list[Perturbation]]:
    """Signal to one realisation per trial."""
    rms = float(np.sqrt(plan.thesis.power[:, 0].sum()))
    duration = plan.settings.duration
    return {
        "thesis": [
            Multisine.draw(seed=trial_seed(0, "benchmark", number), rms=rms, duration=duration)
            for number in range(plan.settings.trials)
        ],
        "optimised": list(plan.perturbations),
    }


def errors(plan: Design, played: list[Perturbation], groups: int, name: str) -> Array:
    """Estimate minus truth, (group, parameter)."""
    subject = plan.settings.subject
    structure = ValidateSettings(task=subject.task, model=plan.settings.model_name()).structure()
    structure = at_truth(structure, subject)
    noise = replace(HUMAN_NOISE[subject.task], spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)
    outcome = np.empty((groups, len(plan.names)))
    for group in range(groups):
        trials = [
            Trial(
                subject=subject,
                perturbation=perturbation,
                repetition=number,
                seed=trial_seed(0, f"noise of {name}", group, number),
                noise=noise,
            )
            for number, perturbation in enumerate(played)
        ]
        recording = run_experiment(
            trials, linear=True, instruments=Instruments(marker_noise=None, emg=None), n_threads=1
        )
        result = estimate([Group.prepare(recording, structure)])
        outcome[group] = [result.values[parameter] for parameter in plan.names]
    return outcome - plan.truth


def measured_factor(of: dict[str, Array]) -> float:
    rms = {name: np.sqrt(np.mean(error**2, axis=0)) for name, error in of.items()}
    return float(np.exp(np.mean(np.log(rms["optimised"] / rms["thesis"]))))


def check(case: str, settings: DesignSettings, groups: int) -> bool:
    """Print what was promised and what came out; whether it is within the tolerance."""
    start = time.process_time()
    plan = design(settings)
    of = {name: errors(plan, played, groups, f"{case}, {name}") for name, played in perturbations(plan).items()}
    print(f"\n{case}: {groups} groups of {settings.trials} trials, {time.process_time() - start:.0f} s")
    print(f"{'parameter':10} {'predicted':>22} {'measured':>22} {'ratio':>13}")
    print(f"{'':10} {'thesis':>11}{'optimised':>11} {'thesis':>11}{'optimised':>11} {'pred.':>6} {'meas.':>6}")
    rms = {name: np.sqrt(np.mean(error**2, axis=0)) for name, error in of.items()}
    for column, row in enumerate(plan.to_frame().to_dict("records")):
        thesis, optimised = rms["thesis"][column], rms["optimised"][column]
        print(
            f"{row['parameter']:10} {row['sem_thesis']:11.4g}{row['sem_optimised']:11.4g} {thesis:11.4g}"
            f"{optimised:11.4g} {row['ratio']:6.2f} {optimised / thesis:6.2f}{' *' if row['goal'] else ''}"
        )
    columns = [plan.names.index(name) for name in settings.wanted()]
    goal = {name: error[:, columns] for name, error in of.items()}
    outcome, rng = measured_factor(goal), np.random.default_rng(0)
    again = [
        measured_factor({name: error[rng.integers(groups, size=groups)] for name, error in goal.items()})
        for _ in range(500)
    ]
    off = outcome / plan.factor - 1.0
    verdict = "met" if abs(off) <= TOLERANCE else "NOT MET"
    print(
        f"geometric mean of *: predicted {plan.factor:.3f}, measured {outcome:.3f} +- {np.std(again):.3f}, off by "
        f"{100 * off:+.1f} % (at most {100 * TOLERANCE:.0f} %): {verdict}"
    )
    print(", ".join(f"noise {law}: predicted {factor:.3f}" for law, factor in plan.factors.items()))
    return abs(off) <= TOLERANCE


def factor_for(plan: Design, person: DesignSettings) -> float:
    """Geometric mean of the goal's predicted errors of a person under the plan's optimised signal over the thesis's.

    Both are weakened where they would take this person beyond the limit of displacement.
    """
    outcome = []
    columns = [plan.names.index(name) for name in plan.settings.wanted()]
    for signal in (plan.thesis, plan.optimised):
        experiment = experiment_at(person, signal.frequency)
        moved = float(experiment.displacement(signal.power).max()) / plan.settings.displacement**2
        information = experiment.information(signal.power / max(1.0, moved))
        outcome.append(experiment.standard_error(information, plan.settings.duration)[columns])
    return float(np.exp(np.mean(np.log(outcome[1] / outcome[0]))))


def other_people(settings: DesignSettings) -> None:
    """What the design for the mean person promises others, and what designs of their own would."""
    plan = design(settings)
    people = [replace(settings, subject=draw_subject("position", seed), trials=1) for seed in range(PEOPLE)]
    factors = [factor_for(plan, person) for person in people]
    own = [design(person).factor for person in people[:OWN]]
    print(
        f"\n{PEOPLE} other people under the mean person's signals: median {np.median(factors):.2f} "
        f"({min(factors):.2f} to {max(factors):.2f})"
    )
    print(f"the first {OWN}: {np.median(factors[:OWN]):.2f}, under signals of their own {np.median(own):.2f}")


def spreading(settings: DesignSettings) -> None:
    """The factor against the share of power that is spread evenly."""
    shares = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    print("\nspread               " + " ".join(f"{share:6.2f}" for share in shares))
    for law in get_args(NoiseLaw):
        factors = [design(replace(settings, spread=share, trials=1, noise=law)).factor for share in shares]
        print(f"factor, {law:13}" + " ".join(f"{factor:6.3f}" for factor in factors))


def main() -> None:
    groups = int(sys.argv[1]) if sys.argv[1:] else GROUPS
    met = [check(case, settings, groups) for case, settings in CASES.items()]
    first = next(iter(CASES.values()))
    other_people(first)
    spreading(first)
    print(f"\n{sum(met)} of {len(met)} cases met")


if __name__ == "__main__":
    main()
