"""Which structure? A ladder of them, of which the trials choose.

The rungs are combinations of three choices (`own_structures.composed`): the joint inertia (three free numbers, or the
thesis's tie of one), the grip (rigid, or spring and damper) and the reflexes (none, velocity feedback, velocity and
position feedback; delays, cut-offs and damping ratio free). All are fitted to the estimated admittance first, which
takes no time. From the nearest on, a search by maximum likelihood goes to whichever neighbour the trials prefer.

Of two structures, that one predicts better whose parameters, found from all trials but one, make that one more likely.
To first order the loss of likelihood that leaving trial t out costs it follows from its score s_t and information I_t
at the estimate, with I the sum of I_t:

    loss_t = 2 s_t^T v + v^T I_t v,    v = (I - I_t)^-1 s_t,

about two for each parameter, and more where a person differs from trial to trial. The score of a structure is minus
twice its log-likelihood plus `CAUTION` times that loss, as further parameters must not come in by chance. Where even
the best structure leaves more than noise, its lack of fit (chi2 over degrees of freedom) is the unit of likelihoods.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import pandas as pd

from armperturb.analysis.fit.group import Group, Method
from armperturb.analysis.fit.likelihood_search import MAX_ROUNDS
from armperturb.analysis.fit.maximum_likelihood import LARGE_LACK, SUSPICIOUS, Estimate, estimate
from armperturb.analysis.fit.own_structures import Grip, Inertia, Reflex, composed
from armperturb.analysis.fit.sketch import SKETCH_ROUNDS, Sketch, sketch
from armperturb.analysis.fit.structures import Structure
from armperturb.analysis.fit.trial_effects import scaled
from armperturb.analysis.fit.whittle import LackOfFit
from armperturb.analysis.response.best_linear import best_linear
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.memory import give_memory_back
from armperturb.subject import Subject

CAUTION = 2.0
"""Weight of the loss on left-out trials [-]; 1 would be the expected likelihood of a further trial."""

FAR = 300.0
"""Difference of the squared distances from the estimated admittance beyond which a structure is not fitted to the
trials, over what a right one leaves [-]; special cases of the best one always are."""

STIFF = 1e5
"""Stiffness from which a search starts where a rigid grip was tried before [N/m]."""

TIE = 20.0
"""What is added to the score of a tied inertia [-]: no arm is two point masses of exactly this ratio, and an inertia
that is wrong by little makes stiffness and damping wrong beyond their intervals."""

LEAST_POWER = 1e-6
"""Share of the information's power below which a direction of the parameters is left out of the loss [-]."""

ORDER: tuple[tuple[Inertia, ...], tuple[Grip, ...], tuple[Reflex, ...]] = (
    ("tied", "free"),
    ("rigid", "spring"),
    ("none", "velocity", "position"),
)
"""Choices of inertia, grip and reflexes, each a special case of the next."""

Place = tuple[Inertia, Grip, Reflex]

RICHEST: Place = ("free", "spring", "position")
"""The rung of which all others are special cases."""

SIMPLER: Place = ("free", "spring", "velocity")
"""The same without position feedback."""

Geometry = Callable[[Subject | None], Group | None]
"""Trials of one condition in the geometry of the start posture, from an estimate of the arm."""

CLOSE = 10.0
"""Difference of scores within which a structure is named as nearly as good [-]: a likelihood ratio of 150."""


