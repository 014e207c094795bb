"""Where trials lie in memory."""

import numpy as np
from numpy.typing import ArrayLike

from armperturb.arrays import Array


def trials_adjacent(values: ArrayLike, axis: int) -> Array:
    """The same values with the trials next to each other in memory.

    Arithmetic on many trials then runs along them, several times faster than along two joints or three elements.
    Shapes and bits stay; results of arithmetic have the same layout.

    Args:
      values: any shape.
      axis: along which the trials are.
    """
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(np.asarray(values, dtype=float), axis, -1)), -1, axis)
