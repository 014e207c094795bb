"""Maximum likelihood estimates of arm parameters, from any number of trials, conditions and tasks of one person.

Initial values come from linear least squares (`linear_start`), so that none has to be guessed. Gauss-Newton steps
within the bounds follow (`likelihood_search`). Then trials are allowed to differ (`trial_effects`).
Standard errors are those of the Fisher information, near the Cramer-Rao bound, if they do not.
"""

import math
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import NamedTuple, get_args

import numpy as np
from scipy import stats

from armperturb.analysis.arm.parameters import MATRIX
from armperturb.analysis.defaults import FEWEST_TRIALS
from armperturb.analysis.fit.emg_laws import MIXED, STRETCH, TORQUE, Law
from armperturb.analysis.fit.emg_likelihood import FEEDBACK, FEW_WITH_EMG, remarks_on_delay
from armperturb.analysis.fit.group import Group, Method, require_one_person
from armperturb.analysis.fit.joint_likelihood import PART_OF, JointLikelihood, shared_names
from armperturb.analysis.fit.likelihood_search import (
    SETTLED,
    Searched,
    bounded_step,
    has_unusual_delays,
    search_best,
    step_size,
    with_usual_delays,
)
from armperturb.analysis.fit.structures import unit
from armperturb.analysis.fit.trial_effects import (
    ASSUMED,
    FEW,
    QUANTITIES,
    SINGULAR,
    differing,
    fit_mixed,
    scaled,
    scatter,
)
from armperturb.analysis.fit.whittle import LackOfFit, Normal
from armperturb.analysis.force_balance import Skew
from armperturb.analysis.imbalance import Imbalance
from armperturb.analysis.numerics.bounds import names_at_bound
from armperturb.analysis.results import Description, FitResult, limits_of, parameter_table
from armperturb.subject import Subject
from armperturb.validation import require_one_of

UNLIKE = "EMG does not follow from the reflexes that the movement shows"
"""Start of the remark on EMG that does not fit."""

OF_BOTH = [MATRIX[name][0, 1] for name in FEEDBACK]
"""Places of the feedback of muscles that cross both joints, without which all laws of EMG are the same."""

CLEAR = 50.0
"""By how much less the objective of a law of EMG is in mean periods if whole trials need not be asked [-]."""

MORE_GAINS = 4
"""By how many gains of EMG the mixture of laws has more than either, at most."""

EFFECT_ROUNDS = 6
"""Steps after which the search for the differences between trials ends."""

SKEWED = 2e-4
"""Least skew between force and displacement that is reported, if it is beyond three standard errors [s]."""

SUSPICIOUS = 0.01
"""p-value of the lack of fit below which a remark is made [-]."""

