"""All trials of one person as one least-squares problem: residuals of the predictions, and their derivatives.

What a few draws of the noise leave in a mean prediction depends on the parameters, and were residuals weighed by the
derivatives of that mean, a fit would make the remainder small (Laffont, Ossard & Vuong 1995, Econometrica 63, on the
bias of simulated least squares). So they are weighed by derivatives without noise, as by instrumental variables
(Soderstrom & Stoica 1983), which are also smooth where an arm is near instability.

Trials of a person differ: each has its own factor on stiffness, damping and feedback, log-normal with a spread that is
estimated too. Its logarithm is a random effect, an unknown with a prior.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.nonlinear.model import Parameters, stem
from armperturb.analysis.nonlinear.simulated import COORDINATE_STEP, SimulatedTrials, State
from armperturb.analysis.nonlinear.spindle_emg import (
    N_REFLEX,
    POSITION,
    REFLEX,
    VELOCITY,
    EmgInFit,
    EmgOfTrials,
    SpindleEmg,
    reflex_values,
)
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.subject import Subject

WIDE = 1e4
"""SD of the prior of all coordinates [-]: it matters only where the trials say nothing of a parameter."""


class Normal(NamedTuple):
    """Gauss-Newton equations at a state: parameters first, then effects.

    Attributes:
      matrix: information, (unknown, unknown).
      slope: minus half the cost's gradient, (unknown,).
    """

    matrix: Array
    slope: Array


class Problem(SimulatedTrials):
    """Simulated trials beside those that were recorded, and the noise as last estimated.

    Takes what `SimulatedTrials` takes, and `emg`: condition to the EMG of all its trials, of conditions that have some;
    None for the movement alone.
    """

    def __init__(
        self,
        parameters: Parameters,
        sets: Sequence[ConditionTrials],
        arms: Mapping[str, Subject],
        threads: int = 1,
        emg: Mapping[str, EmgInFit] | None = None,
    ) -> None:
        super().__init__(parameters, sets, arms, threads)
        self._emg = EmgOfTrials(
            [
                (rows, SpindleEmg(emg[trials.label].of(trials), arms[trials.label], emg[trials.label].delay))
                for trials, rows in zip(self.sets, self.rows, strict=True)
                if emg and trials.label in emg
            ]
        )

    def residual(self, predicted: Array) -> Array:
        """Recorded minus predicted displacement, zero after each trial's end [m], (trial, time, axis)."""
        left = self._observed - predicted
        for trial, end in enumerate(self._ends):
            left[trial, end:] = 0.0
        return left

    def weigh(self, state: State, residual: Array) -> None:
        """Estimate the spectrum of each set's noise from what a state leaves; it weights costs and slopes."""
        for rows, noise in zip(self.rows, self.noises, strict=True):
            noise.weigh(residual[rows])
        self._emg.weigh(self._reflexes(state))

    def white(self, signal: Array) -> list[Array]:
        """Displacements of all trials [m], (trial, time, axis), as numbers of unit variance if they are noise."""
        return [row for rows, noise in zip(self.rows, self.noises, strict=True) for row in noise.white(signal[rows])]

    def costs(self, state: State, predicted: Array) -> Array:
        """Squares of white residuals and of effects over their spread, (trial,); infinite where an arm diverges."""
        left = self.residual(predicted)
        total = np.array(
            [np.sum((state.effects[places] / state.spread[self.kind_of[places]]) ** 2) for places in self.effects_of]
        )
        for rows, noise in zip(self.rows, self.noises, strict=True):
            total[rows] += np.sum(noise.white(left[rows]) ** 2, axis=1)
        return np.where(np.isfinite(predicted).all(axis=(1, 2)), total, np.inf)

    def cost(self, state: State, predicted: Array) -> float:
        """Sum of `costs`, and that of EMG."""
        return float(np.sum(self.costs(state, predicted))) + self._emg.cost(self._reflexes(state))

    def log_determinants(self, state: State) -> Array:
        """Minus twice the log-likelihood and log prior of each trial, less its `costs` and a constant, (trial,)."""
        of_noise = [
            -noise.log_determinant for trials, noise in zip(self.sets, self.noises, strict=True) for _ in trials.onset
        ]
        return np.array(of_noise) + [
            2.0 * np.sum(np.log(state.spread[self.kind_of[places]])) for places in self.effects_of
        ]

    def objective(self, state: State, predicted: Array) -> float:
        """Minus twice the log-likelihood and log prior, but for a constant, with the noise as last estimated."""
        of_movement = float(np.sum(self.costs(state, predicted) + self.log_determinants(state)))
        return of_movement + self._emg.objective(self._reflexes(state))

    def slopes(self, state: State, *, noisy: bool = False, smooth: bool = False) -> list[Array]:
        """Derivatives of white predictions, see `derivatives`: of each trial (parameters and own effects, number)."""
        derivatives, slopes = self.derivatives(state, noisy=noisy, smooth=smooth), []
        for rows, noise in zip(self.rows, self.noises, strict=True):
            slopes += [noise.white(of_trial) for of_trial in derivatives[rows]]
        return slopes

    def gathered(self, state: State, parts: Sequence[Array]) -> Array:
        """Matrices (unknown, unknown) or vectors (unknown,) of the single trials, summed over all unknowns."""
        n = len(state.point)
        total = np.zeros((n + len(state.effects),) * np.ndim(parts[0]))
        for places, part in zip(self.effects_of, parts, strict=True):
            used = np.r_[:n, n + places.start : n + places.stop]
            total[np.ix_(*(used,) * part.ndim)] += part
        return total

    def normal(
        self, state: State, predicted: Array, slopes: Sequence[Array] | None = None, of_trials: Array | None = None
    ) -> Normal:
        """Gauss-Newton equations.

        Args:
          state: where they are.
          predicted: displacements there, see `predict`.
          slopes: by default those there.
          of_trials: `information_of_trials` of these, if it is known already.
        """
        slopes = slopes or self.slopes(state)
        white, n = self.white(self.residual(predicted)), len(state.point)
        slope = self.gathered(state, [columns @ left for columns, left in zip(slopes, white, strict=True)])
        slope[n:] -= self.prior(state)[n:] * state.effects
        of_emg = self.emg_normal(state)
        if of_trials is None:
            of_trials = self.information_of_trials(state, slopes)
        return Normal(of_trials + of_emg.matrix + np.diag(self.prior(state)), slope + of_emg.slope)

    def unexplained(
        self, state: State, slopes: Sequence[Array], records: Iterable[Sequence[Array]]
    ) -> list[list[Array]]:
        """Residuals that a fit, linearised at a state, would leave of white records of all trials.

        Args:
          state: where the fit is.
          slopes: from `slopes`.
          records: any number of them, of each trial (number,).
        """
        n, information, left = len(state.point), self.information(state, slopes), []
        for white in records:
            score = self.gathered(state, [a @ b for a, b in zip(slopes, white, strict=True)])
            step = np.linalg.solve(information, score)
            left.append(
                [
                    record - np.concatenate([step[:n], step[n:][places]]) @ columns
                    for record, columns, places in zip(white, slopes, self.effects_of, strict=True)
                ]
            )
        return left

    def information(self, state: State, slopes: Sequence[Array]) -> Array:
        """Of trials, EMG and prior, were the noise white, (unknown, unknown)."""
        return self.information_of_trials(state, slopes) + self.emg_normal(state).matrix + np.diag(self.prior(state))

    def information_of_trials(self, state: State, slopes: Sequence[Array]) -> Array:
        """Of the movement alone, (unknown, unknown); the same at all states with these slopes."""
        return self.gathered(state, [columns @ columns.T for columns in slopes])

    @property
    def uses_emg(self) -> bool:
        """Whether EMG of some trials is fitted beside the movement."""
        return not self._emg.is_empty

    def emg_normal(self, state: State, *, as_variance: bool = False) -> Normal:
        """Gauss-Newton equations of the EMG alone; zero without any.

        Args:
          state: where they are.
          as_variance: whether the matrix is the variance of the slope, as the noise is estimated.
        """
        n, at = len(state.point), self._reflexes(state)
        changes = np.zeros((n + len(state.effects), *at.shape))
        if self.uses_emg:
            for column, name in enumerate(self.parameters.names):
                if stem(name) in REFLEX:
                    point = state.point.copy()
                    point[column] += COORDINATE_STEP
                    changes[column] = (self._reflexes(state._replace(point=point)) - at) / COORDINATE_STEP
            for place, kind in enumerate(self.kind_of):
                trial = next(i for i, places in enumerate(self.effects_of) if places.start <= place < places.stop)
                factor = {"kv": VELOCITY, "kp": POSITION}.get(self.kinds[kind][1])
                if factor is not None:
                    changes[n + place, trial, factor] = at[trial, factor]
        return Normal(*self._emg.normal(at, changes, as_variance=as_variance))

    def _reflexes(self, state: State) -> Array:
        """`reflex_values` of all trials, (trial, value); of none without EMG."""
        if not self.uses_emg:
            return np.zeros((self.n_trials, N_REFLEX))
        bodies = [self.parameters.bodies[task] for task in self.tasks]
        return np.array([reflex_values(each or body) for each, body in zip(self.subjects(state), bodies, strict=True)])

    def prior(self, state: State) -> Array:
        """Information in the prior, (unknown,)."""
        return np.concatenate([np.full(len(state.point), WIDE**-2), 1.0 / state.spread[self.kind_of] ** 2])
