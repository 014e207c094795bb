"""Variance accounted for: how well a model predicts a recorded displacement (thesis 2.7)."""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal

from armperturb.analysis.arm.state_space import largest_real_pole, simulate_linear
from armperturb.analysis.defaults import SETTLED
from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.trials import ConditionTrials, Trials, prepared
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


def _judged(trials: ConditionTrials) -> slice:
    """From when on a prediction that starts at rest is judged."""
    return slice(0 if trials.from_rest else round(SETTLED * trials.rate), None)


def _share(x: Array, model: Array) -> Array:
    return np.asarray(100.0 * (1.0 - np.sum((x - model) ** 2, axis=-2) / np.sum(x**2, axis=-2)))


@per_trials
def _recorded(trials: ConditionTrials) -> tuple[Array, ...]:
    """Displacement of each trial up to its pulse without what the high-pass takes out [m], each (time, axis)."""
    return tuple(
        _highpassed(x[:end], trials.rate, HIGHPASS)
        for x, end in zip(trials.recorded_displacement, trials.onset.tolist(), strict=True)
    )


def trial_vaf(trials: ConditionTrials, trial: int, arm: Subject, environment: Environment) -> Array:
    """VAF of a linear model's displacement in one trial [%], (axis,); as `prediction_vaf`."""
    if largest_real_pole(arm, environment) >= 0:
        return np.full(2, -np.inf)
    driven = trials.perturbation[trial, : trials.onset[trial]]
    predicted = simulate_linear(arm, environment, driven, trials.rate).displacement
    judged = _judged(trials)
    return _share(_recorded(trials)[trial][judged], _highpassed(predicted, trials.rate, HIGHPASS)[judged])


def prediction_vaf(trials: Trials, arm: Subject, environment: Environment) -> Array:
    """VAF of the linear model's displacement up to the pulse [%], (trial, axis).

    Of records that start amid the movement, the first `SETTLED` seconds are left out, as the model starts at rest.

    Args:
      trials: that are predicted, or their recording.
      arm: the model; minus infinity if it is unstable, as its response has no bound.
      environment: what the hand held.
    """
    ready = prepared(trials)
    return np.array([trial_vaf(ready, trial, arm, environment) for trial in range(ready.n_trials)])
