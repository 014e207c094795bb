"""Agents that answer what they sense in proportion: how they act, and those that the package has trained."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array
from armperturb.files import packaged_table
from armperturb.validation import require_one_of


@dataclass(frozen=True, eq=False)
class LinearPolicy:
    """Actions in proportion to observations, in one matrix product.

    Attributes:
      weights: of the observations, and in the last column what is done at rest, (action, observation + 1).
    """

    weights: Array

    def __call__(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Actions for observations, (..., action) of (..., observation); the environment clips them to their range."""
        sensed = np.asarray(observation, dtype=float)
        return np.asarray(sensed @ self.weights[:, :-1].T + self.weights[:, -1], dtype=np.float32)


def trained_policy(name: str) -> LinearPolicy:
    """The policy that `python -m benchmarks.baselines` trained for an environment, such as "ArmPerturb/Position-v1".

    Raises:
      ValueError: there is none for this name.
    """
    table = packaged_table(__package__, "policies.toml")
    require_one_of("trained_policy", "name", name, tuple(table))
    return LinearPolicy(np.array(table[name]["weights"], dtype=float))
