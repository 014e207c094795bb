"""Trials that tell of another inertia than the others: a limb has one, so that a signal of theirs is wrong.

What makes a person stiffer or more reflexive in one trial leaves the inertia as it is, while a torque that is late,
lost or of another size does not. With delay and dynamics held, each trial alone has a least-squares estimate about that
of all trials, see `part_differences`, whose variance is that of the noise times how much more of it the trial has.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

from armperturb.analysis.fit.trial_effects import inverse
from armperturb.analysis.joint.estimate import JointEstimate
from armperturb.analysis.joint.likelihood import Loop
from armperturb.analysis.joint.part_differences import CHANCE, DIFFERENT, telling_trials, white_slopes
from armperturb.analysis.joint.signals import JointSignals
from armperturb.analysis.results import plain
from armperturb.arrays import Array

ROUND_OFF = 1e-9
"""Share of the largest inertia below which one is none [-]."""


class OddTrials(NamedTuple):
    """Trials whose inertia is not that of the others.

    Attributes:
      inertia: number of such a trial, see `JointSignals.numbers`, to its inertia [kg m^2, or kg]; of two trials that
        differ, both.
      others: inertia of the other trials together; None where there are two trials, of which either may be right.
    """

    inertia: Mapping[int, float]
    others: float | None

    def sentence(self, *, angular: bool) -> str:
        """In words, without full stop; empty where all trials agree.

        Args:
          angular: whether it is a joint, or a single direction.
        """
        if not self.inertia:
            return ""
        size, unit, force = ("inertia", "kg m^2", "torque") if angular else ("mass", "kg", "force")
        least = ROUND_OFF * max(map(abs, [*self.inertia.values(), self.others or 0.0]))
        each = ", ".join(
            f"{plain(value if abs(value) > least else 0.0, 3)} {unit} in trial {number}"
            for number, value in self.inertia.items()
        )
        against = "" if self.others is None else f" against {plain(self.others, 3)} {unit} in the others"
        return (
            f"trials differ in {size} by more than noise ({each}{against}), but a limb has one: {force} or movement of "
            f"{'one of them' if self.others is None else 'such a trial'} is late, lost or of another size; leave it out"
        )


def odd_trials(fit: JointEstimate, signals: JointSignals, loop: Loop | None) -> OddTrials:
    """Trials whose inertia differs from that of the others significantly and by more than `DIFFERENT`.

    Args:
      fit: of all trials.
      signals: of these.
      loop: the virtual environment of a force servo; None of a position servo.
    """
    white = white_slopes(fit, signals, loop)
    if white is None or white.likelihood.n_trials < 2 or white.names[0] != "inertia":
        return OddTrials({}, None)
    telling = telling_trials(np.einsum("ptn,qtn->tpq", white.slopes, white.slopes)).tolist()
    if len(telling) < 2:
        return OddTrials({}, None)
    residual = white.likelihood.residual(fit.values)[telling]
    values, variances = _alone(white.slopes[:, telling], residual, float(white.values[0]))
    numbers = [signals.numbers[trial] for trial in telling]
    limit = float(stats.norm.isf(CHANCE / (2 * len(values))))
    left, odd = list(range(len(values))), []
    while len(left) > 1:
        weights, weighed = 1.0 / variances[left], values[left] / variances[left]
        of_others = weights.sum() - weights
        others = (weighed.sum() - weighed) / of_others
        apart, error = values[left] - others, np.sqrt(variances[left] + 1.0 / of_others)
        furthest = int(np.argmax(np.abs(apart) / error))
        if abs(apart[furthest]) < max(limit * error[furthest], DIFFERENT * abs(others[furthest])):
            break
        if len(values) == 2:
            return OddTrials({numbers[trial]: float(values[trial]) for trial in left}, None)
        odd.append(left.pop(furthest))
    inertia = {numbers[trial]: float(values[trial]) for trial in sorted(odd)}
    return OddTrials(inertia, float(np.average(values[left], weights=1.0 / variances[left])))


def _alone(slopes: Array, residual: Array, inertia: float) -> tuple[Array, Array]:
    """Inertia of each trial alone, and its variance, (trial,).

    Args:
      slopes: white derivatives, inertia first, (parameter, trial, number).
      residual: white, (trial, number).
      inertia: of all trials.
    """
    covariances = [inverse(rows @ rows.T) for rows in slopes.swapaxes(0, 1)]
    shifts = [
        covariance @ (rows @ left)
        for covariance, rows, left in zip(covariances, slopes.swapaxes(0, 1), residual, strict=True)
    ]
    left = residual - np.einsum("ptn,tp->tn", slopes, np.array(shifts))
    power = np.mean(left**2, axis=1)
    louder = np.maximum(1.0, power / np.median(power))
    return inertia + np.array([shift[0] for shift in shifts]), louder * np.array([each[0, 0] for each in covariances])
