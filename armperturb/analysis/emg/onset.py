"""When muscles answer a pulse: latency of their stretch reflex, and averages triggered by the pulses.

A pulse sets the arm in motion slowly, so that a response has no sharp onset, and what a threshold finds is late by a
time that depends on its strength. So the onset is sought by likelihood: about each pulse, the amplitude of a muscle is

    a(t) = max(0, b_i + s_i r(c . z(t - T))),    r(y) = y for y > 0, u y for y < 0,

with a background b_i and a size s_i of the response of each trial i, and gains c >= 0 of what stretches the muscle.
Shortening either takes from the background as much as stretch adds, down to silence (u = 1), or nothing (u = 0),
whichever is most likely. Here z holds the rotations of both joints from where they were held, their velocities and the
sum of these (muscles that cross both), the velocities v as v / (1 + |v| / v_0). The speed v_0 at which responses have
fallen to half is one of `SATURATIONS`, whichever is most likely. The rotation is measured, so that nothing is assumed
of when it starts; sizes are of trials, as people do not answer alike each time, nor in each condition.
The power of whitened EMG in an interval is gamma distributed about a^2 + noise with as many degrees of freedom as
there are independent samples in it (Staude & Wolf 1999, Med. Eng. Phys. 21, compare onset detectors and find those by
likelihood best). The latency T has the largest profile likelihood, and its 95 % interval is that of the profile
likelihood, over the dispersion that the power shows. It is that of a stretch reflex: a muscle that the pulse shortens
at first has none, even if it falls silent.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.matching import rows_of
from armperturb.analysis.emg.onset_fit import LATENCIES, N_GAINS, Fits, MusclePower, Stretch
from armperturb.analysis.emg.reference import mean_known
from armperturb.analysis.emg.rotation import rotation
from armperturb.analysis.results import Description, Result, Table
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, Indices
from armperturb.subject import Subject
from armperturb.validation import as_list_of, require_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WINDOW = (-0.1, 0.1)
"""Time about a pulse's onset that is fitted [s]."""

SHOWN = (-0.1, 0.3)
"""Time about a pulse's onset of which averages are kept [s]."""

COARSE = 5
"""Every so many of the latencies are tried at first."""

ROUGH, CONVERGED = 0.2, 0.02
"""How near deviances have to be to the least one where the latency is looked for, and for its interval [-]."""

OVERLAP = 2.0
"""Samples of the power that share any moment: neighbours are averages over half the same time."""

SIGNIFICANT = 1e-6
"""Level of the test whether a muscle answers at all [-]: of tens of tests, each at the best of tens of latencies."""

