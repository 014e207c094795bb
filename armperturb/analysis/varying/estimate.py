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

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import inside_limit, one_condition
from armperturb.analysis.fit.ladder import left_out_loss
from armperturb.analysis.fit.likelihood_search import SKETCHED, search_from
from armperturb.analysis.joint.choice import ScoredStructure, score_of, structures
from armperturb.analysis.joint.model import REFLEXES, JointStructure, Reflex
from armperturb.analysis.joint.prediction import explained
from armperturb.analysis.joint.remarks import cut_short
from armperturb.analysis.joint.signals import EDGE, TOP, JointSignals, joint_signals, mean_angle
from armperturb.analysis.joint.torque_likelihood import BlockScore
from armperturb.analysis.joint_balance import impossible_joint
from armperturb.analysis.varying.likelihood import STRETCH, VaryingLikelihood
from armperturb.analysis.varying.model import VaryingModel, finer
from armperturb.analysis.varying.result import VaryingEstimate
from armperturb.analysis.varying.solution import Search, maxima_near, mixed, size_of, together
from armperturb.analysis.varying.starts import at_dynamics, inverse, search_starts
from armperturb.arrays import Array
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
    (recording,), left_out = inside_limit([each_once])
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
        tried.append(_tried(likelihood, min(search_starts(likelihood), key=likelihood.cost)))
    best, chosen, scored = _best(tried, CANDIDATES[variable])
    likelihood = best.likelihood.with_orders({name: finer(n) if name != "static" else n for name, n in chosen.items()})
    grid = np.linspace(low, high, n_points)
    maxima = maxima_near(likelihood, best.dynamics, chosen, grid)
    solution, curves = maxima[0].solution, mixed(maxima)
    model, values = solution.model, solution.values
    dynamics = dict(zip(model.dynamics, map(float, values[model.n_linear :]), strict=True))
    inside = Search(likelihood, values).inside(values)
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
        inertia_error=float(size_of(solution.influence)[0]),
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
    values = search_from(Search(likelihood, start), start, settled=SKETCHED).values
    objective = likelihood.objective(values)
    inside = Search(likelihood, values).inside(values)
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
        return _tried(likelihood, at_dynamics(likelihood, each.dynamics))

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
            weights = inverse(information) @ slope
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
    return [together(groups[first::N_FOLDS]) for first in range(min(N_FOLDS, len(groups)))]
