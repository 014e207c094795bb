"""Muscle law, reflexes and body of greatest likelihood, from any number of raw trials of one person.

Levenberg-Marquardt steps in the logarithms of the parameters, with the noise weighed anew before each; first without
noise in the prediction, then in its presence (see `problem`). Steps that make an arm unstable, or less likely, are
shortened.
"""

import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from armperturb.nonlinear.model import EFFECTS, Model, Parameters
from armperturb.nonlinear.problem import Normal, Problem, State
from armperturb.nonlinear.start import best_start, start_values
from armperturb.nonlinear.trials import TrialSet
from armperturb.subject import Subject

Array = NDArray[np.float64]

N_PAIRS = 6
"""Pairs of draws of the noise: with half as many, the damping that thins in relaxed people comes out a third off."""

MAX_ROUNDS = 40
"""Of each of the two searches."""

SETTLED = 0.05
"""A step this small in units of the standard error ends a search [-]."""

DAMPINGS = (0.03, 0.3, 3.0, 30.0)
"""Factors on the last damping of the steps that are tried side by side."""

MOST_DAMPING = 1e6
LONGEST = 1.0
"""Longest step of a logarithm [-]."""

LEAST_SPREAD = 0.01
"""Trials differ by this at least [-]."""

UNCERTAIN, ALIKE = 0.5, 0.95
"""From when on remarks are made: standard error of a logarithm, and correlation of errors [-]."""

AT_BOUND = 1e-3
"""A logarithm this close to its bound sits on it [-]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NonlinearEstimate:
    """Parameters of greatest likelihood.

    Attributes:
      model: the structure.
      parameters: what was free in it.
      values: free parameter to its estimate, in the units of `Subject` and `MuscleLaw`.
      log_error: standard error of the estimates' logarithms, from the information and the spread of trials.
      correlation: of the logarithms' errors, (parameter, parameter), in the order of `values`.
      spread: task and quantity to the SD over trials of the logarithm of a factor on it.
      objective: minus twice the logarithm of the likelihood, effects at their best, but for a constant.
      n_rounds: steps in both searches.
      converged: whether both ended at a maximum.
      status: how, in words.
      at_bound: parameters that sit on a bound.
      n_conditions: how many conditions with different amplitudes told it.
      state: where the search ended.
    """

    model: Model
    parameters: Parameters
    values: Mapping[str, float]
    log_error: Mapping[str, float]
    correlation: Array
    spread: Mapping[tuple[str, str], float]
    objective: float
    n_rounds: int
    converged: bool
    status: str
    at_bound: tuple[str, ...]
    n_conditions: int
    state: State

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of a parameter: symmetric in its logarithm."""
        half = float(stats.norm.ppf(0.5 + level / 2.0)) * self.log_error[name]
        return self.values[name] * float(np.exp(-half)), self.values[name] * float(np.exp(half))

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
        for i, j in zip(*np.nonzero(np.triu(np.abs(self.correlation) > ALIKE, 1)), strict=True):
            said.append(
                f"{names[i]} and {names[j]} can hardly be told apart: their errors correlate, "
                f"{self.correlation[i, j]:.2f}"
            )
        return tuple(said)


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
    bodies, conditions = _people(sets)
    parameters = Parameters(model, bodies, conditions)
    everywhere = {one.label: _nearest(one, sets, arms) for one in sets}
    problem = Problem(parameters, sets, everywhere, threads)
    search = _Search(problem, n_pairs, seed, checkpoint, progress)
    if not search.resume():
        search.state = best_start(problem, start_values(parameters, sets, everywhere, start or {}), start or {})
    return search.run()


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


