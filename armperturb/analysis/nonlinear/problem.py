"""All trials of one person as one least-squares problem: predictions, residuals, and their derivatives.

The prediction is the mean response to the disturbance in the presence of the person's noise. A muscle that yields is
softer when noise moves it too, so the response without noise differs from that mean, and estimates from it are biased;
the bias grows with the noise. The mean is taken over draws of the noise (`draws`), in pairs of opposite sign, so that
their linear responses cancel. What a few draws leave in such a mean depends on the parameters, and were its derivatives
averaged over the same draws, a fit would make that remainder small: so derivatives have draws of their own (Laffont,
Ossard & Vuong 1995, Econometrica 63, on the bias of simulated least squares).

Trials of a person differ: each has its own factor on stiffness, damping and feedback, log-normal with a spread that is
estimated too. Its logarithm is a random effect, an unknown with a prior.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.nonlinear.model import EFFECTS, Parameters, person, stem
from armperturb.analysis.nonlinear.noise import OF_DERIVATIVES, OF_PREDICTIONS, Noise, NoiseDraws
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
from armperturb.arrays import Array, Indices
from armperturb.planar_arm.lanes import lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import Subject

COARSE_STEP = 5e-3
"""Longest step of the simulation from which coarse derivatives are taken [s]. They are off by some 15 %, which costs a
search a step or two, and take half the time."""

COORDINATE_STEP = 1e-4
"""Change of a coordinate in finite differences [-]."""

PAIRS_OF_SLOPES = 1
"""Pairs of draws over which derivatives are averaged during the search: they need less accuracy than residuals."""

REST = 8.0
"""How long nothing pushes an arm before it is tested for a limit cycle [s]."""

STILL = 0.1
"""Largest speed in the last second of `REST`, as a share of the largest speed before, of an arm that comes to rest
[-]. Arms without a limit cycle have less than 0.01."""

WIDE = 1e4
"""SD of the prior of all coordinates [-]: it matters only where the trials say nothing of a parameter."""


class State(NamedTuple):
    """All unknowns of a fit.

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


