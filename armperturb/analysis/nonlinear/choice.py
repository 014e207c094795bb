"""Which law trials show: structures judged by trials and pulses that they were not fitted to.

A larger law fits better whether it is true or not; what it is not fitted to it predicts better only if it is. Trials of
each condition are therefore shared out among folds; a structure is fitted to all folds but one, noise included, and
asked how likely the trials of that one are. Their own factors (see `problem`) are integrated over, by Laplace's method.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats

from armperturb.analysis.nonlinear.estimate import N_PAIRS, NonlinearEstimate, fit, free_parameters, nearest_arms
from armperturb.analysis.nonlinear.model import Law, Model, bounds, stem
from armperturb.analysis.nonlinear.noise import Noise
from armperturb.analysis.nonlinear.prediction import PulsePrediction, median_peak, predict_pulses
from armperturb.analysis.nonlinear.problem import Problem, State
from armperturb.analysis.nonlinear.trials import TrialSet
from armperturb.arrays import Array
from armperturb.subject import Subject

LAWS: tuple[Law, ...] = ("linear", "short-range", "full")
"""From the simplest to the largest."""

MECHANISMS: Mapping[str, Mapping[str, float]] = {
    "thixotropy": {"loss_angle_deg": math.inf, "recovery_time": 1.0},
    "damping that thins": {"thinning_velocity": math.inf},
    "spindles that saturate": {"spindle_saturation": math.inf},
}
"""Mechanism of the full law to the values of its parameters that switch it off."""

CHANCE = 0.025
"""Of taking a larger law for better where it is not [-]."""

N_FOLDS = 2
N_PAIRS_OF_FOLDS = 2
"""Pairs of draws of the noise in the folds' fits: laws differ by more than what so few draws leave."""

MAX_STEPS = 20
"""Of the search for the factors of trials that were left out."""


class Gain(NamedTuple):
    """By how much one structure makes left-out trials likelier than another one.

    Attributes:
      mean: sum over all trials of the difference between logarithms of the likelihood [-].
      standard_error: of that, from how it differs between trials of a condition; infinite if none has two [-].
      dof: degrees of freedom of the latter.
    """

    mean: float
    standard_error: float
    dof: int

    @property
    def is_shown(self) -> bool:
        """Whether so large a gain has at most a probability of `CHANCE` where there is none (one-sided t test)."""
        return self.dof > 0 and self.mean > float(stats.t.isf(CHANCE, self.dof)) * self.standard_error


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A structure, and how it does on what it was not fitted to.

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
            own = difference[labels == label]
            if len(own) > 1:
                variance += len(own) * float(own.var(ddof=1))
                dof += len(own) - 1
        return Gain(float(difference.sum()), math.sqrt(variance) if dof else math.inf, dof)


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """Laws compared.

    Attributes:
      judged: law to how it does, from the simplest to the largest.
      chosen: the simplest law over which no larger one gains anything that is shown.
      gains: each larger law's gain over the one that had been chosen before it was asked.
      mechanisms: mechanism to what the full law gains over that without it; empty unless they were asked for.
    """

    judged: Mapping[Law, Judged]
    chosen: Law
    gains: Mapping[Law, Gain]
    mechanisms: Mapping[str, Gain]

    @property
    def estimate(self) -> NonlinearEstimate:
        """That of the chosen law, from all trials."""
        found = self.judged[self.chosen].estimate
        assert found is not None
        return found

    def verdict(self) -> tuple[str, ...]:
        """What the trials say, a sentence each."""
        said = []
        before: Law = next(iter(self.judged))
        for law, gain in self.gains.items():
            said.append(f"the {law} law makes left-out trials {_in_words(gain)} than the {before} one")
            before = law if gain.is_shown else before
        if self.chosen == "linear":
            said.append("your data do not show muscles that yield: the linear law does as well")
        elif self.chosen == "short-range":
            said.append(
                "your data show short-range stiffness that yields; they do not show thixotropy, damping that thins or "
                "spindles that saturate"
            )
        else:
            said.append("your data show more than short-range stiffness that yields: the full law")
        said += [
            f"your data {'show' if gain.is_shown else 'do not show'} {name}: with it, left-out trials are "
            f"{_in_words(gain)} than without"
            for name, gain in self.mechanisms.items()
        ]
        for law, one in self.judged.items():
            if one.pulses:
                vaf = float(np.median([pulse.vaf for pulse in one.pulses]))
                said.append(
                    f"{len(one.pulses)} left-out pulses, {law} law: median peak {median_peak(one.pulses):.0f} %, "
                    f"median VAF {vaf:.1f} %"
                )
        return tuple(said)


def _in_words(gain: Gain) -> str:
    likelier = "likelier" if gain.mean > 0.0 else "less likely"
    size = f"by {abs(gain.mean):.1f} (standard error {gain.standard_error:.1f}) in the logarithm"
    return f"{likelier} {size}{'' if gain.is_shown else ', which may be chance,'}"


