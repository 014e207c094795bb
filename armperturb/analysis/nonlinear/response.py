"""How people whose muscles may follow the muscle law answer recorded disturbances, many lanes side by side."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from armperturb.analysis.nonlinear.planar_arm import simulate_lanes
from armperturb.arrays import Array, Indices

STEP = 2.5e-3
"""Longest step of the simulation [s]."""

PARTS_PER_THREAD = 4
"""Lanes take unequally long: those that blow up early, and those whose trial is short."""


class Disturbances:
    """Recorded disturbances, ready to be answered by any number of people.

    Attributes:
      decimation: steps of the simulation per sample.
      timestep: of the simulation [s].
      n_samples: of each disturbance.

    Args:
      perturbation: d as recorded, smooth between its samples [N], (trial, time, axis).
      rate: of the samples [Hz].
      threads: how many simulate at a time; no effect on what they find.
    """

    def __init__(self, perturbation: Array, rate: float, threads: int = 1) -> None:
        self._threads = threads
        self.decimation = max(1, int(np.ceil(round(1.0 / (rate * STEP), 9))))
        self.timestep = 1.0 / (rate * self.decimation)
        self.n_samples = perturbation.shape[1]
        self._held = _held(perturbation, self.decimation)

    def responses(self, lanes: NDArray[np.void], of_lane: Indices, n_samples: Indices | None = None) -> Array:
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

        def simulate(part: slice) -> None:
            simulate_lanes(
                lanes[part],
                self._held,
                of_lane[part],
                wanted[part],
                self.decimation,
                self.timestep,
                n_history,
                displacement[part],
            )

        if self._threads == 1:
            simulate(slice(None))
        else:
            size = max(1, len(lanes) // (PARTS_PER_THREAD * self._threads))
            with ThreadPoolExecutor(self._threads) as pool:
                list(pool.map(simulate, (slice(first, first + size) for first in range(0, len(lanes), size))))
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
