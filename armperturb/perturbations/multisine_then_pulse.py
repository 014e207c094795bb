"""A multisine directly followed by a pulse (thesis 2.4, fig. 2.5)."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from armperturb.perturbations.multisine import Multisine
from armperturb.perturbations.perturbation import sample_times
from armperturb.perturbations.pulse import Pulse
from armperturb.validation import require_number, require_type


@dataclass(frozen=True, kw_only=True)
class MultisineThenPulse:
    """A multisine that fades to zero as the pulse starts on top of it.

    The multisine runs from time 0 at full strength until the pulse's onset, periodically extended if that is later
    than its own duration, and goes on under the pulse while half a cosine takes it to zero over `fade`.

    Attributes:
      multisine: the continuous part.
      pulse: the transient part; its onset ends the multisine and its duration is the trial's.
      fade: time from the pulse's onset until the multisine is gone [s], > 0, inside the trial.

    Raises:
      TypeError: multisine is no `Multisine`, pulse no `Pulse`, or fade no number.
      ValueError: fade is out of its range.
    """

    multisine: Multisine
    pulse: Pulse
    fade: float = 0.04

    def __post_init__(self) -> None:
        require_type("MultisineThenPulse: multisine", self.multisine, Multisine, "a Multisine")
        require_type("MultisineThenPulse: pulse", self.pulse, Pulse, "a Pulse")
        longest = self.pulse.duration - self.pulse.onset
        require_number("MultisineThenPulse", "fade", self.fade, above=0.0, at_most=longest)

    @classmethod
    def join(
        cls,
        multisine: Multisine,
        *,
        peak: float,
        direction_deg: float,
        onset: float | None = None,
        tail: float = 4.0,
    ) -> Self:
        """The usual trial: a multisine, at its end a pulse, then nothing.

        Args:
          multisine: the continuous part.
          peak: largest force of the pulse [N], > 0.
          direction_deg: direction of the pulse from the fronto-parallel (x) axis [deg].
          onset: time at which the pulse starts [s]; left out, the multisine's duration.
          tail: time from the pulse's onset until the end of the trial [s].

        Raises:
          TypeError: a value is not a number.
          ValueError: a value is not finite or out of its range.
        """
        onset = multisine.duration if onset is None else onset
        pulse = Pulse(peak=peak, direction_deg=direction_deg, onset=onset, duration=onset + tail)
        return cls(multisine=multisine, pulse=pulse)

    @property
    def duration(self) -> float:
        """Duration of the whole trial [s]."""
        return self.pulse.duration

    @property
    def highest_frequency(self) -> float:
        """The higher one of the two parts' [Hz]."""
        return max(self.multisine.highest_frequency, self.pulse.highest_frequency)

    def sample(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Force [N] at the times start + k / rate, zero outside [0, duration), (n_samples, axis)."""
        times = sample_times(rate, n_samples, start)
        faded = np.clip((times - self.pulse.onset) / self.fade, 0.0, 1.0)
        strength = np.where(times < 0.0, 0.0, 0.5 + 0.5 * np.cos(np.pi * faded))
        force = strength[:, np.newaxis] * self.multisine.periodic(rate, n_samples, start)
        return force + self.pulse.sample(rate, n_samples, start)
