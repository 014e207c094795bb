"""The transient perturbation: a half-sine force pulse (thesis 2.4, figs 2.3, 2.4)."""

import math
from dataclasses import dataclass

import numpy as np

from armperturb.perturbations.perturbation import sample_times
from armperturb.seeds import generator_of
from armperturb.validation import require_number, require_ranges


@dataclass(frozen=True, kw_only=True)
class Pulse:
    """Half a sine wave in one direction.

    Attributes:
      peak: largest force [N], > 0.
      direction_deg: direction from the fronto-parallel (x) axis, counter-clockwise from above [deg]; thesis: 20, 200.
      onset: time at which it starts [s].
      duration: duration of the trial that it is part of [s]; the whole pulse lies inside.
      width: duration of the pulse itself [s], > 0.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is not finite or out of its range, or the pulse does not fit into the trial.
    """

    peak: float
    direction_deg: float
    onset: float
    duration: float
    width: float = 0.08

    def __post_init__(self) -> None:
        require_ranges("Pulse", self)
        latest = self.duration - self.width
        if latest < 0.0:
            raise ValueError(f"Pulse: width = {self.width:g} s; expected at most the duration, {self.duration:g} s")
        # The slack is rounding: a pulse that ends with the trial fits.
        if not 0.0 <= self.onset <= latest + 1e-9 * self.duration:
            raise ValueError(f"Pulse: onset = {self.onset:g} s; expected between 0 and {latest:g} s")

    @property
    def direction(self) -> np.ndarray:
        """Unit vector of the force [-], (axis,)."""
        angle = math.radians(self.direction_deg)
        return np.array([math.cos(angle), math.sin(angle)])

    @property
    def highest_frequency(self) -> float:
        """End of the spectrum's main lobe [Hz], which holds 99.5 % of a half-sine's energy."""
        return 1.5 / self.width

    def sample(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Force [N] at the times start + k / rate, zero outside the pulse, (n_samples, axis)."""
        since_onset = sample_times(rate, n_samples, start) - self.onset
        inside = (since_onset >= 0.0) & (since_onset < self.width)
        force = np.zeros((n_samples, 2))
        force[inside] = self.peak * np.sin(np.pi / self.width * since_onset[inside, np.newaxis]) * self.direction
        return force


def draw_onset(seed: int | np.random.Generator, low: float = 5.0, high: float = 20.0) -> float:
    """A random onset for a pulse alone [s], uniform between `low` and `high` [s] (thesis 2.4).

    Raises:
      TypeError: a bound is not a number, or seed neither a whole number nor a generator.
      ValueError: a bound is not finite or negative, or high lies below low.
    """
    require_number("draw_onset", "low", low, at_least=0.0)
    require_number("draw_onset", "high", high, at_least=low)
    return float(generator_of("draw_onset", seed).uniform(low, high))
