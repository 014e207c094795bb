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
from armperturb.validation import require_number

HIGHPASS = 0.40
"""Cut-off that takes voluntary interventions out [Hz] (thesis 2.7)."""

ORDER = 3
"""Of that high-pass."""

FEWEST_SAMPLES = 3 * (ORDER + 1) + 1
"""One more than what is mirrored at either end to start the high-pass."""


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

    Raises:
      TypeError: rate or highpass is no number.
      ValueError: shapes differ, there are too few samples, or rate or highpass is out of its range.

    Source: eq. 2.23 and the text below it.
    """
    x, model = np.asarray(recorded, dtype=float), np.asarray(predicted, dtype=float)
    require_number("variance_accounted_for", "rate", rate, above=0.0)
    require_number("variance_accounted_for", "highpass", highpass, above=0.0, below=rate / 2.0, optional=True)
    if x.ndim < 2 or x.shape != model.shape:
        raise ValueError(
            f"variance_accounted_for: recorded has shape {x.shape}, predicted {model.shape}; expected the same, "
            "(..., time, axis)"
        )
    least = 2 if highpass is None else FEWEST_SAMPLES
    if x.shape[-2] < least:
        raise ValueError(f"variance_accounted_for: {x.shape[-2]} samples; expected at least {least} along time")
    if highpass is not None:
        x, model = (_highpassed(values, rate, highpass) for values in (x, model))
    return _share(x, model)


def _highpassed(values: Array, rate: float, highpass: float) -> Array:
    return np.asarray(signal.sosfiltfilt(_sections(rate, highpass), values, axis=-2))


@cache
def _sections(rate: float, highpass: float) -> Array:
    return np.asarray(signal.butter(ORDER, highpass, "highpass", fs=rate, output="sos"))


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


def driving(trials: ConditionTrials, trial: int, end: int) -> Array:
    """What moves a linear model from rest as it moved the handle up to a sample [N], (time, axis).

    A constant force that was there before only displaces the handle; the recorded displacement need not have that.
    """
    perturbation = trials.perturbation[trial, :end]
    return perturbation if trials.from_rest else perturbation - perturbation[: trials.onset[trial]].mean(axis=0)


def trial_vaf(trials: ConditionTrials, trial: int, arm: Subject, environment: Environment) -> Array:
    """VAF of a linear model's displacement in one trial [%], (axis,); as `prediction_vaf`."""
    if largest_real_pole(arm, environment) >= 0:
        return np.full(2, -np.inf)
    driven = driving(trials, trial, trials.onset[trial])
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
