"""All trials of one person as one least-squares problem: what a model predicts, what is left, and its derivatives.

The prediction is the mean response to the disturbance in the presence of the person's noise. A muscle that yields is
softer when noise moves it as well, so that the response without noise is another one: estimates from it are biased,
the more so the noisier the person is. The mean is taken over draws of the noise as it was last estimated, in pairs of
opposite sign, whose linear response cancels.

Trials of a person differ: each has its own factor on stiffness, damping and feedback, log-normal with a spread that is
estimated as well. Its logarithm is a random effect, an unknown with a prior.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armperturb.nonlinear.lanes import lane_table
from armperturb.nonlinear.model import EFFECTS, Parameters
from armperturb.nonlinear.noise import Noise
from armperturb.nonlinear.response import Disturbances
from armperturb.nonlinear.trials import TrialSet
from armperturb.subject import Subject

Array = NDArray[np.float64]

STEP = 1e-4
"""Of a logarithm, for differences [-]."""

PAIRS_OF_SLOPES = 1
"""Pairs of draws over which derivatives are averaged: they need not be as exact as the residual."""


class State(NamedTuple):
    """Where a fit is.

    Attributes:
      point: logarithms of the free parameters, (parameter,).
      effects: of the trials, one after the other, (effect,).
      spread: SD of the effects of each task and quantity, (kind,).
    """

    point: Array
    effects: Array
    spread: Array


class Normal(NamedTuple):
    """Gauss-Newton equations at a state: parameters first, then effects.

    Attributes:
      matrix: information, (unknown, unknown).
      slope: minus half the cost's gradient, (unknown,).
    """

    matrix: Array
    slope: Array


class Problem:
    """Trials, a structure, and the noise as last estimated.

    Attributes:
      parameters: what is free.
      sets: the trials.
      n_trials: in all sets.
      kinds: task and quantity of the effects, (kind,).
      kind_of: kind of each effect, (effect,).
      noises: of each set.
    """

    def __init__(
        self, parameters: Parameters, sets: Sequence[TrialSet], arms: Mapping[str, Subject], threads: int = 1
    ) -> None:
        """Take the trials.

        Args:
          parameters: what is free.
          sets: trials; each set has its own noise.
          arms: condition to a linear arm near the person there.
          threads: how many simulate at a time; no effect on what they find.
        """
        self._threads = threads
        self.parameters, self.sets = parameters, tuple(sets)
        self.n_trials = sum(one.n_trials for one in sets)
        self._tasks = [one.body.task for one in sets for _ in range(one.n_trials)]
        self._conditions = [one.label for one in sets for _ in range(one.n_trials)]
        self._environments = [one.environment for one in sets for _ in range(one.n_trials)]
        self._ends = np.array([one.end for one in sets for _ in range(one.n_trials)])
        firsts = np.cumsum([0, *(one.n_trials for one in sets)])
        self._rows = [slice(a, b) for a, b in itertools.pairwise(firsts.tolist())]
        self.kinds = [(task, quantity) for task in dict.fromkeys(self._tasks) for quantity in EFFECTS[task]]
        self._own: list[slice] = []
        kind_of: list[int] = []
        for task in self._tasks:
            self._own.append(slice(len(kind_of), len(kind_of) + len(EFFECTS[task])))
            kind_of += [self.kinds.index((task, quantity)) for quantity in EFFECTS[task]]
        self.kind_of = np.array(kind_of)
        rates = {one.rate for one in sets}
        if len(rates) > 1:
            raise ValueError(f"sampling rates {', '.join(f'{rate:g}' for rate in sorted(rates))} Hz; expected one")
        self._rate = rates.pop()
        n = int(self._ends.max())
        self._perturbation, self._observed = (
            np.concatenate([_padded(getattr(one, name), n) for one in sets])
            for name in ("perturbation", "displacement")
        )
        self.noises = [Noise(arms[one.label], one.environment, one.end, one.n_trials, one.rate) for one in self.sets]
        self._draws = [Disturbances(self._perturbation, self._rate, self._threads)]

    @property
    def is_noisy(self) -> bool:
        """Whether predictions are means in the presence of noise."""
        return len(self._draws) > 1

    def draw(self, state: State, n_pairs: int, seed: int) -> None:
        """From now on predict in the presence of noise, as it is at a state; 0 pairs predict without noise.

        Draws are made twice: how much the first ones move the nonlinear arm tells how strong the second must be.
        """
        self._draws = [Disturbances(self._perturbation, self._rate, self._threads)]
        if not n_pairs:
            return
        residual = self.residual(self.predict([state])[0])
        standard = np.random.default_rng(seed).standard_normal((n_pairs, *self._perturbation.shape))
        gains: list[Array | float] = [1.0] * len(self.sets)
        for last in (False, True):
            draws = []
            for one in standard:
                force = np.zeros_like(self._perturbation)
                for rows, noise, gain in zip(self._rows, self.noises, gains, strict=True):
                    for trial in range(rows.start, rows.stop):
                        force[trial] = noise.draw(one[trial], gain)
                draws += [self._perturbation + force, self._perturbation - force]
            self._draws = [Disturbances(one, self._rate, self._threads) for one in (draws if last else draws[:2])]
            if not last:
                plus, minus = (self._responses([state], one)[0] for one in self._draws)
                gains = [
                    noise.gain(residual[rows], 0.5 * (plus - minus)[rows])
                    for rows, noise in zip(self._rows, self.noises, strict=True)
                ]

    def subjects(self, state: State) -> list[Subject]:
        """The person in each trial."""
        return [
            self.parameters.person(task, state.point, condition, state.effects[own])
            for task, condition, own in zip(self._tasks, self._conditions, self._own, strict=True)
        ]

    def _responses(self, states: Sequence[State], draw: Disturbances) -> Array:
        subjects = [subject for state in states for subject in self.subjects(state)]
        lanes = lane_table(subjects, self._environments * len(states), draw.timestep)
        trials = np.tile(np.arange(self.n_trials), len(states))
        responses = draw.responses(lanes, trials, self._ends[trials])
        return responses.reshape(len(states), self.n_trials, *responses.shape[1:])

    def predict(self, states: Sequence[State], *, n_draws: int | None = None) -> Array:
        """Displacement [m], (state, trial, time, axis)."""
        draws = self._draws[:n_draws]
        total = self._responses(states, draws[0])
        for draw in draws[1:]:
            total += self._responses(states, draw)
        return total / len(draws)

    def residual(self, predicted: Array) -> Array:
        """What is left of the displacement, zero after each trial's end [m], (trial, time, axis)."""
        left = self._observed - predicted
        for trial, end in enumerate(self._ends):
            left[trial, end:] = 0.0
        return left

    def weigh(self, residual: Array) -> None:
        """Estimate all noise from what is left."""
        for rows, noise in zip(self._rows, self.noises, strict=True):
            noise.weigh(residual[rows])

    def cost(self, state: State, predicted: Array) -> float:
        """Sum of squares of white residuals and of effects over their spread; infinite where an arm blows up."""
        if not np.isfinite(predicted).all():
            return np.inf
        left = self.residual(predicted)
        total = float(np.sum((state.effects / state.spread[self.kind_of]) ** 2))
        for rows, noise in zip(self._rows, self.noises, strict=True):
            total += float(np.sum(noise.white(left[rows]) ** 2))
        return total

    def objective(self, state: State, predicted: Array) -> float:
        """Minus twice the logarithm of likelihood and prior, but for a constant, the noise being as last weighed."""
        jacobian = sum(one.n_trials * noise.log_determinant for one, noise in zip(self.sets, self.noises, strict=True))
        return self.cost(state, predicted) - jacobian + 2.0 * float(np.sum(np.log(state.spread[self.kind_of])))

    def normal(self, state: State, predicted: Array) -> Normal:
        """Gauss-Newton equations, by differences: all trials, parameters and effects side by side."""
        n, n_effects = len(state.point), max(own.stop - own.start for own in self._own)
        states = []
        for column in range(n):
            point = state.point.copy()
            point[column] += STEP
            states.append(state._replace(point=point))
        for effect in range(n_effects):
            effects = state.effects.copy()
            for own in self._own:
                if own.start + effect < own.stop:
                    effects[own.start + effect] += STEP
            states.append(state._replace(effects=effects))
        n_draws = 2 * PAIRS_OF_SLOPES
        base = predicted if len(self._draws) <= n_draws else self.predict([state], n_draws=n_draws)[0]
        slopes = (self.predict(states, n_draws=n_draws) - base) / STEP
        left = self.residual(predicted)
        size = n + len(state.effects)
        matrix, slope = np.zeros((size, size)), np.zeros(size)
        for rows, noise in zip(self._rows, self.noises, strict=True):
            white = noise.white(left[rows])
            for trial in range(rows.start, rows.stop):
                own = self._own[trial]
                used = np.concatenate([np.arange(n), n + np.arange(own.start, own.stop)])
                columns = noise.white(slopes[: len(used), trial])
                matrix[np.ix_(used, used)] += columns @ columns.T
                slope[used] += columns @ white[trial - rows.start]
        prior = 1.0 / state.spread[self.kind_of] ** 2
        matrix[range(n, size), range(n, size)] += prior
        slope[n:] -= prior * state.effects
        return Normal(matrix, slope)


def _padded(signal: Array, n: int) -> Array:
    """Signals (trial, time, axis) of n samples, cut or held at their last value."""
    missing = n - signal.shape[1]
    return signal[:, :n] if missing <= 0 else np.pad(signal, ((0, 0), (0, missing), (0, 0)), mode="edge")
