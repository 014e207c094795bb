"""Which figures a study allows."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from armperturb.analysis.cuts import of_condition
from armperturb.analysis.measures.kinematics import hand_path, within_reach
from armperturb.study.comparison.effects import AdmittanceEffect, Effects
from armperturb.study.experiments.mechanisms import Yielding
from armperturb.study.report.figures import admittance as admittance_figures
from armperturb.study.report.figures import estimates as estimate_figures
from armperturb.study.report.figures import findings as findings_figures
from armperturb.study.report.figures import fit as fit_figures
from armperturb.study.report.figures import mechanisms as yielding_figures
from armperturb.study.report.figures import nonlinear as nonlinear_figures
from armperturb.study.report.figures import parameters as parameter_figures
from armperturb.study.report.figures import perturbation as perturbation_figures
from armperturb.study.report.figures import pulses as pulse_figures
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.figures import trajectories as trajectory_figures
from armperturb.study.report.figures.axes import Marks
from armperturb.study.report.figures.trajectories import around_pulse, first_pulses
from armperturb.study.report.findings import excesses
from armperturb.study.report.nonlinear_tables import left_out_pulses, tasks_fitted, true_parameters
from armperturb.study.results.appendix_fits import Appendices
from armperturb.study.results.mean_admittance import by_task, main_conditions
from armperturb.study.results.nonlinear_fits import drawn_pulse
from armperturb.study.results.recordings import load_trials, pulse_width
from armperturb.study.results.study_result import StudyResult
from armperturb.subject import TASKS

Drawings = dict[str, "partial[Figure]"]

SLOW = ("rig", "stills")
"""What takes longest to draw, and comes first so that workers end together."""

CLEARLY = 0.01
"""Level of the thesis's second star [-]."""


def drawings(study: StudyResult, effects: Effects) -> Drawings:
    """Figures by name; drawing one may raise RuntimeError, if this machine cannot draw the rig.

    Args:
      study: analysed; its recordings must still be there.
      effects: whose significant ones are marked.

    Raises:
      OSError: a recording is gone.
    """
    # Figures are drawn anew when what they are given changes: none is given more of the study than it may need.
    whole, study = study, replace(study, appendices=Appendices(), nonlinear=(), missing=(), remarks=())
    drawn = {**_of_pulses(study), **_of_cases(study, effects), **_of_people(study, effects)}
    drawn |= _of_laws(replace(study, nonlinear=whole.nonlinear))
    if study.cohort:
        drawn["rig"] = partial(rig_figures.rig, study)
    return dict(sorted(drawn.items(), key=lambda item: item[0] not in SLOW))


def drawings_of_yielding(yielding: Yielding) -> Drawings:
    """Figures of why people yield, by name."""
    return {
        "yielding_loops": partial(yielding_figures.loops, yielding),
        "yielding_admittance": partial(yielding_figures.admittance, yielding),
        "yielding_pulses": partial(yielding_figures.pulses, yielding),
    }


def _of_cases(study: StudyResult, effects: Effects) -> Drawings:
    """Of the people who were identified in conditions with a multisine."""
    drawn: Drawings = {}
    main = {task: study.of(condition.name)[0] for task, condition in main_conditions(study).items()}
    marks = {task: _marks(effect) for task, effect in effects.admittance.items()}
    if main:
        arms = [case.identified.fit.arm for case in study.of(next(iter(main.values())).condition.name)]
        directions = study.protocol.pulse_directions_deg
        if any(condition.pulse_levels for condition in study.protocol.conditions):
            drawn["pulse_directions"] = partial(perturbation_figures.pulse_directions, arms, directions)
        drawn["perturbation"] = partial(perturbation_figures.perturbation, next(iter(main.values())))
        if estimate_figures.estimated_quantities(study):
            drawn["estimates"] = partial(estimate_figures.estimates, study)
        drawn["findings"] = partial(findings_figures.findings, study)
        drawn["admittance_by_task"] = partial(admittance_figures.admittance_by_task, study)
        drawn["gain_linear_scale"] = partial(admittance_figures.gain_linear_scale, study, marks)
        if any(case.single_trials for condition in study.conditions for case in study.of(condition.name)):
            drawn["coherence"] = partial(admittance_figures.coherence, study)
    for task, first in main.items():
        if len(by_task(study)[task]) > 1:
            drawn[f"admittance_by_amplitude_{task}"] = partial(
                admittance_figures.admittance_by_amplitude, study, task, marks.get(task)
            )
        drawn[f"admittance_{task}"] = partial(admittance_figures.admittance_of_trials, first)
        drawn[f"fit_{task}"] = partial(fit_figures.fit, first)
        drawn[f"prediction_{task}"] = partial(fit_figures.prediction, first)
        if study.has_truth:
            drawn[f"parameters_{task}"] = partial(parameter_figures.parameters, study, task)
    return drawn


