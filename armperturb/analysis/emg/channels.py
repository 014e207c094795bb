"""What is wrong with channels of EMG: dead, clipped, spikes, movement artefacts, hum, cross-talk, or no raw EMG."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from armperturb.analysis.plateaus import runs
from armperturb.arrays import Array

DEAD = 0.5
"""Time for which a channel that does not change at all is dead [s]."""

SPIKE_WINDOW, SPIKE = 40, 0.6
"""Samples of a window, and share of its power in one of them from which on that is a spike [-]: of normal noise, it is
beyond that once in 10^11 windows."""

ENDS = 5
"""Windows at the ends of a trial in which no spikes are looked for, as the filter answers to the ends themselves."""

MOST_SPIKES = 5
"""Spikes that are named of a channel in a trial."""

MOVED = 10.0
"""Power below the band over that in it from which on a trial has a movement artefact [-]."""

JUMP, ABOUT, JUMPED = 0.01, 100, 0.4
"""Time over which a channel is averaged [s], how many such times are about a change, and the share of the squares of
changes there from which on one is a jump [-]: a step has half of them, EMG a twentieth."""

HUM_WIDTH, HUM = 4.0, 3e-7
"""Half width of the neighbourhood of a mains line [Hz], and the chance with which the periodogram of noise has as much
power at a frequency, relative to the mean there, as counts as hum [-]."""

MAINS_DRIFT = 0.2
"""By how much the mains frequency may be off; a multiple, by as many times that [Hz]."""

FOLLOWED = MAINS_DRIFT / 9.0
"""The same once a multiple is known: time alone limits how well it is, and the mains may drift within a recording."""

NOTCH = 0.75
"""Half width of the notch at a line of hum [Hz]."""

LEVELS = (0.005, 0.1, 0.5, 0.9)
"""Shares of a trial's samples whose limits tell its distribution."""

SKEW, FLOOR = 1.4, 1.6
"""How far the upper of these is from the median over how far that above the lowest is, and how far the lowest is over
the same [-]: 1.8 and 1.2 of rectified noise, 1.0 and 2.0 of EMG and of any offset. Artefacts to one side have no floor,
drifts no skew, so that EMG is rectified where both hold in every trial."""

LAG, LONGER, SMOOTH = 2e-3, 10, 0.2
"""A time [s], how many of them make another, and the mean square of the change in the one over that in the other below
which a channel is an envelope [-]: at most 0.13 where a mean over time was taken, 0.5 or more of EMG, and 0.39 or more
of hum."""

CROSSTALK = 0.15
"""Correlation of two whitened channels from which on cross-talk is reported [-]: independent muscles have 0."""


class ChannelFault(NamedTuple):
    """Something wrong with a channel.

    Attributes:
      muscle: name of the channel.
      trial: number in the recording, from 0.
      kind: "dead", "clipped", "spike" or "movement artefact".
      start: when it begins [s].
      end: when it ends [s].
    """

    muscle: str
    trial: int
    kind: str
    start: float
    end: float

    def __str__(self) -> str:
        when = (
            f"at {self.start:.3f} s" if self.end - self.start < 0.01 else f"from {self.start:.2f} to {self.end:.2f} s"
        )
        return f"EMG of {self.muscle} in trial {self.trial}: {self.kind} {when}"


class Crosstalk(NamedTuple):
    """Two channels that share a signal.

    Attributes:
      muscles: the two.
      correlation: of their whitened signals [-].
    """

    muscles: tuple[str, str]
    correlation: float

    def __str__(self) -> str:
        first, second = self.muscles
        return (
            f"EMG of {first} and {second} correlates (r = {self.correlation:.2f}): cross-talk of up to "
            f"{100.0 * abs(self.correlation):.0f} % of the amplitude"
        )


