"""Trials of one person as any state of the unknowns simulates them, without noise or as the mean in its presence.

A muscle that yields is softer when noise moves it too, so the response without noise differs from the mean response in
its presence, and estimates from it are biased; the bias grows with the noise. The mean is taken over draws of the noise
(`draws`), in pairs of opposite sign, so that their linear responses cancel.

An elasto-plastic part yields at once, so the response of a muscle of few parts has kinks along the parameters, and its
likelihood several maxima. Responses that are averaged therefore have different elastic limits of one distribution
(`lanes.divisions`): their kinks lie elsewhere, and the mean is smoother.
"""

import itertools
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.nonlinear.model import EFFECTS, Parameters, person
from armperturb.analysis.nonlinear.noise import Noise, NoiseDraws
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, Indices
from armperturb.planar_arm.lanes import Table, divisions, lane_table
from armperturb.planar_arm.simulation import Disturbances
from armperturb.subject import Subject

COORDINATE_STEP = 1e-4
"""Change of a coordinate in finite differences [-]."""

SMOOTHED = 2
"""Divisions of the elastic limits over which derivatives without noise are averaged where they are to be smooth."""

REST = 8.0
"""How long nothing pushes an arm before it is tested for a limit cycle [s]."""

STILL = 0.1
"""Largest speed in the last second of `REST`, as a share of the largest speed before, of an arm that comes to rest
[-]. Arms without a limit cycle have less than 0.01."""


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


