"""Arm parameters of greatest likelihood, from any number of trials, conditions and tasks of one person at once.

The start comes from linear least squares (`linear_start`), so none has to be guessed; Gauss-Newton steps within the
bounds follow, the noise being weighed anew before each (`likelihood`). Steps that lead to an unstable arm, or to a less
likely one, are shortened. Standard errors are those of the Fisher information, which the Cramer-Rao bound says cannot
be beaten.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.fit.likelihood import (
    LackOfFit,
    Likelihood,
    Normal,
    PeriodLikelihood,
    RecordLikelihood,
    whitened,
)
from armperturb.analysis.fit.linear_start import linear_start
from armperturb.analysis.fit.structures import Structure, unit
from armperturb.analysis.force_balance import EDGE, Skew
from armperturb.analysis.response.spectra import averaged_spectra, line_spectra
from armperturb.analysis.results import Description, FitResult, parameter_table
from armperturb.analysis.trials import ConditionTrials, Trials, per_trials, prepared
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.subject import Subject
from armperturb.validation import require_number

Method = Literal["frequency", "record"]
"""Whether the mean period of each trial is used, or all of it from its start."""

MAX_ROUNDS = 60

WEIGHED_ROUNDS = 20
"""A search that has not ended by then goes in circles, noise and arm changing in turn: from then on noise is held."""

SETTLED = 0.01
"""A step this small in units of the standard error ends the search [-]."""

STABILISING = (0.0, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Shares of the default start that are mixed into an unstable one until it is stable [-]."""

AT_BOUND = 1e-6
"""A parameter sits on a bound when it is closer to it than this share of the distance between its bounds."""

SINGULAR = 1e-12
"""Least eigenvalue of the scaled information with which a structure can be identified [-]."""

PART_OF = 1e-3
"""Share of a direction of parameters from which on a parameter belongs to it [-]."""

SKEWED = 2e-4
"""Skew between force and displacement that is remarked upon, if it is beyond three standard errors [s]."""

NOT_PERIODIC = 0.01
"""RMS of what changes from period to period over that of the perturbation from which on it is not periodic [-]."""

SUSPICIOUS, UNCERTAIN, ALIKE = 0.01, 0.5, 0.95
"""From when on remarks are made: chance of the lack of fit, error over value, and correlation of errors [-]."""

SHARES: Mapping[str, tuple[str, ...]] = {
    "mass": ("m_h", "m_f", "m_tot"),
    "damping": ("b_s", "b_se", "b_e"),
    "stiffness": ("k_s", "k_se", "k_e"),
    "velocity": ("kv_s", "kv_se", "kv_e"),
    "position": ("kp_s", "kp_se", "kp_e"),
    "acceleration": ("ka_s", "ka_se", "ka_e"),
    "force": ("kf_s", "kf_se", "kf_e"),
    "delay": ("Td_s", "Td_e"),
    "cutoff": ("fact_s", "fact_e"),
    "grip": ("b_h", "k_h"),
}
"""Names for parameters that are shared together; single ones are named as they are."""


@per_trials
def _white(trials: ConditionTrials) -> Array:
    """Whitened displacement, (trial, time, axis)."""
    return whitened(trials.displacement, trials.rate)


