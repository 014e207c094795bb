"""Whether trials start at rest, as their first samples tell, what pushes them first, and the constant force on them."""

from collections.abc import Sequence

import numpy as np

from armperturb.arrays import Array

STEP = 0.005
"""Time in which a handle that starts at rest hardly moves [s]."""

HELD = 0.2
"""Force at the start, or mean force, over the standard deviation from which on it may be constant, and its difference
from the perturbation over it up to which it is [-]."""

AT_REST = 0.02
"""Distance from zero, and between two samples, over the RMS displacement below which a handle is at rest but for noise
[-]."""

SLOW = 0.4
"""Step from the first sample over the RMS of all steps as long, up to which a handle starts from rest [-]: one that the
whole perturbation sets in motion at once makes steps of up to 0.38."""

BY_NOISE = 4.0
"""Standard deviations of a step's noise by which noise may add to a step, or to where the handle is at first."""

PUSH = 0.05
"""Change of the perturbation over its largest change from which on it pushes [-]: above the noise of a measured one."""


def start_at_rest(perturbation: Array, force: Array, displacement: Array, rate: float) -> bool:
    """Whether every trial starts at rest, the handle at zero and under no constant force.

    Args:
      perturbation: d [N], (trial, time, axis), as the next two.
      force: f [N].
      displacement: x [m].
      rate: of the samples [Hz].
    """
    d, f, x = perturbation, force, displacement
    apart = max(1, round(STEP * rate))
    steps = x[:, apart:] - x[:, :-apart]
    place, step = np.abs(x[:, 0]), np.abs(steps[:, 0])
    # Fourth differences are of noise alone: 70 times its variance; a step has twice that.
    by_noise = BY_NOISE * np.sqrt(np.mean(np.diff(x, 4, axis=1) ** 2, axis=1) * (2.0 / 70.0))
    rest = AT_REST * np.sqrt(np.mean(x**2, axis=1)) + by_noise
    # A slow movement makes steps that are small beside the way that it goes, but not beside its other steps.
    slow = SLOW * np.sqrt(np.mean(steps**2, axis=1)) + by_noise
    held = np.abs(f[:, 0])
    # A handle at rest exerts on the hand what is exerted on it, where that is not nothing.
    is_held = (held > HELD * f.std(axis=1)) & (np.abs(d[:, 0] - f[:, 0]) < HELD * held)
    return bool(np.all((place < rest) & (step < np.minimum(rest, slow))) and not is_held.any())


def constant_force(force: Array) -> Array:
    """Mean of a force over time and trials [N], (axis,), or zero where it is small beside the force and may be chance.

    Args:
      force: d or f before the pulses [N], (trial, time, axis).
    """
    mean, varying = force.mean(axis=(0, 1)), force.std(axis=(0, 1))
    return np.asarray(mean if np.linalg.norm(mean) > HELD * np.linalg.norm(varying) else np.zeros_like(mean))


def first_push(perturbation: Sequence[Array]) -> int:
    """Sample from which on something pushes every trial.

    Args:
      perturbation: d of each trial before its pulse [N], (time, axis).
    """
    first = 0
    for d in perturbation:
        change = np.linalg.norm(d - d[:1], axis=1)
        first = max(first, int(np.argmax(change > PUSH * change.max(initial=0.0))) if len(d) else 0)
    return first
