"""Figures of EMG: envelopes over a trial, and activity by condition."""

from typing import Any, Protocol

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy import ndimage

from armperturb.arrays import Array, ComplexArray
from armperturb.plots.style import GREY, PALETTE, colours_for, figure_for, in_style
from armperturb.recording import Action

JOINTS = {"s": "shoulder", "se": "both joints", "e": "elbow", "": "other muscles"}

ROW = 1.5
"""Height of a panel [inch]."""


class EnvelopesLike(Protocol):
    """What is drawn of `analysis.emg.envelope.Envelopes`."""

    @property
    def muscles(self) -> dict[str, Action]:
        """What each channel's muscle does."""
        ...

    @property
    def labels(self) -> pd.DataFrame:
        """Of the trials."""
        ...

    @property
    def rate(self) -> float:
        """Of the envelopes [Hz]."""
        ...

    @property
    def power(self) -> Array:
        """(trial, time, muscle)."""
        ...

    @property
    def unit(self) -> str:
        """Of amplitudes."""
        ...

    def amplitude_of(self, power: Array) -> Array:
        """Amplitude of power."""
        ...


@in_style()
def plot_envelopes(envelopes: EnvelopesLike, figure: Figure | None, trial: int, smoothing: float) -> Any:
    """Amplitude of every muscle over a trial, those that move the same joints together.

    Args:
      envelopes: to draw.
      figure: where to draw; its height is set. None makes a new one of pyplot.
      trial: which one.
      smoothing: time over which power is averaged [s].

    Returns:
      Axes, (panel,).

    Raises:
      ValueError: there is no such trial.
    """
    n = len(envelopes.power)
    if not 0 <= trial < n:
        raise ValueError(f"plot: trial = {trial}; expected 0 to {n - 1}")
    groups = {
        word: [name for name, action in envelopes.muscles.items() if action.joints == joints]
        for joints, word in JOINTS.items()
    }
    groups = {word: names for word, names in groups.items() if names}
    width = max(round(smoothing * envelopes.rate), 1)
    power = ndimage.uniform_filter1d(envelopes.power[trial], width, axis=0)
    amplitude = 100.0 * envelopes.amplitude_of(power)
    # A smooth course needs no more points than these.
    amplitude = amplitude[:: (every := max(width // 4, 1))]
    time, names = every * np.arange(len(amplitude)) / envelopes.rate, list(envelopes.muscles)
    figure = figure_for(figure, 0.6 + ROW * len(groups))
    axes = figure.subplots(len(groups), 1, squeeze=False, sharex=True)[:, 0]
    for ax, (word, members) in zip(axes, groups.items(), strict=True):
        for name, colour in zip(members, (PALETTE * 2)[: len(members)], strict=False):
            sign = -1.0 if envelopes.muscles[name].sign < 0 else 1.0
            ax.plot(time, sign * amplitude[:, names.index(name)], color=colour, linewidth=0.7, label=_words(name))
        ax.axhline(0.0, color=GREY, linewidth=0.6)
        onset = float(envelopes.labels["pulse_onset"].iloc[trial])
        if np.isfinite(onset):
            ax.axvline(onset, color=GREY, linewidth=0.8, linestyle=":")
        ax.set_title(f"{word}: flexors up, extensors down", loc="left")
        ax.set_ylabel("[%]")
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=6.5)
    axes[-1].set_xlabel("time [s]")
    labels = envelopes.labels.iloc[trial]
    title = f"{labels['subject']}, {labels['condition']}, trial {labels.name}: amplitude in {envelopes.unit}"
    figure.suptitle(title, fontsize=9, parse_math=False)
    return axes


class OnsetsLike(Protocol):
    """What is drawn of `analysis.emg.onset.Onsets`."""

    @property
    def unit(self) -> str:
        """Of amplitudes."""
        ...

    @property
    def latencies(self) -> pd.DataFrame:
        """One row per muscle and direction."""
        ...

    @property
    def time(self) -> Array:
        """From the pulses' onset [s], (time,)."""
        ...

    @property
    def directions_deg(self) -> Array:
        """Of the pulses [deg], (direction,)."""
        ...

    @property
    def average(self) -> Array:
        """(direction, muscle, time)."""
        ...

    @property
    def average_error(self) -> Array:
        """Likewise."""
        ...


@in_style()
def plot_onsets(onsets: OnsetsLike, figure: Figure | None) -> Any:
    """Averages of all muscles about pulses with their 95 % intervals over trials, and latencies of those that answer.

    Args:
      onsets: to draw.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (muscle, direction).
    """
    muscles, directions = list(dict.fromkeys(onsets.latencies["muscle"])), onsets.directions_deg
    figure = figure_for(figure, 0.8 + 0.75 * len(muscles))
    axes = figure.subplots(len(muscles), len(directions), squeeze=False, sharex=True, sharey="row")
    rows = onsets.latencies.set_index(["direction_deg", "muscle"])
    for column, direction in enumerate(directions):
        for row, name in enumerate(muscles):
            ax, mean = axes[row, column], 100.0 * onsets.average[column, row]
            half = 196.0 * onsets.average_error[column, row]
            ax.fill_between(1e3 * onsets.time, mean - half, mean + half, color=PALETTE[0], alpha=0.25, linewidth=0)
            ax.plot(1e3 * onsets.time, mean, color=PALETTE[0], linewidth=0.9)
            ax.axvline(0.0, color=GREY, linewidth=0.6)
            answer = rows.loc[(direction, name)]
            if np.isfinite(answer["latency_s"]):
                ax.axvspan(1e3 * answer["lower_95_s"], 1e3 * answer["upper_95_s"], color=PALETTE[1], alpha=0.35)
                ax.axvline(1e3 * answer["latency_s"], color=PALETTE[1], linewidth=1.0)
            if column == 0:
                ax.set_ylabel(_words(name).replace(" ", "\n", 1), fontsize=6.5, rotation=0, ha="right", va="center")
        axes[0, column].set_title(f"pulses at {direction:g} deg", loc="left")
        axes[-1, column].set_xlabel("time from the pulse [ms]")
    for of_muscle in axes:
        of_muscle[0].set_ylim(bottom=0.0)  # shared, and only once everything is drawn
    figure.suptitle(f"amplitude in {onsets.unit}; latency of the stretch reflex with its 95 % interval", fontsize=9)
    return axes


@in_style()
def plot_activity(levels: pd.DataFrame, cocontraction: pd.DataFrame, unit: str, figure: Figure | None) -> Any:
    """Amplitude of each muscle, and index of co-contraction of each joint, by condition.

    Args:
      levels: as `analysis.emg.activity.Activity.levels`.
      cocontraction: as `analysis.emg.activity.Activity.cocontraction`.
      unit: of amplitudes.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (panel,); one panel without an index.
    """
    places = list(dict.fromkeys(zip(levels["condition"], levels["part"], strict=True)))
    x = np.arange(len(places))
    parts = [(f"mean amplitude in {unit}", levels, "muscle", "amplitude")]
    if len(cocontraction):
        parts.append(("index of co-contraction", cocontraction, "joint", "index"))
    figure = figure_for(figure, 0.9 + len(parts) * ROW)
    axes = figure.subplots(len(parts), 1, sharex=True, squeeze=False)[:, 0]
    for ax, (title, frame, key, value) in zip(axes, parts, strict=True):
        ax.set_title(title, loc="left")
        keys = list(dict.fromkeys(frame[key]))
        for number, (name, colour) in enumerate(zip(keys, colours_for(len(keys)), strict=True)):
            of_name = frame[frame[key] == name].set_index(["condition", "part"])[value]
            y = [100.0 * of_name.get(place, np.nan) for place in places]
            shift = 0.5 * ((number + 0.5) / len(keys) - 0.5)
            ax.plot(x + shift, y, "o", color=colour, markersize=3.5, label=_words(name))
        ax.set_ylim(bottom=0.0)
        ax.set_ylabel("[%]")
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=6.5)
    axes[-1].set_xticks(x, [f"{condition}\n{part}" for condition, part in places])
    return axes


class ReflexesLike(Protocol):
    """What is drawn of `analysis.emg.reflex.Reflexes`."""

    @property
    def condition(self) -> str:
        """Where it was measured."""
        ...

    @property
    def subject(self) -> str:
        """Of whom."""
        ...

    @property
    def responses(self) -> pd.DataFrame:
        """One row per muscle."""
        ...

    @property
    def frequency(self) -> Array:
        """[Hz], (band,)."""
        ...

    @property
    def response(self) -> ComplexArray:
        """(muscle, joint, band)."""
        ...

    @property
    def response_error(self) -> Array:
        """(muscle, joint, band)."""
        ...

    @property
    def coherence(self) -> Array:
        """(muscle, band)."""
        ...


@in_style()
def plot_reflexes(reflexes: ReflexesLike, figure: Figure | None) -> Any:
    """Modulus with 95 % limits, phase and coherence of responses from rotation to EMG, where it is above its error.

    Args:
      reflexes: to draw.
      figure: where to draw; its height is set. None makes a new one of pyplot.

    Returns:
      Axes, (3, joint).
    """
    names, f = list(reflexes.responses["muscle"]), reflexes.frequency
    figure = figure_for(figure, 0.9 + 3 * ROW)
    axes = figure.subplots(3, 2, sharex=True, squeeze=False)
    for joint, word in enumerate(("shoulder", "elbow")):
        for row, (name, colour) in enumerate(zip(names, (PALETTE * 4)[: len(names)], strict=False)):
            modulus, error = np.abs(reflexes.response[row, joint]), 1.96 * reflexes.response_error[row, joint]
            line = {"color": colour, "linewidth": 0.9, "linestyle": "-" if row < len(PALETTE) else "--"}
            known = np.where(modulus > 1.7 * error, 1.0, np.nan)  # by chance once in a thousand; else it is anything
            axes[0, joint].plot(f, known * modulus, label=_words(name), **line)
            axes[0, joint].fill_between(
                f, known * (modulus - error), known * (modulus + error), color=colour, alpha=0.12, linewidth=0
            )
            phase = np.degrees(np.angle(reflexes.response[row, joint]))
            axes[1, joint].plot(f, known * phase, ".", color=colour, markersize=3)
            axes[2, joint].plot(f, reflexes.coherence[row], **line)
        # Limits may reach down to zero, and there may be no response at all.
        size = np.abs(reflexes.response[:, joint])
        seen = size[size > 1.7 * 1.96 * reflexes.response_error[:, joint]]
        axes[0, joint].set_ylim(*((seen.min() / 3.0, seen.max() * 3.0) if len(seen) else (0.1, 10.0)))
        axes[0, joint].set_yscale("log")
        axes[0, joint].set_title(f"from rotation of the {word}", loc="left")
        axes[2, joint].set_ylim(0.0, 1.0)
        axes[2, joint].set_xlabel("frequency [Hz]")
    for ax, label in zip(axes[:, 0], ("modulus [1/rad]", "phase [deg]", "coherence"), strict=True):
        ax.set_ylabel(label)
    axes[0, 1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=6.5)
    figure.suptitle(f"{reflexes.subject}, {reflexes.condition}: EMG", fontsize=9, parse_math=False)
    return axes


def _words(name: str) -> str:
    return str(name).replace("_", " ")
