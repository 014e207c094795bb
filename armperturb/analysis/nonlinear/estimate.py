"""Muscle law, reflexes and body of greatest likelihood, from any number of raw trials of one person.

Levenberg-Marquardt steps in the coordinates of the parameters (see `model.coordinate`), with the noise weighed anew
before each; first without noise in the prediction, then in its presence (see `problem`). Steps that make an arm
unstable, or less likely, are shortened. Last come Gauss-Newton steps whose weights and derivatives stay, the latter
averaged over all draws: those of few draws add noise of their own to the estimate. These steps find the spread of the
trials as well.

Errors are those of an estimating equation (Huber 1967, Proc. 5th Berkeley Symp. 1): A^-1 B A^-1, with A the derivative
of the score and B its variance, which is simulated. The inverse information alone, A^-1, takes the noise for stationary
and is a third too small for muscles that yield.
"""

import functools
import hashlib
import io
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import linalg, stats

from armperturb.analysis.fit.likelihood import LackOfFit
from armperturb.analysis.nonlinear.model import EFFECTS, SIGNED, Model, Parameters, coordinate, stem, value_at
from armperturb.analysis.nonlinear.noise import Noise
from armperturb.analysis.nonlinear.problem import Normal, Problem, State
from armperturb.analysis.nonlinear.start import best_start, start_values
from armperturb.analysis.nonlinear.trials import TrialSet
from armperturb.arrays import Array
from armperturb.files import written_whole
from armperturb.subject import Subject

N_PAIRS = 6
"""Pairs of draws of the noise: with half as many, the damping that thins in relaxed people comes out a third off."""

MAX_ROUNDS = 40
"""Of each of the two searches that come before the last steps."""

N_PAIRS_OF_ERRORS = 16
"""Pairs of draws that tell the variance of the score: with 8 trials, errors are known within some 7 %."""

SEARCHED, NEAR, SETTLED = 1.0, 0.3, 0.05
"""Steps this small in units of the standard error end the searches, and the last steps if nothing near is likelier, or
anyway [-]."""

MAX_LAST, MAX_EXPECTATIONS = 16, 200
"""Most sets of weights and derivatives for the last steps, and steps of expectation maximisation in each."""

FAR = 0.3
"""Change of a logarithm from which on derivatives are taken anew in the last steps [-]."""

ENOUGH = 1e-3
"""Gain in a step over the cost that ends the search without noise [-]: what is left to gain there is bias, for which
parameters that trials tell badly run away."""

DAMPINGS = (0.03, 0.3, 3.0, 30.0)
"""Factors on the last damping of the steps that are tried side by side."""

MOST_DAMPING = 1e6
LONGEST = 1.0
"""Longest step of a logarithm [-]."""

LEAST_SPREAD, MOST_SPREAD = 0.01, 0.5
"""Trials differ by this at least, and at most [-]."""

UNCERTAIN, ALIKE = 0.25, 0.95
"""From when on remarks are made: standard error of a logarithm, and correlation of errors [-]."""

TOGETHER = 0.8
"""Correlation from which on it is said what two parameters are told of together, if one of them is not [-]."""

SHORTER = (1.0, 0.5, 0.25, 0.1, 0.03)
"""Parts of a last step that are tried in turn [-]."""

