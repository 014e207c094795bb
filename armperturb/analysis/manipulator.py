"""How well trials tell the manipulator in which they were recorded, and remarks on trials that are no good."""

from collections.abc import Iterable, Sequence

import numpy as np

from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.signs import no_handle, wrong_signs
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array


@per_trials
def manipulator_covariance(trials: ConditionTrials) -> Array:
    """Covariance of the errors of the manipulator's mass, damping and stiffness in SI units, (3, 3).

    It is zero of a manipulator that is given without one.
    """
    if trials.given is not None:
        return np.zeros((3, 3)) if trials.given_covariance is None else trials.given_covariance
    if trials.whole is not None:
        return manipulator_covariance(trials.whole)
    return trials.balance.covariance(*trials.instruments)


def impossible(parts: Sequence[ConditionTrials]) -> tuple[str, ...]:
    """What of the signals of a condition no handle can show, a line each: signs, axes or units; mostly nothing."""
    return tuple(dict.fromkeys(wrong for part in parts for wrong in _impossible(part)))


def copies_left_out(parts: Iterable[ConditionTrials]) -> tuple[str, ...]:
    """A line on each trial of a condition that repeats another and is left out."""
    return tuple(dict.fromkeys(line for part in parts for line in part.copies.get(part.label, ())))


def remarks_on_trials(parts: Sequence[ConditionTrials]) -> tuple[str, ...]:
    """Which trials of a condition are left out as copies, and what is `impossible`, a line each."""
    return (*copies_left_out(parts), *impossible(parts))


@per_trials
def _impossible(trials: ConditionTrials) -> tuple[str, ...]:
    if trials.whole is not None:
        return _impossible(trials.whole)
    wrong, _ = wrong_signs(trials.recording)
    if not wrong and trials.given is None:
        try:
            wrong = no_handle(trials.environment)
        except (ValueError, np.linalg.LinAlgError):  # of too little movement
            return ()
    return (wrong,) if wrong else ()
