"""Which law the trials support: structures judged by trials and pulses that they were not fitted to.

A larger law fits better whether it is true or not; it predicts other trials better only if it is. Trials of each
condition are therefore shared out among folds. A structure is fitted to all folds but one, noise included, and the
log-likelihood of the trials of that one is computed. Their own factors (see `problem`) are integrated over, by
Laplace's method.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from armperturb.analysis.fit.maximum_likelihood import SUSPICIOUS
from armperturb.analysis.nonlinear.draws import predict_with_stable_noise
from armperturb.analysis.nonlinear.estimate import (
    N_PAIRS,
    N_PAIRS_OF_ERRORS,
    fit,
    free_parameters,
    nearest_arms,
    require_draws,
)
from armperturb.analysis.nonlinear.model import Law, Model, bounds, stem
from armperturb.analysis.nonlinear.noise import NoiseDraws
from armperturb.analysis.nonlinear.prediction import PulsePrediction, facts_of, predict_pulses
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.result import NonlinearEstimate
from armperturb.analysis.nonlinear.simulated import State
from armperturb.analysis.results import Description, Result
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.subject import Subject
from armperturb.validation import require_whole

LAWS: tuple[Law, ...] = ("linear", "short-range", "full", "half-wave")
"""From the simplest to the largest."""

START_FROM: Mapping[Law, Law] = {"full": "short-range", "half-wave": "full"}
"""Law to the one from whose estimates it starts."""

MECHANISMS: Mapping[str, Mapping[str, float]] = {
    "thixotropy": {"loss_angle_deg": math.inf, "recovery_time": 1.0},
    "shear-thinning damping": {"thinning_velocity": math.inf},
    "spindle saturation": {"spindle_saturation": math.inf},
}
"""Mechanism of the full and the half-wave law to the values of its parameters that switch it off."""

CHANCE = 0.025
"""Probability of preferring a larger law that is no better [-]."""

N_FOLDS = 2
N_PAIRS_OF_FOLDS = 2
"""Pairs of draws of the noise in the folds' fits: laws differ by more than the error that so few draws leave."""

MAX_STEPS = 20
"""Of the search for the factors of left-out trials."""