class Problem:
    """Trials, a structure, and the noise as last estimated.

    Attributes:
      parameters: what is free.
      sets: the trials.
      rows: places of each set's trials among all trials, (set,).
      n_trials: in all sets.
      conditions: of each trial, (trial,).
      kinds: task and quantity of the effects, (kind,).
      kind_of: kind of each effect, (effect,).
      effects_of: places of each trial's effects, (trial,).
      noises: of each set.
      perturbation: of all trials [N], (trial, time, axis).
    """

    def __init__(
        self,
        parameters: Parameters,
        sets: Sequence[ConditionTrials],
        arms: Mapping[str, Subject],
        threads: int = 1,
        emg: Mapping[str, EmgInFit] | None = None,
    ) -> None:
        """Take the trials.

        Args:
          parameters: what is free.
          sets: trials; each set has its own noise.
          arms: condition to a linear arm near the person there.
          threads: how many simulate at a time; no effect on the result.
          emg: condition to the EMG of all its trials, of conditions that have some; None for the movement alone.

        Raises:
          ValueError: sampling rates differ.
        """
        self._threads = threads
        self.parameters, self.sets = parameters, tuple(sets)
        self.n_trials = sum(trials.n_trials for trials in sets)
        self._tasks = [trials.body.task for trials in sets for _ in range(trials.n_trials)]
        self.conditions = [trials.label for trials in sets for _ in range(trials.n_trials)]
        self._environments = [trials.environment for trials in sets for _ in range(trials.n_trials)]
        self._ends = np.array([trials.end for trials in sets for _ in range(trials.n_trials)])
        firsts = np.cumsum([0, *(trials.n_trials for trials in sets)])
        self.rows = [slice(a, b) for a, b in itertools.pairwise(firsts.tolist())]
        self.kinds = [(task, quantity) for task in dict.fromkeys(self._tasks) for quantity in EFFECTS[task]]
        self.effects_of: list[slice] = []
        kind_of: list[int] = []
        for task in self._tasks:
            self.effects_of.append(slice(len(kind_of), len(kind_of) + len(EFFECTS[task])))
            kind_of += [self.kinds.index((task, quantity)) for quantity in EFFECTS[task]]
        self.kind_of = np.array(kind_of)
        rates = {trials.rate for trials in sets}
        if len(rates) > 1:
            raise ValueError(f"sampling rates {', '.join(f'{rate:g}' for rate in sorted(rates))} Hz; expected one")
        self._rate = rates.pop()
        n = int(self._ends.max())
        self.perturbation, self._observed = (
            np.concatenate([_padded(getattr(trials, name), n) for trials in sets]) for name in ("drive", "displacement")
        )
        self.noises = [
            Noise(arms[trials.label], trials.environment, trials.end, trials.n_trials, trials.rate)
            for trials in self.sets
        ]
        self._emg = EmgOfTrials(
            [
                (rows, SpindleEmg(emg[trials.label].of(trials), arms[trials.label], emg[trials.label].delay))
                for trials, rows in zip(self.sets, self.rows, strict=True)
                if emg and trials.label in emg
            ]
        )
        self._quiet = Disturbances(self.perturbation, self._rate, self._threads)
        self._average_over((self._quiet,), (self._quiet,))

    @property
    def is_noisy(self) -> bool:
        """Whether predictions are means in the presence of noise."""
        return len(self._averaged) > 1

    def predict_with(self, draws: NoiseDraws) -> None:
        """From now on predict the mean response in the presence of these draws of the noise.

        Derivatives are those of the mean response in the presence of as many other draws.
        """
        predicted, derived = (
            tuple(disturbances for pair in self.disturbed(draws, source) for disturbances in pair)
            for source in (OF_PREDICTIONS, OF_DERIVATIVES)
        )
        self._average_over(predicted, derived)

    def _average_over(self, predicted: tuple[Disturbances, ...], derived: tuple[Disturbances, ...]) -> None:
        self._averaged, self._derived = predicted, derived
        self._coarse = tuple(each.coarser(COARSE_STEP) for each in derived)

    def can_be_coarse(self, state: State) -> bool:
        """Whether coarse derivatives take less time than others, and their step is short enough for the arms."""
        return self._coarse != self._derived and bool(np.isfinite(self.predict([state], self._coarse)).all())

    def reach(self, state: State) -> float:
        """Largest displacement of a trial in the presence of a draw, over the largest that was recorded of it [-].

        Infinite if an arm diverges.
        """
        recorded = np.abs(self._observed).max(axis=(1, 2))
        far = [
            np.abs(self.predict([state], (each,))[0]).max(axis=(1, 2)) / recorded
            for each in (*self._averaged, *self._derived)
        ]
        return float(np.nan_to_num(far, nan=np.inf).max())

    def disturbed(self, draws: NoiseDraws, source: int = OF_PREDICTIONS) -> Iterator[tuple[Disturbances, Disturbances]]:
        """The disturbances plus and minus each draw of the noise; other draws of the same noise for another source."""
        for standard in draws.standard(source, self.perturbation.shape):
            torque = np.zeros_like(self.perturbation)
            for rows, noise, root, strength in zip(self.rows, self.noises, draws.roots, draws.strengths, strict=True):
                for trial in range(rows.start, rows.stop):
                    torque[trial] = noise.torque(root, strength, standard[trial])
            yield self._quiet.with_torque(torque), self._quiet.with_torque(-torque)

    def odd_and_even(self, state: State, draws: NoiseDraws) -> Iterator[tuple[Array, Array]]:
        """Parts of the response to each pair of draws [m] that change sign with the noise, and that do not."""
        for pair in self.disturbed(draws):
            _, (plus, minus) = self._responses([state], pair)
            yield 0.5 * (plus - minus), 0.5 * (plus + minus)

    def sensitivity(self, state: State, disturbances: Sequence[Disturbances] = ()) -> Array:
        """How far the trials move when all unknowns change a little [m], RMS, (trial,); by default without noise.

        Of several disturbances the largest; infinite where an arm diverges.
        """
        steps = self._steps(state)
        moved = state._replace(point=state.point + steps, effects=state.effects + COORDINATE_STEP)
        largest = np.zeros(self.n_trials)
        for each in disturbances or (self._quiet,):
            here, there = self.predict([state, moved], (each,))
            size = np.sqrt(np.mean((there - here) ** 2, axis=(1, 2)))
            largest = np.maximum(largest, np.where(np.isfinite(size), size, np.inf))
        return largest

    def _steps(self, state: State) -> Array:
        """Changes of the parameters for differences: beyond a bound there may be no such person, (parameter,)."""
        is_inside = state.point + COORDINATE_STEP <= self.parameters.upper
        return np.where(is_inside, COORDINATE_STEP, -COORDINATE_STEP)

    def subjects(self, state: State) -> list[Subject]:
        """The person in each trial."""
        bodies, law = self.parameters.bodies, self.parameters.model.law
        values = {task: self.parameters.values(task, state.point) for task in bodies}
        effects = [state.effects[places].tolist() for places in self.effects_of]
        return [
            person(bodies[task], law, values[task], condition, dict(zip(EFFECTS[task], of_trial, strict=True)))
            for task, condition, of_trial in zip(self._tasks, self.conditions, effects, strict=True)
        ]

    def _responses(self, states: Sequence[State], disturbed: Sequence[Disturbances]) -> tuple[Indices, Iterator[Array]]:
        """What differs between states: a parameter that acts in some trials leaves the others as in another state.

        Returns:
          Place of each answer among those that differ, (state, trial), and these with each of the disturbances:
          displacement [m], (place, time, axis).
        """
        subjects = [subject for state in states for subject in self.subjects(state)]
        lanes = lane_table(subjects, self._environments * len(states), disturbed[0].timestep)
        known: dict[tuple[int, bytes], int] = {}
        keys = [(number % self.n_trials, lane.tobytes()) for number, lane in enumerate(lanes)]
        place = np.array([known.setdefault(key, len(known)) for key in keys])
        first = np.unique(place, return_index=True)[1]
        trials = first % self.n_trials
        place = place.reshape(len(states), self.n_trials)
        return place, (each.responses(lanes[first], trials, self._ends[trials]) for each in disturbed)

    def predict(self, states: Sequence[State], averaged: Sequence[Disturbances] = ()) -> Array:
        """Displacement [m], (state, trial, time, axis): the mean over some disturbances, by default all of them."""
        averaged = averaged or self._averaged
        place, responses = self._responses(states, averaged)
        total = next(responses)
        for response in responses:
            total += response
        total /= len(averaged)
        return np.asarray(total[place])

    def limit_cycles(self, state: State) -> tuple[str, ...]:
        """Conditions in which an arm still moves a while after the last push: a self-sustained oscillation.

        Linear arms of large and of small movements may both be stable while one in between is not; delayed reflexes
        then sustain an oscillation. Its phase depends on parameters so strongly that confidence intervals are invalid.
        """
        n, n_second = self.perturbation.shape[1], round(self._rate)
        followed = np.pad(self.perturbation, ((0, 0), (0, round(REST * self._rate)), (0, 0)))
        disturbances = Disturbances(followed, self._rate, self._threads)
        lanes = lane_table(self.subjects(state), self._environments, disturbances.timestep)
        displacement = disturbances.responses(lanes, np.arange(self.n_trials))
        speed = np.linalg.norm(np.diff(displacement, axis=1), axis=2)
        last = np.sqrt(np.mean(speed[:, -n_second:] ** 2, axis=1))
        still = last < STILL * speed[:, :n].max(axis=1)  # false where an arm diverges
        return tuple(dict.fromkeys(label for label, rests in zip(self.conditions, still, strict=True) if not rests))

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

    def slopes(
        self, state: State, *, n_draws: int | None = None, coarse: bool = False, of_predictions: bool = False
    ) -> list[Array]:
        """Derivatives of white predictions: of each trial (parameters and own effects, number).

        They are zero where an arm diverges, so that such a trial says nothing of where to go.

        Args:
          state: where they are taken.
          n_draws: how many draws they are averaged over; by default all.
          coarse: whether simulations take longer steps.
          of_predictions: whether draws are those that predictions are averaged over, instead of draws of their own.
        """
        n_effects = max(places.stop - places.start for places in self.effects_of)
        steps = np.append(self._steps(state), np.full(n_effects, COORDINATE_STEP))
        states = [state._replace(point=state.point + step) for step in np.diag(steps[: len(state.point)])]
        for effect in range(n_effects):
            effects = state.effects.copy()
            for places in self.effects_of:
                if places.start + effect < places.stop:
                    effects[places.start + effect] += COORDINATE_STEP
            states.append(state._replace(effects=effects))
        averaged = self._averaged if of_predictions else self._coarse if coarse else self._derived
        predicted = self.predict([state, *states], averaged[:n_draws])
        if coarse and not np.isfinite(predicted).all():  # the step is too long for this arm
            return self.slopes(state, n_draws=n_draws)
        changes = (predicted[1:] - predicted[0]) / steps[:, None, None, None]
        changes[:, ~np.isfinite(changes).all(axis=(0, 2, 3))] = 0.0
        slopes = []
        for rows, noise in zip(self.rows, self.noises, strict=True):
            for trial in range(rows.start, rows.stop):
                n_unknowns = len(state.point) + self.effects_of[trial].stop - self.effects_of[trial].start
                slopes.append(noise.white(changes[:n_unknowns, trial]))
        return slopes

    def gathered(self, state: State, parts: Sequence[Array]) -> Array:
        """Matrices (unknown, unknown) or vectors (unknown,) of the single trials, summed over all unknowns."""
        n = len(state.point)
        total = np.zeros((n + len(state.effects),) * np.ndim(parts[0]))
        for places, part in zip(self.effects_of, parts, strict=True):
            used = np.r_[:n, n + places.start : n + places.stop]
            total[np.ix_(*(used,) * part.ndim)] += part
        return total

    def normal(self, state: State, predicted: Array, slopes: Sequence[Array] | None = None) -> Normal:
        """Gauss-Newton equations, by default with coarse derivatives from the first draws."""
        slopes = slopes or self.slopes(state, n_draws=2 * PAIRS_OF_SLOPES, coarse=True)
        white, n = self.white(self.residual(predicted)), len(state.point)
        slope = self.gathered(state, [columns @ left for columns, left in zip(slopes, white, strict=True)])
        slope[n:] -= self.prior(state)[n:] * state.effects
        of_emg = self.emg_normal(state)
        return Normal(self._information(state, slopes, of_emg), slope + of_emg.slope)

    def unexplained(
        self, state: State, slopes: Sequence[Array], records: Iterable[Sequence[Array]]
    ) -> list[list[Array]]:
        """Residuals that a fit, linearised at a state, would leave of white records of all trials.

        Args:
          state: where the fit is.
          slopes: from `slopes`.
          records: any number of them, of each trial (number,).
        """
        n, information, left = len(state.point), self._information(state, slopes), []
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

    def _information(self, state: State, slopes: Sequence[Array], of_emg: Normal | None = None) -> Array:
        """Of trials, EMG and prior, were the noise white, (unknown, unknown)."""
        of_emg = of_emg or self.emg_normal(state)
        of_movement = self.gathered(state, [columns @ columns.T for columns in slopes])
        return of_movement + of_emg.matrix + np.diag(self.prior(state))

    def emg_normal(self, state: State, *, as_variance: bool = False) -> Normal:
        """Gauss-Newton equations of the EMG alone; zero without any.

        Args:
          state: where they are.
          as_variance: whether the matrix is the variance of the slope, as the noise is estimated.
        """
        n, at = len(state.point), self._reflexes(state)
        changes = np.zeros((n + len(state.effects), *at.shape))
        if not self._emg.is_empty:
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
        if self._emg.is_empty:
            return np.zeros((self.n_trials, N_REFLEX))
        return np.array([reflex_values(subject) for subject in self.subjects(state)])

    def prior(self, state: State) -> Array:
        """Information in the prior, (unknown,)."""
        return np.concatenate([np.full(len(state.point), WIDE**-2), 1.0 / state.spread[self.kind_of] ** 2])


def _padded(signal: Array, n: int) -> Array:
    """Signals (trial, time, axis) of n samples, cut or held at their last value."""
    missing = n - signal.shape[1]
    return signal[:, :n] if missing <= 0 else np.pad(signal, ((0, 0), (0, missing), (0, 0)), mode="edge")