def faults_of_channel(
    volts: NDArray[np.float32],
    white: NDArray[np.float32],
    low_power: float,
    drift_power: float,
    rate: float,
    trial: int,
    name: str,
) -> list[ChannelFault]:
    """What is wrong with a channel of a trial.

    Args:
      volts: as recorded [V], (time,). Three samples in a row at the largest or least value are clipped.
      white: within the band, whitened, (time,).
      low_power: power below the band, less that of drifts, over that in it.
      drift_power: that of drifts, over the same: it is an artefact only where the signal jumps.
      rate: of the samples [Hz].
      trial: its number.
      name: of the muscle.
    """
    faults = []

    def add(kind: str, start: float, end: float) -> None:
        faults.append(ChannelFault(name, trial, kind, float(start) / rate, float(end) / rate))

    top, bottom = volts.max(), volts.min()
    still = np.flatnonzero(volts[1:] == volts[:-1])
    if len(still) >= DEAD * rate:
        spans = [(start, end) for start, end in runs(volts[1:] == volts[:-1]) if end - start >= DEAD * rate]
        for start, end in spans:
            add("dead", start, end + 1)
        if spans:
            return faults
    at_limit = still[(volts[still] == top) | (volts[still] == bottom)]
    in_a_row = np.flatnonzero(np.diff(at_limit) == 1)
    if len(in_a_row) and (_is_clipped(volts) or _is_clipped(-volts)):
        add("clipped", at_limit[in_a_row[0]], at_limit[in_a_row[-1]] + 2)
    for at in [at for at in _peaks(white) if _stands_out(volts, at)][:MOST_SPIKES]:
        add("spike", at, at + 1)
    moved = [int(np.argmax(np.abs(volts - volts.mean())))] if low_power > MOVED else []
    if not moved and low_power + drift_power > MOVED:
        moved = _jumps(volts, rate)[:MOST_SPIKES]
    for at in moved:
        add("movement artefact", max(at - rate / 2, 0), min(at + rate / 2, len(volts)))
    return faults


def _peaks(white: NDArray[np.float32]) -> list[int]:
    """Samples of a whitened channel, (time,), that have most of the power about them."""
    n_windows = len(white) // SPIKE_WINDOW
    windows = white[: n_windows * SPIKE_WINDOW].reshape(n_windows, SPIKE_WINDOW)
    total = np.einsum("ws,ws->w", windows, windows)
    largest = np.maximum(windows.max(axis=1), -windows.min(axis=1)) ** 2
    # And over the last window but one and the next but one, as a contraction may begin or end with any sample.
    around = np.maximum.reduce([np.roll(total, shift) for shift in (-2, 0, 2)])
    inside = largest[ENDS:-ENDS] > SPIKE * np.maximum(around[ENDS:-ENDS], 1e-30)
    places = ENDS + np.flatnonzero(inside)
    return [int(place * SPIKE_WINDOW + np.argmax(np.abs(windows[place]))) for place in places]


