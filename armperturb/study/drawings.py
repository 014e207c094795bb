"""Which figures a study allows."""

from collections.abc import Callable
from functools import partial

from matplotlib.figure import Figure

from armperturb.study import figures, yielding_figures
from armperturb.study.admittance import by_task, main_conditions
from armperturb.study.effects import Effects
from armperturb.study.results import StudyResult
from armperturb.study.yielding import Yielding


def drawings(study: StudyResult, effects: Effects, yielding: Yielding | None) -> dict[str, Callable[[], Figure]]:
    """Figures by name; drawing one may raise RuntimeError, if this machine cannot draw the rig."""
    drawn: dict[str, Callable[[], Figure]] = {}
    main = {task: study.of(condition.name)[0] for task, condition in main_conditions(study).items()}
    if study.cohort:
        drawn["rig"] = partial(figures.rig, study)
    if main:
        drawn["perturbation"] = partial(figures.perturbation, next(iter(main.values())))
        drawn["admittance_by_task"] = partial(figures.admittance_by_task, study)
        drawn["coherence"] = partial(figures.coherence, study)
    for task, first in main.items():
        if len(by_task(study)[task]) > 1:
            drawn[f"admittance_by_amplitude_{task}"] = partial(figures.admittance_by_amplitude, study, task)
        drawn[f"admittance_{task}"] = partial(figures.admittance_of_trials, first)
        drawn[f"fit_{task}"] = partial(figures.fit, first)
        drawn[f"prediction_{task}"] = partial(figures.prediction, first)
        if study.has_truth:
            drawn[f"parameters_{task}"] = partial(figures.parameters, study, task)
    if yielding is not None:
        drawn["yielding_loops"] = partial(yielding_figures.loops, yielding)
        drawn["yielding_admittance"] = partial(yielding_figures.admittance, yielding)
        drawn["yielding_pulses"] = partial(yielding_figures.pulses, yielding)
    return drawn
