"""Movement and torque of a recording of one axis, in the band in which a joint is identified.

All signals are low-passed at `TOP`, derivatives are those of the low-passed angle. Records are continued by their
mirror image, so that their ends do not leak; what is left of the ends is kept out of every fit.
"""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import fft

from armperturb.arrays import Array
from armperturb.recording import check_recording

TOP = 60.0
"""Frequency up to which a joint is identified [Hz]; above, the torque of most recordings is noise."""

RATE = 200.0
"""Least sampling rate that a faster recording is reduced to [Hz]."""

SETTLE = 1.0
"""What is left out at the start of a record [s]: reflexes answer to what was before it."""

EDGE = 0.1
"""What is left out at its end [s], which the filters spoil."""

NEXT = 1.5
"""Frequency up to which a movement that goes on beyond the band is looked for, over the highest of the band [-]: well
above, it drowns in the noise of the sensor."""

LEAST_RATE = 50.0
"""Sampling rate that a recording must have [Hz]."""

SHORTEST = 4.0
"""Shortest record of an identification [s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointSignals:
    """Band-limited signals of trials of one axis.

    Attributes:
      angle: [rad, or m], from its mean over the trials, (trial, time).
      velocity: its derivative.
      acceleration: its second derivative.
      torque: that the device exerts on the limb [Nm, or N], (trial, time).
      perturbation: of a force servo, (trial, time); None without.
      scheduling: slow imposed movement, (trial, time); None without.
      rate: [Hz].
      top: highest frequency [Hz].
      servo: "force" or "position".
      beyond: power of the velocity from `top` to `NEXT` times that, over its power below [-].
      settle: what is left out at the start of each trial [s].
      numbers: of the trials in what was recorded, see `cuts.inside_limit`; from 0 where none were left out.
    """

    angle: Array
    velocity: Array
    acceleration: Array
    torque: Array
    perturbation: Array | None
    scheduling: Array | None
    rate: float
    top: float
    servo: str
    beyond: float
    numbers: tuple[int, ...]
    settle: float = SETTLE

    @property
    def used(self) -> slice:
        """Samples that count."""
        return slice(round(self.settle * self.rate), self.angle.shape[1] - round(EDGE * self.rate))

    @property
    def velocity_scale(self) -> float:
        """RMS velocity [rad/s, or m/s]."""
        return float(np.sqrt(np.mean(self.velocity**2)))

    @property
    def angle_scale(self) -> float:
        """RMS angle from its mean [rad, or m]."""
        return float(np.sqrt(np.mean(self.angle**2)))


def joint_signals(
    recording: xr.Dataset,
    *,
    reference: float | None = None,
    settle: float = SETTLE,
    shortest: float = SHORTEST,
    top: float = TOP,
) -> JointSignals:
    """Band-limited signals of a recording of one axis.

    Args:
      recording: the trials.
      reference: angle from which angles count [rad, or m]; None for their mean.
      settle: what is left out at the start of each trial [s].
      shortest: record that is taken [s].
      top: highest frequency that is kept [Hz].

    Raises:
      ValueError: the recording is refused, not of one axis, too short, or sampled too slowly.
    """
    check_recording(recording)
    if recording.sizes["axis"] != 1:
        raise ValueError(f"recording: axes = {recording.sizes['axis']}; expected one axis, of a joint (model joint)")
    rate, n = float(recording.attrs["rate"]), recording.sizes["time"]
    if n / rate < shortest:
        raise ValueError(f"recording: duration = {n / rate:.3g} s; expected at least {shortest:g} s")
    if rate < LEAST_RATE:
        raise ValueError(f"recording: rate = {rate:g} Hz; expected at least {LEAST_RATE:g} Hz")
    step = max(int(rate / (RATE * top / TOP)), 1)
    top = min(top, 0.3 * rate)
    s = 2j * np.pi * fft.rfftfreq(2 * n, 1.0 / rate)
    keep = 0.5 - 0.5 * np.cos(np.pi * np.clip((1.15 * top - np.abs(s) / (2 * np.pi)) / (0.3 * top), 0.0, 1.0))

    def beyond(values: Array) -> float:
        spectrum = fft.rfft(np.concatenate([values, values[:, ::-1]], axis=1), axis=1) * s
        power, height = np.sum(np.abs(spectrum) ** 2, axis=0), np.abs(s) / (2 * np.pi * top)
        below = max(float(power[height <= 1.0].sum()), np.finfo(float).tiny)
        return float(power[(height > 1.0) & (height <= NEXT)].sum()) / below

    def limited(values: Array, power: int = 0) -> Array:
        mirrored = np.concatenate([values, values[:, ::-1]], axis=1)
        spectrum = fft.rfft(mirrored, axis=1) * (keep * s**power)
        return np.asarray(fft.irfft(spectrum, 2 * n, axis=1)[:, :n:step])

    x, f = (np.asarray(recording[name].values[..., 0], dtype=float) for name in ("displacement", "force"))
    x = x - (x.mean() if reference is None else reference)
    others = {
        name: limited(np.asarray(recording[name].values[..., 0], dtype=float)) if name in recording.data_vars else None
        for name in ("perturbation", "scheduling")
    }
    return JointSignals(
        angle=limited(x),
        velocity=limited(x, 1),
        acceleration=limited(x, 2),
        torque=limited(f),
        perturbation=others["perturbation"],
        scheduling=others["scheduling"],
        rate=rate / step,
        top=top,
        servo=str(recording.attrs["servo"]),
        beyond=beyond(x),
        settle=settle,
        numbers=tuple(recording["trial"].values.tolist()),
    )


def mean_angle(recording: xr.Dataset) -> float:
    """Mean angle of all trials, from which angles count [rad, or m]."""
    return float(recording["displacement"].values.mean())


def time_blocks(n: int, count: int) -> list[NDArray[np.int64]]:
    """Samples in consecutive blocks of about equal length."""
    return np.array_split(np.arange(n), count)
