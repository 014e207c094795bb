"""Pulses as a fitted person, linear or not, predicts them (thesis 2.8)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from armperturb.analysis.arm.state_space import simulate_linear
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.measures.pulse import WINDOWS, is_cut, peak_norm
from armperturb.analysis.results import Description, Result
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, Indices
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import STEP, Disturbances
from armperturb.recording import LABELS
from armperturb.subject import Subject

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class PulsePrediction(Result):
    """The pulse of one trial, as recorded and as predicted.

    Attributes:
      condition: of the trial.
      direction_deg: of the pulse [deg].
      time: from the onset [s], (time,).
      recorded: displacement of the handle [m], (time, axis).
      predicted: displacement of the handle [m], (time, axis); not finite if the arm diverges.
    """

    condition: str
    direction_deg: float
    time: Array
    recorded: Array
    predicted: Array

    def describe(self) -> Description:
        """Which pulse, and how well it is predicted."""
        return Description(
            title=f"Pulse at {self.direction_deg:g} deg in {self.condition}: predicted over recorded peak "
            f"{self.peak:.0f} %, VAF {self.vaf:.1f} %"
        )

    def to_frame(self) -> pd.DataFrame:
        """One row per sample: recorded and predicted displacement [m]."""
        columns = {
            f"{name}_{axis}_m": values[:, column]
            for name, values in (("recorded", self.recorded), ("predicted", self.predicted))
            for column, axis in enumerate(LABELS["axis"])
        }
        return pd.DataFrame({"time_s": self.time, **columns})

    def to_xarray(self) -> xr.Dataset:
        """Recorded and predicted displacement of the handle [m], (time, axis), time from the onset [s]."""
        signals = {"recorded": self.recorded, "predicted": self.predicted}
        return xr.Dataset(
            {name: (("time", "axis"), values, {"units": "m"}) for name, values in signals.items()},
            {
                "time": ("time", self.time, {"units": "s"}),
                "axis": list(LABELS["axis"]),
                "condition": self.condition,
                "direction_deg": self.direction_deg,
            },
        )

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw displacement along x and y, as recorded and as predicted.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (1, axis).
        """
        from armperturb.plots.pulses import PredictedPulse, plot_pulses

        title = f"{self.condition}, pulse at {self.direction_deg:g} deg"
        shown = PredictedPulse(title, self.time, self.recorded, {"predicted": self.predicted})
        return plot_pulses([shown], figure)

    @property
    def peak(self) -> float:
        """Predicted over recorded peak displacement [%] (eq. 2.25)."""
        return 100.0 * peak_norm(self.predicted) / peak_norm(self.recorded)

    @property
    def vaf(self) -> float:
        """Share of the trajectory's variance that is accounted for, x and y together [%]."""
        return 100.0 * (1.0 - float(np.sum((self.recorded - self.predicted) ** 2) / np.sum(self.recorded**2)))


def predict_pulses(recorded: ConditionTrials, person: Subject) -> list[PulsePrediction]:
    """Predict each pulse of a condition by simulating the whole disturbance from rest, without noise.

    Trials without a pulse, or whose window after it is not recorded to its end (thesis 2.8), are left out.

    Args:
      recorded: whole trials.
      person: of these trials' task, as in this condition; linear, or with a muscle law.
    """
    trials, ends = _with_window(recorded)
    if not trials:
        return []
    step = min(STEP, min(person.Td_s, person.Td_e) / 3.0)  # a delay takes three steps
    disturbances = Disturbances(recorded.drive[trials, : int(ends.max())], recorded.rate, longest_step=step)
    lanes = lane_table([person] * len(trials), [recorded.environment] * len(trials), disturbances.timestep)
    return _compared(recorded, trials, ends, disturbances.responses(lanes, np.arange(len(trials)), ends))


def predict_pulses_linearly(recorded: ConditionTrials, arm: Subject) -> list[PulsePrediction]:
    """Predict the pulses that `predict_pulses` predicts by the linear model, whose geometry stays (thesis 2.8).

    Args:
      recorded: whole trials.
      arm: of these trials' task.
    """
    trials, ends = _with_window(recorded)
    if not trials:
        return []
    force = recorded.drive[trials, : int(ends.max())]
    response = simulate_linear(arm, recorded.environment, force, recorded.rate).displacement
    return _compared(recorded, trials, ends, response)


