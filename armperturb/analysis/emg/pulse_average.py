"""Averages of the amplitude of EMG about the onset of pulses."""

import math
from collections.abc import Iterable

import numpy as np
import pandas as pd

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.reference import mean_known

BACKGROUND, SHORT, LONG = (-0.1, 0.0), (0.02, 0.05), (0.05, 0.1)
"""Windows about the onset of a pulse: before it, of short and of long latency [s]."""


def pulse_averages(envelopes: Envelopes, rows: Iterable[int]) -> pd.DataFrame:
    """Amplitude about the onset of pulses, by muscle and direction: `Reflexes.averages`.

    Trials in which a channel is dead there are none of its muscle's.

    Args:
      envelopes: of a person.
      rows: which trials.
    """
    labels, rate = envelopes.labels.iloc[list(rows)], envelopes.rate
    with_pulse = labels[np.isfinite(labels["pulse_onset"])]
    table = []
    for direction, of_direction in with_pulse.groupby("pulse_direction", sort=True):
        levels = []
        for trial, row in of_direction.iterrows():
            onset = row["pulse_onset"]
            windows = []
            for start, end in (BACKGROUND, SHORT, LONG):
                a, b = (round((onset + t) * rate) for t in (start, end))
                windows.append(envelopes.amplitude_of(envelopes.power[trial, max(a, 0) : b].mean(axis=0)))
            levels.append(windows)
        of_all = np.array(levels)  # (trial, window, muscle)
        of_all = np.where(np.isnan(of_all).any(axis=1, keepdims=True), math.nan, of_all)
        n = np.isfinite(of_all[:, 0]).sum(axis=0)
        above = of_all[:, 1:] - of_all[:, :1]
        mean, background = mean_known(above), mean_known(of_all[:, 0])
        squares = mean_known((above - mean) ** 2) * n
        error = np.sqrt(squares / np.where(n > 1, n - 1.0, math.nan) / np.maximum(n, 1))
        for column, name in enumerate(envelopes.muscles):
            (short, long), (short_error, long_error) = mean[:, column], error[:, column]
            table.append((name, direction, n[column], background[column], short, short_error, long, long_error))
    columns = ["muscle", "direction_deg", "trials", "background", "short", "short_error", "long", "long_error"]
    return pd.DataFrame(table, columns=columns)
