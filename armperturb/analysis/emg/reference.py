"""Means of the power of EMG over time, and what amplitudes are relative to."""

import warnings

import numpy as np
import pandas as pd
from scipy import ndimage

from armperturb.arrays import Array

MAXIMAL_WINDOW, PLATEAU = 1.0, 0.8
"""Time over which a maximal contraction is averaged [s], and power over its largest with which it counts [-]."""

BURST, BRIEF, STEP = 10.0, 0.25, 0.02
"""Power over its median within a brief time from which on it is an artefact [-], that time [s], and time over which
power is averaged before [s]: no contraction is as short."""


def mean_known(power: Array) -> Array:
    """Mean along the first axis of what is known; NaN where nothing is, as of a dead channel."""
    with warnings.catch_warnings(action="ignore"):
        return np.asarray(np.nanmean(power, axis=0))


def means_of_trials(power: Array, ends: Array, first: int) -> Array:
    """Mean of each trial from a sample to its end, without what is dead, (trial, muscle)."""
    return np.stack([mean_known(each[first : max(int(end), first + 1)]) for each, end in zip(power, ends, strict=True)])


def reference_power(power: Array, labels: pd.DataFrame, maximal: str, rate: float) -> tuple[str, Array]:
    """What amplitudes are relative to, and its power [V^2], (muscle,).

    Args:
      power: of the filtered EMG [V^2], (trial, time, muscle); NaN where a channel is dead.
      labels: condition and onset of the pulse [sample] of each trial.
      maximal: name of the condition of maximal contractions.
      rate: of the power [Hz].
    """
    is_maximal = (labels["condition"] == maximal).to_numpy()
    if is_maximal.any():
        window = max(round(MAXIMAL_WINDOW * rate), 1)
        of_maximal = power[is_maximal]
        is_dead = np.isnan(of_maximal)
        known = np.where(is_dead, 0.0, of_maximal)
        known = _without_bursts(known, rate)
        summed, dead = (np.cumsum(each, axis=1) for each in (known, is_dead))
        if summed.shape[1] > window:
            means, lost = (each[:, window:] - each[:, :-window] for each in (summed, dead))
            means = np.where(lost == 0, means / window, -1.0).reshape(-1, power.shape[2])
            # Not the largest, which is that of the noise as well.
            near = np.where((means >= PLATEAU * means.max(axis=0)) & (means >= 0.0), means, np.nan)
            with warnings.catch_warnings(action="ignore"):
                return "maximal contraction", np.nanmedian(near, axis=0)
    means = means_of_trials(power, labels["onset"].to_numpy(), 0)
    by_condition = pd.DataFrame(means).groupby(labels["condition"].to_numpy(), sort=False).mean()
    shares = by_condition / by_condition.max().clip(lower=np.finfo(float).tiny)
    loudest = str(shares.mean(axis=1).idxmax())
    return loudest, by_condition.loc[loudest].fillna(0.0).to_numpy(dtype=float)


def _without_bursts(power: Array, rate: float) -> Array:
    """Power (trial, time, muscle) in which no brief artefact is more than `BURST` times what is about it."""
    n_step = max(round(STEP * rate), 1)
    n_steps = power.shape[1] // n_step
    if n_steps < 2:
        return power
    steps = power[:, : n_steps * n_step].reshape(len(power), n_steps, n_step, -1).mean(axis=2)
    largest = BURST * ndimage.median_filter(steps, (1, round(BRIEF / STEP), 1), mode="nearest")
    left = np.minimum(steps, largest) / np.maximum(steps, np.finfo(float).tiny)
    share = np.repeat(left, n_step, axis=1)
    return power * np.pad(share, ((0, 0), (0, power.shape[1] - share.shape[1]), (0, 0)), mode="edge")