class Rung(NamedTuple):
    """One structure that was tried.

    Attributes:
      inertia: see `own_structures.composed`.
      grip: likewise.
      reflex: likewise.
      structure: of these.
      sketch: the fit with it.
      loss: on left-out trials, see the module [-].
      score: minus twice the log-likelihood plus `CAUTION` times the loss; smaller is better [-].
    """

    inertia: Inertia
    grip: Grip
    reflex: Reflex
    structure: Structure
    sketch: Sketch
    loss: float
    score: float

    @property
    def name(self) -> str:
        """In words."""
        return self.structure.name


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Choice(Result):
    """The structure that the trials of one condition choose.

    Attributes:
      condition: the condition.
      group: the trials that chose.
      in_motion: whether they are those of `in_start_geometry`.
      estimate: with the chosen structure.
      rungs: all structures that were tried, the chosen one first, by their scores.
    """

    condition: str
    group: Group
    in_motion: bool
    estimate: Estimate
    rungs: tuple[Rung, ...]

    @property
    def chosen(self) -> Rung:
        """The structure with the least score."""
        return self.rungs[0]

    @property
    def runner_up(self) -> Rung:
        """The next; the chosen one if the trials told of no other."""
        return self.rungs[min(1, len(self.rungs) - 1)]

    @property
    def sentence(self) -> str:
        """What was chosen, and how clearly."""
        behind = self.runner_up.score - self.chosen.score
        clear = "nearly as good" if behind < CLOSE else "clearly behind"
        return (
            f"structure chosen: {self.chosen.name}; runner-up: {self.runner_up.name}, {clear} "
            f"({plain(behind, 3)} behind in left-out likelihood); "
            + ("geometry of the moving arm" if self.in_motion else "geometry of the start posture")
        )

    @property
    def undecided(self) -> tuple[str, ...]:
        """What the trials do not tell: choices of which another is nearly as good."""
        said = []
        for field in ("inertia", "grip", "reflex"):
            best = getattr(self.chosen, field)
            others = [
                getattr(rung, field)
                for rung in self.rungs[1:]
                if getattr(rung, field) != best and rung.score < self.chosen.score + CLOSE
            ]
            said += [f"{field}: {best} or {other}" for other in dict.fromkeys(others)]
        return tuple(said)

    def remarks(self, parts: Sequence[ConditionTrials]) -> tuple[str, ...]:
        """What a reader must know of the choice before trusting the parameters.

        Args:
          parts: the trials; of multisines in two or more, the distortion tells whether the arm is linear.
        """
        said = [self.sentence, *(f"the trials do not tell {each}" for each in self.undecided)]
        if self.estimate.is_suspicious:
            causes = ["inertia", "grip", "wrong geometry", "delay"]
            distorted = _distorted_band(parts)
            causes.insert(0 if distorted else len(causes), f"nonlinearity{distorted}")
            wrong = [each for each in self.estimate.imbalance.values() if each is not None]
            if wrong:
                causes.insert(0, "clocks" if math.isfinite(wrong[0].delay) else "force balance")
            said.append(
                "no structure that was tried fits, and parameters are not to be trusted; likely causes in order: "
                + ", ".join(causes)
            )
        return tuple(said)

    def to_frame(self) -> pd.DataFrame:
        """One row per structure, the best first: free parameters, score less the best, chi squared over dof [-]."""
        best = self.chosen.score
        rows = [
            (rung.name, len(rung.structure.free), rung.score - best, rung.sketch.chi2 / rung.sketch.dof)
            for rung in self.rungs
        ]
        return pd.DataFrame(rows, columns=["structure", "free", "score_less_best", "chi2_over_dof"])

    def describe(self) -> Description:
        """The ladder, the best structure first."""
        rows = tuple(
            (row.structure, str(row.free), plain(row.score_less_best, 4), plain(row.chi2_over_dof, 3))
            for row in self.to_frame().itertuples()
        )
        return Description(
            title=f"Structures tried for {self.condition}",
            facts=(self.sentence, *(f"the trials do not tell {each}" for each in self.undecided)),
            table=Table(("structure", "free", "score - best", "chi2/dof"), rows),
        )


