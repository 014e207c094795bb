"""Parallel-cascade model of a joint: an intrinsic path beside a reflex path (Kearney, Stein and Parameswaran 1997).

    torque = I a + B v + K (x - x_0) + K_s p(x; w) + R,   R = G h(v(t - d)) through w_n^2 / (s^2 + 2 z w_n s + w_n^2)

with angle x, velocity v and acceleration a. h is the static nonlinearity: none of it (linear), or the half-wave
max(v - c, 0) of one direction of stretch with a threshold c. Short-range stiffness K_s resists like Coulomb friction
behind a spring: the elastic torque p follows the angle within plus and minus w (play operator).

Derivatives by all parameters are exact but for that by w.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from armperturb.analysis.joint.signals import JointSignals
from armperturb.arrays import Array, ComplexArray

Reflex = Literal["none", "linear", "half-wave"]
REFLEXES: tuple[Reflex, ...] = ("none", "linear", "half-wave")

INTRINSIC = ("inertia", "damping", "stiffness")
SHORT_RANGE = ("short_range_stiffness", "short_range_limit")
DYNAMICS = ("reflex_delay", "reflex_frequency", "reflex_damping_ratio")
OF_REFLEX = ("reflex_gain", *DYNAMICS)
THRESHOLD = "reflex_threshold"

UNITS = {
    "inertia": ("kg m^2", "kg"),
    "damping": ("Nms/rad", "Ns/m"),
    "stiffness": ("Nm/rad", "N/m"),
    "short_range_stiffness": ("Nm/rad", "N/m"),
    "short_range_limit": ("rad", "m"),
    "reflex_gain": ("Nms/rad", "Ns/m"),
    "reflex_delay": ("s", "s"),
    "reflex_frequency": ("Hz", "Hz"),
    "reflex_damping_ratio": ("-", "-"),
    "reflex_threshold": ("rad/s", "m/s"),
}
"""Parameter to its unit, of a joint and of a single direction."""

LONGEST_DELAY = 0.2
"""Longest reflex delay that is tried by default [s]."""

MEMORY = 2.0
"""Length over which responses of the reflex path die away [s]."""


@dataclass(frozen=True, kw_only=True)
class JointStructure:
    """Which paths a joint has.

    Attributes:
      reflex: static nonlinearity of the reflex path, or that there is none.
      side: direction of stretch to which a half-wave reflex answers, +1 or -1.
      short_range: whether there is short-range stiffness.
    """

    reflex: Reflex = "half-wave"
    side: int = 1
    short_range: bool = False

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        reflex = () if self.reflex == "none" else OF_REFLEX
        threshold = (THRESHOLD,) if self.reflex == "half-wave" else ()
        return (*INTRINSIC, *(SHORT_RANGE if self.short_range else ()), *reflex, *threshold)

    @property
    def name(self) -> str:
        """In words."""
        reflex = {
            "none": "no reflex",
            "linear": "linear reflex",
            "half-wave": f"half-wave reflex to stretch in the {'positive' if self.side > 0 else 'negative'} direction",
        }[self.reflex]
        return f"intrinsic path, {'short-range stiffness, ' if self.short_range else ''}{reflex}"

    def bounds(self, signals: JointSignals, longest_delay: float = LONGEST_DELAY) -> tuple[Array, Array]:
        """Lower and upper bounds of the parameters, (parameter,) each."""
        v, x = signals.velocity_scale, signals.angle_scale
        limits = {
            "inertia": (0.0, np.inf),
            "damping": (-np.inf, np.inf),
            "stiffness": (-np.inf, np.inf),
            "short_range_stiffness": (0.0, np.inf),
            "short_range_limit": (0.02 * x, 3.0 * x),
            "reflex_gain": (-np.inf, np.inf),
            "reflex_delay": (0.005, longest_delay),
            "reflex_frequency": (0.3, 15.0),
            "reflex_damping_ratio": (0.2, 3.0),
            "reflex_threshold": (-1.5 * v, 3.0 * v),
        }
        pairs = np.array([limits[name] for name in self.parameters])
        return pairs[:, 0], pairs[:, 1]


class JointModel:
    """Torque of a joint for given movements, with its derivatives.

    Args:
      structure: which paths there are.
      signals: the movement.
    """

    def __init__(self, structure: JointStructure, signals: JointSignals) -> None:
        self.structure, self._signals = structure, signals
        self._path = ReflexPath(signals.angle.shape[1], signals.rate)

    def torque(self, values: ArrayLike) -> Array:
        """Torque without its offset, (trial, time)."""
        return np.asarray(sum(self.paths(values).values()))

    def paths(self, values: ArrayLike) -> dict[str, Array]:
        """Torque of the intrinsic and of the reflex path, (trial, time) each."""
        columns = self.derivatives(values)
        given = dict(zip(self.structure.parameters, np.asarray(values, dtype=float), strict=True))
        stiff = [name for name in (*INTRINSIC, "short_range_stiffness") if name in given]
        paths = {"intrinsic": np.sum([given[name] * columns[name] for name in stiff], axis=0)}
        if self.structure.reflex != "none":
            paths["reflex"] = given["reflex_gain"] * columns["reflex_gain"]
        return paths

    def derivatives(self, values: ArrayLike) -> dict[str, Array]:
        """Parameter to the derivative of the torque by it, (trial, time)."""
        signals, given = self._signals, dict(zip(self.structure.parameters, np.asarray(values, float), strict=True))
        columns = {"inertia": signals.acceleration, "damping": signals.velocity, "stiffness": signals.angle}
        if self.structure.short_range:
            width = given["short_range_limit"]
            play, wider = (play_operator(signals.angle, each) for each in (width, 1.02 * width))
            columns["short_range_stiffness"] = play
            columns["short_range_limit"] = given["short_range_stiffness"] * (wider - play) / (0.02 * width)
        if self.structure.reflex != "none":
            columns |= self._reflex(given)
        return {name: columns[name] for name in self.structure.parameters}

    def _reflex(self, given: dict[str, float]) -> dict[str, Array]:
        velocity, gain, dynamics = self._signals.velocity, given["reflex_gain"], [given[name] for name in DYNAMICS]
        drive = drive_of(velocity, self.structure.reflex, given.get(THRESHOLD, 0.0), self.structure.side)
        torque, slopes = self._path.derivatives(drive, *dynamics)
        columns = {"reflex_gain": torque} | {name: gain * slope for name, slope in slopes.items()}
        if self.structure.reflex == "half-wave":
            columns[THRESHOLD] = gain * self._path.torque(closing_of(drive, self.structure.side), *dynamics)
        return columns


class ReflexPath:
    """Delay and dynamics of a reflex, from rest, of signals over time.

    Args:
      n: samples of a trial.
      rate: of these [Hz].
    """

    def __init__(self, n: int, rate: float) -> None:
        self._n, self._n_padded = n, fft.next_fast_len(n + round(MEMORY * rate), real=True)
        self._s = 2j * np.pi * fft.rfftfreq(self._n_padded, 1.0 / rate)

    def torque(self, drive: Array, delay: float, frequency: float, damping_ratio: float) -> Array:
        """Torque of a reflex with a gain of one, (trial, time); arguments as of `activated`."""
        return self._back(fft.rfft(drive, self._n_padded, axis=1) * activated(self._s, delay, frequency, damping_ratio))

    def derivatives(
        self, drive: Array, delay: float, frequency: float, damping_ratio: float
    ) -> tuple[Array, dict[str, Array]]:
        """`torque`, and name of each of its other arguments to the derivative by it, (trial, time) each."""
        s, wn = self._s, 2 * np.pi * frequency
        denominator = s**2 + 2.0 * damping_ratio * wn * s + wn**2
        unit = fft.rfft(drive, self._n_padded, axis=1) * activated(s, delay, frequency, damping_ratio)
        by_wn = 2.0 / wn - (2.0 * damping_ratio * s + 2.0 * wn) / denominator
        factors = (-s, 2 * np.pi * by_wn, -2.0 * wn * s / denominator)
        return self._back(unit), {name: self._back(by * unit) for name, by in zip(DYNAMICS, factors, strict=True)}

    def _back(self, spectrum: ComplexArray) -> Array:
        return np.asarray(fft.irfft(spectrum, self._n_padded, axis=1)[:, : self._n])


def activated(s: ComplexArray, delay: float, frequency: float, damping_ratio: float) -> ComplexArray:
    """Frequency response from the drive of a reflex to its torque with a gain of one: delay and dynamics of muscle.

    Args:
      s: Laplace variable [rad/s].
      delay: [s].
      frequency: natural frequency of the dynamics [Hz].
      damping_ratio: of the dynamics [-].
    """
    wn = 2 * np.pi * frequency
    return np.asarray(wn**2 / (s**2 + 2.0 * damping_ratio * wn * s + wn**2) * np.exp(-s * delay))


def drive_of(velocity: Array, reflex: Reflex, threshold: float = 0.0, side: int = 1) -> Array:
    """What a reflex answers to [rad/s]: the velocity, or its half-wave above a threshold, as `velocity`."""
    return velocity if reflex == "linear" else np.asarray(side * np.maximum(side * velocity - threshold, 0.0))


def closing_of(drive: Array, side: int = 1) -> Array:
    """Derivative of what a half-wave lets through by its threshold [-], as `drive`."""
    return -side * (drive != 0.0).astype(float)


def play_operator(angle: Array, width: float) -> Array:
    """What follows an angle within plus and minus a width, and no further, (trial, time)."""
    out = np.empty_like(angle)
    for trial, values in enumerate(angle.tolist()):
        at, before = 0.0, values[0]
        place = []
        for value in values:
            at = min(max(at + value - before, -width), width)
            before = value
            place.append(at)
        out[trial] = place
    return out
