"""What the laboratory's instruments do to the signals on their way into the recording (thesis 2.3)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armperturb.validation import require_number

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Instruments:
    """Strain gauge and joint encoders of a two-link manipulator.

    Attributes:
      force_noise: standard deviation of the strain gauge's white noise, per sample and axis [N], >= 0.
      encoder_bits: resolution of the two angular encoders [bits per turn].
      link_lengths: of the manipulator, shoulder to elbow and elbow to handle [m].
      base: position of the manipulator's shoulder from the start of the handle, x and y [m].

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is out of its range, or the start of the handle is out of the links' reach.
    """

    force_noise: float = 0.02
    encoder_bits: int = 17
    link_lengths: tuple[float, float] = (0.60, 0.60)
    base: tuple[float, float] = (0.0, 0.65)

    def __post_init__(self) -> None:
        require_number("Instruments", "force_noise", self.force_noise, at_least=0.0)
        require_number("Instruments", "encoder_bits", self.encoder_bits, at_least=1, at_most=32)
        for length in self.link_lengths:
            require_number("Instruments", "link_lengths", length, above=0.0)
        if not abs(self.link_lengths[0] - self.link_lengths[1]) < np.hypot(*self.base) < sum(self.link_lengths):
            raise ValueError(f"Instruments: base = {self.base}; expected the handle's start within reach of the links")

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