def _stands_out(volts: NDArray[np.float32], at: int) -> bool:
    """Whether a sample of a channel is off both that before and that after it, as no begin of a contraction is."""
    bend = np.diff(volts[max(at - SPIKE_WINDOW // 2, 0) : at + SPIKE_WINDOW // 2].astype(float), 2) ** 2
    return bool(bend.max() > SPIKE * bend.sum())


def _jumps(volts: NDArray[np.float32], rate: float) -> list[int]:
    """Samples about which a channel, (time,), changes by more within some milliseconds than in the second about it."""
    n = max(round(JUMP * rate), 1)
    means = volts[: len(volts) // n * n].reshape(-1, n).mean(axis=1, dtype=float)
    changes = (means[2:] - means[:-2]) ** 2
    if not len(changes):
        return []
    about = ndimage.uniform_filter1d(changes, min(ABOUT, len(changes)), mode="nearest") * min(ABOUT, len(changes))
    is_largest = changes == ndimage.maximum_filter1d(changes, ABOUT)
    return [int((at + 1.5) * n) for at in np.flatnonzero(is_largest & (changes > JUMPED * np.maximum(about, 1e-30)))]


def _is_clipped(volts: NDArray[np.float32]) -> bool:
    """Whether the largest value is more frequent than the next: of a coarse converter it is less so."""
    is_less = volts < volts.max()
    if not is_less.any():
        return False
    next_to_it = volts[is_less].max()
    return bool(np.count_nonzero(~is_less) > np.count_nonzero(volts == next_to_it))


def require_raw(volts: NDArray[np.float32], rate: float, names: Sequence[str]) -> None:
    """Refuse channels that are rectified, or envelopes: they pass for noise that is white, or for movement artefacts.

    Args:
      volts: as recorded [V], (trial, time, muscle).
      rate: of the samples [Hz].
      names: of the muscles.

    Raises:
      ValueError: there are such channels.
    """
    wrong = [name for column, name in enumerate(names) if _is_processed(volts[..., column], rate)]
    if wrong:
        raise ValueError(
            f"EMG is not used: that of {', '.join(wrong)} is rectified or an envelope, to judge by its distribution "
            "and its smoothness; expected voltages as amplified (signals.emg.channels of the sidecar)"
        )


def _is_processed(channel: NDArray[np.float32], rate: float) -> bool:
    """Whether a channel, (trial, time), is rectified or an envelope."""
    lag = max(round(LAG * rate), 1)
    if channel.shape[1] <= LONGER * lag:
        return False
    lowest, low, middle, high = np.quantile(channel[:, :: 2 * lag], LEVELS, axis=1)
    spread = middle - low
    alive = spread > 0.0
    if not alive.any():
        return False
    is_rectified = (high - middle > SKEW * spread) & (middle - lowest < FLOOR * spread)
    short, long = (np.array([_change(of_trial, each) for of_trial in channel[alive]]) for each in (lag, LONGER * lag))
    return bool(is_rectified[alive].all() or (short < SMOOTH * long).all())


def _change(values: NDArray[np.float32], lag: int) -> float:
    """Mean square of what a signal changes by in so many samples."""
    return float(np.mean(np.square(values[lag:] - values[:-lag]), dtype=float))


def hum_lines(power: NDArray[Any], frequency: Array, mains: Sequence[float]) -> list[float]:
    """Frequencies at which a channel hums [Hz].

    Args:
      power: periodogram of a channel, mean over trials, (frequency,).
      frequency: evenly spaced [Hz], (frequency,).
      mains: frequencies of the mains that are looked for, with their multiples [Hz].
    """
    lines, step = [], frequency[1] - frequency[0]
    for fundamental in mains:
        unit, drift = fundamental, MAINS_DRIFT
        for number in range(1, int((frequency[-1] - HUM_WIDTH) / fundamental) + 1):
            line, most = number * unit, min(number * drift, HUM_WIDTH / 2.0)
            first, last = np.searchsorted(frequency, [line - HUM_WIDTH, line + HUM_WIDTH])
            here, there = frequency[first:last], power[first:last]
            near = np.abs(here - line) <= most
            beside = there[~near]
            if not near.any() or not len(beside):
                continue
            if there[near].max() > len(beside) * (HUM ** (-1.0 / len(beside)) - 1.0) * beside.mean():
                lines.append(float(here[near][np.argmax(there[near])]))
                unit, drift = lines[-1] / number, max(FOLLOWED, step / number)  # of which the others are multiples
    return sorted({*lines})


def correlation(white: NDArray[np.float32]) -> Array:
    """Of the channels of a trial, (muscle, time), with one another, (muscle, muscle); zero of what does not change."""
    size = np.linalg.norm(white, axis=1)
    scaled = white / np.maximum(size, np.finfo(np.float32).tiny)[:, None]
    return np.asarray(scaled @ scaled.T, dtype=float)


def crosstalk_of(correlation: Array, names: Sequence[str]) -> tuple[Crosstalk, ...]:
    """Pairs of channels that share a signal, the strongest first.

    Args:
      correlation: of the whitened channels, (muscle, muscle).
      names: of the muscles.
    """
    pairs = [
        Crosstalk((names[i], names[j]), float(correlation[i, j]))
        for i, j in itertools.combinations(range(len(names)), 2)
        if abs(correlation[i, j]) > CROSSTALK
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair.correlation)))


def said_of(faults: Sequence[ChannelFault]) -> tuple[str, ...]:
    """One line per muscle and kind of fault, with the first time and how often."""
    by_kind: dict[tuple[str, str], list[ChannelFault]] = {}
    for fault in faults:
        by_kind.setdefault((fault.muscle, fault.kind), []).append(fault)
    lines = []
    for those in by_kind.values():
        more = f" (and {len(those) - 1} more)" if len(those) > 1 else ""
        lines.append(f"{those[0]}{more}")
    return tuple(lines)
