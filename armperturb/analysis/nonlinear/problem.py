"""All trials of one person as one least-squares problem: what a model predicts, what is left, and its derivatives.

The prediction is the mean response to the disturbance in the presence of the person's noise. A muscle that yields is
softer when noise moves it as well, so that the response without noise is another one: estimates from it are biased,
the more so the noisier the person is. The mean is taken over draws of the noise as it was last estimated, in pairs of
opposite sign, whose linear response cancels.

Trials of a person differ: each has its own factor on stiffness, damping and feedback, log-normal with a spread that is
estimated as well. Its logarithm is a random effect, an unknown with a prior.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.fit.likelihood import LackOfFit
from armperturb.analysis.nonlinear.model import EFFECTS, Parameters
from armperturb.analysis.nonlinear.noise import Noise
from armperturb.analysis.nonlinear.trials import TrialSet
from armperturb.arrays import Array
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import Subject

STEP = 1e-4
"""Of a logarithm, for differences [-]."""

PAIRS_OF_SLOPES = 1
"""Pairs of draws over which derivatives are averaged: they need not be as exact as the residual."""

PAIRS_OF_STRENGTH = 4
"""Pairs of draws that tell how strong draws must be."""

MOST_WEAKENED = 6
"""How often draws that make an arm blow up are made weaker: near the edge of stability, the person was luckier."""

REST = 8.0
"""How long nothing pushes an arm before it is looked at whether it still moves [s]."""

STILL = 0.1
"""Speed in the last second of `REST` over the greatest speed before: arms that come to rest have less than 0.01 [-]."""

WIDE = 1e4
"""SD of a prior of all logarithms [-]: it matters to nothing but what trials say nothing of."""


class State(NamedTuple):
    """Where a fit is.

    Attributes:
      point: coordinates of the free parameters, see `model.coordinate`, (parameter,).
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


class Drawn(NamedTuple):
    """White deviations from the mean response, (draw, number) of each trial.

    Attributes:
      odd: what changes its sign with the noise.
      even: what does not.
    """

    odd: list[Array]
    even: list[Array]

    def signed(self) -> Iterator[list[Array]]:
        """Those of all trials with noise of either sign, draw by draw."""
        for draw in range(len(self.odd[0]) if self.odd else 0):
            for sign in (1.0, -1.0):
                yield [sign * odd[draw] + even[draw] for odd, even in zip(*self, strict=True)]


