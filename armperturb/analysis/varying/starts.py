"""Where searches for a time-varying joint start: the best of many delays, dynamics and thresholds of its reflex."""

import itertools

import numpy as np
from scipy import linalg

from armperturb.analysis.joint.model import DYNAMICS, THRESHOLD
from armperturb.analysis.varying.likelihood import VaryingLikelihood
from armperturb.arrays import Array

DELAYS, FREQUENCIES = tuple(np.linspace(0.02, 0.18, 9).tolist()), (1.5, 3.0, 6.0)
"""Delays [s] and natural frequencies [Hz] of the reflex path from which the search may start: from one that is 30 ms
off, it may end at a gain of the wrong sign."""

THRESHOLDS = (0.0, 0.2, 0.6)
"""Thresholds of a half-wave over the velocity's RMS from which it may start [-]. A movement that often rests has a
local maximum at 0."""


def search_starts(likelihood: VaryingLikelihood) -> list[Array]:
    """Values from which a search may start, the noise being as last weighed.

    Args:
      likelihood: of a structure.
    """
    names = likelihood.model.dynamics
    if not names:
        return [at_dynamics(likelihood, np.empty(0))]
    usual = {"reflex_damping_ratio": 0.8, THRESHOLD: 0.0}
    given = [usual | dict(zip(DYNAMICS, each, strict=False)) for each in itertools.product(DELAYS, FREQUENCIES)]
    starts = [at_dynamics(likelihood, np.array([each[name] for name in names])) for each in given]
    best = min(starts, key=likelihood.cost)
    return [*starts, *other_thresholds(likelihood, best[likelihood.model.n_linear :])]


def other_thresholds(likelihood: VaryingLikelihood, dynamics: Array) -> list[Array]:
    """Values with the same delay and dynamics and each of `THRESHOLDS`; none of a reflex without one.

    Args:
      likelihood: of a structure.
      dynamics: values of the parameters that do not enter linearly.
    """
    names = likelihood.model.dynamics
    if THRESHOLD not in names:
        return []
    place, scale = names.index(THRESHOLD), likelihood.model.signals.velocity_scale
    several = np.tile(dynamics, (len(THRESHOLDS), 1))
    several[:, place] = scale * np.array(THRESHOLDS)
    return [at_dynamics(likelihood, each) for each in several]


def at_dynamics(likelihood: VaryingLikelihood, dynamics: Array) -> Array:
    """Values of all parameters with given delay, dynamics and threshold; the noise is held.

    Args:
      likelihood: of a structure.
      dynamics: values of the parameters that do not enter linearly.
    """
    n = likelihood.model.n_linear
    values = np.concatenate([np.zeros(n), dynamics])
    normal = likelihood.normal(values, np.eye(len(values))[:, :n])
    return np.concatenate([inverse(normal.information) @ normal.slope, dynamics])


def inverse(information: Array) -> Array:
    """Inverse of an information whose parameters have units of their own; directions it does not tell are zero.

    Args:
      information: (parameter, parameter).
    """
    size = np.sqrt(np.where(np.diag(information) > 0.0, np.diag(information), 1.0))
    return np.asarray(linalg.pinvh(information / np.outer(size, size)) / np.outer(size, size))