class SimulatedTrials:
    """Trials and a structure; each state of the unknowns predicts the trials.

    Attributes:
      parameters: what is free.
      sets: the trials.
      rows: places of each set's trials among all trials, (set,).
      n_trials: in all sets.
      tasks: of each trial, (trial,).
      conditions: of each trial, (trial,).
      kinds: task and quantity of the effects, (kind,).
      kind_of: kind of each effect, (effect,).
      effects_of: places of each trial's effects, (trial,).
      noises: of each set.
      perturbation: of all trials [N], (trial, time, axis).

    Args:
      parameters: what is free.
      sets: trials; each set has its own noise.
      arms: condition to a linear arm near the person there.
      threads: how many simulate at a time; no effect on the result.

    Raises:
      ValueError: sampling rates differ.
    """

    def __init__(
        self,
        parameters: Parameters,
        sets: Sequence[ConditionTrials],
        arms: Mapping[str, Subject],
        threads: int = 1,
    ) -> None:
        self._threads = threads
        self.parameters, self.sets = parameters, tuple(sets)
        self.n_trials = sum(trials.n_trials for trials in sets)
        self.tasks = [trials.body.task for trials in sets for _ in range(trials.n_trials)]
        self.conditions = [trials.label for trials in sets for _ in range(trials.n_trials)]
        self._environments = [trials.environment for trials in sets for _ in range(trials.n_trials)]
        self._ends = np.array([trials.end for trials in sets for _ in range(trials.n_trials)])
        firsts = np.cumsum([0, *(trials.n_trials for trials in sets)])
        self.rows = [slice(a, b) for a, b in itertools.pairwise(firsts.tolist())]
        self.kinds = [(task, quantity) for task in dict.fromkeys(self.tasks) for quantity in EFFECTS[task]]
        self.effects_of: list[slice] = []
        kind_of: list[int] = []
        for task in self.tasks:
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
        self._quiet = Disturbances(self.perturbation, self._rate, self._threads)
        self._averaged: tuple[Disturbances, ...] = (self._quiet,)

    @property
    def is_noisy(self) -> bool:
        """Whether predictions are means in the presence of noise."""
        return len(self._averaged) > 1

    def predict_with(self, draws: NoiseDraws) -> None:
        """From now on predict the mean response in the presence of these draws of the noise."""
        self._averaged = tuple(disturbances for pair in self.disturbed(draws) for disturbances in pair)

    def disturbed(
        self, draws: NoiseDraws, pairs: Container[int] | None = None
    ) -> Iterator[tuple[Disturbances, Disturbances]]:
        """The disturbances plus and minus each draw of the noise, by default of all pairs."""
        for pair, standard in enumerate(draws.standard(self.perturbation.shape)):
            if pairs is not None and pair not in pairs:
                continue
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

    def sensitivity(
        self,
        state: State,
        disturbances: Sequence[Disturbances] = (),
        trials: Indices | None = None,
        *,
        first: int = 0,
        n_divisions: int = 1,
    ) -> Array:
        """How far trials, by default all, move when all unknowns change a little [m], RMS, (trial,).

        Of several disturbances the largest, by default without noise; infinite where an arm diverges. Each disturbance
        has its division of the elastic limits, see `_responses`.
        """
        steps = self._steps(state)
        moved = state._replace(point=state.point + steps, effects=state.effects + COORDINATE_STEP)
        largest = np.zeros(self.n_trials if trials is None else len(trials))
        for number, each in enumerate(disturbances or (self._quiet,), first):
            here, there = self.predict([state, moved], (each,), trials, first=number, n_divisions=n_divisions)
            size = np.sqrt(np.mean((there - here) ** 2, axis=(1, 2)))
            largest = np.maximum(largest, np.where(np.isfinite(size), size, np.inf))
        return largest

    def _steps(self, state: State) -> Array:
        """Changes of the parameters for differences: beyond a bound there may be no such person, (parameter,)."""
        is_inside = state.point + COORDINATE_STEP <= self.parameters.upper
        return np.where(is_inside, COORDINATE_STEP, -COORDINATE_STEP)

    def subjects(self, state: State, trials: Indices | None = None) -> list[Subject | None]:
        """The person in each of some trials, by default all; None where values make none, as of negative stiffness."""
        bodies, model = self.parameters.bodies, self.parameters.model
        values = {task: self.parameters.values(task, state.point) for task in bodies}
        people = []
        for trial in range(self.n_trials) if trials is None else trials.tolist():
            task = self.tasks[trial]
            effects = dict(zip(EFFECTS[task], state.effects[self.effects_of[trial]].tolist(), strict=True))
            try:
                subject = person(bodies[task], model.law, values[task], self.conditions[trial], effects, model.parts)
            except ValueError:
                subject = None
            people.append(subject)
        return people

    def _lanes(self, people: Sequence[Subject | None], trials: Indices, timestep: float) -> Table:
        """Of people in some trials, again and again; where there is nobody, of what stands in for them."""
        bodies = itertools.cycle([self.parameters.bodies[self.tasks[trial]] for trial in trials])
        simulated = [each or body for each, body in zip(people, bodies, strict=False)]
        environments = [self._environments[trial] for trial in trials] * (len(people) // len(trials))
        return lane_table(simulated, environments, timestep)

    def _responses(
        self,
        states: Sequence[State],
        disturbed: Sequence[Disturbances],
        trials: Indices | None = None,
        *,
        first: int = 0,
        n_divisions: int = 1,
    ) -> tuple[Indices, Iterator[Array]]:
        """What differs between states: a parameter that acts in some trials leaves the others as in another state.

        Args:
          states: of the unknowns.
          disturbed: by what.
          trials: by default all.
          first: division of the elastic limits under the first disturbance; the others have the next ones.
          n_divisions: how many there are, see `lanes.divisions`.

        Returns:
          Place of each answer among those that differ, (state, trial), and these with each of the disturbances:
          displacement [m], (place, time, axis).
        """
        trials = np.arange(self.n_trials) if trials is None else trials
        people = [each for state in states for each in self.subjects(state, trials)]
        lanes = self._lanes(people, trials, disturbed[0].timestep)
        of_lane, is_nobody = np.tile(trials, len(states)), np.array([each is None for each in people])
        known: dict[tuple[int, bool, bytes], int] = {}
        keys = zip(of_lane.tolist(), is_nobody.tolist(), (lane.tobytes() for lane in lanes), strict=True)
        place = np.array([known.setdefault(key, len(known)) for key in keys])
        distinct = np.unique(place, return_index=True)[1]
        of_lane = of_lane[distinct]
        place = place.reshape(len(states), len(trials))
        lanes, is_nobody = lanes[distinct], is_nobody[distinct]
        laws = [each.muscle if (each := people[lane]) else None for lane in distinct]
        numbers = range(first, first + len(disturbed))
        tables = (
            divisions(lanes, laws, n_divisions, numbers) if n_divisions > 1 else itertools.repeat(lanes, len(numbers))
        )
        simulated = (
            each.responses(table, of_lane, self._ends[of_lane]) for table, each in zip(tables, disturbed, strict=True)
        )
        if not is_nobody.any():
            return place, simulated
        return place, (np.where(is_nobody[:, None, None], np.nan, of_lanes) for of_lanes in simulated)

    def predict(
        self,
        states: Sequence[State],
        averaged: Sequence[Disturbances] = (),
        trials: Indices | None = None,
        *,
        first: int = 0,
        n_divisions: int = 0,
    ) -> Array:
        """Displacement [m], (state, trial, time, axis), by default of all trials.

        It is the mean over some disturbances, by default over those that `predict_with` was given.

        Args:
          states: of the unknowns.
          averaged: the disturbances.
          trials: by default all.
          first: division of the elastic limits under the first disturbance, see `_responses`.
          n_divisions: how many there are; by default as many as disturbances.
        """
        averaged = averaged or self._averaged
        n_divisions = n_divisions or len(averaged)
        place, responses = self._responses(states, averaged, trials, first=first, n_divisions=n_divisions)
        total = next(responses)
        for response in responses:
            total += response
        total /= len(averaged)
        return np.asarray(total[place])

    def derivatives(self, state: State, *, noisy: bool = False, smooth: bool = False) -> list[Array]:
        """Derivatives of the predictions of each trial [m], (parameters and own effects, time, axis).

        They are zero where an arm diverges, so that such a trial says nothing of where to go.

        Args:
          state: where they are taken.
          noisy: whether they are those of the mean response in the presence of the noise that is predicted with.
          smooth: whether those without noise are means over `SMOOTHED` divisions of the elastic limits.
        """
        n, along = len(state.point), self.parameters.along_effects(state.point)
        # What an effect does is simulated only where no parameters do the same.
        simulated = sorted({i for each in along.values() for i, weights in enumerate(each) if weights is None})
        steps = np.append(self._steps(state), np.full(len(simulated), COORDINATE_STEP))
        states = [state._replace(point=state.point + step) for step in np.diag(steps[:n])]
        for effect in simulated:
            moved = [places.start + effect for places in self.effects_of if places.start + effect < places.stop]
            effects = state.effects.copy()
            effects[moved] += COORDINATE_STEP
            states.append(state._replace(effects=effects))
        quiet = (self._quiet,) * (SMOOTHED if smooth else 1)
        predicted = self.predict([state, *states], self._averaged if noisy else quiet)
        changes = (predicted[1:] - predicted[0]) / steps[:, None, None, None]
        changes[:, ~np.isfinite(changes).all(axis=(0, 2, 3))] = 0.0
        derivatives = []
        for of_trial, task in zip(changes.swapaxes(0, 1), self.tasks, strict=True):
            of_effects = [
                of_trial[n + simulated.index(effect)]
                if weights is None or effect in simulated
                else np.tensordot(weights, of_trial[:n], 1)
                for effect, weights in enumerate(along[task])
            ]
            derivatives.append(np.array([*of_trial[:n], *of_effects]))
        return derivatives

    def limit_cycles(self, state: State) -> tuple[str, ...]:
        """Conditions in which an arm still moves a while after the last push: a self-sustained oscillation.

        Linear arms of large and of small movements may both be stable while one in between is not; delayed reflexes
        then sustain an oscillation. Its phase depends on parameters so strongly that confidence intervals are invalid.
        """
        n, n_second = self.perturbation.shape[1], round(self._rate)
        followed = np.pad(self.perturbation, ((0, 0), (0, round(REST * self._rate)), (0, 0)))
        disturbances = Disturbances(followed, self._rate, self._threads)
        lanes = self._lanes(self.subjects(state), np.arange(self.n_trials), disturbances.timestep)
        displacement = disturbances.responses(lanes, np.arange(self.n_trials))
        speed = np.linalg.norm(np.diff(displacement, axis=1), axis=2)
        last = np.sqrt(np.mean(speed[:, -n_second:] ** 2, axis=1))
        still = last < STILL * speed[:, :n].max(axis=1)  # false where an arm diverges
        return tuple(dict.fromkeys(label for label, rests in zip(self.conditions, still, strict=True) if not rests))


def _padded(signal: Array, n: int) -> Array:
    """Signals (trial, time, axis) of n samples, cut or held at their last value."""
    missing = n - signal.shape[1]
    return signal[:, :n] if missing <= 0 else np.pad(signal, ((0, 0), (0, missing), (0, 0)), mode="edge")
