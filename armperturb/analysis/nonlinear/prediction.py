"""What a fitted person, linear or not, predicts of pulses that it has not seen (thesis 2.8)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.measures.pulse import WINDOWS, peak_norm
from armperturb.analysis.nonlinear.trials import TrialSet
from armperturb.arrays import Array, Indices
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import Subject


class PulsePrediction(NamedTuple):
    """The pulse of one trial, as recorded and as predicted.

    Attributes:
      condition: of the trial.
      direction_deg: of the pulse [deg].
      time: from the onset [s], (time,).
      recorded: displacement of the handle [m], (time, axis).
      predicted: likewise; not finite if the arm blows up.
    """

    condition: str
    direction_deg: float
    time: Array
    recorded: Array
    predicted: Array

    @property
    def peak(self) -> float:
        """Predicted over recorded peak displacement [%] (eq. 2.25)."""
        return 100.0 * peak_norm(self.predicted) / peak_norm(self.recorded)

    @property
    def vaf(self) -> float:
        """Variance of the trajectory that is accounted for, x and y together, from the start of the trial [%]."""
        return 100.0 * (1.0 - float(np.sum((self.recorded - self.predicted) ** 2) / np.sum(self.recorded**2)))


def predict_pulses(one: TrialSet, person: Subject) -> list[PulsePrediction]:
    """What a person without noise, whole disturbance simulated from rest, predicts of each pulse of a condition.

    Trials without a pulse, or of which the window after it is not recorded (thesis 2.8), are left out.

    Args:
      one: whole trials.
      person: of these trials' task, as in this condition; linear, or with a muscle law.
    """
    trials, ends = _recorded(one)
    if not trials:
        return []
    disturbances = Disturbances(one.perturbation[trials, : int(ends.max())], one.rate)
    lanes = lane_table([person] * len(trials), [one.environment] * len(trials), disturbances.timestep)
    return _compared(one, trials, ends, disturbances.responses(lanes, np.arange(len(trials)), ends))


def predict_pulses_linearly(one: TrialSet, arm: Subject) -> list[PulsePrediction]:
    """What the linear model, with the geometry of the start throughout, predicts of the same pulses (thesis 2.8).

    Args:
      one: whole trials.
      arm: of these trials' task.
    """
    trials, ends = _recorded(one)
    if not trials:
        return []
    force = one.perturbation[trials, : int(ends.max())]
    return _compared(one, trials, ends, simulate_linear(arm, one.environment, force, one.rate).displacement)


def _recorded(one: TrialSet) -> tuple[list[int], Indices]:
    """Trials whose window is recorded, and the sample after it."""
    n_window = round(WINDOWS[one.body.task] * one.rate) + 1
    trials = [trial for trial, onset in enumerate(one.onset) if onset + n_window <= one.end]
    return trials, one.onset[trials] + n_window


def _compared(one: TrialSet, trials: list[int], ends: Indices, responses: Array) -> list[PulsePrediction]:
    return [
        PulsePrediction(
            one.label,
            float(one.direction_deg[trial]),
            np.arange(end - one.onset[trial]) / one.rate,
            one.displacement[trial, one.onset[trial] : end],
            response[one.onset[trial] : end],
        )
        for trial, end, response in zip(trials, ends, responses, strict=True)
    ]


def median_peak(predictions: Sequence[PulsePrediction]) -> float:
    """Median of `PulsePrediction.peak` [%]; NaN of none."""
    return float(np.median([one.peak for one in predictions])) if predictions else float("nan")