class Problem:
    """Trials, a structure, and the noise as last estimated.

    Attributes:
      parameters: what is free.
      sets: the trials.
      n_trials: in all sets.
      conditions: of each trial, (trial,).
      kinds: task and quantity of the effects, (kind,).
      kind_of: kind of each effect, (effect,).
      own_effects: where those of each trial are, (trial,).
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
        self.conditions = [one.label for one in sets for _ in range(one.n_trials)]
        self._environments = [one.environment for one in sets for _ in range(one.n_trials)]
        self._ends = np.array([one.end for one in sets for _ in range(one.n_trials)])
        firsts = np.cumsum([0, *(one.n_trials for one in sets)])
        self._rows = [slice(a, b) for a, b in itertools.pairwise(firsts.tolist())]
        self.kinds = [(task, quantity) for task in dict.fromkeys(self._tasks) for quantity in EFFECTS[task]]
        self.own_effects: list[slice] = []
        kind_of: list[int] = []
        for task in self._tasks:
            self.own_effects.append(slice(len(kind_of), len(kind_of) + len(EFFECTS[task])))
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

    def draw(self, state: State, residual: Array, n_pairs: int, seed: int) -> None:
        """From now on predict in the presence of noise as last weighed.

        Draws are made twice: how much the first ones move the nonlinear arm, and how much of that a fit would leave,
        tell how strong the second must be. Noise comes in bursts when the arm has been moved, which is when unknowns
        show as well: a fit may take most of it for their effect.

        Args:
          state: where the fit is.
          residual: what is left there [m], (trial, time, axis).
          n_pairs: of draws.
          seed: of the draws.
        """
        slopes = self.slopes(state, n_draws=2 * PAIRS_OF_SLOPES)
        for noise in self.noises:
            noise.strength = np.ones_like(noise.strength)
        odd = [self.white(one) for one, _ in self._halves(state, PAIRS_OF_STRENGTH, seed) if np.isfinite(one).all()]
        left = self._unexplained(state, slopes, odd)
        white = self.white(residual)
        for rows, noise in zip(self._rows, self.noises, strict=True) if left else ():  # or all make an arm blow up
            noise.match(np.array(white[rows]), np.array([trial for one in left for trial in one[rows]]))
        self.draw_again(n_pairs, seed)
        for _ in range(MOST_WEAKENED):
            if np.isfinite(self.predict([state])).all():
                break
            for noise in self.noises:
                noise.strength = 0.7 * noise.strength
            self.draw_again(n_pairs, seed)

    def draw_again(self, n_pairs: int, seed: int) -> None:
        """From now on predict in the presence of noise of the spectrum and strength that it has."""
        self._draws = [draw for pair in self._pairs(n_pairs, seed) for draw in pair]

    def _pairs(self, n_pairs: int, seed: int) -> Iterator[tuple[Disturbances, Disturbances]]:
        """The disturbances with drawn noise added and taken away."""
        rng = np.random.default_rng(seed)
        for _ in range(n_pairs):
            standard = rng.standard_normal(self._perturbation.shape)
            force = np.zeros_like(self._perturbation)
            for rows, noise in zip(self._rows, self.noises, strict=True):
                for trial in range(rows.start, rows.stop):
                    force[trial] = noise.draw(standard[trial])
            plus, minus = (
                Disturbances(self._perturbation + sign * force, self._rate, self._threads) for sign in (1.0, -1.0)
            )
            yield plus, minus

    def _halves(self, state: State, n_pairs: int, seed: int) -> Iterator[tuple[Array, Array]]:
        """Of each pair of draws, how the response changes with the noise's sign, and how it does not."""
        for pair in self._pairs(n_pairs, seed):
            plus, minus = (self._responses([state], draw)[0] for draw in pair)
            yield 0.5 * (plus - minus), 0.5 * (plus + minus)

    def subjects(self, state: State) -> list[Subject]:
        """The person in each trial."""
        return [
            self.parameters.person(task, state.point, condition, state.effects[own])
            for task, condition, own in zip(self._tasks, self.conditions, self.own_effects, strict=True)
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

    def costs(self, state: State, predicted: Array) -> Array:
        """Squares of white residuals and of effects over their spread, (trial,); infinite where an arm blows up."""
        left = self.residual(predicted)
        total = np.array(
            [np.sum((state.effects[own] / state.spread[self.kind_of[own]]) ** 2) for own in self.own_effects]
        )
        for rows, noise in zip(self._rows, self.noises, strict=True):
            total[rows] += np.sum(noise.white(left[rows]) ** 2, axis=1)
        return np.where(np.isfinite(predicted).all(axis=(1, 2)), total, np.inf)

    def cost(self, state: State, predicted: Array) -> float:
        """Sum of `costs`."""
        return float(np.sum(self.costs(state, predicted)))

    def log_determinants(self, state: State) -> Array:
        """What `costs` lack of minus twice the logarithm of likelihood and prior, but for a constant, (trial,)."""
        of_noise = [
            -noise.log_determinant for one, noise in zip(self.sets, self.noises, strict=True) for _ in one.onset
        ]
        return np.array(of_noise) + [2.0 * np.sum(np.log(state.spread[self.kind_of[own]])) for own in self.own_effects]

    def objective(self, state: State, predicted: Array) -> float:
        """Minus twice the logarithm of likelihood and prior, but for a constant, the noise being as last weighed."""
        return self.cost(state, predicted) + float(np.sum(self.log_determinants(state)))

    def lack_of_fit(
        self, state: State, predicted: Array, slopes: Sequence[Array], drawn: Drawn
    ) -> dict[str, LackOfFit]:
        """Condition to what is left in its residual that the disturbance explains, the noise being as last weighed.

        Were the noise stationary, the sum of squares would have a chi2 distribution. That of draws, as a fit leaves
        them, says which one it has: one of the same mean and variance.

        Args:
          state: where the fit is.
          predicted: there.
          slopes: from `slopes`.
          drawn: from `drawn`; none if predictions are without noise.
        """
        left = [self.white(self.residual(predicted))]
        left += self._unexplained(state, slopes, drawn.signed())
        sums: dict[str, Array] = {}
        dof: dict[str, int] = {}
        for one, rows, noise in zip(self.sets, self._rows, self.noises, strict=True):
            own, numbers = noise.lack_of_fit(np.array([record[rows] for record in left]), self._perturbation[rows])
            sums[one.label] = sums.get(one.label, 0.0) + own
            dof[one.label] = dof.get(one.label, 0) + numbers
        found = {}
        for label, (chi2, *of_draws) in sums.items():
            if of_draws:
                mean, variance = float(np.mean(of_draws)), float(np.var(of_draws, ddof=1))
                dof[label] = max(1, round(2.0 * mean**2 / variance))
                chi2 *= dof[label] / mean
            found[label] = LackOfFit(float(chi2), dof[label])
        return found

    def restless(self, state: State) -> tuple[str, ...]:
        """Conditions in which an arm moves on when nothing has pushed it for a while.

        Linear arms of large and of small movements may both be stable, and one in between may not be: delayed reflexes
        then sustain an oscillation, and what arms do there depends on parameters so strongly that errors mean nothing.
        """
        n, n_second = self._perturbation.shape[1], round(self._rate)
        followed = np.pad(self._perturbation, ((0, 0), (0, round(REST * self._rate)), (0, 0)))
        disturbances = Disturbances(followed, self._rate, self._threads)
        lanes = lane_table(self.subjects(state), self._environments, disturbances.timestep)
        displacement = disturbances.responses(lanes, np.arange(self.n_trials))
        speed = np.linalg.norm(np.diff(displacement, axis=1), axis=2)
        last = np.sqrt(np.mean(speed[:, -n_second:] ** 2, axis=1))
        still = last < STILL * speed[:, :n].max(axis=1)  # false where an arm blows up
        return tuple(dict.fromkeys(label for label, rests in zip(self.conditions, still, strict=True) if not rests))

    def white(self, signal: Array) -> list[Array]:
        """Displacements of all trials [m], (trial, time, axis), as numbers of unit variance if they are noise."""
        return [row for rows, noise in zip(self._rows, self.noises, strict=True) for row in noise.white(signal[rows])]

    def slopes(self, state: State, *, n_draws: int | None = None) -> list[Array]:
        """Derivatives of white predictions: of each trial (parameters and own effects, number)."""
        states = []
        for column in range(len(state.point)):
            point = state.point.copy()
            point[column] += STEP
            states.append(state._replace(point=point))
        for effect in range(max(own.stop - own.start for own in self.own_effects)):
            effects = state.effects.copy()
            for own in self.own_effects:
                if own.start + effect < own.stop:
                    effects[own.start + effect] += STEP
            states.append(state._replace(effects=effects))
        changes = (self.predict(states, n_draws=n_draws) - self.predict([state], n_draws=n_draws)[0]) / STEP
        found = []
        for rows, noise in zip(self._rows, self.noises, strict=True):
            for trial in range(rows.start, rows.stop):
                n_own = len(state.point) + self.own_effects[trial].stop - self.own_effects[trial].start
                found.append(noise.white(changes[:n_own, trial]))
        return found

    def gathered(self, state: State, parts: Sequence[Array]) -> Array:
        """Matrices (own unknown, own unknown) or vectors (own unknown,) of the trials, summed over all unknowns."""
        n = len(state.point)
        total = np.zeros((n + len(state.effects),) * np.ndim(parts[0]))
        for own, part in zip(self.own_effects, parts, strict=True):
            used = np.r_[:n, n + own.start : n + own.stop]
            total[np.ix_(*(used,) * part.ndim)] += part
        return total

    def normal(self, state: State, predicted: Array, slopes: Sequence[Array] | None = None) -> Normal:
        """Gauss-Newton equations, by default with derivatives from the first draws."""
        slopes = slopes or self.slopes(state, n_draws=2 * PAIRS_OF_SLOPES)
        white, n = self.white(self.residual(predicted)), len(state.point)
        slope = self.gathered(state, [one @ left for one, left in zip(slopes, white, strict=True)])
        slope[n:] -= self._prior(state)[n:] * state.effects
        return Normal(self._information(state, slopes), slope)

    def drawn(self, state: State, n_pairs: int, n_averaged: int, seed: int) -> Drawn:
        """How people might differ from the mean response.

        Were that as stationary as the weights have it, it would be white. But noise moves a muscle that yields the
        more, the more the disturbance does: it comes in bursts. So noise is drawn and simulated.

        Args:
          state: where the fit is.
          n_pairs: of draws; those that make an arm blow up are left out, and all if less than two are left.
          n_averaged: pairs over which predictions were averaged, which leaves a little noise in them.
          seed: of the draws; another one than that of the predictions'.
        """
        halves = [
            (self.white(one), self.white(other))
            for one, other in self._halves(state, n_pairs, seed)
            if np.isfinite(one).all() and np.isfinite(other).all()
        ]
        if len(halves) < 2:
            return Drawn([], [])
        odd = [np.array([one[trial] for one, _ in halves]) for trial in range(self.n_trials)]
        even = [np.array([one[trial] for _, one in halves]) for trial in range(self.n_trials)]
        # With the variance that such deviations have from a mean over others.
        scale = np.sqrt((1.0 + 1.0 / n_averaged) * len(halves) / (len(halves) - 1.0))
        return Drawn(odd, [scale * (one - one.mean(axis=0)) for one in even])

    def score_variance(self, state: State, slopes: Sequence[Array], drawn: Drawn) -> Array:
        """Variance of `Normal.slope` over what people might have done, (unknown, unknown).

        Args:
          state: where the fit is.
          slopes: from `slopes`.
          drawn: from `drawn`.
        """
        parts = []
        for columns, odd, even in zip(slopes, *drawn, strict=True):
            scores = np.concatenate([odd, even]) @ columns.T
            parts.append(scores.T @ scores / len(odd))
        return self.gathered(state, parts) + np.diag(self._prior(state))

    def _unexplained(
        self, state: State, slopes: Sequence[Array], records: Iterable[Sequence[Array]]
    ) -> list[list[Array]]:
        """What a fit would leave of each of some white records of all trials, linearised."""
        n, information, left = len(state.point), self._information(state, slopes), []
        for white in records:
            score = self.gathered(state, [a @ b for a, b in zip(slopes, white, strict=True)])
            taken = np.linalg.solve(information, score)
            left.append(
                [
                    record - np.concatenate([taken[:n], taken[n:][own]]) @ columns
                    for record, columns, own in zip(white, slopes, self.own_effects, strict=True)
                ]
            )
        return left

    def _information(self, state: State, slopes: Sequence[Array]) -> Array:
        """Of trials and prior, were the noise white, (unknown, unknown)."""
        return self.gathered(state, [one @ one.T for one in slopes]) + np.diag(self._prior(state))

    def _prior(self, state: State) -> Array:
        """Information in the prior, (unknown,)."""
        return np.concatenate([np.full(len(state.point), WIDE**-2), 1.0 / state.spread[self.kind_of] ** 2])


def _padded(signal: Array, n: int) -> Array:
    """Signals (trial, time, axis) of n samples, cut or held at their last value."""
    missing = n - signal.shape[1]
    return signal[:, :n] if missing <= 0 else np.pad(signal, ((0, 0), (0, missing), (0, 0)), mode="edge")
