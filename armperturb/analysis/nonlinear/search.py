"""The search for the maximum of the likelihood, in four stages, each of which goes on where the one before ended.

The first three take Levenberg-Marquardt steps in the coordinates of the parameters, first without noise in the
prediction, then in its presence (`draws`), then in the presence of noise that is drawn anew: what a fit without noise
leaves, and how strongly its arm answers noise, may be far from the person's. The noise spectrum is re-estimated before
each step (iteratively reweighted). Steps after which an arm is unstable, or the likelihood lower, are shortened. In the
last stage, Gauss-Newton steps hold spectrum and derivatives, and estimate the spread of the trials as well.

The last stage looks for where the derivatives without noise and the residual of predictions in its presence are
orthogonal (`problem`). So a step of its is taken not if it raises the likelihood, but if less is then left to be gained
by another step. Spectrum and derivatives are taken anew after a few steps, which moves the maximum, often from one side
of where it comes to rest to the other and back. So every other time the search goes on from half-way.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy import linalg

from armperturb.analysis.nonlinear.draws import (
    borne_ahead,
    inverse_of_mixed,
    mixed_information,
    predict_with_noise,
    predict_with_stable_noise,
)
from armperturb.analysis.nonlinear.noise import NoiseDraws
from armperturb.analysis.nonlinear.problem import Normal, Problem
from armperturb.analysis.nonlinear.simulated import State
from armperturb.arrays import Array

MAX_STEPS = 40
"""Most steps of each of the first three stages."""

SEARCH_STEP, STALLED_STEP, FINAL_STEP = 1.0, 0.3, 0.05
"""Convergence thresholds: largest parameter change / standard error, for the first three stages, for a final stage that
cannot lower the cost by more than `NO_GAIN`, and for the final stage [-]."""

NO_GAIN = 0.05
"""Decrease of the cost that is nothing [-]: a parameter's standard error changes it by one. Draws of the noise make the
likelihood rough on the scale of a few tenths of a standard error, so that a search may go on much longer without any
change that matters."""

MAX_REFERENCES, FEW_STEPS, MAX_FINAL_STEPS, MAX_EXPECTATIONS = 6, 3, 40, 200
"""Most times that the last stage takes spectrum and derivatives anew, steps with each of them, steps with those of the
last time, and steps of expectation maximisation in each of these."""

MOST_CALMED = 3
"""How often noise with which an arm runs away where the search ends is drawn anew, and the search goes on."""

ENOUGH = 1e-3
"""Relative decrease of the cost below which the noise-free stage stops: further steps only fit bias in poorly
determined parameters [-]."""

DAMPINGS = (0.03, 0.3, 3.0, 30.0)
"""Factors on the last damping, tried side by side."""

MOST_DAMPING = 1e6
LONGEST = 1.0
"""Longest step of a coordinate [-]."""

LEAST_SPREAD, MOST_SPREAD = 0.01, 0.5
"""Bounds on the spread of trials [-]."""

REACH = 0.5
"""How far about a final step may change a coordinate of which little is known [-]."""

SHORTER = (1.0, 0.5, 0.25, 0.1, 0.03)
"""Parts of a final step that are tried in turn [-]."""

CONVERGED = "converged"
"""How a search ends that has found a maximum."""


Stage = Literal["noise-free", "noisy", "drawn-anew", "final"]
"""Part of the search."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Position:
    """Where a search is, and all that it needs to go on from there.

    Attributes:
      stage: that it is in.
      state: of the unknowns.
      reference: state at which the last stage has its spectrum and derivatives.
      damping: of the last step.
      n_steps: that were taken in all stages.
      n_references: how often the last stage has taken spectrum and derivatives anew.
      draws: of the noise in whose presence trials are predicted; None for none.
    """

    stage: Stage = "noise-free"
    state: State
    reference: State
    damping: float = 1.0
    n_steps: int = 0
    n_references: int = 0
    draws: NoiseDraws | None = None


class _Ahead(NamedTuple):
    """What a linearised problem says of the way to its maximum.

    Attributes:
      maximum: where it is.
      step: largest change of a parameter on the way / standard error [-].
      gain: by how much the cost is lower there [-].
    """

    maximum: State
    step: float
    gain: float