AT_BOUND = 1e-3
"""A logarithm this close to its bound sits on it [-]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NonlinearEstimate:
    """Parameters of greatest likelihood.

    Attributes:
      model: the structure.
      parameters: what was free in it.
      values: free parameter to its estimate, in the units of `Subject` and `MuscleLaw`.
      log_error: standard error of the estimates' logarithms; of their `coordinate`, if they may be negative.
      correlation: of these errors, (parameter, parameter), in the order of `values`.
      spread: task and quantity to the SD over trials of the logarithm of a factor on it.
      objective: minus twice the logarithm of the likelihood, effects at their best, but for a constant.
      lack_of_fit: condition to what is left in its residual that the disturbance explains.
      n_rounds: steps of all searches.
      converged: whether they ended at a maximum.
      status: how, in words.
      at_bound: parameters that sit on a bound.
      n_conditions: how many conditions with different amplitudes told it.
      state: where the search ended.
      noises: of each set of trials.
    """

    model: Model
    parameters: Parameters
    values: Mapping[str, float]
    log_error: Mapping[str, float]
    correlation: Array
    spread: Mapping[tuple[str, str], float]
    objective: float
    lack_of_fit: Mapping[str, LackOfFit]
    n_rounds: int
    converged: bool
    status: str
    at_bound: tuple[str, ...]
    n_conditions: int
    state: State
    noises: tuple[Noise, ...]

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of a parameter: symmetric in its `coordinate`."""
        half = float(stats.norm.ppf(0.5 + level / 2.0)) * self.log_error[name]
        middle = coordinate(name, self.values[name])
        return value_at(name, middle - half), value_at(name, middle + half)

    def subject(self, task: str, condition: str = "") -> Subject:
        """The person in a task and condition, in a trial like the average one."""
        return self.parameters.person(task, self.state.point, condition)

    def remarks(self) -> tuple[str, ...]:
        """What a reader must know before trusting the values, a sentence each."""
        said = []
        if not self.converged:
            said.append(f"the search did not end at a maximum ({self.status})")
        if self.n_conditions < 2 and self.model.law != "linear":
            said.append(
                "all trials have one amplitude: they can hardly tell what yields from what does not, nor damping that "
                "thins from less damping"
            )
        said += [f"{name} sits on a bound" for name in self.at_bound]
        for name, error in self.log_error.items():
            if error > UNCERTAIN and name not in self.at_bound:
                low, high = self.interval(name)
                said.append(f"{name} is not told by these trials: {self.values[name]:.3g} ({low:.2g} to {high:.2g})")
        names = list(self.values)
        said += [self._together(i, j) for i, j in self._told_together()]
        for i, j in zip(*np.nonzero(np.triu(np.abs(self.correlation) > ALIKE, 1)), strict=True):
            said.append(
                f"{names[i]} and {names[j]} can hardly be told apart: their errors correlate, "
                f"{self.correlation[i, j]:.2f}"
            )
        return tuple(said)

    def _combined(self, i: int, j: int) -> tuple[float, float]:
        """Exponent of the second parameter in the ratio or product that is told, and its logarithm's standard error."""
        a, b = (list(self.log_error.values())[k] for k in (i, j))
        correlation = self.correlation[i, j]
        return -float(np.sign(correlation)), float(np.sqrt(max(a**2 + b**2 - 2.0 * abs(correlation) * a * b, 0.0)))

    def _told_together(self) -> list[tuple[int, int]]:
        """Pairs of which one at least is not told, but their ratio or product is."""
        error, names = np.array(list(self.log_error.values())), list(self.values)
        pairs = zip(*np.nonzero(np.triu(np.abs(self.correlation) > TOGETHER, 1)), strict=True)
        # What is not far from zero has no logarithm, and stands in no ratio.
        without = {*self.at_bound, *(name for name in names if self.values[name] <= 10.0 * SIGNED.get(stem(name), 0.0))}
        return [
            (int(i), int(j))
            for i, j in pairs
            if max(error[i], error[j]) > UNCERTAIN >= self._combined(i, j)[1] and not {names[i], names[j]} & without
        ]

    def _together(self, i: int, j: int) -> str:
        (name, value), (other, by) = (list(self.values.items())[k] for k in (i, j))
        exponent, error = self._combined(i, j)
        combined, factor = value * by**exponent, float(np.exp(stats.norm.ppf(0.975) * error))
        what = f"{name} / {other}" if exponent < 0.0 else f"{name} * {other}"
        return (
            f"{what} is told: {combined:.3g} ({combined / factor:.2g} to {combined * factor:.2g}), standard error of "
            f"the logarithm {error:.2f}, of each alone {self.log_error[name]:.2f} and {self.log_error[other]:.2f}"
        )


