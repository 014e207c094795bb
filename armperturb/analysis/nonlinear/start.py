"""Where a nonlinear fit starts: linear arms of several amplitudes, and a grid over what they do not determine."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from armperturb.analysis.defaults import LINEAR_MODELS, WINDOW_START
from armperturb.analysis.fit.identification import Identification
from armperturb.analysis.fit.identify import identify_conditions
from armperturb.analysis.fit.maximum_likelihood import Estimate
from armperturb.analysis.fit.structures import structure_of
from armperturb.analysis.nonlinear.model import QUANTITIES, Parameters, bounds, coordinate, leveled_condition, stem
from armperturb.analysis.nonlinear.problem import Problem
from armperturb.analysis.nonlinear.simulated import State
from armperturb.analysis.periods import common_period
from armperturb.analysis.response.condition_spectra import periodic_lines
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.muscle_law import ELEMENTS
from armperturb.subject import Subject

LEAST: Mapping[str, float] = {"k": 0.5, "b": 0.3, "kv": 1.0, "kp": 1.0}
"""Least values of a muscle group in half of the starts that are tried; the others keep those of the linear arms."""

LONG_RANGE = 0.6
"""Share of the softest linear stiffness that starts as long-range stiffness [-]."""

USUAL: Mapping[str, Mapping[str, float]] = {
    "PT": {
        **{"thinning_velocity": 1.5, "loss_angle_deg": 40.0, "recovery_time": 1.5},
        **{"spindle_saturation": 1.5, "spindle_direction": 0.0, "spindle_threshold": 0.0},
    },
    "RT": {"thinning_velocity": 0.3, "loss_angle_deg": 30.0, "recovery_time": 1.0},
}
TRIED: Mapping[str, tuple[float, ...]] = {
    "elastic_limit_deg": (0.5, 1.0, 2.0),
    "short_range_stiffness": (0.6, 1.0, 1.6),
    "thinning_velocity": (0.4, 1.0, 3.0),
}
"""Factors on the start of these parameters; all combinations are simulated."""

TRIED_LEVELS = (0.3, 0.45, 0.65, 1.0, 1.5)
"""Levels of co-contraction that are tried in each condition; from one far too high, a search does not find back."""

FREER: Mapping[str, str] = {"PT": "3"}
"""Task to the structure of the start where that of `LINEAR_MODELS` is far from the trials: its grip is free."""

FAR = 4.0
"""Chi-squared over degrees of freedom of a linear arm from which on it is far from the trials [-]."""

SHORTEST = 10.0
"""Length of a trial from which a linear arm is identified where the perturbation does not repeat [s]."""

OVER = 1.0
"""Time after which a perturbation that does not change any more is over [s]."""

SPREAD = 0.08
"""SD of the logarithms of the trials' own factors [-]."""


def linear_arms(
    conditions: Mapping[str, ConditionTrials], *, window_start: float = WINDOW_START, period: float | None = None
) -> dict[str, Subject]:
    """Condition to its linear arm, of all conditions from which one can be identified.

    Args:
      conditions: trials of one person by condition.
      window_start: start of the window of whole periods, as in `identify_conditions` [s].
      period: of the disturbance [s]; None to find it.

    Raises:
      ValueError: no trial of a task holds a whole period before its pulse, or `SHORTEST` where there is no period, or
        trials are refused.
    """
    arms: dict[str, Subject] = {}
    for task in dict.fromkeys(trials.body.task for trials in conditions.values()):
        of_task = {label: trials for label, trials in conditions.items() if trials.body.task == task}
        length = _needed(list(of_task.values()), window_start, period)
        wide = {
            label: trials.take(np.flatnonzero(trials.onset >= round(length * trials.rate)))
            for label, trials in of_task.items()
        }
        wide = {label: trials for label, trials in wide.items() if trials.n_trials}
        if not wide:
            raise ValueError(
                f"{task}: all pulses or ends come before {length:g} s; expected a trial that is perturbed that long: a "
                f"whole period from {window_start:g} s on (an earlier --window-start), or {SHORTEST:g} s of noise"
            )
        parts = {label: (trials,) for label, trials in wide.items()}
        structure = structure_of(LINEAR_MODELS[task])
        results = dict(identify_conditions(parts, structure, window_start=window_start, period=period))
        if task in FREER and max(map(_distance, results.values())) > FAR:
            freer = identify_conditions(parts, structure_of(FREER[task]), window_start=window_start, period=period)
            results = {label: min(result, freer.get(label, result), key=_distance) for label, result in results.items()}
        arms |= {label: result.fit.arm for label, result in results.items()}
    return arms


