"""Which trials a fit uses, and what it does not use, in words."""

from collections.abc import Mapping, Sequence

import numpy as np

from armperturb.analysis.pulses_alone import PULSES_ALONE, fitted_whole
from armperturb.analysis.trials import ConditionTrials

MUCH = 0.1
"""Share of what comes before pulses from which on it is told that it is not used [-]."""


def used_conditions(
    conditions: Mapping[str, tuple[ConditionTrials, ...]], window_start: float
) -> tuple[dict[str, tuple[ConditionTrials, ...]], list[str]]:
    """Conditions that are fitted, and remarks on what is left out.

    Those in which nothing perturbs the window are left out if there are others; if there are none, trials are used with
    their pulses.

    Args:
      conditions: all of them.
      window_start: from when on every trial has to be perturbed [s].

    Raises:
      ValueError: as `fitted_whole`.
    """
    perturbed = {
        label: parts for label, parts in conditions.items() if all(part.is_perturbed(window_start) for part in parts)
    }
    if not perturbed:
        whole = {label: tuple(fitted_whole(parts)) for label, parts in conditions.items()}
        return whole, [PULSES_ALONE] if whole != conditions else []
    return perturbed, [
        f"{label} is not identified, as a trial of it ends or is pulsed before {window_start:g} s (an earlier "
        "--window-start)"
        for label, parts in conditions.items()
        if label not in perturbed and any(part.is_perturbed(0.0) for part in parts)
    ]


def cut_by_pulses(parts: Sequence[ConditionTrials]) -> list[str]:
    """Parts of a condition of which much is not used, as trials are used up to the earliest pulse, a line each.

    So they are by estimates from mean periods and by EMG.
    """
    remarks = []
    for part in parts:
        before = float(np.mean(np.minimum(part.onset, part.n_samples)))
        if part.first_onset < (1.0 - MUCH) * before:
            used = part.first_onset / part.rate
            remarks.append(
                f"{part.n_trials} trials are used up to {used:.3g} s, where the earliest pulse begins, of "
                f"{before / part.rate:.3g} s before their pulses (without --emg, --estimator record uses each up to "
                "its own)"
            )
    return remarks
