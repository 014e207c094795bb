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

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import interpolate, optimize, stats

from armperturb.analysis.emg.envelope import Envelopes
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

LATENCIES = (0.01, 0.08)
"""Least and largest latency that is looked for [s]."""

COARSE, FINE = 0.005, 0.001
"""Steps of the search [s]."""

SATURATIONS = (np.inf, 2.0, 1.0, 0.5)
"""Speeds at which the response to velocity may have fallen to half [rad/s]."""

PARTS = 3
"""Points within the averaging time of a sample at which the model is evaluated."""

OVERLAP = 2.0
"""Samples of the power that share any moment: neighbours are averages over half the same time."""

STEPS, CONVERGED = 30, 1e-2
"""Scoring steps at one latency, and fall of the deviance that ends them [-]."""

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
            if not np.isfinite(onset) or onset + WINDOW[0] - LATENCIES[1] < 0.05:
                continue
            power.append(envelopes.power[row])
            moved.append(turned[place])
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
        inputs = _Inputs([moved[k] for k in chosen], [time for _, time in cut], rate, envelopes.averaging)
        its = np.array([labels[k] for k in chosen])
        groups = [np.flatnonzero(its == label) for label in dict.fromkeys(its)]
        for column, name in enumerate(names):
            seen = np.stack([values[:, column] for values, _ in cut])
            weight = envelopes.samples_per_second[column] * envelopes.averaging / OVERLAP
            sign = envelopes.muscles[name].sign
            answer = _latency(seen, inputs.of(-sign), float(envelopes.noise[column]), float(weight), groups)
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


class _Inputs:
    """Rotations and velocities about the pulses of one direction, at any latency."""

    def __init__(self, moved: Sequence[Array], times: Sequence[Array], rate: float, averaging: float) -> None:
        within = averaging * ((np.arange(PARTS) + 0.5) / PARTS - 0.5)
        self._splines, self._times = [], []
        for turned, time in zip(moved, times, strict=True):
            margin = round(0.05 * rate)
            first = max(round((time[0] - LATENCIES[1]) * rate) - margin, 0)
            last = min(round(time[-1] * rate) + margin, len(turned))
            grid = np.arange(first, last) / rate
            spline = interpolate.CubicSpline(grid, turned[first:last] - turned[first:last].mean(axis=0))
            self._splines.append((spline, spline.derivative()))
            self._times.append(time[:, None] + within)
        self._kept: dict[tuple[float, float], Array] = {}

    def of(self, sign: int) -> Callable[[float, float], Array]:
        """The same, positive where muscles of a sign are stretched."""
        return lambda latency, saturation: sign * self(latency, saturation)

    def __call__(self, latency: float, saturation: float) -> Array:
        """Rotations [rad] and three velocities [rad/s] before a latency [s], (trial, time, part, 5)."""
        key = latency, saturation
        if key not in self._kept:
            parts = []
            for (turned, turning), time in zip(self._splines, self._times, strict=True):
                velocity = turning(time - latency)
                velocity = np.concatenate([velocity, velocity.sum(axis=-1, keepdims=True)], axis=-1)
                velocity = velocity / (1.0 + np.abs(velocity) / saturation)
                parts.append(np.concatenate([turned(time - latency), velocity], axis=-1))
            self._kept[key] = np.stack(parts)
        return self._kept[key]


def _latency(
    power: Array, inputs: Callable[[float, float], Array], noise: float, weight: float, groups: Sequence[Indices]
) -> tuple[float, float, float, float]:
    """Latency, its limits and p of no response, of the power of one muscle, (trial, time)."""
    known = np.isfinite(power)
    silent = (np.nan,) * 3
    if not known.any() or not np.nansum(power) > 0.0:
        return (*silent, 1.0)
    floor = LEAST_POWER * float(np.nanmean(power))
    mean = np.nanmean(power, axis=1, keepdims=True)
    still = float(np.sum(_deviance(power, np.maximum(mean, floor) + 0.0 * power)[known]))
    tried: dict[tuple[float, float], tuple[float, list[Array]]] = {}

    def deviance(latency: float, saturation: float) -> float:
        key = round(float(latency), 6), saturation
        if key not in tried:
            near = min(tried, key=lambda other: (other[1] != key[1], abs(other[0] - key[0])), default=None)
            starts = tried[near][1] if near else [None] * len(groups)
            every = inputs(*key)
            fits = [
                _fitted(power[group], known[group], every[group], noise, floor, start)
                for group, start in zip(groups, starts, strict=True)
            ]
            tried[key] = sum(cost for cost, _ in fits), [values for _, values in fits]
        return tried[key][0]

    def profile(latency: float) -> float:
        return min(deviance(latency, saturation) for saturation in SATURATIONS)

    def searched(grid: Array) -> float:
        return float(grid[int(np.argmin([profile(latency) for latency in grid]))])

    best = searched(np.arange(*LATENCIES, COARSE))
    dof = max(known.sum() / OVERLAP - len(power) - 5 * len(groups), 1.0)
    dispersion = max(1.0, weight * profile(best) / dof)
    p = float(stats.chi2.sf((still - profile(best)) * weight / dispersion, 5 * len(groups)))
    if p > SIGNIFICANT:
        return (*silent, p)
    best = searched(best + np.arange(-COARSE, COARSE, FINE))
    limit = stats.chi2.ppf(0.95, 1) * dispersion / weight

    def end(sign: int) -> float:
        at, below = best, best
        while LATENCIES[0] < at < LATENCIES[1] and profile(at) - profile(best) < limit:
            below, at = at, at + sign * COARSE / 2
        for _ in range(4):
            middle = (below + at) / 2.0
            below, at = (middle, at) if profile(middle) - profile(best) < limit else (below, middle)
        return (below + at) / 2.0

    lower, upper = end(-1), end(1)
    if lower <= LATENCIES[0] or upper >= LATENCIES[1]:
        return (*silent, p)
    return best, lower, upper, p


