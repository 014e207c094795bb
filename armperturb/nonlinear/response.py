"""How people whose muscles may follow the muscle law answer recorded disturbances, many lanes side by side."""

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from armperturb.nonlinear.planar_arm import simulate_lanes

Array = NDArray[np.float64]

STEP = 2.5e-3
"""Longest step of the simulation [s]."""


class Disturbances:
    """Recorded disturbances, ready to be answered by any number of people.

    Attributes:
      decimation: steps of the simulation per sample.
      timestep: of the simulation [s].
      n_samples: of each disturbance.

    Args:
      perturbation: d as recorded, smooth between its samples [N], (trial, time, axis).
      rate: of the samples [Hz].
    """

    def __init__(self, perturbation: Array, rate: float) -> None:
        self.decimation = max(1, int(np.ceil(round(1.0 / (rate * STEP), 9))))
        self.timestep = 1.0 / (rate * self.decimation)
        self.n_samples = perturbation.shape[1]
        self._held = _held(perturbation, self.decimation)

    def responses(
        self, lanes: NDArray[np.void], of_lane: NDArray[np.intp], n_samples: NDArray[np.intp] | None = None
    ) -> Array:
        """Displacement of the handle from rest [m], (lane, time, axis); NaN from where an arm blows up.

        Args:
          lanes: who answers, from `lane_table` with this object's `timestep`.
          of_lane: which disturbance each lane answers, (lane,).
          n_samples: how many samples of each lane are wanted, (lane,); the others are zero. By default all.
        """
        wanted = np.full(len(lanes), self.n_samples) if n_samples is None else np.asarray(n_samples)
        n_history = int(np.ceil(lanes["delay"].max() / self.timestep)) + 3
        displacement = np.zeros((len(lanes), self.n_samples, 2))
        of_lane, wanted = (np.asarray(values, dtype=np.intp) for values in (of_lane, wanted))
        simulate_lanes(lanes, self._held, of_lane, wanted, self.decimation, self.timestep, n_history, displacement)
        return displacement


def _held(perturbation: Array, decimation: int) -> Array:
    """What to hold over each step for a handle to feel a smooth force through the samples, (trial, step, axis).

    A held force acts on average at the middle of its step, and holding weakens it by sinc(f timestep); the second
    difference restores that to fourth order.
    """
    n = perturbation.shape[1]
    middle = (np.arange(-1, (n - 1) * decimation + 1) + 0.5) / decimation
    smooth = interpolate.CubicSpline(np.arange(n), perturbation, axis=1)(middle)
    return np.ascontiguousarray(smooth[:, 1:-1] - np.diff(smooth, n=2, axis=1) / 24.0)
