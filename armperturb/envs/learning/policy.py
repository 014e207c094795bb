"""Agents that answer what they sense at once: how they act, and those that the package has trained."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array
from armperturb.files import packaged_table
from armperturb.validation import require_one_of


@dataclass(frozen=True, eq=False)
class Policy:
    """A feed-forward network from observations to actions: hyperbolic tangents between its layers, none after the last.

    With a single layer, actions are in proportion to observations.

    Attributes:
      layers: of each, weights of its inputs, and in the last column its bias, (output, input + 1).
    """

    layers: tuple[Array, ...]

    def __call__(self, observation: ArrayLike) -> NDArray[np.float32]:
        """Actions for observations, (..., action) of (..., observation); the environment clips them to their range.

        Raises:
          ValueError: an observation has another length.
        """
        values = np.asarray(observation, dtype=float)
        size = self.layers[0].shape[1] - 1
        if values.shape[-1:] != (size,):
            raise ValueError(f"observation of shape {values.shape}; expected (..., {size})")
        for layer in self.layers[:-1]:
            values = np.tanh(values @ layer[:, :-1].T + layer[:, -1])
        return np.asarray(values @ self.layers[-1][:, :-1].T + self.layers[-1][:, -1], dtype=np.float32)


def trained_policy(name: str) -> Policy:
    """The policy that `python -m benchmarks.baselines` trained for an environment, such as "ArmPerturb/Position-v1".

    Raises:
      ValueError: there is none for this name.
    """
    table = packaged_table(__package__, "policies.toml")
    require_one_of("trained_policy", "name", name, tuple(table))
    return Policy(tuple(np.array(layer, dtype=float) for layer in table[name]["layers"]))
