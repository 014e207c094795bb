"""A study of random numbers, for tests of what is made of one."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from armperturb.analysis.fit.admittance_fit import AdmittanceFit
from armperturb.analysis.fit.thesis import ThesisEstimate
from armperturb.environment import Environment
from armperturb.study.protocol import THESIS
from armperturb.study.results.cases import Case
from armperturb.study.results.study_result import StudyResult
from armperturb.study.results.trial_measures import PersonMeasures, TrialMeasures
from armperturb.subject import POSITION, RELAX

LEVELS = {
    "PT0": (1.0, 2.0),
    "PT2.5": (2.0,),
    "PT7.5": (1.0, 2.0),
    "PT22.5": (2.0,),
    "RT0": (1.0,),
    "RT2.5": (1.0,),
    "RT7.5": (1.0,),
    "RT22.5": (1.0,),
}
SPRINGS = tuple(f"{quantity}_{joint}" for quantity in ("b", "k") for joint in ("s", "se", "e"))
FEEDBACK = tuple(f"{quantity}_{joint}" for quantity in ("kv", "kp") for joint in ("s", "se", "e"))
FREQUENCY = np.geomspace(0.3, 40.0, 18)


def fitted(names, rng, stable=True):
    arm = POSITION if len(names) > 6 else RELAX
    return AdmittanceFit(
        structure="3b" if len(names) > 6 else "1",
        arm=arm,
        values=dict(zip(names, rng.uniform(1.0, 100.0, len(names)), strict=True)),
        sem=dict(zip(names, rng.uniform(1.0, 100.0, len(names)), strict=True)),
        unidentified=(),
        at_bound=(),
        status="converged",
        converged=True,
        criterion=1.0,
        n_errors=72,
        penalty=1.0,
        stable=stable,
        largest_real_pole=-1.0 if stable else 0.1,
    )


def person(name, rng):
    """Trials with random numbers; unequally many of a condition, and one without a prediction."""
    trials, estimates = [], {}
    for condition, levels in LEVELS.items():
        has_fit = not condition.endswith("T0")
        for level in levels:
            for repetition in range(int(rng.integers(1, 4))):
                vaf = rng.uniform(-20.0, 90.0, (2, 2)) if has_fit else np.full((2, 2), math.nan)
                predicted = rng.uniform(0.02, 0.1, 2) if has_fit and repetition < 2 else (math.nan, math.nan)
                trials.append(
                    TrialMeasures(
                        condition=condition,
                        repetition=repetition,
                        pulse_level=level * (-1) ** repetition,
                        pulse_direction_deg=20.0,
                        displacement=float(rng.uniform(0.05, 0.2)),
                        force=float(rng.uniform(20.0, 80.0)),
                        predicted_linear=float(predicted[0]),
                        predicted_skeletal=float(predicted[1]),
                        vaf_linear=tuple(vaf[0]),
                        vaf_skeletal=tuple(vaf[1]),
                    )
                )
        if has_fit:
            names = SPRINGS + (FEEDBACK if condition.startswith("PT") else ())
            fits = tuple(fitted(names, rng, stable) for stable in (True, True, False))
            estimates[condition] = ThesisEstimate(
                structure=fits[0].structure,
                subjects=(name,) * 3,
                environment=Environment(),
                fits=fits,
                vaf=np.zeros((3, 2)),
            )
    return PersonMeasures(
        name=name,
        conditions=tuple(LEVELS),
        cells={},
        true_cells={},
        low_gain={},
        trials=tuple(trials),
        estimates=estimates,
        left_out=(),
    )


def identified(condition, name, path, rng):
    arm = rng.uniform(1e-3, 1e-2, (18, 2, 2)) * np.exp(1j * rng.uniform(-1.0, 1.0, (18, 2, 2)))
    found = SimpleNamespace(
        spectra=SimpleNamespace(frequency=FREQUENCY, arm=arm),
        fit=SimpleNamespace(arm=POSITION, structure="3b", values={"m_tot": 4.0}, standard_error={}, stable=False),
        environment=Environment(),
    )
    single = SimpleNamespace(frequency=FREQUENCY, arm=arm, coherence=np.full((18, 2), 0.8))
    return Case(
        condition=condition,
        name=name,
        recording=path,
        identification=found,
        left_out=(),
        single_trials=(single,),
    )


def people_of(names=("S01", "S02", "S03")):
    rng = np.random.default_rng(1)
    return tuple(person(name, rng) for name in names)


def study_of(people):
    """These people in all conditions, with admittances of random numbers."""
    rng = np.random.default_rng(2)
    cases = tuple(
        identified(condition, one.name, Path("nowhere"), rng)
        for one in people
        for condition in THESIS.conditions
        if condition.has_multisine
    )
    return StudyResult(
        made=None, protocol=THESIS, environment=Environment(), cohort=(), cases=cases, people=tuple(people)
    )


def renamed(study, factor=1.5):
    """The same study, whose conditions have names of their own, and whose levels of pulses are larger by a factor."""
    names = {condition.name: f"own {condition.name}" for condition in study.protocol.conditions}
    conditions = {
        condition.name: replace(
            condition,
            name=names[condition.name],
            pulse_levels=tuple(factor * level for level in condition.pulse_levels),
        )
        for condition in study.protocol.conditions
    }
    people = tuple(
        replace(
            each,
            conditions=tuple(names[name] for name in each.conditions),
            trials=tuple(
                trial._replace(condition=names[trial.condition], pulse_level=factor * trial.pulse_level)
                for trial in each.trials
            ),
            estimates={names[name]: estimate for name, estimate in each.estimates.items()},
        )
        for each in study.people
    )
    unit = names.get(study.protocol.pulse_unit_condition, "")
    protocol = replace(study.protocol, conditions=tuple(conditions.values()), pulse_unit_condition=unit)
    cases = tuple(replace(case, condition=conditions[case.condition.name]) for case in study.cases)
    return replace(study, protocol=protocol, people=people, cases=cases)
