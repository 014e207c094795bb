"""Elastic limit of a joint, guessed from the wrist's (thesis F.1).

The force of a stretched muscle rises in proportion up to the elastic limit, and less beyond. With moment arm r, length
L_m of the muscle and L_s of its sarcomeres, a rotation x_e lengthens the sarcomeres by

    dL_s = x_e r L_s / L_m,    (F.1)

so that joints whose muscles give way at the same dL_s, and have the same lengths, have x_e in inverse proportion to r.
Experiments on the wrist found its limit to rise linearly with velocity (de Vlugt et al. 2011, van Eesbeek et al. 2010).

It is a guess: the wrist was held active and stretched by ramps; and as in the thesis the velocity is the joint's,
though at the same velocity the longer moment arm of shoulder or elbow stretches its muscles faster than the wrist's.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.validation import require_number

Array = NDArray[np.float64]

WRIST = "wrist"
"""Joint that the others are compared with."""

VELOCITY = (math.radians(74.5), math.radians(186.2))
"""Lowest and highest velocity of the experiments on the wrist [rad/s] (thesis F.1)."""

WRIST_LIMIT = (math.radians(1.4), math.radians(3.8))
"""Elastic limit of the wrist at these velocities, linear in between [rad] (thesis F.1)."""


def elastic_limit(joint: str, velocity: ArrayLike, moment_arms: Mapping[str, float]) -> Array:
    """Rotation up to which the muscles of a joint are elastic [rad], of the shape of velocity.

    Args:
      joint: one of `moment_arms`.
      velocity: of the joint in either direction [rad/s]; outside of `VELOCITY` the limit is that at its nearer end.
      moment_arms: joint to the mean moment arm of its muscles [m], > 0, with "wrist" among them.

    Raises:
      ValueError: there is no moment arm of the joint or the wrist, or one is not above 0.
    """
    for name in (joint, WRIST):
        if name not in moment_arms:
            raise ValueError(f"elastic_limit: joint = {name!r}; expected one of {', '.join(moment_arms)}")
        require_number("elastic_limit", f"moment arm of the {name}", moment_arms[name], above=0.0)
    of_wrist = np.interp(np.abs(np.asarray(velocity, dtype=float)), VELOCITY, WRIST_LIMIT)
    return np.asarray(of_wrist * moment_arms[WRIST] / moment_arms[joint])
