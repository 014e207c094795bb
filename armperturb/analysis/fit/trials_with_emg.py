"""Movement and EMG of the same trials: how likely they are together."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.fit.emg_likelihood import N_ARM, EmgLikelihood
from armperturb.analysis.fit.likelihood import Likelihood
from armperturb.analysis.fit.whittle import LackOfFit, Normal, Whittle
from armperturb.arrays import Array


class TrialsWithEmg:
    """Likelihood of movement and EMG of the same trials together; reads as a `Likelihood`.

    Args:
      movement: of the trials.
      emg: of the same.
    """

    def __init__(self, movement: Likelihood, emg: EmgLikelihood) -> None:
        if movement.n_trials != emg.n_trials:
            raise ValueError(f"EMG of {emg.n_trials} trials; expected that of {movement.n_trials}")
        self.movement, self.emg = movement, emg

    @property
    def n_trials(self) -> int:
        """How many trials."""
        return self.movement.n_trials

    @property
    def is_long(self) -> bool:
        """Whether derivatives that are not quick take long."""
        return self.movement.is_long

    def weigh(self, values: Array) -> None:
        """As `Whittle.weigh`; values are as `EmgLikelihood` has them, also below."""
        self.movement.weigh(values[..., :N_ARM])
        self.emg.weigh(values)

    def cost(self, values: Array) -> float:
        """As `Whittle.cost`."""
        return self.movement.cost(values[..., :N_ARM]) + self.emg.cost(values)

    def objective(self, values: Array) -> float:
        """As `Whittle.objective`."""
        return self.movement.objective(values[..., :N_ARM]) + self.emg.objective(values)

    def normal(self, values: Array, mixing: Array, *, quick: bool = False) -> Normal:
        """As `Whittle.normal`."""
        return self._added(values, mixing, self.n_trials, lambda each, *of: each.normal(*of, quick=quick))

    def step_normal(self, values: Array, mixing: Array) -> Normal:
        """As `Whittle.step_normal`."""
        return self._added(values, mixing, 1, lambda each, *of: each.step_normal(*of))

    def _added(
        self, values: Array, mixing: Array, n_rows: int, ask: Callable[[Whittle, Array, Array], Normal]
    ) -> Normal:
        """What movement and EMG say together, (row, parameter)."""
        n = mixing.shape[1]
        cost, slopes, informations = 0.0, np.zeros((n_rows, n)), np.zeros((n_rows, n, n))
        for each, of_its, acts in self._parts(values, mixing):
            normal = ask(each, of_its, mixing[: of_its.shape[-1], acts])
            cost += normal.cost
            slopes[:, acts] += normal.slopes
            informations[:, acts[:, None], acts] += normal.informations
        return Normal(cost, slopes, informations)

    def informations(self, values: Array, mixing: Array) -> tuple[Array, Array]:
        """As `Whittle.informations`."""
        known, left = np.zeros((2, mixing.shape[1], mixing.shape[1]))
        for each, of_its, acts in self._parts(values, mixing):
            of_all, of_noise = each.informations(of_its, mixing[: of_its.shape[-1], acts])
            known[acts[:, None], acts] += of_all
            left[acts[:, None], acts] += of_noise
        return known, left

    def _parts(self, values: Array, mixing: Array) -> Iterator[tuple[Whittle, Array, NDArray[np.int_]]]:
        """Movement and EMG, the values that each depends on, and the free parameters: of most, derivatives are zero."""
        yield self.movement, values[..., :N_ARM], np.flatnonzero(mixing[:N_ARM].any(axis=0))
        yield self.emg, values, np.flatnonzero(mixing[self.emg.rows].any(axis=0))

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """As `Whittle.lack_of_fit`."""
        moved, active = self.movement.lack_of_fit(values[..., :N_ARM]), self.emg.lack_of_fit(values)
        return LackOfFit(moved.chi2 + active.chi2, moved.dof + active.dof)
