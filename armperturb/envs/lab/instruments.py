"""What the laboratory's instruments do to the signals on their way into the recording (thesis 2.3).

The recorder samples far below the rate at which forces change, so an analog low-pass stands before it. The admittances
are ratios of recorded signals and stay what they are only if perturbation, force and position pass the same filter:
what it does to one it does to all. Then each instrument adds its own error:

- the strain gauges' amplifier adds noise, which is set as it is found in the record;
- the encoders are digital: what is recorded is a count, so position is rounded last, at the instants of sampling, and
  every recorded position is one of those that two whole counts can give. (Position holds nothing above the filter that
  could alias, as inertia divides by the square of frequency; the filter in front of the counter stands for the delay
  that keeps the counts in step with the force.)
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from scipy import signal

from armperturb.arrays import Array
from armperturb.envs.lab.emg import Emg
from armperturb.validation import require_number, require_ranges

ANTIALIAS_ORDER = 4
"""Order of the Butterworth low-pass in front of the recorder."""


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Recorder, strain gauges, joint encoders of a two-link manipulator, camera and EMG.

    Attributes:
      antialias: cut-off of the fourth-order Butterworth low-pass in front of the recorder [Hz], > 0 and below half the
        recording's rate; None takes samples as they come.
      force_noise: standard deviation of the strain gauge's white noise, per sample and axis [N], >= 0.
      encoder_bits: resolution of the two angular encoders [bits per turn].
      link_lengths: of the manipulator, shoulder to elbow and elbow to handle [m].
      base: position of the manipulator's shoulder from the start of the handle, x and y [m].
      marker_noise: standard deviation of the person's shoulder in the top-view movies, per sample and axis [m], >= 0;
        None for no movies.
      emg: amplifier of the muscles' signals; None records no EMG.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is out of its range, or the start of the handle is out of the links' reach.
    """

    antialias: float | None = 80.0
    force_noise: float = 0.02
    encoder_bits: int = 17
    link_lengths: tuple[float, float] = (0.60, 0.60)
    base: tuple[float, float] = (0.0, 0.65)
    marker_noise: float | None = 1e-3
    emg: Emg | None = field(default_factory=Emg)

    def __post_init__(self) -> None:
        require_ranges("Instruments", self)
        for name, least in (("link_lengths", 0.0), ("base", -np.inf)):
            values = getattr(self, name)
            if len(values) != 2:
                raise ValueError(f"Instruments: {name} = {values!r}; expected two numbers")
            for value in values:
                require_number("Instruments", name, value, above=least)
        if not abs(self.link_lengths[0] - self.link_lengths[1]) < np.hypot(*self.base) < sum(self.link_lengths):
            raise ValueError(f"Instruments: base = {self.base}; expected the handle's start within reach of the links")
        if self.emg is not None and not isinstance(self.emg, Emg):
            raise TypeError(f"Instruments: emg = {self.emg!r}; expected Emg or None")

    def lowpass(self, timestep: float, rate: float) -> Array | None:
        """The filter in front of the recorder as second-order sections at the simulation's rate; None if there is none.

        Args:
          timestep: of the simulation [s].
          rate: of the recording [Hz].

        Raises:
          ValueError: the cut-off is not below half the recording's rate.
        """
        if self.antialias is None:
            return None
        require_number("Instruments", "antialias", self.antialias, above=0.0, below=rate / 2.0)
        return _antialias(self.antialias, timestep).copy()  # the caller's own

    def read_marker(self, position: Array, rng: np.random.Generator) -> Array:
        """Shoulder marker in the movies [m] of a position, (..., axis)."""
        return position + (self.marker_noise or 0.0) * rng.standard_normal(position.shape)

    def read_force(self, force: Array, rng: np.random.Generator) -> Array:
        """Strain gauge reading [N] of a force, (..., axis)."""
        return force + self.force_noise * rng.standard_normal(force.shape)

    def read_displacement(self, displacement: Array) -> Array:
        """Handle displacement as the quantised joint angles give it [m], (..., axis).

        A position out of the links' reach reads as the nearest one within.
        """
        step = 2 * np.pi / 2**self.encoder_bits
        first, second = self._joint_angles(displacement)
        first, second = np.round(first / step) * step, np.round(second / step) * step
        near, far = self.link_lengths
        x = near * np.cos(first) + far * np.cos(first + second)
        y = near * np.sin(first) + far * np.sin(first + second)
        return np.stack([x + self.base[0], y + self.base[1]], axis=-1)

    def _joint_angles(self, displacement: Array) -> tuple[Array, Array]:
        x, y = displacement[..., 0] - self.base[0], displacement[..., 1] - self.base[1]
        near, far = self.link_lengths
        cosine = (x**2 + y**2 - near**2 - far**2) / (2 * near * far)
        second = np.arccos(np.clip(cosine, -1.0, 1.0))
        first = np.arctan2(y, x) - np.arctan2(far * np.sin(second), near + far * np.cos(second))
        return first, second


@lru_cache(maxsize=8)
def _antialias(cutoff: float, timestep: float) -> Array:
    """Second-order sections, which all trials of an experiment share."""
    return np.asarray(signal.butter(ANTIALIAS_ORDER, cutoff, fs=1.0 / timestep, output="sos"))
