"""Movement and EMG of the same trials: how likely they are together."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from armperturb.analysis.fit.emg_likelihood import N_ARM, EmgLikelihood
from armperturb.analysis.fit.frequency_rows import complex_values
from armperturb.analysis.fit.likelihood import Likelihood, RecordLikelihood
from armperturb.analysis.fit.whittle import LackOfFit, Normal
from armperturb.arrays import Array, ComplexArray

Slopes = tuple[NDArray[np.int_], Array]
"""Free parameters, and the derivatives by these, (free parameter, number); those by others are zero."""

SAME_STEP = 1e-9
"""Relative difference between the steps of two frequencies up to which they are the same [-]."""


class TrialsWithEmg:
    """Likelihood of movement and EMG of the same trials together; reads as a `Likelihood`.

    What the disturbance leaves of the movement may show in the EMG, see `emg_likelihood`, where both are whole records;
    mean periods of movement, from which searches start, are taken to be without it.

    Args:
      movement: of the trials.
      emg: of the same.
    """

    def __init__(self, movement: Likelihood, emg: EmgLikelihood) -> None:
        if movement.n_trials != emg.n_trials:
            raise ValueError(f"EMG of {emg.n_trials} trials; expected that of {movement.n_trials}")
        self.movement, self.emg = movement, emg
        # Where the frequencies of the EMG begin among those of the movement.
        step, of_emg = (np.diff(each.judged_frequency[:2])[0] for each in (movement, emg))
        self._is_shown = isinstance(movement, RecordLikelihood) and bool(abs(step / of_emg - 1.0) < SAME_STEP)
        self._first = round(float((emg.judged_frequency[0] - movement.judged_frequency[0]) / step))

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
        if not self._is_shown:
            self.emg.weigh(values)
            return
        arm = values[..., :N_ARM]
        moved = self._shown(self.movement.white_rows(arm))
        self.emg.weigh_beside(values, moved, self._at_emg(self.movement.noise_torque(arm)))

    def cost(self, values: Array) -> float:
        """As `Whittle.cost`."""
        return sum(float(np.sum(each**2)) for each in self._white_rows(values))

    def objective(self, values: Array) -> float:
        """As `Whittle.objective`."""
        self.weigh(values)
        return self.cost(values) + self.movement.noise_size + self.emg.noise_size

    def normal(self, values: Array, mixing: Array, *, quick: bool = False) -> Normal:
        """As `Whittle.normal`."""
        moved, active = self._white_rows(values)
        n_trials, n = self.n_trials, mixing.shape[1]
        slopes, informations = np.zeros((n_trials, n)), np.zeros((n_trials, n, n))
        along, exact = moved, None
        if self.is_long and not quick:
            along = moved - self._of_emg(active) if self._is_shown else moved
            of_movement = np.flatnonzero(mixing[:N_ARM].any(axis=0))
            exact = self.movement.exact_slopes(values[..., :N_ARM], mixing[:N_ARM, of_movement], along)
        for trial, *both in self._white_slopes(values, mixing, quick=quick or exact is not None):
            for (columns, rows), left in zip(both, (moved[trial], active[trial]), strict=True):
                slopes[trial, columns] += rows @ left
                informations[trial][np.ix_(columns, columns)] += rows @ rows.T
            if exact is not None:
                columns, rows = both[0]
                slopes[trial, columns] += exact[trial] - rows @ along[trial]
        return Normal(float(np.sum(moved**2) + np.sum(active**2)), slopes, informations)

    def informations(self, values: Array, mixing: Array) -> tuple[Array, Array]:
        """As `Whittle.informations`."""
        known, left = np.zeros((2, mixing.shape[1], mixing.shape[1]))
        for _, *both in self._white_slopes(values, mixing, quick=True):
            for (columns, rows), sure in zip(both, (self.movement.sure, self.emg.sure), strict=True):
                known[np.ix_(columns, columns)] += rows @ rows.T
                rows *= sure
                left[np.ix_(columns, columns)] += rows @ rows.T
        return known, left

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """As `Whittle.lack_of_fit`."""
        every = zip((self.movement, self.emg), self._white_rows(values), strict=True)
        moved, active = (each.lack_in(rows) for each, rows in every)
        return LackOfFit(moved.chi2 + active.chi2, moved.dof + active.dof)

    def _shown(self, rows: Array) -> ComplexArray:
        """White movement at the frequencies of the EMG, (..., axis, frequency)."""
        return self._at_emg(complex_values(rows, (*rows.shape[:-1], 2, len(self.movement.judged_frequency))))

    def _at_emg(self, values: ComplexArray) -> ComplexArray:
        """Values (..., frequency) at the frequencies of the EMG, zero where movement is not judged."""
        part = values[..., self._first : self._first + len(self.emg.judged_frequency)]
        return np.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, len(self.emg.judged_frequency) - part.shape[-1])])

    def _of_emg(self, rows: Array) -> Array:
        """The transpose of what white movement makes of the white residual of the EMG, (..., number)."""
        moved = self.emg.to_movement(rows)
        n = len(self.movement.judged_frequency)
        back = np.zeros((*moved.shape[:-1], n), dtype=complex)
        part = back[..., self._first : self._first + moved.shape[-1]]
        part[...] = moved[..., : part.shape[-1]]
        return np.stack([back.real, back.imag], axis=-3).reshape(*rows.shape[:-1], -1)

    def _white_rows(self, values: Array) -> tuple[Array, Array]:
        """The white residuals of movement and EMG, as `Whittle.white_rows`."""
        moved, active = self.movement.white_rows(values[..., :N_ARM]), self.emg.white_rows(values)
        return moved, active - self.emg.of_movement(self._shown(moved)) if self._is_shown else active

    def _white_slopes(self, values: Array, mixing: Array, *, quick: bool) -> Iterator[tuple[int, Slopes, Slopes]]:
        """Each trial and the derivatives of movement and EMG, as `Whittle.white_slopes`."""
        # Of the other parameters, derivatives are zero.
        of_movement, of_emg = (np.flatnonzero(each.any(axis=0)) for each in (mixing[:N_ARM], mixing[self.emg.rows]))
        moved = self.movement.white_slopes(values[..., :N_ARM], mixing[:N_ARM, of_movement], quick=quick)
        active = self.emg.white_slopes(values, mixing[:, of_emg], quick=quick)
        for (trial, of_arm), (_, of_gains) in zip(moved, active, strict=True):
            columns, rows = of_emg, of_gains
            if self._is_shown:
                columns = np.union1d(of_movement, of_emg)
                rows = np.zeros((len(columns), of_gains.shape[1]))
                rows[np.searchsorted(columns, of_emg)] = of_gains
                for place, row in zip(np.searchsorted(columns, of_movement), of_arm, strict=True):  # for memory's sake
                    rows[place] -= self.emg.of_movement(self._shown(row))
            yield trial, (of_movement, of_arm), (columns, rows)
