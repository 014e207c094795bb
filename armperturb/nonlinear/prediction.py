"""What a fitted person, linear or not, predicts of pulses that it has not seen (thesis 2.8)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.pulse import WINDOWS, peak_norm
from armperturb.nonlinear.lanes import lane_table
from armperturb.nonlinear.response import Disturbances
from armperturb.nonlinear.trials import TrialSet
from armperturb.subject import Subject

Array = NDArray[np.float64]


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
    n_window = round(WINDOWS[one.body.task] * one.rate) + 1
    trials = [trial for trial, onset in enumerate(one.onset) if onset + n_window <= one.end]
    if not trials:
        return []
    ends = one.onset[trials] + n_window
    disturbances = Disturbances(one.perturbation[trials, : int(ends.max())], one.rate)
    lanes = lane_table([person] * len(trials), [one.environment] * len(trials), disturbances.timestep)
    responses = disturbances.responses(lanes, np.arange(len(trials)), ends)
    time = np.arange(n_window) / one.rate
    return [
        PulsePrediction(
            one.label,
            float(one.direction_deg[trial]),
            time,
            one.displacement[trial, one.onset[trial] : end],
            response[one.onset[trial] : end],
        )
        for trial, end, response in zip(trials, ends, responses, strict=True)
    ]


def median_peak(predictions: Sequence[PulsePrediction]) -> float:
    """Median of `PulsePrediction.peak` [%]; NaN of none."""
    return float(np.median([one.peak for one in predictions])) if predictions else float("nan")