def fit(
    sets: Sequence[TrialSet],
    arms: Mapping[str, Subject],
    model: Model | None = None,
    *,
    start: Mapping[str, float] | None = None,
    n_pairs: int = N_PAIRS,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Callable[[str], object] | None = None,
    threads: int = 1,
) -> NonlinearEstimate:
    """Fit one person.

    Args:
      sets: trials of one person, see `training_sets`. The first condition of the position task has level 1.
      arms: condition to a linear arm that fits it; where there is none, the nearest of its task is taken.
      model: the structure; by default the full law.
      start: parameter to the value that it starts with, instead of what the linear arms say.
      n_pairs: draws of the noise, pairs of opposite sign, in whose presence trials are predicted; 0 leaves noise out.
      seed: of the draws.
      checkpoint: file in which the search is kept after each step; a search that was stopped there goes on.
      progress: called with a line after each step.
      threads: how many simulate at a time; no effect on what they find.

    Raises:
      ValueError: trials are of several people or rates, there are none, `start` or `model` names what is not free, or
        the arm at the start is unstable.
      OSError: the checkpoint cannot be read or written.
    """
    model = model or Model()
    parameters = free_parameters(sets, model)
    everywhere = nearest_arms(sets, arms)
    problem = Problem(parameters, sets, everywhere, threads)
    point = start_values(parameters, sets, everywhere, start or {})
    search = _Search(problem, repr((point.tolist(), sorted(everywhere.items()))), n_pairs, seed, checkpoint, progress)
    if not search.resume():
        search.state = best_start(problem, point, start or {})
    return search.run()


def free_parameters(sets: Sequence[TrialSet], model: Model) -> Parameters:
    """What is free in a structure for these trials.

    Raises:
      ValueError: trials are of several people, there are none, or the structure names what they have not.
    """
    return Parameters(model, *_people(sets))