def remarks_on_windows(left_out: Iterable[ConditionTrials]) -> list[str]:
    """A line on left-out pulses whose window is not recorded, and which are not predicted; none if there are none."""
    of_conditions = list(left_out)
    counts = [(sum(trials.onset < trials.n_samples), len(_with_window(trials)[0])) for trials in of_conditions]
    n_pulses, n_predicted = map(int, np.sum(counts or [(0, 0)], axis=0))
    if n_predicted == n_pulses:
        return []
    tasks = sorted({trials.body.task for trials in of_conditions})
    seconds = " and ".join(f"{WINDOWS[task] + EDGE:g} s in {task}" for task in tasks)
    return [
        f"{n_pulses - n_predicted} of {n_pulses} left-out pulses are not predicted, as the record ends too early or "
        f"the handle met the workspace limit; expected {seconds} after the onset"
    ]


def _with_window(recorded: ConditionTrials) -> tuple[list[int], Indices]:
    """Trials whose window after the pulse is recorded, and the sample after it.

    Both ends of a window count, so that it may end with the first sample that fits leave out at the end of a record.
    """
    n_window = round(WINDOWS[recorded.body.task] * recorded.rate) + 1
    is_edge = recorded.end == recorded.n_samples - round(EDGE * recorded.rate)
    trials = [trial for trial, onset in enumerate(recorded.onset) if onset + n_window <= recorded.end + is_edge]
    return trials, recorded.onset[trials] + n_window


def _compared(recorded: ConditionTrials, trials: list[int], ends: Indices, responses: Array) -> list[PulsePrediction]:
    return [
        PulsePrediction(
            condition=recorded.label,
            direction_deg=float(recorded.direction_deg[trial]),
            time=np.arange(end - recorded.onset[trial]) / recorded.rate,
            recorded=recorded.displacement[trial, recorded.onset[trial] : end],
            predicted=response[recorded.onset[trial] : end],
        )
        for trial, end, response in zip(trials, ends, responses, strict=True)
    ]


def predicted_at_all(predictions: Sequence[PulsePrediction]) -> list[PulsePrediction]:
    """Those whose arm does not diverge."""
    return [pulse for pulse in predictions if np.isfinite(pulse.predicted).all()]


def median_peak(predictions: Sequence[PulsePrediction]) -> float:
    """Median of `PulsePrediction.peak` of those that are predicted [%]; NaN of none."""
    peaks = [pulse.peak for pulse in predicted_at_all(predictions)]
    return float(np.median(peaks)) if peaks else float("nan")


def facts_of(predictions: Mapping[str, Sequence[PulsePrediction]]) -> tuple[str, ...]:
    """A line per model, by its name, that has left-out pulses to predict."""
    return tuple(
        f"{len(pulses)} left-out pulses, {name}: {', '.join(_agreement(pulses))}"
        for name, pulses in predictions.items()
        if pulses
    )


def remarks_on_peaks(pulses: Sequence[PulsePrediction]) -> list[str]:
    """A line on pulses after which the handle still moves away where their window ends; none if there are none."""
    n_cut = sum(is_cut(pulse.recorded) for pulse in pulses)
    if not n_cut:
        return []
    windows = " and ".join(f"{seconds:g} s in {task}" for task, seconds in WINDOWS.items())
    return [
        f"after {n_cut} of {len(pulses)} left-out pulses the handle is farthest where the window for peaks ends "
        f"({windows} after the onset); recorded and predicted peaks are those until then"
    ]


def _agreement(pulses: Sequence[PulsePrediction]) -> list[str]:
    """How pulses are predicted, and in how many the arm diverges, which count in no median."""
    predicted, said = predicted_at_all(pulses), []
    if predicted:
        vaf = float(np.median([pulse.vaf for pulse in predicted]))
        said = [f"median peak {median_peak(predicted):.0f} %", f"median VAF {vaf:.1f} %"]
    if len(predicted) < len(pulses):
        said.append(f"{len(pulses) - len(predicted)} of {len(pulses)} not predicted, as the arm diverges")
    return said
