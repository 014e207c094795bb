"""Admittance of a condition over its subjects."""

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armperturb.arrays import Array
from armperturb.study.protocol import Condition
from armperturb.study.results.cases import Case
from armperturb.study.results.study_result import StudyResult
from armperturb.subject import TASKS

if TYPE_CHECKING:
    from armperturb.plots.bands import Curve


NEARBY = 0.07
"""Distance of frequencies over the frequency up to which one is near the other [-]."""

APART = 1.1
"""Ratio of two movements from which on they differ in amplitude [-]."""


def by_task(study: StudyResult) -> dict[str, list[Condition]]:
    """Tasks in which somebody was identified, to their conditions, the smallest displacement first."""
    tasks = {task: [c for c in perturbed_conditions(study, task) if c in study.conditions] for task in TASKS}
    return {task: conditions for task, conditions in tasks.items() if conditions}


def perturbed_conditions(study: StudyResult, task: str) -> list[Condition]:
    """The protocol's conditions of a task with a perturbation, the smallest displacement under the multisine first.

    Those of the same displacement are in the order of their co-contraction, the lowest first.
    """
    present = [c for c in study.protocol.conditions if c.task == task and c.contraction is None]
    return sorted(present, key=lambda condition: (movement(condition), condition.co_contraction))


def compared_conditions(study: StudyResult) -> tuple[Condition, ...]:
    """Those of both tasks, see `perturbed_conditions`."""
    return tuple(condition for task in TASKS for condition in perturbed_conditions(study, task))


def movement(condition: Condition) -> float:
    """RMS displacement that people reach under the multisine of a condition, as the protocol has it [m]."""
    return condition.rms_displacement * condition.reached


def differ_in_amplitude(conditions: Collection[Condition]) -> bool:
    """Whether conditions of a task differ in the amplitude of their movement and not in co-contraction."""
    sizes, levels = sorted(map(movement, conditions)), {each.co_contraction for each in conditions}
    return all(larger > APART * size for size, larger in pairwise(sizes)) and len(levels) <= 1


def main_conditions(study: StudyResult) -> dict[str, Condition]:
    """Tasks in which somebody was identified, to the condition that most trials are spent on."""
    return {
        task: max(conditions, key=lambda condition: study.n_trials(condition.name))
        for task, conditions in by_task(study).items()
    }


def at_usual_frequencies(cases: Iterable[Case]) -> list[Case]:
    """Cases at the frequencies at which most have their admittance, or of as many, the first.

    Those who have it at others nearby are interpolated, as people under noise; those who have none `NEARBY` are left
    out.
    """
    every = [(case, tuple(np.round(case.identified.spectra.frequency, 3).tolist())) for case in cases]
    if not every:
        return []
    counts = Counter(of_case for _, of_case in every)
    usual = max(counts, key=counts.__getitem__)
    frequency = next(case.identified.spectra.frequency for case, of_case in every if of_case == usual)
    alike = []
    for case, of_case in every:
        if of_case == usual:
            alike.append(case)
        elif _is_nearby(frequency, case.identified.spectra.frequency):
            spectra = case.identified.spectra.interpolated(frequency)
            alike.append(replace(case, identification=replace(case.identified, spectra=spectra)))
    return alike


def _is_nearby(wanted: Array, known: Array) -> bool:
    """Whether there is a known frequency near each that is wanted."""
    return bool((np.abs(np.log(wanted[:, None] / known)).min(axis=1) < NEARBY).all())


class MeanAdmittance(NamedTuple):
    """Admittance of a condition over its subjects: geometric mean of gains, circular mean of phases.

    Attributes:
      frequency: [Hz], (frequency,).
      gain: [m/N], (frequency, output, input).
      gain_ratio: one SD over subjects as a factor on the gain [-]; NaN for one subject.
      phase: [rad], (frequency, output, input).
      phase_sd: over subjects [rad]; NaN for one subject.
    """

    frequency: Array
    gain: Array
    gain_ratio: Array
    phase: Array
    phase_sd: Array


def mean_admittance(study: StudyResult, condition: str) -> MeanAdmittance:
    """Mean of the estimated admittance over the subjects of a condition, see `at_usual_frequencies`.

    Raises:
      ValueError: no subject was identified in the condition.
    """
    cases = at_usual_frequencies(study.of(condition))
    if not cases:
        raise ValueError(f"condition = {condition!r}; expected one in which somebody was identified")
    spectra = [case.identified.spectra for case in cases]
    arm = np.stack([spectrum.arm for spectrum in spectra])
    log_gain, direction = np.log(np.abs(arm)), np.mean(arm / np.abs(arm), axis=0)
    if len(arm) > 1:
        gain_ratio = np.exp(log_gain.std(axis=0, ddof=1))
        phase_sd = np.angle(arm / direction).std(axis=0, ddof=1)
    else:
        gain_ratio = phase_sd = np.full(direction.shape, np.nan)
    return MeanAdmittance(
        spectra[0].frequency, np.exp(log_gain.mean(axis=0)), gain_ratio, np.angle(direction), phase_sd
    )


def mean_curves(study: StudyResult) -> list["Curve"]:
    """Mean admittance of each condition, with one SD over subjects to either side where there are several."""
    # An analysis draws nothing, and is spared Matplotlib.
    from armperturb.plots.bands import Curve
    from armperturb.plots.style import colours_for

    curves = []
    for condition, colour in zip(study.conditions, colours_for(len(study.conditions)), strict=True):
        mean = mean_admittance(study, condition.name)
        n = len(at_usual_frequencies(study.of(condition.name)))
        bands = (
            mean.gain / mean.gain_ratio,
            mean.gain * mean.gain_ratio,
            mean.phase - mean.phase_sd,
            mean.phase + mean.phase_sd,
        )
        look = {"color": colour, "marker": "o", "markersize": 2.5}
        response = mean.gain * np.exp(1j * mean.phase)
        curves.append(Curve(f"{condition.name} ({n})", mean.frequency, response, bands if n > 1 else None, look))
    return curves