def choose_structure(
    recorded: Group,
    in_geometry: Geometry | None = None,
    method: Method = "record",
    *,
    with_emg: Callable[[Group], Group] = lambda group: group,
) -> Choice:
    """Fit the structures of the ladder to the trials of one condition, and choose.

    Args:
      recorded: the trials as they were recorded; their structure does not matter.
      in_geometry: the same trials as `in_start_geometry` has them, for an estimate of the arm or None; None where an
        arm cannot reach the handle. Of all these, those are used that a linear arm explains best.
      method: of the likelihood, see `maximum_likelihood.estimate`.
      with_emg: adds the EMG that the estimate with the chosen structure uses as well; the choice is made without it.

    Raises:
      ValueError: as `estimate`, of every structure that was tried, or as `with_emg`.
    """
    group, richest, start = _nearest_to_linear(recorded, in_geometry, method)
    fits = _fits_of_spectra(group, start)
    place = min(fits, key=lambda each: fits[each].score)
    # Neighbouring lines share noise and an arm is never quite linear: the nearest fit sets the scale.
    limit = fits[place].score + FAR * max(1.0, fits[place].distance / (8 * len(group.spectra.frequency)))
    tried = {RICHEST: richest}
    if place not in tried:
        tried[place] = _sketched(group, place, fits[place], [richest], method)
    moved: set[Place] = set()
    while True:
        # If the trials refute a structure, the spectra that led to it tell too little of the others, too.
        refuted = _is_refuted(tried[place])
        for other in _neighbours(place):
            promising = refuted or fits[other].score < limit or sum(_rank(other)) < sum(_rank(place))
            # Searches from a structure whose own had ended in the wrong place are begun again.
            if (other in tried and place in moved) or (other not in tried and promising):
                rung = _sketched(group, other, fits[other], [tried[place], tried[RICHEST]], method)
                tried[other] = min(tried.get(other, rung), rung, key=_objective)
        moved.discard(place)
        for other, rung in tried.items():
            # No structure is less likely than its special case: its search ended in the wrong place.
            special = min((tried[each] for each in tried if _is_special(each, other)), key=_objective, default=rung)
            if _objective(special) < _objective(rung) - CLOSE:
                tried[other] = min(rung, _sketched(group, other, fits[other], [special], method), key=_objective)
                if _objective(tried[other]) < _objective(rung) - CLOSE:
                    moved.add(other)
        scored = _scored(tuple(tried.values()))
        if scored[0][:3] == place and place not in moved:
            break
        place = scored[0][:3]
    best = scored[0]
    for each in (recorded, group):
        each.made.pop("segments", None)  # they take much memory, and are not needed any more
    give_memory_back()
    initial = dict(zip(best.structure.free, best.sketch.values.tolist(), strict=True))
    estimate_of_best = estimate([with_emg(group.with_structure(best.structure))], method, initial=initial)
    return Choice(
        condition=group.label,
        group=group,
        in_motion=group is not recorded,
        estimate=estimate_of_best,
        rungs=tuple(scored),
    )


def nearest_to_linear(recorded: Group, in_geometry: Geometry, method: Method) -> Group:
    """The trials as recorded or in the start geometry: those with the greater likelihood in the richest rung.

    Args:
      recorded: see `choose_structure`, also for the next two. The group that is returned has its structure.
      in_geometry: likewise.
      method: likewise.

    Raises:
      ValueError: as `estimate`.
    """
    return _nearest_to_linear(recorded, in_geometry, method)[0]


def _nearest_to_linear(recorded: Group, in_geometry: Geometry | None, method: Method) -> tuple[Group, Rung, "_Fitted"]:
    """Those trials, the richest rung with them, and its fit to their admittance."""
    start = _fit_of_spectra(recorded, RICHEST)
    tried = [(recorded, _richest(recorded, start, (), method), start)]
    arm: Subject | None = None
    while in_geometry is not None and len(tried) < 3 and (group := in_geometry(arm)) is not None:
        if method == "frequency" and group.period is None:
            break  # the movement, which differs from period to period, acts in this geometry as a force
        start = _fit_of_spectra(group, RICHEST)
        rung = _richest(group, start, () if arm is None else [tried[-1][1]], method)
        arm = rung.structure.arm(group.body, rung.sketch.values)
        tried.append((group, rung, start))
    return min(tried, key=lambda each: _objective(each[1]))


def _richest(group: Group, start: "_Fitted", others: Sequence[Rung], method: Method) -> Rung:
    """The rung of which all others are special cases; if it is refuted, searched longer and from other starts."""
    rung = _sketched(group, RICHEST, start, others, method)
    if not _is_refuted(rung):
        return rung
    # With position feedback the likelihood has further maxima, at delays that are far too long.
    simpler = _sketched(group, SIMPLER, _fit_of_spectra(group, SIMPLER), (), method)
    usual = np.array([start.structure.initial[name] for name in start.structure.free])
    starts = usual, rung.sketch.values, _carried(simpler.structure, simpler.sketch.values, start.structure)
    longer = [_sketched(group, RICHEST, start._replace(values=each), (), method, MAX_ROUNDS) for each in starts]
    return min(longer, key=_objective)


def _is_refuted(rung: Rung) -> bool:
    """Whether the structure is wrong by far, or its search ended in the wrong place."""
    fit = LackOfFit(rung.sketch.chi2, rung.sketch.dof)
    return fit.p_value < SUSPICIOUS and fit.chi2 > LARGE_LACK * fit.dof


def _rank(place: Place) -> tuple[int, ...]:
    """How far up each choice is."""
    return tuple(order.index(choice) for order, choice in zip(ORDER, place, strict=True))


def _is_special(place: Place, other: Place) -> bool:
    """Whether a rung is a special case of another one."""
    return place != other and all(a <= b for a, b in zip(_rank(place), _rank(other), strict=True))


def _objective(rung: Rung) -> float:
    return rung.sketch.objective


