"""Trials that nothing but a pulse perturbs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armperturb.analysis.trials import ConditionTrials

PULSES_ALONE = (
    "nothing but pulses perturbs these trials: they are used with them, and stiffness is that of such movements"
)
"""Remark on a fit to such trials."""

EARLIEST = 1.0
"""Onset from which on a pulse tells of manipulator and arm [s]: fits taper records, or leave out their start."""


def used_whole(several: Sequence[ConditionTrials]) -> list[ConditionTrials]:
    """The trials, of which those that nothing perturbs before their pulses are used with these, as with any other part.

    Args:
      several: trials, those of one length together.
    """
    return [_without_onsets(trials) if _has_pulses_alone(trials) else trials for trials in several]


def _without_onsets(trials: ConditionTrials) -> ConditionTrials:
    recording = trials.recording.assign_coords(pulse_onset=("trial", np.full(trials.n_trials, np.nan)))
    return replace(ConditionTrials.prepare(recording, is_checked=True), copies=trials.copies)


def fitted_whole(several: Sequence[ConditionTrials]) -> list[ConditionTrials]:
    """As `used_whole`, for a fit of an arm.

    Raises:
      ValueError: the pulse of a trial that nothing else perturbs comes before `EARLIEST`.
    """
    whole = used_whole(several)
    for trials, used in zip(several, whole, strict=True):
        if used is not trials and trials.first_onset < EARLIEST * trials.rate:
            trial = int(np.argmin(trials.onset))
            raise ValueError(
                f"pulse_onset of trial {trial} of {trials.label} is {trials.onset[trial] / trials.rate:g} s, and "
                f"nothing else perturbs the trial; expected at least {EARLIEST:g} s before it (response --method "
                "arx takes earlier ones)"
            )
    return whole


def _has_pulses_alone(trials: ConditionTrials) -> bool:
    """Whether every trial has a pulse, before which nothing changes."""
    before = (d[:end] for d, end in zip(trials.perturbation, trials.onset, strict=True))
    return bool((trials.onset < trials.n_samples).all()) and not any(len(d) and np.ptp(d, axis=0).any() for d in before)