EARLIEST = 0.05 + float(LATENCIES[-1]) - WINDOW[0]
"""Time of a trial from which on a pulse is used: what comes before its window tells the posture [s]."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Onsets(Result):
    """Responses of muscles to pulses.

    Attributes:
      subject: the person.
      conditions: of the trials.
      unit: of amplitudes.
      latencies: one row per muscle and direction of the pulses: number of `trials`; `latency_s` from rotation to EMG
        with its 95 % limits `lower_95_s` and `upper_95_s`, NaN where the muscle does not answer clearly or the pulse
        shortens it at first; `p` of no response.
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
        none = (
            f"no muscle that pulses stretch answers clearly (p < {SIGNIFICANT:g}) with a latency whose interval is "
            f"within {1e3 * LATENCIES[0]:g} to {1e3 * LATENCIES[-1]:g} ms"
        )
        return Description(
            title=f"Answers of the muscles of {self.subject} to pulses in {', '.join(self.conditions)}",
            facts=(f"amplitudes in {self.unit}", *(() if rows else (none,))),
            table=Table(("muscle", "direction [deg]", "trials", "latency [ms] (95 %)", "p"), rows),
        )

    def to_frame(self) -> pd.DataFrame:
        """`latencies`, and conditions, with + between, and subject as the last columns."""
        return self.latencies.assign(condition="+".join(self.conditions), subject=self.subject)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw the averages of all muscles about the pulses, with latencies.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, (muscle, direction).
        """
        from armperturb.plots.muscles import plot_onsets

        return plot_onsets(self, figure)


def onsets(
    trials: Sequence[ConditionTrials], envelopes: Envelopes, arms: Mapping[str, Subject] | None = None
) -> Onsets:
    """Latencies of the answers to pulses, the trials of several conditions together.

    Args:
      trials: of one person, of conditions that are analysed together.
      envelopes: of all the person's trials.
      arms: condition to the arm whose grip gives, see `reflexes`; None for rigid ones.

    Raises:
      TypeError: trials are no `ConditionTrials`, or envelopes no `Envelopes`.
      ValueError: no trial has a pulse at `EARLIEST` or later, the envelopes hold other trials of a condition, or
        neither joint angles nor the posture are known.
    """
    require_type("onsets: envelopes", envelopes, Envelopes, "those of armperturb.envelopes")
    expected = "trials of conditions, of ConditionTrials.prepare"
    trials = as_list_of("onsets: trials", "onsets: trials of a condition", trials, ConditionTrials, expected)
    rate, names = envelopes.rate, list(envelopes.muscles)
    power, moved, starts, directions, per_second = [], [], [], [], []
    latest = -math.inf
    for part in trials:
        turned = rotation(part, (arms or {}).get(part.label))
        for place, row in enumerate(rows_of(part, envelopes)):
            row_labels = envelopes.labels.iloc[row]
            onset = float(row_labels["pulse_onset"])
            latest = max(latest, onset)  # of no pulse, a NaN, the first stays
            if not onset >= EARLIEST:
                continue
            power.append(envelopes.power[row])
            per_second.append(envelopes.samples_per_second[row])
            # Reflexes act about the posture that is held.
            moved.append(turned[place] - turned[place, : max(round(onset * rate), 1)].mean(axis=0))
            starts.append(onset)
            directions.append(float(row_labels["pulse_direction"]))
    if not power:
        which = ", ".join(part.label for part in trials)
        if math.isfinite(latest):
            raise ValueError(
                f"onsets: the latest pulse of {which} comes after {latest:.3g} s; expected some after {EARLIEST:.3g} s "
                "or more"
            )
        raise ValueError(f"onsets: no trial of {which} has a pulse; expected some (labels.pulse_onset of the sidecar)")
    of_direction = np.unique(directions)
    table, averages, errors = [], [], []
    for direction in of_direction:
        chosen = [k for k, each in enumerate(directions) if each == direction]
        shown = np.stack([_about(power[k], starts[k], rate, SHOWN)[0] for k in chosen])
        amplitude = envelopes.amplitude_of(shown)  # (trial, time, muscle)
        averages.append(mean_known(amplitude).T)
        spread = amplitude.std(axis=0, ddof=1) if len(chosen) > 1 else np.full(amplitude.shape[1:], np.nan)
        errors.append(spread.T / np.sqrt(len(chosen)))
        cut = [_about(power[k], starts[k], rate, WINDOW) for k in chosen]
        after = np.arange(round(-WINDOW[0] * rate), cut[0][0].shape[0])
        stretch = Stretch([moved[k] for k in chosen], [time for _, time in cut], rate, envelopes.averaging)
        for column, name in enumerate(names):
            seen = np.stack([values[:, column] for values, _ in cut])
            weight = float(np.mean([per_second[k][column] for k in chosen]) * envelopes.averaging / OVERLAP)
            sign = -envelopes.muscles[name].sign
            answer = _latency(seen, stretch, sign, float(envelopes.noise[column]), weight, after)
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
      power: of the muscle.
      stretch: of the same trials.
      sign: 1 for muscles that positive rotation stretches, -1 for others.
    """

    def __init__(self, power: MusclePower, stretch: Stretch, sign: int) -> None:
        self._power, self._stretch, self._sign = power, stretch, sign
        self._found = dict[int, Fits]()
        self._missed = np.full(len(LATENCIES), np.inf)

    def __call__(self, latencies: Indices, converged: float) -> Array:
        """Least deviance at some of `LATENCIES`, (latency,), up to about `converged`."""
        new = latencies[self._missed[latencies] > converged]
        if len(new):
            inputs, tried = self._stretch(new, self._sign), np.array(sorted(self._found))
            starts = [self._near(tried, new + shift) for shift in (-COARSE // 2, 0, COARSE // 2)] if len(tried) else []
            fits = self._power.fit(inputs, starts, converged)
            for k, place in enumerate(new.tolist()):
                self._found[place] = fits.of(np.arange(k, len(fits.deviance), len(new)))
            self._missed[new] = converged
        return np.array([self._found[place].deviance.min() for place in latencies.tolist()])

    def is_stretched(self, place: int, after: Indices) -> bool:
        """Whether a muscle that answers at one of `LATENCIES` has seen more stretch after the pulse than before."""
        fits, inputs = self._found[place], self._stretch(np.array([place]), self._sign)
        best = fits.deviance.argsort()[:1]
        seen = fits.of(best).stretch(inputs[best])[0].mean(axis=0)
        return float(seen[after].mean()) > float(np.delete(seen, after).mean())

    def _near(self, tried: Indices, places: Indices) -> Fits:
        """What was found nearest to some latencies."""
        nearest = [self._found[int(tried[np.argmin(np.abs(tried - place))])] for place in places]
        return Fits(*(np.stack(each, axis=1).reshape(-1, *each[0].shape[1:]) for each in zip(*nearest, strict=True)))


def _latency(
    seen: Array, stretch: Stretch, sign: int, noise: float, weight: float, after: Indices
) -> tuple[float, float, float, float]:
    """Latency, its limits and p of no response, of the power of one muscle, (trial, time); after: samples that are."""
    if not np.nansum(seen) > 0.0:
        return math.nan, math.nan, math.nan, 1.0
    power, last = MusclePower(seen, noise, weight), len(LATENCIES) - 1
    profile, still = _Profile(power, stretch, sign), power.still()
    n_response = N_GAINS + len(seen) - 1
    dof = max(power.known.sum() / OVERLAP - len(seen) - n_response, 1.0)

    def tested(least: float) -> tuple[float, float]:
        dispersion = max(1.0, weight * least / dof)
        return float(stats.chi2.sf((still - least) * weight / dispersion, n_response)), dispersion

    every = np.arange(0, last + 1, COARSE)
    deviances = profile(every, ROUGH)
    p, _ = tested(deviances.min())
    if p > SIGNIFICANT:
        return math.nan, math.nan, math.nan, p
    best = int(every[np.argmin(deviances)])
    low, high = max(best - COARSE, 0), min(best + COARSE, last)
    while True:
        deviances = profile(np.arange(low, high + 1), CONVERGED)
        p, dispersion = tested(deviances.min())
        limit = deviances.min() + stats.f.ppf(0.95, 1, dof) * dispersion / weight
        if deviances[0] < limit and low > 0:
            low = max(low - COARSE, 0)
        elif deviances[-1] < limit and high < last:
            high = min(high + COARSE, last)
        else:
            break
    chosen = low + int(np.argmin(deviances))
    if deviances[0] < limit or deviances[-1] < limit or not profile.is_stretched(chosen, after):
        return math.nan, math.nan, math.nan, p
    at, inside = LATENCIES[low : high + 1], np.flatnonzero(deviances < limit)
    lower, upper = (
        float(np.interp(limit, deviances[[within, beyond]], at[[within, beyond]]))
        for within, beyond in ((inside[0], inside[0] - 1), (inside[-1], inside[-1] + 1))
    )
    return float(at[np.argmin(deviances)]), lower, upper, p