def _neighbours(place: Place) -> list[Place]:
    """The rungs that differ in one choice."""
    places: list[Place] = list(itertools.product(*ORDER))
    return [other for other in places if sum(a != b for a, b in zip(other, place, strict=True)) == 1]


def _scored(rungs: Sequence[Rung]) -> list[Rung]:
    """The rungs with their scores, the best first."""
    likelihood_unit = max(1.0, min(rung.sketch.chi2 / rung.sketch.dof for rung in rungs))
    scored = [
        rung._replace(
            score=rung.sketch.objective / likelihood_unit + CAUTION * rung.loss + TIE * (rung.inertia == "tied")
        )
        for rung in rungs
    ]
    return sorted(scored, key=lambda rung: rung.score)


def _sketched(
    group: Group, place: Place, start: "_Fitted", others: Sequence[Rung], method: Method, most: int = SKETCH_ROUNDS
) -> Rung:
    """One rung, from the fit to the admittance or from what other rungs have found, without its score."""
    carried = [_carried(other.structure, other.sketch.values, start.structure) for other in others]
    fit = sketch(group.with_structure(start.structure), [start.values, *carried], method, most=most)
    return Rung(*place, start.structure, fit, left_out_loss(fit.scores), np.inf)


def _distorted_band(parts: Sequence[ConditionTrials]) -> str:
    """Where the arm's response is distorted, in words; "" where it is not, or nothing tells."""
    try:
        linear = best_linear(parts)
    except ValueError:
        return ""
    distorted = linear.response.frequency[(linear.distortion > 1.645 * linear.distortion_error).any(axis=1)]
    if linear.p_value > SUSPICIOUS or not len(distorted):
        return ""
    return f" (distortion from {distorted[0]:.2g} to {distorted[-1]:.2g} Hz, p = {linear.p_value:.1g})"


class _Fitted(NamedTuple):
    structure: Structure
    values: Array
    distance: float

    @property
    def score(self) -> float:
        """Distance from the estimated admittance, with Akaike's penalty for each parameter."""
        return self.distance + 2.0 * len(self.structure.free)


def _fit_of_spectra(group: Group, place: Place) -> _Fitted:
    """The nearest of what several starts give."""
    inertia, grip, reflex = place
    candidate = group.with_structure(composed(inertia=inertia, grip=grip, reflex=reflex))
    return _Fitted(candidate.structure, *candidate.best_fit_of_spectra())


def _fits_of_spectra(group: Group, richest: _Fitted) -> dict[Place, _Fitted]:
    """All rungs, each fitted to the estimated admittance, as the richest has been."""
    fitted: dict[Place, _Fitted] = {}
    for place in itertools.product(*ORDER):
        fitted[place] = richest if place == RICHEST else _fit_of_spectra(group, place)
    # A search may end too early. What the nearest structure has found is another start for the others.
    tried: set[Place] = set()
    while (best := min(fitted, key=lambda place: fitted[place].score)) not in tried:
        tried.add(best)
        for place, rung in fitted.items():
            if place == best:
                continue
            start = _carried(fitted[best].structure, fitted[best].values, rung.structure)
            again = group.with_structure(rung.structure).fit_of_spectra(start)
            if again[1] < rung.distance:
                fitted[place] = _Fitted(rung.structure, *again)
    return fitted


def _carried(source: Structure, values: Array, structure: Structure) -> Array:
    """Values of a structure from those of another; gains that it has not are zero, and a rigid grip is a stiff one."""
    known = dict(zip(source.free, values.tolist(), strict=True))
    start = []
    for name, (lower, upper) in structure.bounds.items():
        usual = 0.0 if name.startswith(("kv_", "kp_")) else STIFF if name == "k_h" else structure.initial[name]
        start.append(min(max(known.get(name, usual), lower), upper))
    return np.array(start)


class _Score(Protocol):
    """Score and information of a part of the data that is left out."""

    @property
    def score(self) -> Array: ...

    @property
    def information(self) -> Array: ...


def left_out_loss(scores: Sequence[_Score]) -> float:
    """Loss of likelihood on trials that are left out one by one, see the module [-]."""
    whole = np.sum([trial.information for trial in scores], axis=0)
    loss = 0.0
    for trial in scores:
        scale, power, directions = scaled(whole - trial.information)
        known = power > LEAST_POWER
        along = directions[:, known].T @ (trial.score / scale)
        change = directions[:, known] @ (along / power[known]) / scale
        loss += float(2.0 * trial.score @ change + change @ trial.information @ change)
    return loss