class Gain(NamedTuple):
    """How much larger one structure's log-likelihood of left-out trials is than another one's.

    Attributes:
      mean: difference between log-likelihoods, summed over all trials [-].
      standard_error: of that, from how it differs between trials of a condition; infinite if none has two [-].
      dof: degrees of freedom of the latter.
    """

    mean: float
    standard_error: float
    dof: int

    @property
    def is_shown(self) -> bool:
        """Whether so large a gain has at most a probability of `CHANCE` if the true one is zero (one-sided t test)."""
        return self.dof > 0 and self.mean > float(stats.t.isf(CHANCE, self.dof)) * self.standard_error

    def __str__(self) -> str:
        change = "raises" if self.mean > 0.0 else "lowers"
        by_chance = ", not significant" if self.mean > 0.0 and not self.is_shown else ""
        return (
            f"{change} the log-likelihood of left-out trials by {abs(self.mean):.1f} (standard error "
            f"{self.standard_error:.1f}{by_chance})"
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Judged:
    """A structure, and how well it predicts what it was not fitted to.

    Attributes:
      model: the structure.
      estimate: from all trials to fit; None of laws that are not chosen, if no pulses are left out.
      log_likelihood: of each trial when it was left out [-], (trial,).
      conditions: of these trials.
      pulses: what the estimate predicts of pulses that were left out.
    """

    model: Model
    estimate: NonlinearEstimate | None
    log_likelihood: Array
    conditions: tuple[str, ...]
    pulses: tuple[PulsePrediction, ...]

    def gain(self, over: "Judged") -> Gain:
        """What this structure gains over another one that was judged by the same trials."""
        difference, labels = self.log_likelihood - over.log_likelihood, np.array(self.conditions)
        variance, dof = 0.0, 0
        for label in dict.fromkeys(self.conditions):
            of_condition = difference[labels == label]
            if len(of_condition) > 1:
                variance += len(of_condition) * float(of_condition.var(ddof=1))
                dof += len(of_condition) - 1
        return Gain(float(difference.sum()), math.sqrt(variance) if dof else math.inf, dof)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Choice(Result):
    """Laws compared.

    Attributes:
      judged: law to how well it does, from the simplest to the largest.
      chosen: the simplest law over which no larger one has a significant gain.
      gains: each larger law's gain over the one that had been chosen before it was judged.
      mechanisms: mechanism to what the chosen law gains over that without it; empty unless they were asked for.
    """

    judged: Mapping[Law, Judged]
    chosen: Law
    gains: Mapping[Law, Gain]
    mechanisms: Mapping[str, Gain]

    @property
    def estimate(self) -> NonlinearEstimate:
        """That of the chosen law, from all trials."""
        estimate = self.judged[self.chosen].estimate
        assert estimate is not None
        return estimate

    def to_frame(self) -> pd.DataFrame:
        """One row per law: log-likelihood of left-out trials, and what it gains over the law chosen before it [-]."""
        unknown = Gain(math.nan, math.nan, 0)
        rows = []
        for law, judged in self.judged.items():
            gain = self.gains.get(law, unknown)
            rows.append((law, float(judged.log_likelihood.sum()), gain.mean, gain.standard_error, law == self.chosen))
        return pd.DataFrame(rows, columns=["law", "log_likelihood", "gain", "standard_error", "is_chosen"])

    def describe(self) -> Description:
        """Which law was chosen, and why."""
        return Description(
            title=f"Laws compared: {', '.join(self.judged)}; chosen: {self.chosen}", facts=self.verdict()
        )

    def verdict(self) -> tuple[str, ...]:
        """What the trials support, a sentence each."""
        lines = []
        before: Law = next(iter(self.judged))
        for law, gain in self.gains.items():
            lines.append(f"compared with the {before} law, the {law} law {gain}")
            before = law if gain.is_shown else before
        lines.append(
            {
                "linear": "these trials do not show short-range stiffness: the linear law predicts them as well",
                "short-range": "these trials show short-range stiffness and yielding; they do not show thixotropy, "
                "shear-thinning damping or spindle saturation",
                "full": "these trials show more than short-range stiffness and yielding: the full law",
                "half-wave": "these trials show half-wave rectified spindles: the full law with a direction and a "
                "threshold of the velocity feedback",
            }[self.chosen]
        )
        estimate = self.judged[self.chosen].estimate
        tested = {} if estimate is None else estimate.lack_of_fit
        if lacking := [label for label, test in tested.items() if test.p_value < SUSPICIOUS]:
            lines.append(
                f"but the {self.chosen} law does not explain the trials of {', '.join(lacking)} (lack of fit): none of "
                "these laws may be right"
            )
        lines += [
            f"these trials {'show' if gain.is_shown else 'do not show'} {name}: it {gain}"
            for name, gain in self.mechanisms.items()
        ]
        return (*lines, *facts_of({f"{law} law": judged.pulses for law, judged in self.judged.items()}))


def compare_laws(
    sets: Sequence[ConditionTrials],
    arms: Mapping[str, Subject],
    left_out: Sequence[ConditionTrials] = (),
    *,
    laws: Sequence[Law] = LAWS,
    mechanisms: bool = False,
    n_pairs: int = N_PAIRS,
    n_pairs_of_folds: int = N_PAIRS_OF_FOLDS,
    checkpoint: Path | None = None,
    progress: Callable[[str], object] | None = None,
    **options: Any,
) -> Choice:
    """Compare laws by trials and pulses that they were not fitted to, and choose one.

    Starting with the first law, a larger one replaces the one chosen so far if its log-likelihood of left-out trials is
    significantly larger, judged by how the difference varies between trials of a condition. Pulses take no part in the
    choice; how well each law predicts them is reported.

    Args:
      sets: trials of one person to fit, see `training_sets`. Conditions with a single trial are fitted only.
      arms: condition to a linear arm that fits it.
      left_out: whole trials whose pulses are predicted, see `training_sets`.
      laws: to compare, from the simplest to the largest; the half-wave law is that of the position task only.
      mechanisms: whether the mechanisms of the full law are judged singly, if it or the half-wave law is chosen.
      n_pairs: pairs of draws of the noise in fits to all trials, see `fit`.
      n_pairs_of_folds: pairs of draws in the folds' fits and in predictions of what they leave out; 0 leaves noise out.
      checkpoint: folder for the checkpoints of all fits; a comparison that was stopped there goes on.
      progress: called with a line after each step.
      **options: further ones of `fit`.

    Raises:
      TypeError: as `fit`.
      ValueError: as `fit`, or no condition has two trials.
      OSError: a checkpoint cannot be written.
    """
    require_draws("compare_laws", n_pairs, options.get("n_pairs_of_errors", N_PAIRS_OF_ERRORS))
    require_whole("compare_laws", "n_pairs_of_folds", n_pairs_of_folds, at_least=0)
    folds = _folds(sets)
    if not folds:
        raise ValueError("each condition has one trial; expected two in one at least, to leave one out")
    if not any(trials.body.task == "PT" for trials in sets):
        laws = [law for law in laws if law != "half-wave"]
    arms = nearest_arms(sets, arms)
    fits = _Fits(arms, checkpoint, progress, options)
    judged: dict[Law, Judged] = {}
    in_folds: dict[Law, list[NonlinearEstimate]] = {}
    gains: dict[Law, Gain] = {}
    chosen: Law = laws[0]
    for law in laws:
        # A linear arm's stiffness is that of all bonds, so a yielding one starts from the arms of all amplitudes.
        starts = in_folds.get(START_FROM[law], []) if law in START_FROM else []
        judged[law], in_folds[law] = fits.judge(folds, Model(law=law), law, starts, n_pairs_of_folds)
        if law != laws[0]:
            gains[law] = judged[law].gain(judged[chosen])
            if gains[law].is_shown:
                chosen = law
    singly: dict[str, Gain] = {}
    if mechanisms and chosen in ("full", "half-wave"):
        free = {stem(name) for name in in_folds[chosen][0].values}
        for name, off in MECHANISMS.items():
            if free & set(off):
                without = Model(law=chosen, fixed=off)
                reduced, _ = fits.judge(folds, without, f"{chosen} without {name}", in_folds[chosen], n_pairs_of_folds)
                singly[name] = judged[chosen].gain(reduced)
    for law in laws:
        if left_out or law == chosen:
            estimate = fits.fit(sets, Model(law=law), law, in_folds[law][0].values, n_pairs)
            pulses = [
                pulse
                for trials in left_out
                for pulse in predict_pulses(trials, estimate.subject(trials.body.task, trials.label))
            ]
            judged[law] = replace(judged[law], estimate=estimate, pulses=tuple(pulses))
    return Choice(judged=judged, chosen=chosen, gains=gains, mechanisms=singly)


Fold = tuple[list[ConditionTrials], list[ConditionTrials]]
"""Trials to fit and trials to leave out, set by set; a set may leave out nothing."""


class _Fits(NamedTuple):
    """What all fits of a comparison share; attributes as in `compare_laws`."""

    arms: Mapping[str, Subject]
    checkpoint: Path | None
    progress: Callable[[str], object] | None
    options: Mapping[str, Any]

    def fit(
        self, trials: Sequence[ConditionTrials], model: Model, name: str, start: Mapping[str, float], n_pairs: int
    ) -> NonlinearEstimate:
        """A fit of that name, which starts from the values that its law has too."""
        report = self.progress
        limits = {parameter: bounds(parameter, model.law) for parameter in free_parameters(trials, model).names}
        return fit(
            trials,
            self.arms,
            model,
            initial={name: float(np.clip(value, *limits[name])) for name, value in start.items() if name in limits},
            n_pairs=n_pairs,
            checkpoint=self.checkpoint
            and self.checkpoint / f"checkpoint_{name.replace(' ', '_').replace(',', '')}.json.gz",
            progress=report and (lambda line: report(f"{name}: {line}")),
            **self.options,
        )

    def judge(
        self, folds: Sequence[Fold], model: Model, name: str, starts: Sequence[NonlinearEstimate], n_pairs: int
    ) -> tuple[Judged, list[NonlinearEstimate]]:
        """A structure judged, and its estimates in the folds, each of which starts from one of `starts`."""
        estimates, log_likelihood, conditions = [], [], []
        for i, (train, test) in enumerate(folds):
            estimate = self.fit(train, model, f"{name}, fold {i + 1}", starts[i].values if starts else {}, n_pairs)
            estimates.append(estimate)
            draws = {name: self.options[name] for name in ("seed", "threads") if name in self.options}
            log_likelihood.append(left_out_likelihood(estimate, test, self.arms, n_pairs=n_pairs, **draws))
            conditions += [trials.label for trials in test for _ in range(trials.n_trials)]
        judged = Judged(
            model=model,
            estimate=None,
            log_likelihood=np.concatenate(log_likelihood),
            conditions=tuple(conditions),
            pulses=(),
        )
        return judged, estimates


def _folds(sets: Sequence[ConditionTrials]) -> list[Fold]:
    folds = []
    for fold in range(N_FOLDS):
        train, test = [], []
        for trials in sets:
            out = [trial for trial in range(trials.n_trials) if trial % N_FOLDS == fold and trials.n_trials > 1]
            train.append(trials.take(trial for trial in range(trials.n_trials) if trial not in out))
            test.append(trials.take(out))
        if any(trials.n_trials for trials in test):
            folds.append((train, test))
    return folds


def left_out_likelihood(
    estimate: NonlinearEstimate,
    sets: Sequence[ConditionTrials],
    arms: Mapping[str, Subject],
    *,
    n_pairs: int = N_PAIRS_OF_FOLDS,
    seed: int = 0,
    threads: int = 1,
) -> Array:
    """Log-likelihood of trials that an estimate was not fitted to, but for a constant, (trial,).

    Args:
      estimate: person, noise and spread of trials.
      sets: for each set of the estimate, other trials of its condition; there may be none.
      arms: condition to a linear arm.
      n_pairs: draws of the noise in whose presence trials are predicted; 0 leaves noise out.
      seed: of the draws.
      threads: how many simulate at a time; no effect on the result.
    """
    used = [place for place, trials in enumerate(sets) if trials.n_trials]
    parameters = estimate.parameters.fixed_at(estimate.state.point)
    problem = Problem(parameters, [sets[place] for place in used], arms, threads)
    problem.noises = [estimate.noises[place] for place in used]
    spread = np.array([estimate.spread[kind] for kind in problem.kinds])
    state = State(np.empty(0), np.zeros(len(problem.kind_of)), spread)
    roots = tuple(noise.root for noise in problem.noises)
    strengths = tuple(estimate.strengths[place] for place in used)
    if n_pairs:
        predict_with_stable_noise(problem, state, NoiseDraws(roots, strengths, n_pairs, seed))
    predicted = problem.predict([state])[0]
    for _ in range(MAX_STEPS):
        normal = problem.normal(state, predicted)
        step = np.linalg.solve(normal.matrix, normal.slope)
        before = problem.cost(state, predicted)
        for part in (1.0, 0.5, 0.2):
            moved = state._replace(effects=state.effects + part * step)
            answer = problem.predict([moved])[0]
            if problem.cost(moved, answer) < before:
                state, predicted = moved, answer
                break
        else:
            break
        if np.all(np.abs(step) < 0.05 / np.sqrt(np.diag(normal.matrix))):
            break
    matrix = problem.normal(state, predicted).matrix
    curvature = np.array([np.linalg.slogdet(matrix[places, places])[1] for places in problem.effects_of])
    return -0.5 * (problem.costs(state, predicted) + problem.log_determinants(state) + curvature)
