"""When muscles answer a pulse: latency of their stretch reflex, and averages triggered by the pulses.

A pulse sets the arm in motion slowly, so that a response has no sharp onset, and what a threshold finds is late by a
time that depends on its strength. So the onset is sought by likelihood: about each pulse, the amplitude of a muscle is

    a(t) = b + max(0, c . z(t - T)),

with a background b of each trial and gains c >= 0, common to the trials of a condition and direction, of what stretches
the muscle: z holds the rotations of both joints, their velocities and the sum of these (muscles that cross both), the
velocities v as v / (1 + |v| / v_0). The speed v_0 at which responses have fallen to half is one of `SATURATIONS`,
whichever is most likely. The rotation is measured, so that nothing is assumed of when it starts.
The power of whitened EMG in an interval is gamma distributed about a^2 + noise with as many degrees of freedom as
there are independent samples in it (Staude & Wolf 1999, Med. Eng. Phys. 21, compare onset detectors and find those by
likelihood best). The latency T has the largest profile likelihood, and its 95 % interval holds what is within 3.84 of
it, over the dispersion that the amplitudes show.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.onset_fit import Fits, Trials, stretch_inputs
from armperturb.analysis.emg.reflex import rotation
from armperturb.analysis.results import Description, Result, Table
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, Indices

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINDOW = (-0.1, 0.1)
"""Time about a pulse's onset that is fitted [s]."""

SHOWN = (-0.1, 0.3)
"""Time about a pulse's onset of which averages are kept [s]."""

LATENCIES = 0.01 + 1e-3 * np.arange(71)
"""Latencies that are looked for [s]."""

COARSE = 5
"""How many of these are passed over at first."""

OVERLAP = 2.0
"""Samples of the power that share any moment: neighbours are averages over half the same time."""

SIGNIFICANT = 1e-6
"""Level of the test whether a muscle answers at all [-]: of tens of tests, each at the best of tens of latencies."""

LEAST_POWER = 1e-4
"""Share of the mean power below which the model's power does not fall [-]."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Onsets(Result):
    """Responses of muscles to pulses.

    Attributes:
      subject: the person.
      conditions: of the trials.
      unit: of amplitudes.
      latencies: one row per muscle and direction of the pulses: number of `trials`; `latency_s` from rotation to EMG
        with its 95 % limits `lower_95_s` and `upper_95_s`, NaN where the muscle does not answer clearly; `p` of no
        response.
      time: from the pulses' onset [s], (time,).
      directions_deg: of the pulses [deg], (direction,).
      average: mean amplitude over trials [-], (direction, muscle, time).
      average_error: standard error of that, (direction, muscle, time); NaN of one trial.
    """

    subject: str
    conditions: tuple[str, ...]
    unit: str
    latencies: pd.DataFrame
    time: Array
    directions_deg: Array
    average: Array
    average_error: Array

    def describe(self) -> Description:
        """Latency of each muscle that answers, by direction."""
        rows = tuple(
            (
                str(row["muscle"]),
                f"{row['direction_deg']:g}",
                str(row["trials"]),
                f"{1e3 * row['latency_s']:.1f} ({1e3 * row['lower_95_s']:.1f} to {1e3 * row['upper_95_s']:.1f})",
                f"{row['p']:.2g}",
            )
            for row in self.latencies.to_dict("records")
            if np.isfinite(row["latency_s"])
        )
        return Description(
            title=f"Answers of the muscles of {self.subject} to pulses in {', '.join(self.conditions)}",
            facts=(f"amplitudes in {self.unit}",),
            table=Table(("muscle", "direction [deg]", "trials", "latency [ms] (95 %)", "p"), rows),
        )

    def to_frame(self) -> pd.DataFrame:
        """`latencies`."""
        return self.latencies

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the averages of all muscles about the pulses, with latencies.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (muscle, direction).
        """
        from armperturb.plots.muscles import plot_onsets

        return plot_onsets(self, figure)