def _nearest(one: TrialSet, sets: Sequence[TrialSet], arms: Mapping[str, Subject]) -> Subject:
    """The linear arm of a condition, or of that condition of the task whose movements are nearest in size."""
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
        n_pairs: int,
        seed: int,
        checkpoint: Path | None,
        progress: Callable[[str], object] | None,
    ) -> None:
        self._problem, self._n_pairs, self._seed = problem, n_pairs, seed
        self._checkpoint, self._progress = checkpoint, progress
        self.state: State
        self._rounds, self._damping, self._noisy = 0, 1.0, False
        self._drawn: list[Array] = []

    def run(self) -> NonlinearEstimate:
        status = ""
        if not self._noisy:
            status = self._settle()
            if self._n_pairs:
                self._draw()
        if self._n_pairs:
            status = self._settle()
        return self._estimate(status)

    def _draw(self) -> None:
        problem = self._problem
        problem.weigh(problem.residual(problem.predict([self.state])[0]))
        self._drawn = [noise.root for noise in problem.noises]
        problem.draw(self.state, self._n_pairs, self._seed)
        self._noisy, self._damping = True, 1.0
        self._drawn_at = self.state

    def _settle(self) -> str:
        """Step until nothing changes; say how it ended."""
        problem, parameters = self._problem, self._problem.parameters
        n = len(parameters.names)
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
            self._rounds += 1
            step = np.abs(candidates[best].point - self.state.point) / error[:n]
            self._say(f"round {self._rounds}: cost {min(costs[best], before):.1f}, largest step {step.max():.2f} SE")
            if costs[best] < before:
                self._damping = float(np.clip(self._damping * DAMPINGS[best], 1e-4, MOST_DAMPING))
                self.state = self._with_spread(candidates[best], error[n:])
                predicted = answers[best]
                self._keep()
                if step.max() < SETTLED:
                    return "settled"
            else:
                if step.max() < SETTLED or self._damping > MOST_DAMPING:
                    return "settled"
                self._damping *= DAMPINGS[-1]
        return f"not settled after {MAX_ROUNDS} steps"

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
        return state._replace(spread=np.maximum(spread, LEAST_SPREAD))

    def _estimate(self, status: str) -> NonlinearEstimate:
        problem, parameters = self._problem, self._problem.parameters
        predicted = problem.predict([self.state])[0]
        problem.weigh(problem.residual(predicted))
        normal = problem.normal(self.state, predicted)
        n = len(parameters.names)
        covariance = _inverse(normal.matrix)[:n, :n]
        error = np.sqrt(np.diag(covariance))
        point = self.state.point
        near = np.minimum(point - parameters.lower, parameters.upper - point) < AT_BOUND
        return NonlinearEstimate(
            model=parameters.model,
            parameters=parameters,
            values=dict(zip(parameters.names, np.exp(point).tolist(), strict=True)),
            log_error=dict(zip(parameters.names, error.tolist(), strict=True)),
            correlation=covariance / np.outer(error, error),
            spread=dict(zip(problem.kinds, self.state.spread.tolist(), strict=True)),
            objective=problem.objective(self.state, predicted),
            n_rounds=self._rounds,
            converged=status == "settled",
            status=status,
            at_bound=tuple(name for name, hit in zip(parameters.names, near, strict=True) if hit),
            n_conditions=len({one.label for one in problem.sets}),
            state=self.state,
        )

    def _say(self, line: str) -> None:
        if self._progress is not None:
            self._progress(line)

    def _key(self) -> str:
        """Digest of all that a search depends on."""
        digest = hashlib.sha256(repr((self._problem.parameters.model, self._n_pairs, self._seed)).encode())
        for one in self._problem.sets:
            digest.update(repr((one.label, one.body, one.environment, one.end)).encode())
            for signal in (one.perturbation, one.displacement):
                digest.update(np.ascontiguousarray(signal).tobytes())
        return digest.hexdigest()

    def _keep(self) -> None:
        if self._checkpoint is None:
            return
        drawn = {f"drawn_{i}": root for i, root in enumerate(self._drawn)}
        at = self._drawn_at if self._noisy else self.state
        kept: dict[str, Any] = {
            "key": self._key(),
            "rounds": self._rounds,
            "damping": self._damping,
            "noisy": self._noisy,
            **self.state._asdict(),
            **{f"at_{name}": value for name, value in at._asdict().items()},
            **drawn,
        }
        buffer = io.BytesIO()
        np.savez(buffer, **kept)
        staged = self._checkpoint.with_name(self._checkpoint.name + ".part")
        staged.write_bytes(buffer.getvalue())
        staged.replace(self._checkpoint)

    def resume(self) -> bool:
        """Go on where a search of the same trials and structure was stopped; whether there was one."""
        if self._checkpoint is None or not self._checkpoint.exists():
            return False
        try:
            with np.load(self._checkpoint) as kept:
                found = {name: kept[name] for name in kept.files}
        except (ValueError, OSError, EOFError, KeyError):
            return False
        if str(found.get("key")) != self._key():
            return False
        self.state = State(found["point"], found["effects"], found["spread"])
        self._rounds, self._damping = int(found["rounds"]), float(found["damping"])
        if bool(found["noisy"]):
            at = State(found["at_point"], found["at_effects"], found["at_spread"])
            self._drawn = [found[f"drawn_{i}"] for i in range(len(self._problem.noises))]
            for noise, root in zip(self._problem.noises, self._drawn, strict=True):
                noise.root = root
            self._problem.draw(at, self._n_pairs, self._seed)
            self._noisy, self._drawn_at = True, at
        return True


def _inverse(matrix: Array) -> Array:
    """Inverse of an information matrix; directions that the trials say nothing of get large, finite variances."""
    scale = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix / np.outer(scale, scale)
    inverse = linalg.pinvh(scaled + 1e-12 * np.eye(len(scale)))
    return np.asarray(inverse / np.outer(scale, scale))
