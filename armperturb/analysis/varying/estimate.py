"""Maximum likelihood of the parallel cascade with parameters that change.

The likelihood is that of other joints (`analysis.joint.torque_likelihood`), the search that of arms
(`analysis.fit.likelihood_search`). Delay, dynamics and threshold of the reflex are searched with the weights of the
splines, in which the torque is linear. Left-out repetitions, or left-out stretches of a single record, choose the
structure of the reflex path (`analysis.joint.choice`): with few splines first, then with the numbers that the best
structure has, as a reflex makes up for jumps of stiffness that few splines cannot follow. The number of splines of each
quantity is that with which what is left out is the most likely.

That number balances noise with what few splines cannot follow, so that at the balance bands of noise alone hold too
little. The distance of knots is therefore halved once more: what a smooth course lacks falls to a sixteenth, and
noise grows by the root of two (undersmoothing: Hall 1992, Ann. Statist. 20, 675-694). Where halving moves a curve by
more than noise does, as it does next to a jump, bands count by how much, without the share of it that noise makes up
(Wiener's estimate). Standard errors are those of an estimating equation (sandwich) over repetitions or stretches.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import xarray as xr
from scipy import linalg, ndimage

from armperturb.analysis.cuts import inside_limit, one_condition
from armperturb.analysis.fit.ladder import left_out_loss
from armperturb.analysis.fit.likelihood_search import SKETCHED, search_from
from armperturb.analysis.fit.whittle import Normal
from armperturb.analysis.joint.choice import ScoredStructure, score_of, structures
from armperturb.analysis.joint.model import DYNAMICS, REFLEXES, JointStructure, Reflex
from armperturb.analysis.joint.prediction import explained
from armperturb.analysis.joint.remarks import cut_short
from armperturb.analysis.joint.signals import EDGE, TOP, JointSignals, joint_signals, mean_angle
from armperturb.analysis.joint.torque_likelihood import BlockScore
from armperturb.analysis.joint_balance import impossible_joint
from armperturb.analysis.varying.likelihood import STRETCH, VaryingLikelihood
from armperturb.analysis.varying.model import DEGREE, VaryingModel, finer
from armperturb.analysis.varying.result import Curve, VaryingEstimate
from armperturb.arrays import Array, Indices
from armperturb.copied_trials import without_copies
from armperturb.recording import check_recording, labels_of, named
from armperturb.validation import require_number, require_one_of, require_whole

Variable = Literal["time", "scheduling"]

CANDIDATES: Mapping[str, tuple[int, ...]] = {
    "time": (1, 4, 5, 7, 11, 19, 35, 67, 131),
    "scheduling": (1, 4, 5, 7, 11),
}
"""Numbers of splines that are tried for stiffness; those up to `MOST_OF_OTHERS` also for damping and gain."""

MOST_OF_OTHERS = 35

FIRST: Mapping[str, int] = {"time": 7, "scheduling": 4}
"""Splines of each quantity before their numbers are chosen."""

STATIC = 8
"""Splines of the static torque over a scheduling variable."""

FASTEST = 100.0
"""Frequency up to which the movement of an ensemble is kept [Hz]: without what is fast in the velocity of a step, the
half-wave of a reflex is another, which stiffness makes up for."""

SETTLE = 0.3
"""What is left out at the start of each repetition, whose reflexes answer to what was before it [s]."""

SHORTEST = 1.0
"""Shortest repetition [s]."""

FEWEST = 4
"""Repetitions of an ensemble at least."""

SHARED = 0.002
"""Share of the velocity's variance that must differ between repetitions [-]: a perturbation of 5 % of a movement that
they share has 0.0025; what noise of an angle makes of equal ones is mostly less."""

LITTLE = 10.0
"""Share of the torque below which a remark says how little the model explains [%]."""

N_FOLDS = 5

DELAYS, FREQUENCIES = tuple(np.linspace(0.02, 0.18, 9).tolist()), (1.5, 3.0, 6.0)
"""Delays [s] and natural frequencies [Hz] of the reflex path from which the search may start: from one that is 30 ms
off, it may end at a gain of the wrong sign."""


class _Search:
    """A likelihood as the search sees it: parameters that are held have no room.

    Args:
      likelihood: of the trials.
      values: of all parameters, for their number.
    """

    def __init__(self, likelihood: VaryingLikelihood, values: Array) -> None:
        self.likelihood, n = likelihood, len(values)
        self.lower, self.upper = np.full(n, -np.inf), np.full(n, np.inf)
        model, first = likelihood.model, likelihood.model.n_linear
        lower, upper = (
            dict(zip(model.structure.parameters, bound, strict=True)) for bound in model.structure.bounds(model.signals)
        )
        self.lower[first:] = [lower[name] for name in model.dynamics]
        self.upper[first:] = [upper[name] for name in model.dynamics]
        self.weigh, self.cost = likelihood.weigh, likelihood.cost

    def pole(self, values: Array) -> float:
        """The movement is imposed: nothing is unstable."""
        return -1.0

    def normal(self, values: Array) -> Normal:
        """Least squares of all parameters."""
        return self.likelihood.normal(values, np.eye(len(values)))

    def inside(self, values: Array) -> Indices:
        """Numbers of the parameters that are not at a bound."""
        return np.flatnonzero((self.lower < values) & (values < self.upper))


def _size(influence: Array) -> Array:
    """Standard error from the influence of independent groups, (group, ...) to (...)."""
    n = len(influence)
    return np.asarray(np.sqrt(np.sum(influence**2, axis=0) * n / (n - 1.0)))


def identify_varying(
    recording: xr.Dataset,
    variable: Variable = "time",
    *,
    reflex: Reflex | None = None,
    fit_until: float | None = None,
    n_points: int = 201,
) -> VaryingEstimate:
    """Stiffness, damping and reflex gain of one joint over time in an ensemble, or over a scheduling variable.

    Args:
      recording: of one axis on a position servo, of one person in one condition: repetitions with different
        perturbations of the same course of parameters, or, for "scheduling", any trials with a scheduling signal.
        Trials that met the limit of the workspace count only if there are no others, up to then.
      variable: what parameters depend on.
      reflex: "none", "linear" or "half-wave", whose direction left-out data choose; None to let them choose among all.
      fit_until: time from which on samples are held out [s]; None fits all, as for "time" it must.
      n_points: of the curves.

    Raises:
      ValueError: the recording is of another kind, of several people, tasks or conditions, repetitions of an ensemble
        have the same perturbation, an option is unknown, or too little is left to fit.
    """
    check_recording(recording)
    require_one_of("identify_varying", "variable", variable, tuple(CANDIDATES))
    require_one_of("identify_varying", "reflex", reflex, (None, *REFLEXES))
    require_whole("identify_varying", "n_points", n_points, at_least=2)
    one_condition([recording])
    each_once = without_copies(recording)
    (recording,), left_out = inside_limit([each_once.recording])
    last = float(recording["time"].values[-1]) - 2.0 * EDGE  # so that something is held out before the edge
    require_number("identify_varying", "fit_until", fit_until, above=0.0, at_most=last, optional=True)
    ensemble, rate = variable == "time", float(recording.attrs["rate"])
    if ensemble and fit_until is not None:
        raise ValueError(
            f"identify_varying: fit_until = {fit_until:g} with variable = 'time'; expected None, as nothing is known "
            "of parameters at times that are not fitted (variable = 'scheduling' holds out samples)"
        )
    fitted = recording if fit_until is None else recording.isel(time=slice(0, round(fit_until * rate)))
    reference = mean_angle(fitted)
    try:
        signals, place = _recorded(fitted, ensemble, reference)
    except ValueError as error:
        left = "; ".join([*each_once.remarks, *left_out])
        raise ValueError(f"{error} ({left})" if left else str(error)) from None
    low, high = float(place[:, signals.used].min()), float(place[:, signals.used].max())
    if low == high:
        raise ValueError(f"recording: scheduling is {low:g} throughout; expected one that changes (or identify_joint)")
    tried = []
    for structure in structures(reflex):
        names = ("stiffness", "damping", *(() if structure.reflex == "none" else ("gain",)))
        orders = dict.fromkeys(names, FIRST[variable]) | ({} if ensemble else {"static": STATIC})
        model = VaryingModel(structure=structure, signals=signals, variable=place, orders=orders, low=low, high=high)
        likelihood = VaryingLikelihood(model, ensemble=ensemble)
        if likelihood.n_groups < 2:
            raise ValueError(
                f"recording: {place.shape[1] / signals.rate:g} s to fit; expected at least {2 * STRETCH:g} s, of which "
                "a part is left out in turn"
            )
        tried.append(_tried(likelihood, min(_starts(likelihood), key=likelihood.cost)))
    best, chosen, scored = _best(tried, CANDIDATES[variable])
    likelihood = best.likelihood.with_orders({name: finer(n) if name != "static" else n for name, n in chosen.items()})
    start = _linear(likelihood, best.dynamics)
    values = search_from(_Search(likelihood, start), start).values
    solution = _solved(likelihood, values)
    grid = np.linspace(low, high, n_points)
    curves = {
        name: _curve(solution, likelihood, name, chosen[name], grid)
        for name in likelihood.model.orders
        if name != "static"
    }
    model, values = solution.model, solution.values
    dynamics = dict(zip(model.dynamics, map(float, values[model.n_linear :]), strict=True))
    inside = _Search(likelihood, values).inside(values)
    at_bound = [name for place, name in enumerate(model.dynamics, model.n_linear) if place not in inside]
    if ensemble and "gain" in curves:
        # What the reflex answers to so late acts when the record is over.
        reach = dynamics["reflex_delay"] + 1.0 / (2 * np.pi * dynamics["reflex_frequency"])
        curves["gain"].standard_error[grid > high - reach] = np.inf
    every, there = (signals, place) if fit_until is None else _recorded(recording, ensemble, reference)
    torque, predicted = every.torque, replace(model, signals=every, variable=there).torque(values)
    if ensemble:
        torque, predicted = (each - each.mean(axis=0) for each in (torque, predicted))
    vaf = explained(torque[:, signals.used], predicted[:, signals.used])
    held = slice(signals.angle.shape[1], every.used.stop)
    return VaryingEstimate(
        label=named(recording),
        labels=labels_of(recording),
        variable=variable,
        angular=recording["displacement"].attrs["units"] == "rad",
        grid=grid,
        curves=curves,
        inertia=float(values[0]),
        inertia_error=float(_size(solution.influence)[0]),
        tried=scored,
        dynamics=dynamics,
        vaf=vaf,
        held_out_vaf=None if fit_until is None else explained(torque[:, held], predicted[:, held]),
        n_trials=len(torque),
        n_groups=len(solution.influence),
        remarks=(*each_once.remarks, *impossible_joint(recording), *left_out, *_remarks(model, at_bound, vaf)),
    )


def _remarks(model: VaryingModel, at_bound: Sequence[str], vaf: float) -> list[str]:
    """Why curves may be wrong, without full stop each.

    Args:
      model: that was fitted.
      at_bound: parameters of the reflex path that sit on a bound.
      vaf: share of the torque that it explains [%].
    """
    said = [cut_short(model.structure.reflex, model.signals.top, model.signals.beyond)]
    said += [f"{name} sits on a bound: the reflex path may be another" for name in at_bound]
    if vaf < LITTLE:
        said.append(
            f"the model explains only {vaf:.1f} % of the torque: what it leaves is taken to be noise, and curves tell "
            "little of the joint"
        )
    return [each for each in said if each]


def _recorded(recording: xr.Dataset, ensemble: bool, reference: float) -> tuple[JointSignals, Array]:
    """Signals of trials, and what parameters depend on, (trial, time)."""
    if recording.sizes["axis"] != 1 or recording.attrs.get("servo") != "position":
        raise ValueError(
            f"recording: servo = {recording.attrs.get('servo')!r} with {recording.sizes['axis']} axes; expected one "
            "axis and servo = 'position', as parameters that change are estimated in open loop"
        )
    if ensemble and recording.sizes["trial"] < FEWEST:
        raise ValueError(
            f"recording: {recording.sizes['trial']} trials; expected an ensemble of at least {FEWEST} repetitions "
            "(variable = 'scheduling' takes one)"
        )
    if not ensemble and "scheduling" not in recording:
        raise ValueError("recording: no scheduling signal; expected one (signals.scheduling of the sidecar)")
    if np.ptp(recording["displacement"].values, axis=1).min() == 0.0:
        raise ValueError("recording: the angle of a trial is constant; expected a perturbation")
    top = FASTEST if ensemble else TOP
    signals = joint_signals(recording, reference=reference, settle=SETTLE, shortest=SHORTEST, top=top)
    if signals.scheduling is not None and not ensemble:
        return signals, signals.scheduling
    velocity = signals.velocity[:, signals.used]
    differing = np.mean((velocity - velocity.mean(axis=0)) ** 2) / np.mean(velocity**2)
    if differing < SHARED:
        raise ValueError(
            f"recording: {100.0 * differing:.2g} % of the velocity's variance differs between repetitions, which seem "
            "to have the same perturbation, and what they share is taken out; expected a different one in each"
        )
    time = float(recording["time"].values[0]) + np.arange(signals.angle.shape[1]) / signals.rate
    return signals, np.broadcast_to(time, signals.angle.shape)


def _starts(likelihood: VaryingLikelihood) -> list[Array]:
    """Values from which a search may start, the noise being as last weighed."""
    names = likelihood.model.dynamics
    if not names:
        return [_linear(likelihood, np.empty(0))]
    usual = {"reflex_damping_ratio": 0.8}
    given = [dict(zip(DYNAMICS, each, strict=False)) for each in itertools.product(DELAYS, FREQUENCIES)]
    return [_linear(likelihood, np.array([(usual | each).get(name, 0.0) for name in names])) for each in given]


def _linear(likelihood: VaryingLikelihood, dynamics: Array) -> Array:
    """Values of all parameters with given delay, dynamics and threshold; the noise is held."""
    n = likelihood.model.n_linear
    values = np.concatenate([np.zeros(n), dynamics])
    normal = likelihood.normal(values, np.eye(len(values))[:, :n])
    return np.concatenate([_inverse(normal.information) @ normal.slope, dynamics])


def _inverse(information: Array) -> Array:
    """Inverse of an information whose parameters have units of their own; directions it does not tell are zero."""
    size = np.sqrt(np.where(np.diag(information) > 0.0, np.diag(information), 1.0))
    return np.asarray(linalg.pinvh(information / np.outer(size, size)) / np.outer(size, size))


class _Tried(NamedTuple):
    """A structure that was fitted with given numbers of splines.

    Attributes:
      score: see `joint.choice.ScoredStructure`.
      likelihood: with the noise that the structure leaves.
      values: of all parameters, at the maximum of the likelihood.
    """

    score: float
    likelihood: VaryingLikelihood
    values: Array

    @property
    def structure(self) -> JointStructure:
        """Of the joint."""
        return self.likelihood.model.structure

    @property
    def dynamics(self) -> Array:
        """Values of the parameters that do not enter linearly."""
        return self.values[self.likelihood.model.n_linear :]


def _tried(likelihood: VaryingLikelihood, start: Array) -> _Tried:
    values = search_from(_Search(likelihood, start), start, settled=SKETCHED).values
    objective = likelihood.objective(values)
    inside = _Search(likelihood, values).inside(values)
    loss = left_out_loss(_folds(likelihood.scores(values, np.eye(len(values))[:, inside])))
    return _Tried(score_of(likelihood.model.structure, objective, loss), likelihood, values)


def _best(
    tried: list[_Tried], candidates: tuple[int, ...]
) -> tuple[_Tried, dict[str, int], tuple[ScoredStructure, ...]]:
    """The best structure, its numbers of splines, and the scores of all with such numbers, the best first.

    With the first numbers a reflex makes up for jumps that these cannot follow.
    """
    best = min(tried, key=lambda each: each.score)
    chosen = _chosen(best, candidates)

    def again(each: _Tried) -> _Tried:
        orders = {name: chosen.get(name, n) for name, n in each.likelihood.model.orders.items()}
        likelihood = each.likelihood.with_orders(orders)
        return _tried(likelihood, _linear(likelihood, each.dynamics))

    several = len({each.structure.reflex for each in tried}) > 1
    scored = [ScoredStructure(each.structure, each.score) for each in (map(again, tried) if several else tried)]
    winner = tried[int(np.argmin([each.score for each in scored]))]
    if winner is not best:
        best, chosen = winner, _chosen(winner, candidates)
    return best, chosen, tuple(sorted(scored, key=lambda each: each.score))


def _chosen(best: _Tried, candidates: tuple[int, ...]) -> dict[str, int]:
    """Numbers of splines with which left-out groups are the most likely, one quantity after the other, twice."""
    model, dynamics = best.likelihood.model, best.dynamics
    chosen = dict(model.orders)
    scores: dict[tuple[int, ...], float] = {}

    def score(orders: Mapping[str, int]) -> float:
        """Cost that splines do not take away, with the loss on what is left out."""
        key = tuple(orders.values())
        if key not in scores:
            tried = best.likelihood.with_orders(orders)
            n = tried.model.n_linear
            nothing = np.concatenate([np.zeros(n), dynamics])
            groups = tried.scores(nothing, np.eye(len(nothing))[:, :n])
            folds = _folds(groups)
            slope, information = (np.sum(each, axis=0) for each in zip(*folds, strict=True))
            weights = _inverse(information) @ slope
            left = [BlockScore(fold.score - fold.information @ weights, fold.information) for fold in folds]
            scores[key] = float(-weights @ slope) + left_out_loss(left)
        return scores[key]

    for _ in range(2):
        for quantity in (name for name in model.orders if name != "static"):
            allowed = [n for n in candidates if quantity == "stiffness" or n <= MOST_OF_OTHERS]
            chosen[quantity] = min(allowed, key=lambda n: score({**chosen, quantity: n}))
    return chosen


def _folds(groups: list[BlockScore]) -> list[BlockScore]:
    """Parts that are left out in turn."""
    return [_together(groups[first::N_FOLDS]) for first in range(min(N_FOLDS, len(groups)))]


def _together(groups: list[BlockScore]) -> BlockScore:
    return BlockScore(*(np.sum(each, axis=0) for each in zip(*groups, strict=True)))


class _Solution(NamedTuple):
    """Estimates and what is known of their errors.

    Attributes:
      model: with its numbers of splines.
      values: of all parameters, (parameter,).
      influence: of each repetition or stretch on them, (group, parameter); the sum over groups is zero.
    """

    model: VaryingModel
    values: Array
    influence: Array

    def curve(self, quantity: str, grid: Array) -> tuple[Array, Array]:
        """A quantity on a grid, (point,), and the influence of each group on it, (group, point)."""
        basis, part = self.model.basis(quantity, grid), self.model.part(quantity)
        return self.values[part] @ basis, self.influence[:, part] @ basis


def _solved(likelihood: VaryingLikelihood, values: Array) -> _Solution:
    """One step from near the estimate, and how much each group has to do with where it leads; the noise is held."""
    inside = _Search(likelihood, values).inside(values)
    groups = likelihood.scores(values, np.eye(len(values))[:, inside])
    slope, information = _together(groups)
    inverse = _inverse(information)
    step = inverse @ slope
    influence = np.zeros((len(groups), len(values)))
    influence[:, inside] = [inverse @ (group.score - group.information @ step) for group in groups]
    solution = values.copy()
    solution[inside] += step
    return _Solution(likelihood.model, solution, influence)


def _curve(solution: _Solution, likelihood: VaryingLikelihood, quantity: str, n_chosen: int, grid: Array) -> Curve:
    """A quantity over the grid; its band counts how much further than noise splines of twice the distance lead.

    Where the variable has no values, as between two postures, nothing is known, and the standard error is infinite.
    """
    coarse = likelihood.with_orders({**solution.model.orders, quantity: n_chosen})
    before = _solved(coarse, _linear(coarse, solution.values[solution.model.n_linear :]))
    (value, influence), (other, of_other) = (each.curve(quantity, grid) for each in (solution, before))
    moved, noise = (_over_knots(each, n_chosen) for each in ((value - other) ** 2, _size(influence - of_other) ** 2))
    beyond = np.maximum(moved - noise, 0.0)
    bias = beyond * (beyond / np.maximum(moved, np.finfo(float).tiny))
    error = np.sqrt(_size(influence) ** 2 + bias)
    model = solution.model
    reached = model.basis(quantity, np.unique(model.variable[:, model.signals.used])).any(axis=1)
    error[model.basis(quantity, grid)[~reached].any(axis=0)] = np.inf  # of splines without data nothing is known
    return Curve(value, error, model.orders[quantity])


def _over_knots(squares: Array, n_basis: int) -> Array:
    """Means over twice the distance of knots, (point,): two of the splines that halving it adds."""
    width = min(round(2.0 * len(squares) / max(n_basis - DEGREE, 1)), 2 * len(squares))
    return np.asarray(ndimage.uniform_filter1d(squares, max(width, 1), mode="reflect"))
