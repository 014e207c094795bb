"""Whether trials start at rest, as their first samples tell."""

import numpy as np

from armperturb.arrays import Array

STEP = 0.005
"""Time in which a handle that starts at rest hardly moves [s]."""

HELD = 0.2
"""Force at the start over its standard deviation from which on it may be constant, and its difference from the
perturbation over it up to which it is [-]."""

AT_REST = 0.02
"""Distance from zero, and between two samples, over the RMS displacement below which a handle is at rest [-]."""


def start_at_rest(perturbation: Array, force: Array, displacement: Array, rate: float) -> bool:
    """Whether every trial starts at rest, the handle at zero and under no constant force.

    Args:
      perturbation: d [N], (trial, time, axis), as the next two.
      force: f [N].
      displacement: x [m].
      rate: of the samples [Hz].
    """
    d, f, x = perturbation, force, displacement
    rms = np.sqrt(np.mean(x**2, axis=1))
    place, step = np.abs(x[:, 0]), np.abs(x[:, max(1, round(STEP * rate))] - x[:, 0])
    held = np.abs(f[:, 0])
    # A handle at rest exerts on the hand what is exerted on it, where that is not nothing.
    is_held = (held > HELD * f.std(axis=1)) & (np.abs(d[:, 0] - f[:, 0]) < HELD * held)
    return bool(np.all((place < AT_REST * rms) & (step < AT_REST * rms)) and not is_held.any())
