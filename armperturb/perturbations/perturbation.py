"""What every perturbation offers: a duration, a bandwidth and its force at any time."""

from typing import Protocol, runtime_checkable

import numpy as np

from armperturb.validation import require_number, require_whole

BANDWIDTH_SHARE = 0.45
"""A perturbation may reach up to this share of the simulation rate [-]: the Nyquist frequency with a margin."""

MAX_DURATION = 3600.0
"""Longest perturbation of a trial [s]: anything longer is a slip in a file, and would not fit into memory."""


@runtime_checkable
class Perturbation(Protocol):
    """A force on the handle as a function of time; x = right, y = forward (thesis fig. 2.1)."""

    @property
    def duration(self) -> float:
        """Time from the start until the force is zero for good [s]."""
        ...

    @property
    def highest_frequency(self) -> float:
        """Frequency above which nothing significant is left [Hz]."""
        ...

    def sample(self, rate: float, n_samples: int, start: float = 0.0) -> np.ndarray:
        """Force at the times start + k / rate, zero outside [0, duration).

        Args:
          rate: samples per second [Hz], > 0.
          n_samples: number of samples, >= 0.
          start: time of the first sample [s]; may be negative.

        Returns:
          Force [N], (n_samples, axis).
        """
        ...


def sample_times(rate: float, n_samples: int, start: float) -> np.ndarray:
    """The times start + k / rate [s], (n_samples,).

    Raises:
      TypeError: an argument is not a number, or n_samples not a whole one.
      ValueError: an argument is not finite, rate is not positive or n_samples is negative.
    """
    require_number("sample", "rate", rate, above=0.0)
    require_whole("sample", "n_samples", n_samples, at_least=0)
    require_number("sample", "start", start)
    return start + np.arange(n_samples) / rate


def check_bandwidth(perturbation: Perturbation, simulation_rate: float) -> None:
    """Refuse a perturbation that is too fast for the simulation to render.

    Args:
      perturbation: what is to be applied.
      simulation_rate: simulation steps per second [Hz], > 0.

    Raises:
      ValueError: the perturbation has significant content above 45 % of the simulation rate.
    """
    require_number("check_bandwidth", "simulation_rate", simulation_rate, above=0.0)
    limit = BANDWIDTH_SHARE * simulation_rate
    if perturbation.highest_frequency > limit:
        shorter = 1.0 / (simulation_rate * np.ceil(perturbation.highest_frequency / limit))
        raise ValueError(
            f"{type(perturbation).__name__}: highest significant frequency = {perturbation.highest_frequency:.6g} Hz; "
            f"expected at most {limit:.6g} Hz, {BANDWIDTH_SHARE:.0%} of the simulation rate of {simulation_rate:g} Hz "
            f"(the option timestep = {shorter:.12g}, or smoother edges)"
        )


LARGEST_RMS_DISPLACEMENT = 0.1
"""A multisine that moves the handle further, per axis [m], takes it out of the workspace; refuses millimetres."""