def onsets(trials: Sequence[ConditionTrials], envelopes: Envelopes) -> Onsets:
    """Latencies of the answers to pulses, the trials of several conditions together.

    Args:
      trials: of one person, of conditions that are analysed together.
      envelopes: of all the person's trials.

    Raises:
      ValueError: no trial has a pulse, or neither joint angles nor the posture are known.
    """
    rate, names = envelopes.rate, list(envelopes.muscles)
    power, moved, starts, directions, labels = [], [], [], [], []
    for part in trials:
        rows = np.flatnonzero((envelopes.labels["condition"] == part.label).to_numpy())
        turned = rotation(part)
        for place, row in enumerate(rows):
            row_labels = envelopes.labels.iloc[row]
            onset = float(row_labels["pulse_onset"])
            if not np.isfinite(onset) or onset + WINDOW[0] - LATENCIES[-1] < 0.05:
                continue
            power.append(envelopes.power[row])
            # Reflexes act about the posture that is held.
            moved.append(turned[place] - turned[place, : max(round(onset * rate), 1)].mean(axis=0))
            starts.append(onset)
            directions.append(float(row_labels["pulse_direction"]))
            labels.append(part.label)
    if not power:
        raise ValueError(
            f"onsets: no trial of {', '.join(part.label for part in trials)} has a pulse; expected some "
            "(labels.pulse_onset of the sidecar)"
        )
    of_direction = np.unique(directions)
    table, averages, errors = [], [], []
    for direction in of_direction:
        chosen = [k for k, each in enumerate(directions) if each == direction]
        shown = np.stack([_about(power[k], starts[k], rate, SHOWN)[0] for k in chosen])
        amplitude = envelopes.amplitude_of(shown)  # (trial, time, muscle)
        averages.append(np.nanmean(amplitude, axis=0).T)
        spread = amplitude.std(axis=0, ddof=1) if len(chosen) > 1 else np.full(amplitude.shape[1:], np.nan)
        errors.append(spread.T / np.sqrt(len(chosen)))
        cut = [_about(power[k], starts[k], rate, WINDOW) for k in chosen]
        inputs = stretch_inputs(
            [moved[k] for k in chosen], [time for _, time in cut], LATENCIES, rate, envelopes.averaging
        )
        its = np.array([labels[k] for k in chosen])
        groups = [np.flatnonzero(its == label) for label in dict.fromkeys(its)]
        for column, name in enumerate(names):
            seen = np.stack([values[:, column] for values, _ in cut])
            weight = envelopes.samples_per_second[column] * envelopes.averaging / OVERLAP
            sign = envelopes.muscles[name].sign
            answer = _latency(seen, -sign * inputs, float(envelopes.noise[column]), float(weight))
            table.append((name, float(direction), len(chosen), *answer))
    n_shown = averages[0].shape[1]
    columns = ["muscle", "direction_deg", "trials", "latency_s", "lower_95_s", "upper_95_s", "p"]
    return Onsets(
        subject=trials[0].name,
        conditions=tuple(part.label for part in trials),
        unit=envelopes.unit,
        latencies=pd.DataFrame(table, columns=columns),
        time=SHOWN[0] + np.arange(n_shown) / rate,
        directions_deg=of_direction,
        average=np.stack(averages),
        average_error=np.stack(errors),
    )


def _about(values: Array, onset: float, rate: float, window: tuple[float, float]) -> tuple[Array, Array]:
    """Samples about an onset [s], (time, muscle), as many as there are, and their times [s], (time,)."""
    first, n = round((onset + window[0]) * rate), round((window[1] - window[0]) * rate)
    index = first + np.arange(n)
    inside = np.clip(index, 0, len(values) - 1)
    return np.where((index == inside)[:, None], values[inside], np.nan), index / rate


class _Profile:
    """Least deviance at each latency of a muscle, found as it is asked for.

    Args:
      trials: power of the muscle.
      inputs: as of `stretch_inputs`, positive where the muscle is stretched.
    """

    def __init__(self, trials: Trials, inputs: Array) -> None:
        self._trials, self._inputs = trials, inputs
        shape, n_trials = inputs.shape[:2], inputs.shape[3]
        self._found = Fits(
            np.full(shape, np.inf),
            np.zeros((*shape, n_trials)),
            np.zeros((*shape, n_trials)),
            np.zeros((*shape, inputs.shape[-1])),
        )

    def __call__(self, latencies: Indices) -> Array:
        """Least deviance at some latencies, (latency,)."""
        tried = np.flatnonzero(np.isfinite(self._found.deviance[0]))
        new = np.setdiff1d(latencies, tried)
        if len(new):
            candidates = self._inputs[:, new].reshape(-1, *self._inputs.shape[2:])
            start = None
            if len(tried):
                near = tried[np.argmin(np.abs(new[:, None] - tried), axis=1)]
                start = Fits(*(each[:, near].reshape(-1, *each.shape[2:]) for each in self._found))
            for each, values in zip(self._found, self._trials.fit(candidates, start), strict=True):
                each[:, new] = values.reshape(-1, len(new), *values.shape[1:])
        return np.asarray(self._found.deviance[:, latencies].min(axis=0))


def _latency(power: Array, inputs: Array, noise: float, weight: float) -> tuple[float, float, float, float]:
    """Latency, its limits and p of no response, of the power of one muscle, (trial, time)."""
    silent = (np.nan,) * 3
    if not np.nansum(power) > 0.0:
        return (*silent, 1.0)
    trials = Trials(power, noise, LEAST_POWER * float(np.nanmean(power)))
    profile = _Profile(trials, inputs)
    n = len(LATENCIES)
    coarse = np.arange(0, n, COARSE)
    deviances = profile(coarse)
    best = int(coarse[np.argmin(deviances)])
    n_response = inputs.shape[-1] + len(power) - 1
    dof = max(trials.known.sum() / OVERLAP - len(power) - n_response, 1.0)
    dispersion = max(1.0, weight * deviances.min() / dof)
    p = float(stats.chi2.sf((trials.still() - deviances.min()) * weight / dispersion, n_response))
    if p > SIGNIFICANT:
        return (*silent, p)
    limit = stats.chi2.ppf(0.95, 1) * dispersion / weight
    first, last = max(best - COARSE, 0), min(best + COARSE, n - 1)
    while True:
        deviances = profile(np.arange(first, last + 1))
        beyond = deviances > deviances.min() + limit
        if not beyond[0] and first > 0:
            first = max(first - COARSE, 0)
        elif not beyond[-1] and last < n - 1:
            last = min(last + COARSE, n - 1)
        else:
            break
    if not beyond[0] or not beyond[-1]:
        return (*silent, p)
    at, inside = LATENCIES[first : last + 1], np.flatnonzero(~beyond)
    best = int(np.argmin(deviances))
    ends = [
        float(np.interp(deviances.min() + limit, deviances[[i, o]], at[[i, o]]))
        for i, o in ((inside[0], inside[0] - 1), (inside[-1], inside[-1] + 1))
    ]
    return float(at[best]), ends[0], ends[1], p
