"""No perturbation: trials at rest, and of contractions that EMG refers to."""

from dataclasses import dataclass

import numpy as np

from armperturb.perturbations.perturbation import sample_times
from armperturb.validation import require_number


@dataclass(frozen=True, kw_only=True)
class Rest:
    """No force at all.

    Attributes:
      duration: of the trial [s], > 0.

    Raises:
      TypeError: duration is not a number.
      ValueError: duration is not finite or not positive.
    """

    duration: float

    def __post_init__(self) -> None:
        require_number("Rest", "duration", self.duration, above=0.0)

    @property
    def highest_frequency(self) -> float:
        """Nothing is above 0 Hz."""
        return 0.0

    def sample(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Zero [N], (n_samples, axis); see `Perturbation.sample`."""
        return np.zeros((len(sample_times(rate, n_samples, start)), 2))
