"""Variance accounted for: how well a model predicts a recorded displacement (thesis 2.7)."""

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from armperturb.analysis.arm_model import largest_real_pole, simulate_linear
from armperturb.environment import Environment
from armperturb.subject import Subject


def variance_accounted_for(
    recorded: ArrayLike, predicted: ArrayLike, rate: float, *, highpass: float | None = 0.40
) -> NDArray[np.float64]:
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
        sections = signal.butter(3, highpass, "highpass", fs=rate, output="sos")
        x, model = (signal.sosfiltfilt(sections, values, axis=-2) for values in (x, model))
    return 100.0 * (1.0 - np.sum((x - model) ** 2, axis=-2) / np.sum(x**2, axis=-2))


def prediction_vaf(recording: xr.Dataset, arm: Subject, environment: Environment) -> NDArray[np.float64]:
    """VAF of the linear model's displacement up to the pulse [%], (trial, axis).

    Args:
      recording: the trials that are predicted.
      arm: the model; minus infinity if it is unstable, as its response has no bound.
      environment: what the hand held.
    """
    vaf = np.full((recording.sizes["trial"], 2), -np.inf)
    if largest_real_pole(arm, environment) >= 0:
        return vaf
    rate = float(recording.attrs["rate"])
    for trial in range(len(vaf)):
        onset = float(recording["pulse_onset"].values[trial])
        n = recording.sizes["time"] if np.isnan(onset) else round(onset * rate)
        d, x = recording["perturbation"].values[trial, :n], recording["displacement"].values[trial, :n]
        vaf[trial] = variance_accounted_for(x, simulate_linear(arm, environment, d, rate).displacement, rate)
    return vaf
