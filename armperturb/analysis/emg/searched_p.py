"""How likely noise alone explains as much as a response does at the best of all delays."""

import math

import numpy as np
from scipy import special, stats

from armperturb.arrays import Array

RANK = 1e-12
"""Power of a direction of the design over the largest one below which it counts as none [-]."""


def searched_p(explained: float, n: float, design: Array, change: Array, extent: float) -> float:
    """Probability that noise alone is explained so well at any of many delays, at most.

    Bound of Davies (1987, Biometrika 74) for the largest chi-squared along a line, here for the share of the sum of
    squares, as its size is unknown: it explains more at the first delay, or comes to do so at a later one. The rate of
    that is the same at all delays, as they turn the columns of the design and do not change how these go together.

    Args:
      explained: largest share of the sum of squares that the design explains [-].
      n: independent numbers.
      design: at the first delay, (number, column); numbers that depend on one another all do so alike.
      change: its derivative by the delay, likewise [1/s]; at most two columns outside the span of the design.
      extent: largest delay less the least one [s].
    """
    power, axes = np.linalg.eigh(design.T @ design)
    is_seen = power > RANK * power[-1]
    white = axes[:, is_seen] / np.sqrt(power[is_seen])
    within = design @ white
    leaving = change @ white
    leaving = leaving - within @ (within.T @ leaving)
    *_, lesser, larger = np.maximum(np.linalg.eigvalsh(leaving.T @ leaving), 0.0)
    # Mean length of a normal vector of two dimensions with these variances.
    speed = math.sqrt(2.0 * larger / math.pi) * special.ellipe(1.0 - lesser / max(larger, 1e-300))
    half, rest = 0.5 * is_seen.sum(), 0.5 * (n - is_seen.sum())
    at_first = stats.beta.sf(explained, half, rest)
    later = extent * speed * math.sqrt(2.0 / math.pi) / n * stats.beta.pdf(explained, half + 0.5, rest + 0.5)
    return float(min(at_first + later, 1.0))
