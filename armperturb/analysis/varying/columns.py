"""Regressors of the parallel cascade of one joint whose parameters change, filtered alike with the torque.

The torque of the device on the limb is

    f = I q'' + B(z) q' + K(z) q + T(z) + h * [g(z) phi(q')](t - T_d),

where z is time in an ensemble of repetitions or a scheduling variable such as a slow imposed angle; phi is linear or
half-wave rectified, h the second-order activation with a gain of one. B, K, g and the static torque T are sums of
B-splines of z. A product of a spline and a signal is made first and filtered afterwards, as the torque is, so that
jumps of a parameter are not blurred by the filters.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import fft
from scipy.interpolate import BSpline, CubicSpline

from armperturb.analysis.joint.model import Reflex, activated, drive_of
from armperturb.arrays import Array

TOP = 25.0
"""Frequencies above this are filtered out of torque and regressors before they are sampled more slowly [Hz]."""

PER_TOP = 4.0
"""Rate of what is fitted, over `TOP` [-]."""

DEGREE = 3
"""Of B-splines; fewer of them are of a lower degree, and a single one is a constant."""


class Cascade(NamedTuple):
    """What the regressors of the reflex depend on nonlinearly.

    Attributes:
      delay: [s].
      cutoff: of the activation [Hz].
      zeta: relative damping of the activation [-].
      threshold: velocity of stretch above which the reflex acts, if it is half-wave rectified [rad/s].
    """

    delay: float = 0.04
    cutoff: float = 5.0
    zeta: float = 0.8
    threshold: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Signals:
    """Trials prepared: what regressors are made of.

    Attributes:
      angle: [rad], (trial, time).
      velocity: [rad/s], (trial, time).
      acceleration: [rad/s^2], (trial, time).
      torque: of the device on the limb [Nm], (trial, time).
      variable: what parameters depend on, (trial, time).
      rate: of these [Hz].
      stride: samples of these in one of what is fitted.
      ensemble: whether `variable` is time, so that what repetitions have in common is left out.
    """

    angle: Array
    velocity: Array
    acceleration: Array
    torque: Array
    variable: Array
    rate: float
    stride: int
    ensemble: bool

    def prepared(self, values: Array) -> Array:
        """Signals as they are fitted: low-passed, sampled more slowly, without what repetitions have in common.

        Args:
          values: (column, trial, time).

        Returns:
          (column, trial, slow time).
        """
        n_time = values.shape[-1]
        length, keep = fft.next_fast_len(n_time + round(0.5 * self.rate), real=True), slice(0, n_time, self.stride)
        frequency = fft.rfftfreq(length, 1.0 / self.rate)
        gain = 1.0 / (1.0 + (frequency / TOP) ** 8)
        level = values[..., -1:]
        slow = fft.irfft(gain * fft.rfft(values - level, length), length)[..., keep] + level
        return slow - slow.mean(axis=1, keepdims=True) if self.ensemble else slow

    def activated(self, values: Array, cascade: Cascade) -> Array:
        """Delayed and filtered by the activation, from rest; (..., time)."""
        n_time = values.shape[-1]
        length = fft.next_fast_len(n_time + round(2.0 * self.rate), real=True)
        s = 2j * np.pi * fft.rfftfreq(length, 1.0 / self.rate)
        response = activated(s, cascade.delay, cascade.cutoff, cascade.zeta)
        return np.asarray(fft.irfft(response * fft.rfft(values, length), length)[..., :n_time])


def signals_of(recording: xr.Dataset, variable: str) -> Signals:
    """Signals of a recording of one axis on a position servo.

    Args:
      recording: the trials.
      variable: "time" or "scheduling".

    Raises:
      ValueError: the recording is of another kind, or lacks what the variable needs.
    """
    if recording.sizes["axis"] != 1 or recording.attrs.get("servo") != "position":
        raise ValueError(
            f"recording: servo = {recording.attrs.get('servo')!r} with {recording.sizes['axis']} axes; expected one "
            "axis and servo = 'position', as parameters that change are estimated in open loop"
        )
    rate = float(recording.attrs["rate"])
    if rate < PER_TOP * TOP:
        raise ValueError(f"recording: rate = {rate:g} Hz; expected at least {PER_TOP * TOP:g} Hz")
    ensemble = variable == "time"
    if ensemble and recording.sizes["trial"] < 4:
        raise ValueError(
            f"recording: {recording.sizes['trial']} trials; expected an ensemble of at least 4 repetitions (variable = "
            "'scheduling' takes one)"
        )
    if not ensemble and "scheduling" not in recording:
        raise ValueError("recording: no scheduling signal; expected one (signals.scheduling of the sidecar)")
    angle = recording["displacement"].values[..., 0]
    angle = angle - angle.mean(axis=1, keepdims=True)
    torque = recording["force"].values[..., 0]
    times = np.broadcast_to(recording["time"].values, angle.shape)
    if np.ptp(angle, axis=1).min() == 0.0:
        raise ValueError("recording: the angle of a trial is constant; expected a perturbation")
    velocity = CubicSpline(recording["time"].values, angle, axis=1)(recording["time"].values, 1)
    return Signals(
        angle=angle,
        velocity=velocity,
        acceleration=CubicSpline(recording["time"].values, velocity, axis=1)(recording["time"].values, 1),
        torque=torque - torque.mean(axis=1, keepdims=True),
        variable=times if ensemble else recording["scheduling"].values[..., 0],
        rate=rate,
        stride=max(1, round(rate / (PER_TOP * TOP))),
        ensemble=ensemble,
    )


def splines(variable: Array, n_basis: int, low: float, high: float) -> Array:
    """B-splines with evenly spaced knots that sum to one, (basis, ...); constant beyond the ends.

    Args:
      variable: where, any shape.
      n_basis: how many; one is a constant.
      low: where the first knot is.
      high: where the last one is.
    """
    degree = min(DEGREE, n_basis - 1)
    if not degree:
        return np.ones((1, *np.shape(variable)))
    inner = np.linspace(low, high, n_basis - degree + 1)
    knots = np.concatenate([np.full(degree, low), inner, np.full(degree, high)])
    values = BSpline.design_matrix(np.clip(variable, low, high).ravel(), knots, degree).toarray()
    return np.moveaxis(values.reshape(*np.shape(variable), n_basis), -1, 0)


def excitation(signals: Signals, reflex: Reflex, threshold: float) -> Array:
    """Velocity to which the reflex responds [rad/s], (trial, time); a threshold below zero excites none at rest."""
    at_rest = 0.0 if reflex == "linear" else min(threshold, 0.0)
    return drive_of(signals.velocity, reflex, threshold) + at_rest