@dataclass(frozen=True, kw_only=True, eq=False)
class Group:
    """Trials of one person in one condition, and the structure that is fitted to them.

    Attributes:
      trials: the trials.
      structure: what is free.
      initial: values of the free parameters by linear least squares, from which a search may start, (parameter,).
      period: likelihood of the mean periods.
      record: likelihood of the whole records.
    """

    trials: ConditionTrials
    structure: Structure
    initial: Array
    period: Likelihood
    record: Likelihood

    @property
    def label(self) -> str:
        """The condition."""
        return self.trials.label

    @property
    def body(self) -> Subject:
        """Task, segment lengths and posture."""
        return self.trials.body

    @property
    def environment(self) -> Environment:
        """What the hand held, as identified from these trials."""
        return self.trials.environment

    @classmethod
    def prepare(
        cls,
        trials: Trials,
        structure: Structure,
        *,
        window_start: float = WINDOW_START,
        period: float | None = None,
        settle: float = 0.0,
    ) -> Self:
        """Prepare trials. Of trials with pulses, what is before the earliest is used.

        Args:
          trials: of one person in one condition, or their recording.
          structure: what is to be estimated.
          window_start: start of the window of whole periods, after the transient has died away [s].
          period: of the disturbance [s]; None to find it.
          settle: time at the start of the records that "record" does not judge [s]: 0 where they start at rest, some 8
            s where they start amid the perturbation, so that the response to what is not recorded has died away.

        Raises:
          ValueError: the recording is refused, gives no spectra, is of several people, tasks or postures, its
            perturbation is not periodic, or settle leaves less than a period.
        """
        trials = prepared(trials)
        body = trials.body
        spectra = averaged_spectra(trials, window_start=window_start, period=period)
        lines = line_spectra(trials, window_start=window_start, period=period)
        rate = trials.rate
        period = trials.period(window_start) if period is None else period
        n_period, first = round(period * rate), round(window_start * rate)
        d = trials.perturbation
        _require_periodic(d, first, n_period, rate)
        environment, white = trials.environment, _white(trials)
        end = min(trials.first_onset, trials.n_samples - round(EDGE * rate))
        require_number("Group", "settle", settle, at_least=0.0, at_most=end / rate - period)
        top = min(1.1 * float(lines.frequency[-1]), 0.45 * rate)
        last = first + n_period * max(1, (end - first) // n_period)
        return cls(
            trials=trials,
            structure=structure,
            initial=linear_start(spectra.frequency, spectra.arm, body, structure),
            period=PeriodLikelihood(d[:, first:last], white[:, first:last], body, environment, rate, n_period, top),
            record=RecordLikelihood(d[:, :end], white[:, :end], body, environment, rate, top, settle),
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Estimate(FitResult):
    """Maximum-likelihood estimate of the parameters of one person, of all conditions together.

    With several conditions, a parameter that is not shared is called "k_s [RT7.5]". Standard errors are those of the
    Fisher information, times the square root of `dispersion`.

    Attributes:
      method: "frequency" or "record".
      arms: condition to the arm, fixed parameters included.
      stable: whether arm and environment are stable together in every condition.
      largest_real_pole: of arm and environment, over the conditions [1/s].
      chi2: of what the disturbance explains of the residual, see `likelihood.LackOfFit`.
      dof: its degrees of freedom.
      objective: minus twice the log-likelihood, up to a constant that depends on the trials and the method.
      n_rounds: Gauss-Newton steps.
      skew: condition to the skew between the clocks of force and displacement.
    """

    method: Method
    arms: Mapping[str, Subject]
    stable: bool
    largest_real_pole: float
    chi2: float
    dof: int
    objective: float
    n_rounds: int
    skew: Mapping[str, Skew]

    @property
    def p_value(self) -> float:
        """Chance of so large a `chi2` if the structure is right and the person linear [-]."""
        return LackOfFit(self.chi2, self.dof).p_value

    @property
    def is_suspicious(self) -> bool:
        """Whether the trials say that the structure is wrong, or the person not linear or not always the same."""
        return self.p_value < SUSPICIOUS

    @property
    def dispersion(self) -> float:
        """How much more the residual varies along the disturbance than elsewhere, at least one [-]."""
        return max(1.0, self.chi2 / self.dof)

    def unit_of(self, name: str) -> str:
        """SI unit of a parameter."""
        return unit(name.partition(" ")[0])

    def place_of(self, name: str) -> tuple[str, str]:
        """Name of a parameter, and its condition; all of them, with + between, if it is shared."""
        parameter, _, condition = name.partition(" [")
        return parameter, condition.removesuffix("]") or "+".join(self.arms)

    def describe(self) -> Description:
        """Estimates and how the search ended."""
        people = ", ".join(dict.fromkeys(arm.name for arm in self.arms.values()))
        return Description(
            title=f"Maximum-likelihood estimate ({self.method}) of {people} in {', '.join(self.arms)}",
            facts=(self.message, f"chi2 / dof = {self.chi2:.1f} / {self.dof}, p = {self.p_value:.2g}"),
            table=parameter_table(self.to_frame(), "condition"),
            remarks=self.remarks,
        )


def _remarks(fit: Estimate) -> tuple[str, ...]:
    """What a reader must know before trusting an estimate."""
    said = []
    if not fit.converged:
        said.append(f"the search did not end at a maximum ({fit.message})")
    if not fit.stable:
        said.append(f"arm and environment are unstable: largest real part of a pole {fit.largest_real_pole:.2g} 1/s")
    if fit.is_suspicious:
        said.append(
            "the disturbance explains more of the movement than the model does (chi2 / dof = "
            f"{fit.chi2 / fit.dof:.2f}, p = {fit.p_value:.1g}): wrong structure, or a person who is not linear, "
            "or who differs from trial to trial"
        )
    for label, (time, error) in fit.skew.items():
        if abs(time) > max(SKEWED, 3.0 * error):
            said.append(
                f"{label}: force is recorded {1e3 * time:.2f} ms later than displacement (standard error "
                f"{1e3 * error:.2f} ms); expected clocks that agree, as skew turns inertia into damping"
            )
    said += [f"{name} sits on a bound" for name in fit.at_bound]
    for name, error in fit.standard_error.items():
        value = fit.values[name]
        if error == np.inf:
            said.append(f"{name} is not identifiable from these trials")
        elif error > UNCERTAIN * abs(value):
            relative = f", relative s.e. {error / abs(value):.0%}" if value else ""
            said.append(f"{name} is poorly determined ({value:.3g} +/- {error:.2g}{relative})")
    names = list(fit.values)
    said += [
        f"{names[i]} and {names[j]} are not separately identifiable (error correlation r = {fit.correlation[i, j]:.2f})"
        for i, j in zip(*np.nonzero(np.triu(np.abs(fit.correlation) > ALIKE, 1)), strict=True)
    ]
    return tuple(said)


class _Problem:
    """Free parameters of all groups in one vector, and their likelihood."""

    def __init__(self, groups: Sequence[Group], method: Method, share: Sequence[str]) -> None:
        self.groups = tuple(groups)
        self.likelihoods = [group.period if method == "frequency" else group.record for group in self.groups]
        shared = _shared_names(self.groups, share)
        self.names: list[str] = []
        self.columns: list[list[int]] = []
        for group in self.groups:
            mine = []
            for name in group.structure.free:
                label = name if len(self.groups) == 1 or name in shared else f"{name} [{group.label}]"
                if label not in self.names:
                    self.names.append(label)
                mine.append(self.names.index(label))
            self.columns.append(mine)
        self.lower, self.upper = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for group, columns in zip(self.groups, self.columns, strict=True):
            lower, upper = np.array([group.structure.bounds[name] for name in group.structure.free]).T
            self.lower[columns] = np.maximum(self.lower[columns], lower)
            self.upper[columns] = np.minimum(self.upper[columns], upper)
        for name, lower, upper in zip(self.names, self.lower, self.upper, strict=True):
            if not lower < upper:
                raise ValueError(f"bounds of the shared {name} cross ({lower:g} to {upper:g}); expected some overlap")

    def initial(self, given: Mapping[str, float]) -> Array:
        """Given values, and where there is none the mean over the groups of where linear least squares would start."""
        values = self._mean([group.initial for group in self.groups])
        for name, value in given.items():
            if name not in self.names:
                raise ValueError(f"initial: unknown parameter {name!r}; expected {', '.join(self.names)}")
            column = self.names.index(name)
            lower, upper = self.lower[column], self.upper[column]
            if not lower <= value <= upper:
                raise ValueError(
                    f"initial: {name} = {value!r}; expected {lower:g} to {upper:g} {unit(name.split()[0])}"
                )
            values[column] = value
        return values

    def _mean(self, of_groups: Sequence[ArrayLike]) -> Array:
        total, count = np.zeros(len(self.names)), np.zeros(len(self.names))
        for columns, values in zip(self.columns, of_groups, strict=True):
            total[columns] += np.asarray(values)
            count[columns] += 1.0
        return np.clip(total / count, self.lower, self.upper)

    def parameters(self, values: Array) -> list[Array]:
        return [
            group.structure.parameters(group.body.task, values[columns])
            for group, columns in zip(self.groups, self.columns, strict=True)
        ]

    def arms(self, values: Array) -> list[Subject]:
        return [
            group.structure.arm(group.body, values[columns])
            for group, columns in zip(self.groups, self.columns, strict=True)
        ]

    def pole(self, values: Array) -> float:
        """Largest real part of a pole of any arm on its environment [1/s]."""
        arms = zip(self.arms(values), self.groups, strict=True)
        return max(largest_real_pole(arm, group.environment) for arm, group in arms)

    def weigh(self, values: Array) -> None:
        for likelihood, parameters in zip(self.likelihoods, self.parameters(values), strict=True):
            likelihood.weigh(parameters)

    def cost(self, values: Array) -> float:
        pairs = zip(self.likelihoods, self.parameters(values), strict=True)
        return sum(likelihood.cost(parameters) for likelihood, parameters in pairs)

    def objective(self, values: Array) -> float:
        pairs = zip(self.likelihoods, self.parameters(values), strict=True)
        return sum(likelihood.objective(parameters) for likelihood, parameters in pairs)

    def normal(self, values: Array) -> Normal:
        cost, slope = 0.0, np.zeros(len(self.names))
        information = np.zeros((len(self.names), len(self.names)))
        every = zip(self.groups, self.likelihoods, self.columns, self.parameters(values), strict=True)
        for group, likelihood, columns, parameters in every:
            part = likelihood.normal(parameters, group.structure.mixing)
            cost += part.cost
            slope[columns] += part.slope
            information[np.ix_(columns, columns)] += part.information
        return Normal(cost, slope, information)

    def lack_of_fit(self, values: Array) -> LackOfFit:
        """Of all groups together; the noise must have been weighed."""
        parts = [
            likelihood.lack_of_fit(parameters)
            for likelihood, parameters in zip(self.likelihoods, self.parameters(values), strict=True)
        ]
        dof = sum(part.dof for part in parts) - len(self.names)
        return LackOfFit(sum(part.chi2 for part in parts), max(dof, 1))

    def published(self) -> Array:
        """Mean over the groups of the structures' default starts."""
        return self._mean([[group.structure.initial[name] for name in group.structure.free] for group in self.groups])

    def stabilised(self, values: Array) -> Array:
        """The values moved towards the structures' default starts until every arm is stable, or all the way."""
        published = self.published()
        for share in STABILISING:
            mixed = (1.0 - share) * values + share * published
            if self.pole(mixed) < 0.0:
                break
        return mixed

    def require_identifiable(self, values: Array) -> None:
        """Refuse structures in which some direction of the parameters changes no movement.

        What has no effect at these values may have some elsewhere, as a delay has none without gains: only what has
        none at the structures' default starts either is refused.

        Raises:
          ValueError: there is such a direction.
        """
        information = np.zeros((len(self.names), len(self.names)))
        for place in (values, self.published()):
            self.weigh(place)
            information += self.normal(place).information
            if _scaled(information)[1][0] > SINGULAR:
                return
        require_informative(information, self.names)


def require_informative(information: Array, names: Sequence[str]) -> None:
    """Refuse information that leaves some direction of the parameters unknown.

    Args:
      information: Fisher information, (parameter, parameter).
      names: of the parameters.

    Raises:
      ValueError: there is such a direction; the message names it.
    """
    scale, power, directions = _scaled(information)
    if power[0] > SINGULAR:
        return
    silent = [name for name, size in zip(names, np.diag(information), strict=True) if not size > 0.0]
    if silent:
        raise ValueError(f"{', '.join(silent)} cannot be identified: no effect on the movement; expected fixed values")
    weak = directions[:, 0] / scale
    weak /= np.abs(weak).max()
    terms = [f"{w:+.2g} {name}" for w, name in zip(weak, names, strict=True) if abs(w) > PART_OF]
    raise ValueError(
        f"the structure cannot be identified: a change of {' '.join(terms)} leaves the movement as it is; "
        "expected one of them fixed"
    )


class _Search(NamedTuple):
    values: Array
    information: Array
    status: str
    converged: bool
    n_rounds: int


def estimate(
    groups: Sequence[Group],
    method: Method = "record",
    *,
    share: Sequence[str] = (),
    initial: Mapping[str, float] | None = None,
) -> Estimate:
    """Estimate the arm of one person from the trials of one or several conditions.

    Args:
      groups: trials, one group per condition.
      method: "frequency" (mean periods; fast) or "record" (all of each trial; best, started from the former).
      share: parameters that are the same in all conditions: names of parameters, or of `SHARES`.
      initial: values to start from, named as in `Estimate.values`, SI; linear least squares for those not given.

    Raises:
      ValueError: there is no group, groups differ in person or posture, a shared name is unknown, an initial value is
        unknown or outside its bounds, or no data identify the structure; the message names the direction.
    """
    if method not in get_args(Method):
        raise ValueError(f"method = {method!r}; expected one of {', '.join(get_args(Method))}")
    if not groups:
        raise ValueError("groups is empty; expected the trials of at least one condition")
    _require_one_person(groups)
    problem = _Problem(groups, "frequency", share)
    first = problem.stabilised(problem.initial(initial or {}))
    found = _judge(problem, "frequency", _search(problem, first))
    if not np.isfinite(list(found.standard_error.values())).all():
        problem.require_identifiable(first)
    if not found.converged or found.is_suspicious:
        other = _judge(problem, "frequency", _search(problem, problem.stabilised(problem.published())))
        if other.objective < found.objective:
            found = other
    if method == "frequency":
        return found
    problem = _Problem(groups, "record", share)
    start_of_record = problem.stabilised(np.array(list(found.values.values())))
    return _judge(problem, "record", _search(problem, start_of_record))


def profile(
    groups: Sequence[Group], found: Estimate, name: str, points: Sequence[float], *, share: Sequence[str] = ()
) -> Array:
    """Profile likelihood of a parameter: how much less likely the trials are if it is held, all others fitted anew.

    Args:
      groups: the trials.
      found: the estimate around which to look.
      name: of the parameter, as in `Estimate.values`.
      points: values at which to hold it, SI.
      share: as it was for the estimate.

    Returns:
      Twice the logarithm of the likelihood ratio [-], (point,), with the noise as weighed at the estimate. A point
      belongs to the 95 % interval if it is below 3.84 (times `Estimate.dispersion`).

    Raises:
      ValueError: the parameter is unknown, or a point is outside its bounds.
    """
    problem = _Problem(groups, found.method, share)
    if name not in problem.names:
        raise ValueError(f"no parameter {name!r}; expected one of {', '.join(problem.names)}")
    column = problem.names.index(name)
    best = np.array([found.values[one] for one in problem.names])
    problem.weigh(best)
    least = problem.cost(best)
    bounds = problem.lower.copy(), problem.upper.copy()
    deviance = np.empty(len(points))
    for index, point in enumerate(points):
        if not bounds[0][column] <= point <= bounds[1][column]:
            raise ValueError(
                f"{name} = {point!r}; expected {bounds[0][column]:g} to {bounds[1][column]:g} {unit(name.split()[0])}"
            )
        problem.lower[column] = problem.upper[column] = point
        held = _search(problem, np.clip(best, problem.lower, problem.upper), weigh=False)
        deviance[index] = problem.cost(held.values) - least
        problem.lower, problem.upper = bounds[0].copy(), bounds[1].copy()
    return deviance


def _search(problem: _Problem, values: Array, *, weigh: bool = True) -> _Search:
    """Gauss-Newton steps within bounds, the noise being weighed anew before each unless told otherwise.

    No step leads to an unstable arm, or from an unstable start to one that is less stable.
    """
    damping = 0.0
    limit = max(0.0, problem.pole(values))
    for n_rounds in range(1, MAX_ROUNDS + 1):
        if weigh and n_rounds <= WEIGHED_ROUNDS:
            problem.weigh(values)
        normal = problem.normal(values)
        room = problem.lower - values, problem.upper - values
        reason = "no smaller step leads to more likely values"
        if _size(normal, _bounded_step(normal, 0.0, *room)) < SETTLED:
            return _Search(values, normal.information, "converged: steps are far below the errors", True, n_rounds)
        while True:
            after = np.clip(values + _bounded_step(normal, damping, *room), problem.lower, problem.upper)
            if not problem.pole(after) < limit:
                reason = "at the border of stability"
            elif problem.cost(after) < normal.cost:
                break
            damping = max(10.0 * damping, 1e-3)
            if damping > 1e8:
                return _Search(values, normal.information, f"not converged: {reason}", False, n_rounds)
        values, damping = after, damping / 10.0 if damping > 1e-6 else 0.0
    return _Search(values, normal.information, f"not converged: {MAX_ROUNDS} steps were not enough", False, MAX_ROUNDS)


def _scaled(information: Array) -> tuple[Array, Array, Array]:
    """Scale that gives the information a diagonal of ones, its eigenvalues then, rising, and its directions."""
    scale = np.sqrt(np.diag(information))
    scale[scale == 0.0] = 1.0
    power, directions = np.linalg.eigh(information / np.outer(scale, scale))
    return scale, np.asarray(power), np.asarray(directions)


def _size(normal: Normal, step: Array) -> float:
    """Largest change of a parameter in units of its error, were all others known."""
    return float(np.max(np.abs(step) * np.sqrt(np.diag(normal.information))))


def _bounded_step(normal: Normal, damping: float, lower: Array, upper: Array) -> Array:
    """Levenberg-Marquardt step that stays within bounds."""
    scale, power, directions = _scaled(normal.information)
    root = np.sqrt(np.maximum(power, 0.0) + damping + SINGULAR)
    target = directions.T @ (normal.slope / scale) / root
    design = root[:, None] * directions.T
    free = upper > lower
    step = np.zeros(len(scale))
    bounds = lower[free] * scale[free], upper[free] * scale[free]
    step[free] = optimize.lsq_linear(design[:, free], target, bounds, method="bvls").x
    return step / scale


def _judge(problem: _Problem, method: Method, search: _Search) -> Estimate:
    values, names = search.values, problem.names
    objective = problem.objective(values)
    fit = problem.lack_of_fit(values)
    scale, power, directions = _scaled(search.information)
    known = power > SINGULAR
    covariance = (directions[:, known] / power[known]) @ directions[:, known].T
    error = np.sqrt(np.diag(covariance)) / scale * np.sqrt(max(1.0, fit.chi2 / fit.dof))
    unknown = np.abs(directions[:, ~known]).max(axis=1, initial=0.0) > PART_OF
    error[unknown] = np.inf
    correlation = np.eye(len(names))
    rest = np.ix_(~unknown, ~unknown)
    spread = np.sqrt(np.diag(covariance))[~unknown]
    correlation[rest] = covariance[rest] / np.outer(spread, spread)
    near = np.minimum(values - problem.lower, problem.upper - values) <= AT_BOUND * (problem.upper - problem.lower)
    pole = problem.pole(values)
    result = Estimate(
        method=method,
        values=dict(zip(names, values.tolist(), strict=True)),
        standard_error=dict(zip(names, error.tolist(), strict=True)),
        correlation=correlation,
        at_bound=tuple(name for name, hit in zip(names, near, strict=True) if hit),
        arms={group.label: arm for group, arm in zip(problem.groups, problem.arms(values), strict=True)},
        message=search.status,
        remarks=(),
        converged=search.converged,
        stable=pole < 0.0,
        largest_real_pole=pole,
        chi2=fit.chi2,
        dof=fit.dof,
        objective=objective,
        n_rounds=search.n_rounds,
        skew={group.label: group.trials.skew for group in problem.groups},
    )
    return replace(result, remarks=_remarks(result))


def _shared_names(groups: Sequence[Group], share: Sequence[str]) -> set[str]:
    known = {name for group in groups for name in group.structure.free}
    shared: set[str] = set()
    for name in share:
        names = [one for one in SHARES.get(name, (name,)) if one in known]
        if not names:
            raise ValueError(f"share: {name!r} is no free parameter; expected {', '.join((*SHARES, *sorted(known)))}")
        shared.update(names)
    return shared


def _require_one_person(groups: Sequence[Group]) -> None:
    labels = [group.label for group in groups]
    for field in ("name", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        values = {getattr(group.body, field) for group in groups}
        if len(values) > 1:
            raise ValueError(
                f"the conditions {', '.join(labels)} differ in {field} ({', '.join(map(str, sorted(values)))}); "
                "expected one person in one posture"
            )
    for label in labels:
        if labels.count(label) > 1:
            raise ValueError(f"the condition {label!r} comes twice; expected each once (its trials in one group)")


def _require_periodic(perturbation: Array, first: int, n_period: int, rate: float) -> None:
    """Refuse a perturbation that is another before and in the window than a period later."""
    n = min(n_period, first // 2)
    earlier, later = perturbation[:, first - n : first], perturbation[:, first - n + n_period : first + n_period]
    change = np.sqrt(np.mean((later - earlier) ** 2, axis=(1, 2))) if n else np.zeros(len(perturbation))
    rms = np.sqrt(np.mean(perturbation[:, first : first + n_period] ** 2, axis=(1, 2)))
    worst = int(np.argmax(change / rms))
    if change[worst] > NOT_PERIODIC * rms[worst]:
        raise ValueError(
            f"the perturbation of trial {worst} changes by {change[worst] / rms[worst]:.0%} of its RMS from one period "
            f"of {n_period / rate:g} s to the next; expected a periodic one (another period?)"
        )