def _distance(result: Identification) -> float:
    """Chi-squared over degrees of freedom of a fit by maximum likelihood [-]."""
    assert isinstance(result.fit.detail, Estimate)
    return result.fit.detail.chi2 / result.fit.detail.dof


def _needed(conditions: Sequence[ConditionTrials], window_start: float, period: float | None) -> float:
    """How long a trial must be before its pulse [s].

    To the end of a whole period, or `SHORTEST` if there is none; any length if whole trials hold all of a perturbation.
    """
    if period is not None:
        return window_start + period
    for trials in conditions:
        late = trials.take(np.flatnonzero(trials.onset > round(window_start * trials.rate) + 1))
        if late.n_trials and late.is_perturbed(window_start):
            is_periodic = periodic_lines([late], window_start) is not None
            return window_start + common_period([late], window_start) if is_periodic else SHORTEST
    if all(_are_over(trials) for trials in conditions):
        return 0.0
    raise ValueError(
        f"{conditions[0].body.task}: all pulses come before {window_start:g} s, or nothing perturbs the trials before "
        "them; expected a multisine or noise (an earlier --window-start)"
    )


def _are_over(trials: ConditionTrials) -> bool:
    """Whether trials without a labelled pulse are perturbed, but none in its last second any more, as by a pulse."""
    last = max(trials.n_samples - round(OVER * trials.rate), 0)
    ended = not np.ptp(trials.perturbation[:, last:], axis=1).any()
    return bool((trials.onset == trials.n_samples).all()) and ended and trials.is_perturbed(0.0)


def start_values(
    parameters: Parameters, sets: Sequence[ConditionTrials], arms: Mapping[str, Subject], given: Mapping[str, float]
) -> Array:
    """Coordinates of the free parameters from linear arms, (parameter,).

    The softest arm gives the long-range stiffness, the stiffest one the short-range stiffness that is added to it.

    Args:
      parameters: what is free.
      sets: the trials.
      arms: condition to its linear arm.
      given: parameter to the value that it starts with instead.

    Raises:
      ValueError: a given parameter is not free, or out of its bounds.
    """
    values: dict[str, float] = {}
    for task in parameters.bodies:
        labels = dict.fromkeys(trials.label for trials in sets if trials.body.task == task)
        of_task = [arms[label] for label in labels]
        groups = {group: np.array([arm.muscle_groups(group) for arm in of_task]) for group in QUANTITIES}
        softest = groups["k"].sum(axis=1).argmin()
        initial: dict[str, float] = {
            name: float(np.mean([getattr(arm, name) for arm in of_task])) for name in ("m_h", "m_f", "k_h", "b_h")
        }
        linear = parameters.model.law == "linear"
        for i, element in enumerate(ELEMENTS):
            k = groups["k"][softest, i] * (1.0 if linear else LONG_RANGE)
            initial[f"k.{element}"] = k
            initial[f"short_range_stiffness.{element}"] = max(groups["k"][:, i].max() - k, 2.0 * LEAST["k"])
            initial[f"b.{element}"] = groups["b"][:, i].max()
            initial[f"elastic_limit_deg.{element}"] = 1.0
            for group in ("kv", "kp"):
                initial[f"{group}.{element}"] = groups[group][:, i].mean()
        for element in ("shoulder", "elbow"):  # joints of no stiffness are at the edge of those that there are
            k = f"k.{element}"
            initial[k] = max(initial[k], LEAST["k"] - initial["k.two-joint"])
        initial |= {"Td": of_task[0].Td_s, "fact": of_task[0].fact_s, "elastic_limit_spread": 0.5, **USUAL[task]}
        for name in parameters.names:
            bare = name.removesuffix(f" [{task}]")
            values.setdefault(name, initial.get(bare, 1.0 if stem(name) == "level" else np.nan))
            if bare in initial and np.isnan(values[name]):
                values[name] = initial[bare]
    for name, value in given.items():
        if name not in parameters.names:
            raise ValueError(f"initial: {name!r} is not free; expected {', '.join(parameters.names)}")
        low, high = bounds(name, parameters.model.law)
        if not low - 1e-3 * abs(low) <= value <= 1.001 * high:  # those that sat on a bound were rounded
            raise ValueError(f"initial: {name} = {value:g}; expected {low:g} to {high:g}")
        values[name] = value
    point = [coordinate(name, values[name]) for name in parameters.names]
    return np.clip(point, parameters.lower + 1e-6, parameters.upper - 1e-6)


