"""Variance accounted for: how well a model predicts a recorded displacement (thesis 2.7)."""

from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import signal

from armperturb.analysis.arm.state_space import largest_real_pole, simulate_linear
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject

HIGHPASS = 0.40
"""Cut-off that takes voluntary interventions out [Hz] (thesis 2.7)."""


def variance_accounted_for(
    recorded: ArrayLike, predicted: ArrayLike, rate: float, *, highpass: float | None = HIGHPASS
) -> Array:
    """Share of the recorded displacement's variance that a prediction accounts for [%], (..., axis).

    Args:
      recorded: displacement [m], (..., time, axis).
      predicted: the same, by the model.
      rate: sampling rate [Hz].
      highpass: cut-off of the third-order Butterworth high-pass, run forth and back, that takes voluntary
        interventions out of both [Hz]; None leaves them in.

    Source: eq. 2.23 and the text below it.
    """
    x, model = np.asarray(recorded, dtype=float), np.asarray(predicted, dtype=float)
    if highpass is not None:
        x, model = (_highpassed(values, rate, highpass) for values in (x, model))
    return _share(x, model)


def _highpassed(values: Array, rate: float, highpass: float) -> Array:
    return np.asarray(signal.sosfiltfilt(_sections(rate, highpass), values, axis=-2))


@cache
def _sections(rate: float, highpass: float) -> Array:
    return np.asarray(signal.butter(3, highpass, "highpass", fs=rate, output="sos"))


def _share(x: Array, model: Array) -> Array:
    return np.asarray(100.0 * (1.0 - np.sum((x - model) ** 2, axis=-2) / np.sum(x**2, axis=-2)))


@dataclass(frozen=True, eq=False)
class Predictable:
    """A trial up to its pulse, whose displacement any number of models may predict.

    Attributes:
      perturbation: d [N], (time, axis).
      displacement: without what the high-pass takes out [m], (time, axis).
      rate: of the samples [Hz].
    """

    perturbation: Array
    displacement: Array
    rate: float

    @classmethod
    def prepare(cls, recording: xr.Dataset) -> list[Self]:
        """The trials of a recording."""
        rate, trials = float(recording.attrs["rate"]), []
        for onset, d, x in zip(
            *(recording[name].values for name in ("pulse_onset", "perturbation", "displacement")), strict=True
        ):
            n = len(x) if np.isnan(onset) else round(float(onset) * rate)
            trials.append(cls(d[:n], _highpassed(np.asarray(x[:n], dtype=float), rate, HIGHPASS), rate))
        return trials

    def vaf(self, arm: Subject, environment: Environment) -> Array:
        """VAF of the linear model's displacement [%], (axis,); minus infinity if it is unstable: it has no bound."""
        if largest_real_pole(arm, environment) >= 0:
            return np.full(2, -np.inf)
        predicted = simulate_linear(arm, environment, self.perturbation, self.rate).displacement
        return _share(self.displacement, _highpassed(predicted, self.rate, HIGHPASS))


def prediction_vaf(recording: xr.Dataset, arm: Subject, environment: Environment) -> Array:
    """VAF of the linear model's displacement up to the pulse [%], (trial, axis).

    Args:
      recording: the trials that are predicted.
      arm: the model; minus infinity if it is unstable, as its response has no bound.
      environment: what the hand held.
    """
    return np.array([trial.vaf(arm, environment) for trial in Predictable.prepare(recording)])
