"""How far a curve of a few splines may be from a truth that is less smooth: what enters its band beside the noise.

A sum of n splines cannot follow a jump. How much it misses is told by what changes when there are fewer of them: from
n / 2 to n splines the curve moves by d_1, from n / 4 to n / 2 by d_2, and from n to the truth by about |d_1 / d_2| d_1
if that ratio goes on (Aitken's extrapolation). Next to a jump it is near one, and for a smooth course near none.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from armperturb.arrays import Array


class Fitted(NamedTuple):
    """A curve that was fitted with a number of splines.

    Attributes:
      value: (point,).
      standard_error: (point,).
    """

    value: Array
    standard_error: Array


def smoothing_bias(curve: Fitted, halved: Fitted, quartered: Fitted, width: int) -> Array:
    """Expected distance of a curve from the truth because it has no more splines, (point,), in its unit.

    Args:
      curve: whose distance is asked for.
      halved: the same with half as many splines.
      quartered: with a quarter of them.
      width: points over which squared distances are averaged, as differences of curves swing through zero.
    """
    near, far = _distance(curve, halved), _distance(halved, quartered)
    whole = float(np.sqrt(np.mean(far)))
    ratio = min(float(np.sqrt(np.mean(near))) / whole, 1.0) if whole > 0.0 else 1.0
    power = np.maximum(ndimage.uniform_filter1d(near, max(width, 1), mode="nearest"), 0.0)  # running sums round off
    return np.asarray(ratio * np.sqrt(power))


def _distance(fine: Fitted, coarse: Fitted) -> Array:
    """Squared difference of two curves without what noise adds to it, (point,)."""
    noise = np.abs(fine.standard_error**2 - coarse.standard_error**2)  # of estimates of which one contains the other
    return np.asarray(np.maximum((fine.value - coarse.value) ** 2 - noise, 0.0))