def best_start(problem: Problem, point: Array, given: Mapping[str, float]) -> State:
    """The start of largest likelihood on a coarse grid over what linear arms do not determine.

    Levels are chosen first and once more at the end, each by the trials of its own condition.

    Raises:
      ValueError: no arm among them is stable.
    """
    parameters = problem.parameters
    effects, spread = np.zeros(len(problem.kind_of)), np.full(len(problem.kinds), SPREAD)
    point = _best_levels(problem, State(point, effects, spread), given)
    least = [coordinate(name, LEAST[stem(name)]) if stem(name) in LEAST else -np.inf for name in parameters.names]
    positive = np.where([name in given for name in parameters.names], point, np.maximum(point, least))
    states = []
    for factors in itertools.product(*TRIED.values()):
        shift = {name: np.log(factor) for name, factor in zip(TRIED, factors, strict=True)}
        moved = [0.0 if name in given else shift.get(stem(name), 0.0) for name in parameters.names]
        for base in (point, positive):
            states.append(State(np.clip(base + moved, parameters.lower, parameters.upper), effects, spread))
    unique = list({state.point.tobytes(): state for state in states}.values())
    objectives = [float(np.sum(_objectives(problem, state))) for state in unique]
    if not np.isfinite(objectives).any():
        raise ValueError(
            "initial: the arm is unstable, and so are all arms near it; expected values of an arm that comes to rest "
            "(less feedback, or more damping)"
        )
    best = unique[int(np.argmin(objectives))]
    return best._replace(point=_best_levels(problem, best, given))


def _best_levels(problem: Problem, state: State, given: Mapping[str, float]) -> Array:
    """The point with the level of each condition of largest likelihood; unchanged where no level is stable."""
    names, point = problem.parameters.names, state.point.copy()
    levels = [i for i, name in enumerate(names) if stem(name) == "level" and name not in given]
    if not levels:
        return point
    tried = []
    for level in TRIED_LEVELS:
        moved = point.copy()
        moved[levels] = np.log(level)
        tried.append(_objectives(problem, state._replace(point=moved)))
    for i in levels:
        of_level = [condition == leveled_condition(names[i]) for condition in problem.conditions]
        best = int(np.argmin([objective[of_level].sum() for objective in tried]))
        if np.isfinite(tried[best][of_level].sum()):
            point[i] = np.log(TRIED_LEVELS[best])
    return point


def _objectives(problem: Problem, state: State) -> Array:
    """Minus twice the log-likelihood with the spectrum of these residuals, (trial,); infinite where an arm diverges."""
    predicted = problem.predict([state])[0]
    problem.weigh(state, problem.residual(np.nan_to_num(predicted, nan=0.0, posinf=0.0, neginf=0.0)))
    return problem.costs(state, predicted) + problem.log_determinants(state)