class Search:
    """One search."""

    def __init__(
        self,
        problem: Problem,
        begin: Position,
        *,
        n_pairs: int,
        seed: int,
        max_steps: int = MAX_STEPS,
        save: Callable[[Position], object] | None = None,
        progress: Callable[[str], object] | None = None,
    ) -> None:
        """Go to where the search begins.

        Args:
          problem: what is fitted.
          begin: position to start from, or one that an earlier search had saved.
          n_pairs: draws of the noise, pairs of opposite sign, in whose presence trials are predicted; 0 for none.
          seed: of the draws.
          max_steps: most steps of each of the first three stages.
          save: called with the position after each step.
          progress: called with a line after each step.
        """
        self._problem, self._at = problem, begin
        self._n_pairs, self._seed, self._max_steps = n_pairs, seed, max_steps
        self._save, self._progress = save, progress
        if begin.draws is not None:
            problem.predict_with(begin.draws)

    def run(self) -> tuple[Position, str, list[Array]]:
        """Search on to the end."""
        if self._at.stage == "noise-free":
            self._approach()
            self._enter("noisy" if self._n_pairs else "final", self._drawn() if self._n_pairs else None)
        if self._at.stage == "noisy":
            self._approach()
            self._enter("drawn-anew", self._drawn())
        if self._at.stage == "drawn-anew":
            self._approach()
            self._enter("final", self._at.draws)
        self._calmed()
        for _ in range(MOST_CALMED):
            message, slopes = self._finish()
            if not self._calmed():
                break
            self._at = replace(self._at, n_references=0)
        return self._at, message, slopes

    def _enter(self, stage: Stage, draws: NoiseDraws | None) -> None:
        self._at = replace(self._at, stage=stage, damping=1.0, reference=self._at.state, n_references=0, draws=draws)
        self._keep()

    def _drawn(self) -> NoiseDraws:
        """Draws of the noise that is left at this state."""
        problem, state = self._problem, self._at.state
        residual = problem.residual(problem.predict([state])[0])
        problem.weigh(state, residual)
        return predict_with_noise(problem, state, residual, self._n_pairs, self._seed)

    def _approach(self) -> None:
        """Levenberg-Marquardt steps until they are short."""
        problem, n = self._problem, len(self._at.state.point)
        predicted = problem.predict([self._at.state])[0]
        for _ in range(self._max_steps):
            problem.weigh(self._at.state, problem.residual(predicted))
            state, damping = self._at.state, self._at.damping
            before = problem.cost(state, predicted)
            normal = problem.normal(state, predicted)
            error = np.sqrt(np.diag(inverse(normal.matrix)))
            candidates = [self._stepped(normal, damping * factor) for factor in DAMPINGS]
            answers = problem.predict(candidates)
            costs = [problem.cost(moved, answer) for moved, answer in zip(candidates, answers, strict=True)]
            best = int(np.argmin(costs))
            step = float(np.max(np.abs(candidates[best].point - state.point) / error[:n], initial=0.0))
            self._count(min(costs[best], before), step)
            if costs[best] < before:
                damping = float(np.clip(damping * DAMPINGS[best], 1e-4, MOST_DAMPING))
                self._at = replace(self._at, state=self._with_spread(candidates[best], error[n:]), damping=damping)
                predicted = answers[best]
                self._keep()
            elif damping > MOST_DAMPING:
                return
            else:
                self._at = replace(self._at, damping=damping * DAMPINGS[-1])
            if step < SEARCH_STEP or (not problem.is_noisy and 0.0 < before - costs[best] < ENOUGH * before):
                return

    def _finish(self) -> tuple[str, list[Array]]:
        """The last stage; returns how it ended, and with which derivatives."""
        problem = self._problem
        predicted = problem.predict([self._at.reference])[0]
        while True:
            if not np.isfinite(predicted).all():
                raise ValueError(
                    "nonlinear fit: the arm runs away under the person's noise where the search has come to; expected "
                    "trials that tell of a stable arm (more of them, or --law short-range or linear)"
                )
            problem.weigh(self._at.reference, problem.residual(predicted))
            slopes = problem.slopes(self._at.reference, smooth=True)
            if self._distance():
                predicted = problem.predict([self._at.state])[0]
            message, predicted = self._descend(slopes, predicted, is_last=self._at.n_references >= MAX_REFERENCES)
            if message:
                return message, slopes
            before, state = self._at.reference, self._at.state
            if self._at.n_references % 2:
                middle = State((before.point + state.point) / 2.0, (before.effects + state.effects) / 2.0, state.spread)
                of_middle = problem.predict([middle])[0]
                if np.isfinite(of_middle).all():
                    state, predicted = middle, of_middle
            self._at = replace(self._at, state=state, reference=state, n_references=self._at.n_references + 1)
            self._keep()

    def _calmed(self) -> bool:
        """Whether there was noise with which the arm runs away where the search is; it is drawn anew."""
        before, state = self._at.draws, self._at.state
        return before is not None and self._took(predict_with_stable_noise(self._problem, state, before))

    def _calmed_ahead(self, ahead: State) -> bool:
        """Whether noise with which the arm runs away at a state ahead was drawn anew, see `borne_ahead`."""
        before, state = self._at.draws, self._at.state
        return before is not None and self._took(borne_ahead(self._problem, state, ahead, before))

    def _took(self, draws: NoiseDraws) -> bool:
        """Whether draws are other ones than before; the search goes on with them."""
        if draws is self._at.draws:
            return False
        self._at = replace(self._at, draws=draws, reference=self._at.state)
        self._keep()
        return True

    def _distance(self) -> float:
        """How far the point has come since spectrum and derivatives were taken."""
        return float(np.max(np.abs(self._at.state.point - self._at.reference.point), initial=0.0))

    def _descend(self, slopes: list[Array], predicted: Array, *, is_last: bool) -> tuple[str, Array]:
        """Steps with one spectrum and one set of derivatives.

        Returns how they ended, "" if both are wanted anew, and what is predicted there.

        Where Gauss-Newton steps lead no nearer, how predictions move in the presence of the noise shows the way.
        """
        problem, mixed = self._problem, None
        of_trials = problem.information_of_trials(self._at.state, slopes)
        normal = problem.normal(self._at.state, predicted, slopes, of_trials)
        ahead = self._linearised_maximum(self._at.state, normal)
        for number in range(1, MAX_FINAL_STEPS + 1):
            state, (maximum, step, gain) = self._at.state, ahead
            for part in SHORTER:
                moved = State(
                    state.point + part * (maximum.point - state.point),
                    state.effects + part * (maximum.effects - state.effects),
                    maximum.spread,
                )
                answer = problem.predict([moved])[0]
                if np.isfinite(answer).all():
                    there = problem.normal(moved, answer, slopes, of_trials)
                    ahead = self._linearised_maximum(moved, there, mixed)
                    if ahead.gain < gain:
                        break
            else:  # no part of the step leaves less to be gained
                if not is_last and self._distance():
                    return "", predicted
                if not is_last and self._calmed_ahead(maximum):
                    return "", problem.predict([state])[0]
                if step < STALLED_STEP or gain < self._difference_of_seeds(slopes, normal):
                    return CONVERGED, predicted
                if mixed is not None or not problem.is_noisy:
                    return "no step leads nearer to the maximum", predicted
                mixed = mixed_information(problem, state, slopes, problem.slopes(state, noisy=True))
                ahead = self._linearised_maximum(state, normal, mixed)
                continue
            self._count(problem.cost(moved, answer), part * step)
            self._at, normal, predicted = replace(self._at, state=moved), there, answer
            self._keep()
            if is_last:
                if step < FINAL_STEP or (step < STALLED_STEP and gain - ahead.gain < NO_GAIN):
                    return CONVERGED, predicted
            elif number == 1 and step < FINAL_STEP:
                return CONVERGED, predicted
            elif number == FEW_STEPS or ahead.step < FINAL_STEP:
                return "", predicted
        return f"not converged after {MAX_FINAL_STEPS} steps with the same weights and derivatives", predicted

    def _difference_of_seeds(self, slopes: list[Array], normal: Normal) -> float:
        """What a fit with draws of another seed is expected to have to gain at this state, if this one has nothing."""
        problem, draws = self._problem, self._at.draws
        if draws is None or draws.n_pairs < 2:  # one pair does not tell how others differ
            return 0.0
        even = np.array([even for _, even in problem.odd_and_even(self._at.state, draws)])
        scores = [
            problem.gathered(self._at.state, [a @ b for a, b in zip(slopes, problem.white(each), strict=True)])
            for each in even - even.mean(axis=0)
        ]
        covariance = inverse(normal.matrix)
        of_one = np.mean([score @ covariance @ score for score in scores]) / (len(scores) - 1.0)
        return float(2.0 * of_one)

    def _linearised_maximum(self, state: State, normal: Normal, mixed: Array | None = None) -> "_Ahead":
        """Maximum of the problem linearised at a state, spread included.

        Args:
          state: where it is linearised.
          normal: equations there.
          mixed: how they change, see `mixed_information`; by default as without noise.
        """
        problem, parameters = self._problem, self._problem.parameters
        n = len(state.point)
        old = np.concatenate([np.zeros(n), 1.0 / state.spread[problem.kind_of] ** 2])
        matrix, slope = normal.matrix - np.diag(old), normal.slope.copy()
        slope[n:] += old[n:] * state.effects
        free = np.ones(len(slope), dtype=bool)
        spread = state.spread
        for _ in range(MAX_EXPECTATIONS):
            prior = np.concatenate([np.zeros(n), 1.0 / spread[problem.kind_of] ** 2])
            covariance = np.zeros_like(matrix)
            covariance[np.ix_(free, free)] = inverse((matrix + np.diag(prior))[np.ix_(free, free)])
            score = np.where(free, slope - prior * np.concatenate([np.zeros(n), state.effects]), 0.0)
            gain = float(score @ covariance @ score)
            # A step that is held back in what is poorly determined is made up for in the rest.
            near = np.diag(prior + np.concatenate([np.full(n, REACH**-2), np.zeros(len(score) - n)]))
            alone, moving = ((of + near)[np.ix_(free, free)] for of in (matrix, matrix if mixed is None else mixed))
            step = np.zeros_like(score)
            step[free] = (inverse(alone) if mixed is None else inverse_of_mixed(alone, moving)) @ score[free]
            step[:n] = np.clip(step[:n], -LONGEST, LONGEST)
            point = np.clip(state.point + step[:n], parameters.lower, parameters.upper)
            # The others make up for a parameter that stops at its bound.
            stopped = free[:n] & (point != state.point + step[:n])
            step[:n] = point - state.point
            free[:n] &= ~stopped
            effects = state.effects + step[n:]
            newer = self._spread(effects**2 + np.diag(covariance)[n:])
            done = not stopped.any() and np.allclose(newer, spread, rtol=1e-3)
            spread = newer
            if done:
                break
        error = np.sqrt(np.maximum(np.diag(covariance)[:n], np.finfo(float).tiny))
        largest = float(np.max(np.abs(step[:n]) / error, initial=0.0, where=free[:n]))
        return _Ahead(State(point, effects, spread), largest, gain)

    def _spread(self, square: Array) -> Array:
        """Spread of the effects with these expected squares, (kind,); the least where one trial tells of none."""
        of_kinds = [square[self._problem.kind_of == kind] for kind in range(len(self._problem.kinds))]
        spread = [np.sqrt(of_kind.mean()) if len(of_kind) > 1 else LEAST_SPREAD for of_kind in of_kinds]
        return np.clip(spread, LEAST_SPREAD, MOST_SPREAD)

    def _with_spread(self, state: State, error: Array) -> State:
        """The state with the spread of its effects after a step of expectation maximisation."""
        return state._replace(spread=self._spread(state.effects**2 + error**2))

    def _stepped(self, normal: Normal, damping: float) -> State:
        parameters, state, n = self._problem.parameters, self._at.state, len(self._at.state.point)
        scale = np.diag(normal.matrix)
        step = np.linalg.solve(normal.matrix + np.diag((0.01 * damping + 1e-9) * scale + 1e-9), normal.slope)
        moved = state.point + np.clip(step[:n], -LONGEST, LONGEST)
        return state._replace(
            point=np.clip(moved, parameters.lower, parameters.upper), effects=state.effects + step[n:]
        )

    def _count(self, cost: float, step: float) -> None:
        self._at = replace(self._at, n_steps=self._at.n_steps + 1)
        if self._progress is not None:
            stages, stage = get_args(Stage), self._at.stage
            where = f"{stage}, stage {stages.index(stage) + 1} of {len(stages)}"
            self._progress(f"step {self._at.n_steps} ({where}): cost {cost:.1f}, largest change {step:.2f} SE")

    def _keep(self) -> None:
        if self._save is not None:
            self._save(self._at)


def inverse(matrix: Array) -> Array:
    """Inverse of an information matrix, also of one with nearly dependent columns."""
    scale = np.sqrt(np.diag(matrix))
    scaled = linalg.pinvh(matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    return np.asarray(scaled / np.outer(scale, scale))
