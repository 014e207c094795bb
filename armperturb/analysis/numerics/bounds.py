"""Which parameters of a fit sit on a bound."""

from collections.abc import Sequence

import numpy as np

from armperturb.arrays import Array

AT_BOUND = 1e-6
"""A parameter sits on a bound when it is closer to it than this share of the distance between its bounds."""


def names_at_bound(names: Sequence[str], values: Array, lower: Array, upper: Array) -> tuple[str, ...]:
    """Names of the parameters that sit on a bound.

    Args:
      names: of all parameters.
      values: of them, (parameter,).
      lower: their lower bounds, (parameter,).
      upper: their upper bounds, (parameter,).
    """
    near = np.minimum(values - lower, upper - values) <= AT_BOUND * (upper - lower)
    return tuple(name for name, hit in zip(names, near, strict=True) if hit)