LARGE_LACK = 2.0
"""Lack of fit over its degrees of freedom from which on parameters are not to be trusted [-]. Of long trials, the
p-value refutes what is off by less."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Estimate(FitResult):
    """Maximum-likelihood estimate of the parameters of one person, of all conditions together.

    With several conditions, a parameter that is not shared is called "k_s [RT7.5]". Variances are those of
    the Fisher information, times `dispersion`, and what errors of the noise's spectrum and of the manipulator add, both
    of which the same trials tell. Standard errors are NaN where the search could not make a single step.

    Attributes:
      method: "frequency" or "record".
      arms: condition to the arm, fixed parameters included.
      stable: whether arm and environment are stable together in every condition.
      largest_real_pole: of arm and environment, over the conditions [1/s].
      chi2: of what the disturbance explains of the residual, see `likelihood.LackOfFit`.
      dof: its degrees of freedom.
      lack_of_emg: the part of both that EMG has; None without EMG.
      law: what EMG follows; None without EMG.
      dispersion: how much more parameters vary than noise makes them, at least one [-]. Where all trials have
        perturbations of their own, it is how much more their scores vary, see `trial_effects.scatter`, and intervals
        are those of the arm that explains such perturbations best; else it is `chi2` over `dof`.
      objective: minus twice the log-likelihood, up to a constant that depends on the trials and the method.
      n_rounds: Gauss-Newton steps.
      skew: condition to the skew between the clocks of force and displacement.
      imbalance: condition to what is wrong with a signal or the manipulator; None where nothing is known to be.
      trial_spread: quantity, as "k" of stiffness, to the standard deviation over trials of the factor by which it
        differs from its mean [-]; without those of which no difference was found.
    """

    method: Method
    arms: Mapping[str, Subject]
    stable: bool
    largest_real_pole: float
    chi2: float
    dof: int
    lack_of_emg: LackOfFit | None
    law: Law | None
    dispersion: float
    objective: float
    n_rounds: int
    skew: Mapping[str, Skew]
    imbalance: Mapping[str, Imbalance | None]
    trial_spread: Mapping[str, float]

    @property
    def p_value(self) -> float:
        """Chance of so large a `chi2` if the structure is right and the person linear [-]."""
        return LackOfFit(self.chi2, self.dof).p_value

    @property
    def is_suspicious(self) -> bool:
        """Whether the trials say that the structure is wrong, or the person not linear or not always the same."""
        return self.p_value < SUSPICIOUS

    @property
    def doubts_emg(self) -> bool:
        """Whether it is EMG, more than the movement, that tells a lack of fit."""
        emg = self.lack_of_emg
        return self.is_suspicious and emg is not None and emg.chi2 * self.dof > self.chi2 * emg.dof

    def unit_of(self, name: str) -> str:
        """SI unit of a parameter."""
        return unit(name.partition(" ")[0])

    def place_of(self, name: str) -> tuple[str, str]:
        """Name of a parameter, and its condition; all of them, with + between, if it is shared."""
        parameter, _, condition = name.partition(" [")
        return parameter, condition.removesuffix("]") or "+".join(self.arms)

    @property
    def labels(self) -> dict[str, str]:
        """The subject."""
        return {"subject": ", ".join(dict.fromkeys(arm.name for arm in self.arms.values()))}

    def describe(self) -> Description:
        """Estimates and how the search ended."""
        return Description(
            title=f"Maximum-likelihood estimate ({self.method}) of {self.labels['subject']} in {', '.join(self.arms)}",
            facts=(self.message, f"chi2 / dof = {self.chi2:.1f} / {self.dof}, p = {self.p_value:.2g}"),
            table=parameter_table(self.to_frame(), "condition"),
            remarks=self.remarks,
        )


def _remarks(fit: Estimate) -> tuple[str, ...]:
    """What a reader must know before trusting an estimate."""
    said = []
    if not fit.converged:
        said.append(f"the search did not end at a maximum ({fit.message})")
    if np.isnan([*fit.standard_error.values()]).all():
        said.append("the search could not make a single step: the values are those it started from, without intervals")
    if not fit.stable:
        said.append(f"arm and environment are unstable: largest real part of a pole {fit.largest_real_pole:.2g} 1/s")
    if fit.doubts_emg and fit.lack_of_emg is not None:
        emg = fit.lack_of_emg
        moved = (fit.chi2 - emg.chi2) / max(fit.dof - emg.dof, 1)
        said.append(
            f"{UNLIKE} (chi2 / dof = {emg.chi2 / emg.dof:.2f} of EMG, {moved:.2f} of the movement): expected muscles "
            "whose joints and signs are right (signals.emg.muscles of the sidecar); rely on a fit without --emg"
        )
    elif fit.is_suspicious:
        said.append(
            "the disturbance explains more of the movement than the model does (chi2 / dof = "
            f"{fit.chi2 / fit.dof:.2f}, p = {fit.p_value:.1g}): wrong structure, or a person who is not linear, "
            "or who differs from trial to trial"
        )
    for label, (time, error) in fit.skew.items():
        where, wrong = f"{label}: " if len(fit.skew) > 1 else "", fit.imbalance[label]
        if wrong is not None:
            said.append(f"{where}{wrong.text}")
        elif abs(time) > max(SKEWED, 3.0 * error):
            said.append(
                f"{where}force is recorded {1e3 * time:.2f} ms later than displacement (standard error "
                f"{1e3 * error:.2f} ms); expected clocks that agree, as skew turns inertia into damping"
            )
    return (*said, *limits_of(fit))


def estimate(
    groups: Sequence[Group],
    method: Method = "record",
    *,
    share: Sequence[str] = (),
    initial: Mapping[str, float] | None = None,
) -> Estimate:
    """Estimate the arm of one person from the trials of one or several conditions.

    EMG follows the more likely of two laws, `emg_laws.TORQUE` and `emg_laws.STRETCH`; or, where neither fits and that
    is clearly more likely, the mixture of both. Where mean periods tell the laws apart, whole trials are fitted by one.

    Args:
      groups: trials, one group per condition.
      method: "frequency" (mean periods; fast) or "record" (all of each trial; best, started from the former).
      share: parameters that are the same in all conditions: names of parameters, or of `SHARES`.
      initial: values to start from, named as in `Estimate.values`, SI; linear least squares for those not given. Where
        all are given, no other start is tried. None starts several groups from where each ends alone.

    Raises:
      ValueError: there is no group, groups differ in person or posture, a shared name is unknown, an initial value is
        unknown or outside its bounds, or no data identify the structure; the message names the direction.
    """
    begun = _begun(groups, method, share, initial)
    if not begun.problem.uses_emg or not all(group.structure.mixing[OF_BOTH].any() for group in groups):
        return _ended(begun, method, share)
    likely = sorted((begun, *_under(STRETCH, begun, method, share)), key=lambda each: each.objective)
    best = _ended(likely[0], method, share)
    for each in likely[1:]:
        if each.objective < likely[0].objective + CLEAR:
            best = min(best, _ended(each, method, share), key=lambda fit: fit.objective)
    if best.is_suspicious:
        for each in _under(MIXED, begun, method, share):
            mixed = _ended(each, method, share)
            if mixed.objective < best.objective - float(stats.chi2.isf(SUSPICIOUS, MORE_GAINS)):
                best = mixed
    if best.law is None or best.law is TORQUE:
        return best
    return replace(best, remarks=(*best.remarks, f"EMG follows {best.law.text}"))


class Begun(NamedTuple):
    """Where the search ended in mean periods; where there are none, or no more is asked for, all of an estimate's.

    Attributes:
      problem: the likelihood.
      search: its end.
      objective: as `Estimate.objective`.
      is_suspicious: as `Estimate.is_suspicious`.
    """

    problem: JointLikelihood
    search: Searched
    objective: float
    is_suspicious: bool


def _under(law: Law, begun: Begun, method: Method, share: Sequence[str]) -> Iterator[Begun]:
    """The search by another law of EMG, near the end of one; nothing if the trials do not identify its gains."""
    ends = zip(begun.problem.names, begun.search.values.tolist(), strict=True)
    near = {name: value for name, value in ends if not name.startswith("g_")}
    try:
        # Where one law fits, another one is near it or no match.
        groups = [group.under(law) for group in begun.problem.groups]
        yield _begun(groups, method, share, near, is_near=not begun.is_suspicious)
    except ValueError:
        return


def _begun(
    groups: Sequence[Group],
    method: Method,
    share: Sequence[str],
    initial: Mapping[str, float] | None,
    *,
    is_near: bool = False,
    is_start: bool = False,
) -> Begun:
    """Search by the law that the EMG of the groups has; where values are near, no other start is tried.

    What is but a start need not identify the structure.
    """
    require_one_of("estimate", "method", method, get_args(Method))
    if not groups:
        raise ValueError("groups is empty; expected the trials of at least one condition")
    require_one_person(groups)
    if method == "frequency":
        for group in groups:
            if group.period is None:
                raise ValueError(
                    f"estimator 'frequency': the perturbation of {group.label} is not periodic from the start of the "
                    "window on; expected whole periods (--estimator record takes any perturbation)"
                )
    first_method: Method = "record" if any(group.period is None for group in groups) else "frequency"
    problem = JointLikelihood(groups, first_method, share)
    if initial is None and len(groups) > 1:
        initial = _alone(problem, method, shared_names(groups, share))
    first = problem.stabilised(problem.initial(initial or {}))
    search = search_best(problem, first)
    if not is_start and scaled(search.information)[1][0] <= SINGULAR:
        problem.require_identifiable(first)
    problem.weigh(search.values)
    fit = problem.lack_of_fit(search.values)
    is_given = is_near or (initial is not None and len(initial) == len(problem.names))
    if not is_given and (not search.converged or fit.p_value < SUSPICIOUS):
        starts = [problem.published()]
        if fit.chi2 > LARGE_LACK * fit.dof:
            starts.append(problem.nearest())
        others = (search_best(problem, problem.stabilised(start)) for start in starts)
        search = min(search, *others, key=lambda each: problem.objective(each.values))
        problem.weigh(search.values)
        fit = problem.lack_of_fit(search.values)
    # Maxima at unusual delays or cut-offs, or at the end of their range, are seldom the global one.
    if not is_given and (has_unusual_delays(problem, search.values) or fit.chi2 > LARGE_LACK * fit.dof):
        again = search_best(problem, with_usual_delays(problem))
        search = min(search, again, key=lambda each: problem.objective(each.values))
    return Begun(problem, search, problem.objective(search.values), fit.p_value < SUSPICIOUS)


def _alone(problem: JointLikelihood, method: Method, shared: Set[str]) -> dict[str, float]:
    """Where searches of each group alone end, by name; of what groups share the mean, by its precision.

    Conditions differ in more than they share: from a mean of them a search may not find back.
    """
    values: dict[str, float] = {}
    total, weight = dict.fromkeys(shared, 0.0), dict.fromkeys(shared, 0.0)
    for group in problem.groups:
        begun = _begun([group], method, (), None, is_start=True)
        scale, power, directions = scaled(begun.search.information)
        precision = scale**2 / np.sum(directions**2 / np.maximum(power, SINGULAR), axis=1)
        ends = zip(begun.problem.names, begun.search.values.tolist(), precision.tolist(), strict=True)
        for name, value, known in ends:
            if name in shared:
                total[name] += known * value
                weight[name] += known
            else:
                values[f"{name} [{group.label}]"] = value
    values |= {name: total[name] / weight[name] for name in shared}
    bounds = zip(problem.names, problem.lower.tolist(), problem.upper.tolist(), strict=True)
    return {name: min(max(values[name], lower), upper) for name, lower, upper in bounds}


def _ended(begun: Begun, method: Method, share: Sequence[str]) -> Estimate:
    """The estimate from whole trials, if these are asked for, which may differ."""
    problem, search = begun.problem, begun.search
    if problem.method != method:
        problem = JointLikelihood(problem.groups, method, share)
        search = search_best(problem, problem.stabilised(search.values))
    return _judge(problem, method, _with_trial_effects(problem, search))


def _with_trial_effects(problem: JointLikelihood, search: Searched) -> Searched:
    """The average arm where trials may differ, from one that takes them to be alike.

    The noise is estimated with effects of trials that may be large, see `trial_effects.LOOSE`. Where no difference is
    found, or a step leads to an unstable arm, the search before stands; and where there are too few trials to tell,
    unless they have EMG.
    """
    few = problem.n_trials < FEWEST_TRIALS
    if few and not problem.uses_emg:
        return search
    effects = problem.no_effects()
    values = search.values
    for round_ in range(EFFECT_ROUNDS):
        problem.weigh(values, effects)
        scores = problem.scores(values, effects)
        mixed = fit_mixed(scores, len(values), ASSUMED if few else None)
        normal = Normal(0.0, mixed.slope[None], mixed.information[None])
        step = bounded_step(normal, 0.0, problem.lower - values, problem.upper - values)
        after = np.clip(values + step, problem.lower, problem.upper)
        if not problem.pole(after) < 0.0:
            return search
        moved = (
            weight @ trial.design.T @ (trial.score - trial.information @ step[trial.columns])
            for trial, weight in zip(scores, mixed.weights, strict=True)
        )
        effects = [np.array([next(moved) for _ in each]) for each in effects]
        values = after
        if round_ > 0 and step_size(normal, step) < SETTLED:
            break
    if not mixed.spread.any():
        return search
    return search._replace(
        values=values, information=mixed.information, effects=effects, spread=mixed.spread, dof=mixed.dof
    )


def _dispersion(problem: JointLikelihood, search: Searched, fit: LackOfFit) -> float:
    """See `Estimate.dispersion`; the noise must have been weighed."""
    if not problem.are_independent or problem.n_trials < FEWEST_TRIALS:
        return max(1.0, fit.chi2 / fit.dof)
    effects = problem.no_effects() if search.effects is None else search.effects
    spread = np.zeros(len(QUANTITIES)) if search.spread is None else search.spread
    scores = problem.scores(search.values, effects)[: problem.n_trials]
    return max(1.0, scatter(scores, spread, search.information))


def _judge(problem: JointLikelihood, method: Method, search: Searched) -> Estimate:
    values, names = search.values, problem.names
    few = problem.n_trials < FEWEST_TRIALS
    is_assumed = problem.uses_emg and few
    objective = problem.objective(values)
    if search.effects is not None:
        problem.weigh(values, search.effects)
    fit = problem.lack_of_fit(values, search.effects)
    scale, power, directions = scaled(search.information)
    known = power > SINGULAR
    covariance = (directions[:, known] / power[known]) @ directions[:, known].T
    dispersion = _dispersion(problem, search, fit)
    covariance = dispersion * covariance + problem.added_covariance(values) * np.outer(scale, scale)
    error = np.sqrt(np.diag(covariance)) / scale
    unknown = np.abs(directions[:, ~known]).max(axis=1, initial=0.0) > PART_OF
    error[unknown] = np.inf
    if not search.converged and search.n_rounds == 1:
        error[:] = np.nan  # where a search starts says nothing of where the trials would have led it
    correlation = np.eye(len(names))
    rest = np.ix_(~unknown, ~unknown)
    spread = np.sqrt(np.diag(covariance))[~unknown]
    correlation[rest] = covariance[rest] / np.outer(spread, spread)
    pole = problem.pole(values)
    result = Estimate(
        method=method,
        values=dict(zip(names, values.tolist(), strict=True)),
        standard_error=dict(zip(names, error.tolist(), strict=True)),
        degrees_of_freedom={} if search.dof is None else dict(zip(names, search.dof.tolist(), strict=True)),
        correlation=correlation,
        trial_spread={} if search.spread is None or is_assumed else differing(QUANTITIES, search.spread),
        at_bound=names_at_bound(problem.names, values, problem.lower, problem.upper),
        arms={group.label: arm for group, arm in zip(problem.groups, problem.arms(values), strict=True)},
        message=search.status,
        remarks=(),
        converged=search.converged,
        stable=pole < 0.0,
        largest_real_pole=pole,
        chi2=fit.chi2,
        dof=fit.dof,
        lack_of_emg=problem.lack_of_emg(values, search.effects),
        law=next((group.emg.law for group in problem.groups if group.emg), None),
        dispersion=dispersion,
        objective=objective,
        n_rounds=search.n_rounds,
        skew={group.label: group.parts[0].skew for group in problem.groups},
        imbalance={group.label: group.parts[0].balance.imbalance for group in problem.groups},
    )
    on_few = (FEW_WITH_EMG if is_assumed else FEW,) if few else ()
    tells = problem.uses_emg and search.converged
    later, unsure = problem.emg_delay(values, search.effects) if tells else (0.0, np.inf)
    on_delay = remarks_on_delay(later, unsure * math.sqrt(dispersion), lacks=result.is_suspicious)
    return replace(result, remarks=(*_remarks(result), *on_delay, *on_few))