def _deviance(power: Array, model: Array) -> Array:
    """Of gamma variables about a model, per degree of freedom, (trial, time)."""
    ratio = np.maximum(power, 1e-12 * model) / model
    return np.asarray(ratio - 1.0 - np.log(ratio))


def _fitted(
    power: Array, known: Any, inputs: Array, noise: float, floor: float, start: Array | None
) -> tuple[float, Array]:
    """Least deviance over backgrounds and gains, and these, by Fisher scoring."""
    n_trials, n_inputs = len(power), inputs.shape[-1]
    scale = np.sqrt(np.mean(inputs**2, axis=(0, 1, 2))) + 1e-300
    scaled = inputs / scale
    if start is None:
        level = np.sqrt(np.maximum(np.nanmedian(power, axis=1) - noise, floor))
        start = np.append(level, np.zeros(n_inputs))
        # Gains from the response of the amplitude, by least squares.
        amplitude = np.sqrt(np.maximum(np.nan_to_num(power) - noise, 0.0)) - level[:, None]
        columns = scaled.mean(axis=2)[known]
        start[n_trials:] = optimize.nnls(columns, amplitude[known])[0]
        start = np.append(start[:n_trials], start[n_trials:] / scale)
    values = np.append(start[:n_trials], start[n_trials:] * scale)

    def modelled(values: Array) -> tuple[Array, Array, Array]:
        driven = scaled @ values[n_trials:]
        acts = driven > 0.0
        amplitude = np.maximum(values[:n_trials], 0.0)[:, None, None] + np.where(acts, driven, 0.0)
        return np.maximum(np.mean(amplitude**2, axis=2) + noise, floor), amplitude, acts

    def total(model: Array) -> float:
        return float(np.sum(_deviance(np.where(known, power, model), model)))

    model, amplitude, acts = modelled(values)
    cost, damping = total(model), 1e-3
    for _ in range(STEPS):
        by_level = 2.0 * amplitude.mean(axis=2)
        by_gain = 2.0 * np.mean((amplitude * acts)[..., None] * scaled, axis=2)
        design = np.zeros((*power.shape, len(values)))
        for trial in range(n_trials):
            design[trial, :, trial] = by_level[trial]
        design[..., n_trials:] = by_gain
        rows = (design / model[..., None])[known]
        residual = (np.where(known, power, model) / model - 1.0)[known]
        gram = rows.T @ rows
        while True:
            ridge = damping * np.diag(gram) + 1e-9 * np.trace(gram)
            # Gains that are zero and would fall stay where they are.
            free = np.ones(len(values), dtype=bool)
            free[n_trials:] = (values[n_trials:] > 0.0) | ((rows.T @ residual)[n_trials:] > 0.0)
            within = np.ix_(free, free)
            after = values.copy()
            after[free] += np.linalg.solve((gram + np.diag(ridge))[within], (rows.T @ residual)[free])
            after[n_trials:] = np.maximum(after[n_trials:], 0.0)
            model, amplitude, acts = modelled(after)
            lower = total(model)
            if lower <= cost or damping > 1e6:
                break
            damping *= 10.0
        if damping > 1e6:
            break
        fall, values, cost, damping = cost - lower, after, lower, damping / 10.0
        if fall < CONVERGED:
            break
    return cost, np.append(values[:n_trials], values[n_trials:] / scale)