def _of_people(study: StudyResult, effects: Effects) -> Drawings:
    """Of what everybody's trials tell."""
    drawn: Drawings = {}
    names = {condition.name for condition in study.protocol.conditions}
    trials = [trial for person in study.people for trial in person.trials if trial.condition in names]
    if any((np.array(trial.vaf_linear) > 0.0).all() for trial in trials):
        drawn["vaf"] = partial(fit_figures.vaf, study)
    p = {task: {name: p for (of, name), p in effects.parameters.items() if of == task} for task in TASKS}
    for task in TASKS:
        if parameter_figures.estimated(study, task):
            drawn[f"joint_parameters_{task}"] = partial(parameter_figures.joint_parameters, study, task, p[task])
            drawn["penalty"] = partial(fit_figures.penalty, study)
            drawn["muscle_parameters"] = partial(parameter_figures.muscle_parameters, study, p)
    if study.pulses:
        drawn["peak_displacement"] = partial(pulse_figures.peak_displacement, study)
        drawn["pulse_admittance"] = partial(pulse_figures.pulse_admittance, study, effects.levels)
    if excesses(study):
        drawn["pulse_prediction"] = partial(pulse_figures.pulse_prediction, study)
    return drawn


def _of_pulses(study: StudyResult) -> Drawings:
    """Of single pulses to the first person."""
    if not study.recordings:
        return {}
    drawn: Drawings = {}
    name, path = next(iter(study.recordings.items()))
    recording = load_trials(path, ["joint_angle"])
    stills: dict[str, xr.Dataset] = {}
    is_known = study.made is not None
    for condition in study.protocol.conditions:
        trials = of_condition(recording, condition.name)
        pulses = first_pulses(trials) if condition.pulse_levels and not condition.has_multisine else {}
        if not pulses:
            continue
        trial = trials.isel(trial=[next(iter(pulses.values()))])
        if math.isnan(pulse_width(trial)):
            continue
        drawn.setdefault("pulse_signal", partial(perturbation_figures.pulse_signal, trial, is_known=is_known))
        if all(_within_reach(around_pulse(trials, number)) for number in pulses.values()):
            drawn.setdefault("joint_rotations", partial(trajectory_figures.joint_rotations, trials, is_known=is_known))
        stills.setdefault(condition.task, trial)
    person = next((person for person in study.cohort if person.name == name), None)
    if person is not None and stills and "joint_angle" in recording:
        drawn["stills"] = partial(rig_figures.stills, person, study.environment, list(stills.values()))
    measures = next((person for person in study.people if person.name == name), None)
    for task in TASKS:
        if (pulse := drawn_pulse(study.protocol.conditions, task)) is None:
            continue
        trials = of_condition(recording, pulse[0])
        if first_pulses(trials, pulse[1]):
            estimate = measures.estimates.get(pulse[0]) if measures else None
            drawn[f"trajectories_{task}"] = partial(trajectory_figures.trajectories, trials, estimate, pulse[1])
    return drawn


def _of_laws(study: StudyResult) -> Drawings:
    """Of nonlinear fits."""
    drawn: Drawings = {}
    for task in tasks_fitted(study):
        if any(true_parameters(study, fit) for fit in study.nonlinear if fit.task == task and not fit.failed):
            drawn[f"nonlinear_parameters_{task}"] = partial(nonlinear_figures.parameters, study, task)
        if nonlinear_figures.drawn_pulses(study, task):
            drawn[f"nonlinear_trajectories_{task}"] = partial(nonlinear_figures.trajectories, study, task)
        if left_out_pulses(study, task):
            drawn["nonlinear_prediction"] = partial(nonlinear_figures.prediction, study)
    return drawn


def _within_reach(trials: xr.Dataset) -> bool:
    """Whether the handle stays within the arm's reach."""
    lengths = (trials[name].values[:, None] for name in ("l_h", "l_f"))
    return bool(within_reach(hand_path(trials), *lengths).all())


def _marks(effect: AdmittanceEffect) -> Marks:
    """Where an effect counts, and where it is clear as well."""
    counts, clear = (np.moveaxis(mask, 0, -1) for mask in (effect.counts, effect.counts & (effect.p < CLEARLY)))
    return {(output, input_): (counts[output, input_], clear[output, input_]) for output, input_ in np.ndindex(2, 2)}
