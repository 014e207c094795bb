"""The force to hold over each step of a simulation so that the handle feels a continuous one."""

import numpy as np

from armperturb.arrays import Array


def held_over_steps(middle: Array, *, straight: bool = False) -> Array:
    """Force to hold over each step so that the handle moves as under a continuous force [N], (..., step, axis).

    With the mean of the force over a step the handle ends at the right velocity but step^2 / (12 m_env) times the rise
    of the force too far; the second difference of the mean over 12 takes that back, to fourth order. The mean itself is
    the value at the middle of the step, plus a 24th of its second difference if the force is smooth.

    Args:
      middle: the force at the middle of each step, and of one step more at either end [N], (..., step + 2, axis).
      straight: whether the force runs straight within each step, with corners between steps, and is not smooth.
    """
    return middle[..., 1:-1, :] - np.diff(middle, n=2, axis=-2) / (12.0 if straight else 24.0)