def compare_laws(
    sets: Sequence[TrialSet],
    arms: Mapping[str, Subject],
    left_out: Sequence[TrialSet] = (),
    *,
    mechanisms: bool = False,
    n_pairs: int = N_PAIRS,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Callable[[str], object] | None = None,
    threads: int = 1,
) -> Choice:
    """Compare laws by trials and pulses that they were not fitted to, and choose one.

    Starting with the linear law, a larger one takes the place of the one chosen so far if it makes left-out trials
    likelier by more than chance, as told by how trials of a condition differ in that. Pulses are beside: they judge,
    they do not choose.

    Args:
      sets: trials of one person to fit, see `training_sets`. Conditions with a single trial are fitted only.
      arms: condition to a linear arm that fits it.
      left_out: whole trials whose pulses are predicted, see `training_sets`.
      mechanisms: whether the mechanisms of the full law are judged one by one, if it is chosen.
      n_pairs: as in `fit`, of the fits to all trials.
      seed: as in `fit`.
      checkpoint: folder for the checkpoints of all fits; a comparison that was stopped there goes on.
      progress: as in `fit`.
      threads: as in `fit`.

    Raises:
      ValueError: as `fit`, or no condition has two trials.
      OSError: a checkpoint cannot be read or written.
    """
    folds = _folds(sets)
    if not folds:
        raise ValueError("each condition has one trial; expected two in one at least, to leave one out")
    everywhere = nearest_arms(sets, arms)

    def fitted(
        trials: Sequence[TrialSet], model: Model, name: str, start: Mapping[str, float], pairs: int
    ) -> NonlinearEstimate:
        def tell(line: str) -> None:
            if progress is not None:
                progress(f"{name}: {line}")

        limits = {name: bounds(name, model.law) for name in free_parameters(trials, model).names}
        return fit(
            trials,
            everywhere,
            model,
            start={name: float(np.clip(value, *limits[name])) for name, value in start.items() if name in limits},
            n_pairs=pairs,
            seed=seed,
            checkpoint=checkpoint and checkpoint / f"checkpoint_{name.replace(' ', '_').replace(',', '')}.npz",
            progress=tell,
            threads=threads,
        )

    def judge(model: Model, name: str, starts: Sequence[NonlinearEstimate]) -> tuple[Judged, list[NonlinearEstimate]]:
        """A structure judged, and its estimates in the folds."""
        estimates, log_likelihood, conditions = [], [], []
        for i, (train, test) in enumerate(folds):
            start = starts[i].values if starts else {}
            found = fitted(train, model, f"{name}, fold {i + 1}", start, N_PAIRS_OF_FOLDS)
            estimates.append(found)
            left = [one for one in test if one.n_trials]
            noises = [noise for one, noise in zip(test, found.noises, strict=True) if one.n_trials]
            log_likelihood.append(left_out_likelihood(found, left, noises, everywhere, seed=seed, threads=threads))
            conditions += [one.label for one in left for _ in range(one.n_trials)]
        judged = Judged(
            model=model,
            estimate=None,
            log_likelihood=np.concatenate(log_likelihood),
            conditions=tuple(conditions),
            pulses=(),
        )
        return judged, estimates

    judged: dict[Law, Judged] = {}
    in_folds: dict[Law, list[NonlinearEstimate]] = {}
    gains: dict[Law, Gain] = {}
    chosen: Law = LAWS[0]
    for law in LAWS:
        # A linear arm's stiffness is that of all bonds: a yielding one starts from the arms of all amplitudes instead.
        judged[law], in_folds[law] = judge(Model(law=law), law, in_folds["short-range"] if law == "full" else [])
        if law != LAWS[0]:
            gains[law] = judged[law].gain(judged[chosen])
            if gains[law].is_shown:
                chosen = law
    singly: dict[str, Gain] = {}
    if mechanisms and chosen == "full":
        for name, off in MECHANISMS.items():
            if {stem(free) for free in in_folds["full"][0].values} & set(off):
                without, _ = judge(Model(fixed=off), f"full without {name}", in_folds["full"])
                singly[name] = judged["full"].gain(without)
    for law in LAWS:
        if left_out or law == chosen:
            estimate = fitted(sets, Model(law=law), law, in_folds[law][0].values, n_pairs)
            pulses = [
                pulse for one in left_out for pulse in predict_pulses(one, estimate.subject(one.body.task, one.label))
            ]
            judged[law] = replace(judged[law], estimate=estimate, pulses=tuple(pulses))
    return Choice(judged=judged, chosen=chosen, gains=gains, mechanisms=singly)


def _folds(sets: Sequence[TrialSet]) -> list[tuple[list[TrialSet], list[TrialSet]]]:
    """For each fold what is fitted and what is left out, set by set; a set may leave out nothing."""
    found = []
    for fold in range(N_FOLDS):
        train, test = [], []
        for one in sets:
            out = [trial for trial in range(one.n_trials) if trial % N_FOLDS == fold and one.n_trials > 1]
            train.append(one.take(trial for trial in range(one.n_trials) if trial not in out))
            test.append(one.take(out))
        if any(one.n_trials for one in test):
            found.append((train, test))
    return found


def left_out_likelihood(
    estimate: NonlinearEstimate,
    sets: Sequence[TrialSet],
    noises: Sequence[Noise],
    arms: Mapping[str, Subject],
    seed: int = 0,
    threads: int = 1,
) -> Array:
    """Logarithm of the likelihood of trials that an estimate has not seen, but for a constant, (trial,).

    Args:
      estimate: person, noise and spread of trials.
      sets: the trials, one set for each of `noises`.
      noises: those of the estimate that belong to the conditions of the sets.
      arms: condition to a linear arm.
      seed: of the draws of the noise in whose presence trials are predicted.
      threads: how many simulate at a time.
    """
    problem = Problem(estimate.parameters.fixed_at(estimate.state.point), sets, arms, threads)
    problem.noises = list(noises)
    problem.draw_again(N_PAIRS_OF_FOLDS, seed)
    spread = np.array([estimate.spread[kind] for kind in problem.kinds])
    state = State(np.empty(0), np.zeros(len(problem.kind_of)), spread)
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
    curvature = np.array([np.linalg.slogdet(matrix[own, own])[1] for own in problem.own_effects])
    return -0.5 * (problem.costs(state, predicted) + problem.log_determinants(state) + curvature)