def _people(sets: Sequence[TrialSet]) -> tuple[dict[str, Subject], dict[str, tuple[str, ...]]]:
    if not sets:
        raise ValueError("no trials; expected at least one")
    for name in ("name", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        found = list(dict.fromkeys(getattr(one.body, name) for one in sets))
        if len(found) > 1:
            raise ValueError(
                f"trials differ in {'subject' if name == 'name' else name} ({', '.join(map(str, found))}); expected "
                "one person in one posture"
            )
    bodies = {one.body.task: one.body for one in sets}
    bodies = {task: bodies[task] for task in EFFECTS if task in bodies}
    conditions = {}
    for task in bodies:
        labels = [one.label for one in sets if one.body.task == task]
        # Level 1 is that of the condition with most trials.
        count = {label: sum(one.n_trials for one in sets if one.label == label) for label in labels}
        conditions[task] = tuple(sorted(count, key=lambda label: -count[label]))
    return bodies, conditions


def nearest_arms(sets: Sequence[TrialSet], arms: Mapping[str, Subject]) -> dict[str, Subject]:
    """Condition to its linear arm, or to that of the condition of its task whose movements are nearest in size.

    Raises:
      ValueError: there is no arm of a task.
    """
    return {one.label: _nearest(one, sets, arms) for one in sets}


def _nearest(one: TrialSet, sets: Sequence[TrialSet], arms: Mapping[str, Subject]) -> Subject:
    if one.label in arms:
        return arms[one.label]

    def size(of: TrialSet) -> float:
        return float(np.log(of.displacement[:, : of.end].std()))

    others = [of for of in sets if of.body.task == one.body.task and of.label in arms]
    if not others:
        raise ValueError(f"arms: none of the task {one.body.task}; expected at least one")
    return arms[min(others, key=lambda of: abs(size(of) - size(one))).label]


class _Search:
    def __init__(
        self,
        problem: Problem,
        origin: str,
        n_pairs: int,
        seed: int,
        checkpoint: Path | None,
        progress: Callable[[str], object] | None,
    ) -> None:
        self._problem, self._origin, self._n_pairs, self._seed = problem, origin, n_pairs, seed
        self._checkpoint, self._progress = checkpoint, progress
        self.state: State
        self._rounds, self._damping, self._stage = 0, 1.0, "plain"
        self._drawn: list[tuple[Array, Array]] = []
        self._last_at: State

    def run(self) -> NonlinearEstimate:
        if self._stage == "plain":
            self._approach()
            if self._n_pairs:
                self._draw()
            self._enter("noisy" if self._n_pairs else "last")
        if self._stage == "noisy":
            self._approach()
            self._enter("last")
        return self._estimate(*self._settle())

    def _enter(self, stage: str) -> None:
        self._stage, self._damping, self._last_at = stage, 1.0, self.state
        self._keep()

    def _draw(self) -> None:
        """Predict in the presence of the noise that is left at this state."""
        problem = self._problem
        residual = problem.residual(problem.predict([self.state])[0])
        problem.weigh(residual)
        problem.draw(self.state, residual, self._n_pairs, self._seed)
        self._drawn = [(noise.root, noise.strength) for noise in problem.noises]

    def _approach(self) -> None:
        """Step until steps are short."""
        problem, n = self._problem, len(self.state.point)
        predicted = problem.predict([self.state])[0]
        for _ in range(MAX_ROUNDS):
            problem.weigh(problem.residual(predicted))
            before = problem.cost(self.state, predicted)
            normal = problem.normal(self.state, predicted)
            error = np.sqrt(np.diag(_inverse(normal.matrix)))
            candidates = [self._stepped(normal, self._damping * factor) for factor in DAMPINGS]
            answers = problem.predict(candidates)
            costs = [problem.cost(one, answer) for one, answer in zip(candidates, answers, strict=True)]
            best = int(np.argmin(costs))
            step = float(np.max(np.abs(candidates[best].point - self.state.point) / error[:n], initial=0.0))
            self._tell(min(costs[best], before), step)
            if costs[best] < before:
                self._damping = float(np.clip(self._damping * DAMPINGS[best], 1e-4, MOST_DAMPING))
                self.state = self._with_spread(candidates[best], error[n:])
                predicted = answers[best]
                self._keep()
            elif self._damping > MOST_DAMPING:
                return
            else:
                self._damping *= DAMPINGS[-1]
            if step < SEARCHED or (not problem.is_noisy and 0.0 < before - costs[best] < ENOUGH * before):
                return

    def _settle(self) -> tuple[str, list[Array]]:
        """The last steps; says how they ended, and with which derivatives."""
        problem = self._problem
        for _ in range(MAX_LAST):
            predicted = problem.predict([self._last_at])[0]
            problem.weigh(problem.residual(predicted))
            slopes = problem.slopes(self._last_at)
            if self._moved():
                predicted = problem.predict([self.state])[0]
            status = self._descend(slopes, predicted)
            if status:
                return status, slopes
            self._last_at = self.state
            self._keep()
        return f"not settled after {MAX_LAST} times the last steps", slopes

    def _moved(self) -> float:
        """How far the point has come since weights and derivatives were taken."""
        return float(np.max(np.abs(self.state.point - self._last_at.point), initial=0.0))

    def _descend(self, slopes: list[Array], predicted: Array) -> str:
        """Gauss-Newton steps with weights and derivatives that stay; says how they ended, "" if those hold no more."""
        problem = self._problem
        while True:
            likeliest, step = self._likeliest(problem.normal(self.state, predicted, slopes))
            before = problem.cost(self.state._replace(spread=likeliest.spread), predicted)
            for part in SHORTER:
                moved = State(
                    self.state.point + part * (likeliest.point - self.state.point),
                    self.state.effects + part * (likeliest.effects - self.state.effects),
                    likeliest.spread,
                )
                answer = problem.predict([moved])[0]
                cost = problem.cost(moved, answer)
                if cost < before:
                    break
            else:  # nothing near is likelier
                if step < NEAR:
                    return "settled"
                return "" if self._moved() else "no likelier step"
            self._tell(cost, part * step)
            self.state, predicted = moved, answer
            self._keep()
            if step < SETTLED:
                return "settled"
            if part < 1.0 or self._moved() > FAR:
                return ""

    def _likeliest(self, normal: Normal) -> tuple[State, float]:
        """Where the linearised problem has its maximum, spread included, and the largest step in standard errors."""
        problem, parameters = self._problem, self._problem.parameters
        state, n = self.state, len(self.state.point)
        old = np.concatenate([np.zeros(n), 1.0 / state.spread[problem.kind_of] ** 2])
        matrix, slope = normal.matrix - np.diag(old), normal.slope.copy()
        slope[n:] += old[n:] * state.effects
        free = np.ones(len(slope), dtype=bool)
        spread = state.spread
        for _ in range(MAX_EXPECTATIONS):
            prior = np.concatenate([np.zeros(n), 1.0 / spread[problem.kind_of] ** 2])
            inverse = np.zeros_like(matrix)
            inverse[np.ix_(free, free)] = _inverse((matrix + np.diag(prior))[np.ix_(free, free)])
            step = np.zeros(len(slope))
            step[free] = (
                inverse[np.ix_(free, free)] @ (slope - prior * np.concatenate([np.zeros(n), state.effects]))[free]
            )
            step[:n] = np.clip(step[:n], -LONGEST, LONGEST)
            point = np.clip(state.point + step[:n], parameters.lower, parameters.upper)
            # The others make up for a parameter that stops at its bound.
            stopped = free[:n] & (point != state.point + step[:n])
            step[:n] = point - state.point
            free[:n] &= ~stopped
            effects = state.effects + step[n:]
            square = effects**2 + np.diag(inverse)[n:]
            newer = np.array([np.sqrt(square[problem.kind_of == kind].mean()) for kind in range(len(spread))])
            newer = np.clip(newer, LEAST_SPREAD, MOST_SPREAD)
            done = not stopped.any() and np.allclose(newer, spread, rtol=1e-3)
            spread = newer
            if done:
                break
        error = np.sqrt(np.maximum(np.diag(inverse)[:n], np.finfo(float).tiny))
        largest = float(np.max(np.abs(step[:n]) / error, initial=0.0, where=free[:n]))
        return State(point, effects, spread), largest

    def _stepped(self, normal: Normal, damping: float) -> State:
        parameters, n = self._problem.parameters, len(self.state.point)
        scale = np.diag(normal.matrix)
        step = np.linalg.solve(normal.matrix + np.diag((0.01 * damping + 1e-9) * scale + 1e-9), normal.slope)
        moved = self.state.point + np.clip(step[:n], -LONGEST, LONGEST)
        return self.state._replace(
            point=np.clip(moved, parameters.lower, parameters.upper), effects=self.state.effects + step[n:]
        )

    def _with_spread(self, state: State, error: Array) -> State:
        """Spread of the effects that is most likely (a step of expectation maximisation)."""
        square = state.effects**2 + error**2
        spread = [np.sqrt(square[self._problem.kind_of == kind].mean()) for kind in range(len(state.spread))]
        return state._replace(spread=np.clip(spread, LEAST_SPREAD, MOST_SPREAD))

    def _estimate(self, status: str, slopes: list[Array]) -> NonlinearEstimate:
        problem, parameters, state = self._problem, self._problem.parameters, self.state
        n = len(state.point)
        restless = problem.restless(state)
        if restless:
            status = f"the arm sustains oscillations in {', '.join(restless)}, errors mean nothing"
        predicted = problem.predict([state])[0]
        inverse = _inverse(problem.normal(state, predicted, slopes).matrix)
        drawn = problem.drawn(state, N_PAIRS_OF_ERRORS if problem.is_noisy else 0, self._n_pairs, self._seed + 1)
        if problem.is_noisy and not drawn.odd:
            status = "noise like the person's makes the arm blow up, errors mean nothing"
        elif problem.is_noisy:
            inverse = inverse @ problem.score_variance(state, slopes, drawn) @ inverse
        lack_of_fit = problem.lack_of_fit(state, predicted, slopes, drawn)
        covariance = inverse[:n, :n]
        error = np.sqrt(np.diag(covariance))
        near = np.minimum(state.point - parameters.lower, parameters.upper - state.point) < AT_BOUND
        problem.weigh(problem.residual(predicted))
        return NonlinearEstimate(
            model=parameters.model,
            parameters=parameters,
            values={name: value_at(name, at) for name, at in zip(parameters.names, state.point, strict=True)},
            log_error=dict(zip(parameters.names, error.tolist(), strict=True)),
            correlation=covariance / np.outer(error, error),
            spread=dict(zip(problem.kinds, state.spread.tolist(), strict=True)),
            objective=problem.objective(state, predicted),
            lack_of_fit=lack_of_fit,
            n_rounds=self._rounds,
            converged=status == "settled",
            status=status,
            at_bound=tuple(name for name, hit in zip(parameters.names, near, strict=True) if hit),
            n_conditions=len({one.label for one in problem.sets}),
            state=state,
            noises=tuple(problem.noises),
        )

    def _tell(self, cost: float, step: float) -> None:
        self._rounds += 1
        if self._progress is not None:
            self._progress(f"round {self._rounds}: cost {cost:.1f}, largest step {step:.2f} SE")

    @functools.cached_property
    def _key(self) -> str:
        """Digest of all that a search depends on."""
        digest = hashlib.sha256(
            repr((self._problem.parameters.model, self._origin, self._n_pairs, self._seed)).encode()
        )
        for one in self._problem.sets:
            digest.update(repr((one.label, one.body, one.environment, one.end)).encode())
            for signal in (one.perturbation, one.displacement):
                digest.update(np.ascontiguousarray(signal).tobytes())
        return digest.hexdigest()

    def _keep(self) -> None:
        if self._checkpoint is None:
            return
        kept: dict[str, Any] = {
            "key": self._key,
            "rounds": self._rounds,
            "damping": self._damping,
            "stage": self._stage,
            **self.state._asdict(),
            **{f"root_{i}": root for i, (root, _) in enumerate(self._drawn)},
            **{f"strength_{i}": strength for i, (_, strength) in enumerate(self._drawn)},
        }
        if self._stage == "last":
            kept |= {f"last_at_{name}": value for name, value in self._last_at._asdict().items()}
        buffer = io.BytesIO()
        np.savez(buffer, **kept)
        with written_whole(self._checkpoint) as path:
            path.write_bytes(buffer.getvalue())

    def resume(self) -> bool:
        """Go on where a search of the same trials and structure was stopped; whether there was one."""
        if self._checkpoint is None or not self._checkpoint.exists():
            return False
        try:
            with np.load(io.BytesIO(self._checkpoint.read_bytes())) as kept:
                found = {name: kept[name] for name in kept.files}
        except (ValueError, OSError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error):
            return False  # a damaged file: nothing to go on with
        if str(found.get("key")) != self._key:
            return False

        def state(prefix: str) -> State:
            return State(*(found[prefix + name] for name in State._fields))

        self.state, self._stage = state(""), str(found["stage"])
        self._rounds, self._damping = int(found["rounds"]), float(found["damping"])
        if "root_0" in found:
            self._drawn = [(found[f"root_{i}"], found[f"strength_{i}"]) for i in range(len(self._problem.noises))]
            for noise, (root, strength) in zip(self._problem.noises, self._drawn, strict=True):
                noise.root, noise.strength = root, strength
            self._problem.draw_again(self._n_pairs, self._seed)
        if self._stage == "last":
            self._last_at = state("last_at_")
        return True


def _inverse(matrix: Array) -> Array:
    """Inverse of an information matrix, also of one with nearly dependent columns."""
    scale = np.sqrt(np.diag(matrix))
    inverse = linalg.pinvh(matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    return np.asarray(inverse / np.outer(scale, scale))
