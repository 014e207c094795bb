"""How people answer disturbances: many lanes of the compiled arm side by side."""

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy import interpolate

from armperturb.arrays import Array, Indices
from armperturb.controllers.lanes import Table
from armperturb.extras import naming_the_extra
from armperturb.planar_arm.lanes import GROUP, Start, at_rest

STEP = 2.5e-3
"""Longest step of the simulation [s]."""

PARTS_PER_THREAD = 4
"""Batches per thread, as lanes take unequally long: some diverge early, and trials differ in length."""

SMOOTH = 7
"""Degree of the spline between samples. Of a multisine up to a fifth of the sampling rate it errs by 5e-6 of the RMS, a
cubic one by 0.2 %."""

NO_TORQUE = np.zeros((0, 0, 2))
"""On the joints, in no trial."""


class Disturbances:
    """Recorded disturbances, ready to be answered by any number of people.

    Attributes:
      decimation: steps of the simulation per sample.
      timestep: of the simulation [s].
      n_samples: of each disturbance.
      force: at the start and middle of each step [N], (trial, 2 step + 1, axis).
      torque: on the joints beside it [Nm], (trial, 2 step + 1, joint); (0, 0, 2) without any.

    Args:
      perturbation: d as recorded [N], (trial, time, axis).
      rate: of the samples [Hz].
      threads: how many simulate at a time; no effect on the result.
      longest_step: of the simulation [s].
      straight: whether d runs straight between its samples; by default it is smooth.
    """

    def __init__(
        self,
        perturbation: Array,
        rate: float,
        threads: int = 1,
        *,
        longest_step: float = STEP,
        straight: bool = False,
    ) -> None:
        self._threads = threads
        self.decimation = _steps_per_sample(rate, longest_step)
        self.timestep = 1.0 / (rate * self.decimation)
        self.n_samples = perturbation.shape[1]
        self.force = _halved(perturbation, self.decimation, straight)
        self.torque = NO_TORQUE

    def with_torque(self, torque: Array) -> "Disturbances":
        """The same disturbances while a torque acts on the joints, smooth between its samples.

        Args:
          torque: [Nm], (trial, time, joint).
        """
        other = copy.copy(self)
        other.torque = _halved(torque, self.decimation, straight=False)
        return other

    def responses(
        self,
        lanes: Table,
        of_lane: Indices,
        n_samples: Indices | None = None,
        start: Start | None = None,
    ) -> Array:
        """Displacement of the handle from rest [m], (lane, time, axis); NaN from where an arm diverges.

        Args:
          lanes: who answers, from `lane_table` with this object's `timestep`.
          of_lane: which disturbance each lane answers, (lane,).
          n_samples: how many samples of each lane are wanted, (lane,); the others are zero. By default all.
          start: of each lane; by default all are at rest.

        Raises:
          ModuleNotFoundError: numba is not installed.
        """
        simulate_lanes = load_compiled_arm()
        wanted = np.full(len(lanes), self.n_samples) if n_samples is None else np.asarray(n_samples)
        of_lane, wanted = (np.asarray(values, dtype=np.intp) for values in (of_lane, wanted))
        displacement = np.zeros((len(lanes), self.n_samples, 2))
        first = at_rest(lanes, self.timestep) if start is None else start

        def simulate(part: slice) -> None:
            simulate_lanes(
                lanes[part],
                first.part(part),
                self.force,
                self.torque,
                of_lane[part],
                wanted[part],
                self.decimation,
                self.timestep,
                displacement[part],
            )

        if self._threads == 1:
            simulate(slice(None))
        else:
            size = GROUP * max(1, len(lanes) // (PARTS_PER_THREAD * self._threads * GROUP))
            with ThreadPoolExecutor(self._threads) as pool:
                list(pool.map(simulate, (slice(lane, lane + size) for lane in range(0, len(lanes), size))))
        return displacement


def load_compiled_arm() -> Callable[..., None]:
    """`compiled.simulate_lanes`; not imported with this module, as it loads slowly and few analyses need it.

    Raises:
      ModuleNotFoundError: numba is not installed; the message names the extra.
    """
    with naming_the_extra("the compiled arm"):
        from armperturb.planar_arm.compiled import simulate_lanes
    return simulate_lanes


def _steps_per_sample(rate: float, longest_step: float) -> int:
    return max(1, int(np.ceil(round(1.0 / (rate * longest_step), 9))))


def _halved(perturbation: Array, decimation: int, straight: bool) -> Array:
    """Recorded forces at the start and middle of each step, (trial, 2 step + 1, axis)."""
    sample = np.arange(perturbation.shape[1])
    wanted = np.arange(2 * sample[-1] * decimation + 1) / (2 * decimation)
    degree = 1 if straight else min(SMOOTH, sample[-1])
    curve = interpolate.make_interp_spline(sample, perturbation, k=degree, axis=1)
    return np.ascontiguousarray(curve(wanted))
