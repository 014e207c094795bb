"""Maximum-likelihood estimate of muscle law, reflexes and body, from any number of raw trials of one person.

`problem` has the model of the trials, `search` the way to the maximum of the likelihood.

Errors are those of an estimating equation (Huber 1967, Proc. 5th Berkeley Symp. 1): A^-1 B A^-1, with A the derivative
of the score and B its variance, which is simulated. The inverse information A^-1 alone takes the noise for stationary,
and is a third too small for muscles that yield.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from armperturb.analysis.fit.maximum_likelihood import SUSPICIOUS
from armperturb.analysis.nonlinear.checkpoint import digest_of, load_position, save_position
from armperturb.analysis.nonlinear.draws import (
    Deviations,
    inverse_of_mixed,
    is_borne,
    lack_of_fit,
    mixed_information,
    score_variance,
    simulate_deviations,
)
from armperturb.analysis.nonlinear.model import EFFECTS, Model, Parameters, value_at, value_per_coordinate
from armperturb.analysis.nonlinear.noise import NoiseDraws
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.result import NonlinearEstimate, remarks_on
from armperturb.analysis.nonlinear.search import CONVERGED, MAX_STEPS, MOST_SPREAD, Position, Search
from armperturb.analysis.nonlinear.spindle_emg import EmgInFit, digests
from armperturb.analysis.nonlinear.start import best_start, start_values
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.subject import Subject
from armperturb.validation import require_whole

N_PAIRS = 6
"""Pairs of draws of the noise: with half as many, the shear-thinning damping of relaxed people is a third off."""

N_PAIRS_OF_ERRORS = 16
"""Pairs of draws that the variance of the score is simulated with: with 8 trials, errors are then within some 7 %."""

SAME_AMPLITUDE = 1.5
"""RMS of the largest perturbation over that of the smallest up to which all are of one amplitude [-]."""

AT_BOUND = 1e-3
"""Distance in the coordinate from its bound at which a parameter sits on it [-]."""


def fit(
    sets: Sequence[ConditionTrials],
    arms: Mapping[str, Subject],
    model: Model | None = None,
    *,
    initial: Mapping[str, float] | None = None,
    n_pairs: int = N_PAIRS,
    n_pairs_of_errors: int = N_PAIRS_OF_ERRORS,
    max_steps: int = MAX_STEPS,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Callable[[str], object] | None = None,
    threads: int = 1,
    emg: Mapping[str, EmgInFit] | None = None,
) -> NonlinearEstimate:
    """Fit one person.

    Args:
      sets: trials of one person, see `training_sets`. The first condition of the position task has level 1.
      arms: condition to a linear arm that fits it; where there is none, the nearest of its task is taken.
      model: the structure; by default the full law.
      initial: parameter to the value that it starts with, instead of that from the linear arms.
      n_pairs: draws of the noise, pairs of opposite sign, in whose presence trials are predicted; 0 leaves noise out.
      n_pairs_of_errors: draws from which the errors are estimated, at least 2.
      max_steps: most steps of each of the first three stages of the search.
      seed: of the draws.
      checkpoint: file in which the search is saved after each step; a search that was stopped there goes on.
      progress: called with a line after each step.
      threads: how many simulate at a time; no effect on the result.
      emg: condition to the EMG of all its trials, where it tells of reflexes; not of half-wave rectified spindles.

    Raises:
      TypeError: a number of draws or steps, or the seed, is no whole number.
      ValueError: such a number is too small, trials are of several people or rates, there are none, `initial` or
        `model` names what is not free, the arm at the start is unstable, or it runs away under the person's noise where
        the search has come to.
      OSError: the checkpoint cannot be written.
      ModuleNotFoundError: numba is not installed.
    """
    require_draws("fit", n_pairs, n_pairs_of_errors)
    require_whole("fit", "max_steps", max_steps, at_least=1)
    require_whole("fit", "seed", seed, at_least=0)
    model = model or Model()
    parameters = free_parameters(sets, model)
    everywhere = nearest_arms(sets, arms)
    problem = Problem(parameters, sets, everywhere, threads, emg)
    point = start_values(parameters, sets, everywhere, initial or {})
    begin, save = None, None
    if checkpoint is not None:
        digest = digest_of(problem, point.tolist(), sorted(everywhere.items()), n_pairs, seed, *digests(emg))
        begin, save = load_position(checkpoint, digest), partial(save_position, checkpoint, digest)
    if begin is None:
        state = best_start(problem, point, initial or {})
        begin = Position(state=state, reference=state)
    search = Search(problem, begin, n_pairs=n_pairs, seed=seed, max_steps=max_steps, save=save, progress=progress)
    return _estimate(problem, *search.run(), n_pairs_of_errors, seed + 1)


def require_draws(owner: str, n_pairs: object, n_pairs_of_errors: object) -> None:
    """Refuse numbers of draws with which there is no fit, see `fit`.

    Raises:
      TypeError: a number is no whole number.
      ValueError: a number is too small.
    """
    require_whole(owner, "n_pairs", n_pairs, at_least=0)
    require_whole(owner, "n_pairs_of_errors", n_pairs_of_errors, at_least=2)


def free_parameters(sets: Sequence[ConditionTrials], model: Model) -> Parameters:
    """What is free in a structure for these trials.

    Raises:
      ValueError: trials are of several people, there are none, or the structure names what they have not.
    """
    return Parameters(model, *_people(sets))


def _people(sets: Sequence[ConditionTrials]) -> tuple[dict[str, Subject], dict[str, tuple[str, ...]]]:
    if not sets:
        raise ValueError("no trials; expected at least one")
    for name in ("name", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        distinct = list(dict.fromkeys(getattr(trials.body, name) for trials in sets))
        if len(distinct) > 1:
            raise ValueError(
                f"trials differ in {'subject' if name == 'name' else name} ({', '.join(map(str, distinct))}); expected "
                "one person in one posture"
            )
    bodies = {trials.body.task: trials.body for trials in sets}
    bodies = {task: bodies[task] for task in EFFECTS if task in bodies}
    conditions = {}
    for task in bodies:
        labels = [trials.label for trials in sets if trials.body.task == task]
        # Level 1 is that of the condition with most trials.
        count = {label: sum(trials.n_trials for trials in sets if trials.label == label) for label in labels}
        conditions[task] = tuple(sorted(count, key=lambda label: -count[label]))
    return bodies, conditions


def nearest_arms(sets: Sequence[ConditionTrials], arms: Mapping[str, Subject]) -> dict[str, Subject]:
    """Condition to its linear arm, or to that of the condition of its task whose movements are nearest in size.

    Raises:
      ValueError: there is no arm of a task.
    """

    def size(trials: ConditionTrials) -> float:
        return float(np.log(trials.displacement[:, : trials.end].std()))

    nearest = {}
    for trials in sets:
        task = trials.body.task
        others = [other for other in sets if other.body.task == task and other.label in arms]
        if trials.label in arms:
            nearest[trials.label] = arms[trials.label]
        elif others:
            target = size(trials)
            nearest[trials.label] = arms[min(others, key=lambda other: abs(size(other) - target)).label]
        else:
            raise ValueError(f"arms: none of the task {task}; expected at least one")
    return nearest


def _estimate(
    problem: Problem, position: Position, message: str, slopes: list[Array], n_pairs_of_errors: int, seed: int
) -> NonlinearEstimate:
    """The solution with errors and tests.

    Args:
      problem: what was fitted.
      position: where the search ended.
      message: how, in words; `CONVERGED` at a maximum.
      slopes: the derivatives of the last step, see `Problem.slopes`.
      n_pairs_of_errors: as in `fit`.
      seed: of these draws; another one than that of the predictions'.
    """
    parameters, state, names = problem.parameters, position.state, problem.parameters.names
    n = len(state.point)
    invalid = ""
    if oscillating := problem.limit_cycles(state):
        invalid = f"the arm has a limit cycle (self-sustained oscillation) in {', '.join(oscillating)}"
    predicted = problem.predict([state])[0]
    answers = problem.slopes(state, noisy=True) if problem.is_noisy else slopes
    variance = problem.information(state, slopes)
    mixed = mixed_information(problem, state, slopes, answers) + np.diag(problem.prior(state))
    moved = inverse_of_mixed(variance, mixed)
    roots = tuple(noise.root for noise in problem.noises)
    deviations, strengths = Deviations([], []), tuple(np.ones(len(root)) for root in roots)
    if position.draws is not None:
        strengths = position.draws.strengths
        draws = NoiseDraws(roots, strengths, n_pairs_of_errors, seed)
        deviations = simulate_deviations(problem, state, draws, position.draws.n_pairs)
        if deviations.odd:
            variance = score_variance(problem, state, slopes, deviations)
        else:
            invalid = "every noise draw makes the simulation diverge"
        if not is_borne(problem, state, position.draws):
            invalid = "in some trials the arm runs away under the person's noise"
    tested = lack_of_fit(problem, state, predicted, slopes, deviations)
    covariance = (moved @ variance @ moved.T)[:n, :n]
    error = np.sqrt(np.diag(covariance))
    if invalid:
        message = f"{invalid}; confidence intervals are not valid"
        error = np.full_like(error, np.nan)
    near = np.minimum(state.point - parameters.lower, parameters.upper - state.point) < AT_BOUND
    problem.weigh(state, problem.residual(predicted))
    values = {name: value_at(name, at) for name, at in zip(names, state.point, strict=True)}
    coordinate_error = dict(zip(names, error.tolist(), strict=True))
    correlation = covariance / np.outer(error, error)
    at_bound = tuple(name for name, is_near in zip(names, near, strict=True) if is_near)
    remarks = [] if message == CONVERGED else [f"the search did not end at a maximum ({message})"]
    alone = [task for (task, _), n in zip(problem.kinds, np.bincount(problem.kind_of), strict=True) if n == 1]
    remarks += [f"{task}: one trial; intervals leave out what differs between trials" for task in dict.fromkeys(alone)]
    remarks += [
        f"the SD over trials of {quantity} [{task}] sits on its bound of {100.0 * MOST_SPREAD:.0f} %: "
        "trials differ by more, or the law is wrong"
        for (task, quantity), spread in zip(problem.kinds, state.spread, strict=True)
        if spread >= MOST_SPREAD
    ]
    remarks += [
        f"{label}: the perturbation explains more of the movement than the {parameters.model.law} law does (chi2 / "
        f"dof = {test.chi2 / test.dof:.2f}, p = {test.p_value:.1g})"
        for label, test in tested.items()
        if test.p_value < SUSPICIOUS
    ]
    if problem.uses_emg and any(test.p_value < SUSPICIOUS for test in tested.values()):
        remarks.append(
            "EMG that is early or late moves delays and gains by far more than their intervals, and shows as such lack "
            "of fit: compare a fit without EMG (lead of the sidecar, --emg-delay)"
        )
    if parameters.model.law != "linear":
        remarks += _one_amplitude(problem.sets)
    return NonlinearEstimate(
        values=values,
        standard_error={name: value_per_coordinate(name, values[name]) * coordinate_error[name] for name in names},
        coordinate_error=coordinate_error,
        correlation=correlation,
        at_bound=at_bound,
        converged=message == CONVERGED,
        message=message,
        remarks=(*remarks, *remarks_on(values, coordinate_error, correlation, at_bound)),
        model=parameters.model,
        parameters=parameters,
        spread=dict(zip(problem.kinds, state.spread.tolist(), strict=True)),
        objective=problem.objective(state, predicted),
        lack_of_fit=tested,
        n_steps=position.n_steps,
        n_conditions=len({trials.label for trials in problem.sets}),
        state=state,
        noises=tuple(problem.noises),
        strengths=strengths,
    )


def _one_amplitude(sets: Sequence[ConditionTrials]) -> list[str]:
    """A line for each task whose perturbations are all of nearly one size, as what yields is then hard to tell."""
    tasks = dict.fromkeys(trials.body.task for trials in sets)
    remarks = []
    for task in tasks:
        drives = [trials.drive[:, : trials.end] for trials in sets if trials.body.task == task]
        sizes = np.concatenate([np.linalg.norm(drive.std(axis=1), axis=1) for drive in drives])
        if sizes.max() < SAME_AMPLITUDE * sizes.min():
            remarks.append(
                f"all trials{f' of {task}' if len(tasks) > 1 else ''} have one amplitude: yielding is hard to "
                "distinguish from softer muscle, and shear-thinning from less damping"
            )
    return remarks
