"""Which structure? A ladder of them, of which the trials choose.

The rungs are combinations of three choices (`own_structures.composed`): the joint inertia (three free numbers, two point
masses, or the thesis's tie of one), the grip (rigid, or spring and damper) and the reflexes (none, velocity feedback,
velocity and position feedback; delays, cut-offs and damping ratio free). Each is fitted by maximum likelihood. Grip and
reflexes are chosen first, with free inertia, then the inertia.

Of two structures, that one predicts better whose parameters, found from all trials but one, make that one more likely.
To first order the loss of likelihood that leaving trial t out costs it follows from its score s_t and information I_t at
the estimate, with I the sum of I_t:

    loss_t = 2 s_t^T v + v^T I_t v,    v = (I - I_t)^-1 s_t,

about two for each parameter, and more where a person differs from trial to trial. The score of a structure is minus
twice its log-likelihood plus `CAUTION` times that loss, as further parameters must not come in by chance.
"""

from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np

from armperturb.analysis.fit.group import Group, Method
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.maximum_likelihood import Estimate, estimate
from armperturb.analysis.fit.own_structures import Grip, Inertia, Reflex, composed
from armperturb.analysis.fit.structures import Structure
from armperturb.analysis.fit.trial_effects import SINGULAR, scaled
from armperturb.analysis.results import Description, Result, Table, plain

CAUTION = 2.0
"""Weight of the loss on left-out trials [-]; 1 would be the expected likelihood of a further trial."""

CLOSE = 10.0
"""Difference of scores within which a structure is named as nearly as good [-]: a likelihood ratio of 150."""


class Rung(NamedTuple):
    """One structure that was tried.

    Attributes:
      inertia: see `own_structures.composed`.
      grip: likewise.
      reflex: likewise.
      structure: of these.
      estimate: with it.
      loss: on left-out trials, see the module [-].
      score: minus twice the log-likelihood plus `CAUTION` times the loss; smaller is better [-].
    """

    inertia: Inertia
    grip: Grip
    reflex: Reflex
    structure: Structure
    estimate: Estimate
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
      rungs: all structures that were tried, the chosen one first, by their scores.
    """

    condition: str
    rungs: tuple[Rung, ...]

    @property
    def chosen(self) -> Rung:
        """The structure with the least score."""
        return self.rungs[0]

    @property
    def runner_up(self) -> Rung:
        """The next."""
        return self.rungs[1]

    @property
    def sentence(self) -> str:
        """What was chosen, and how clearly."""
        behind = self.runner_up.score - self.chosen.score
        clear = "nearly as good" if behind < CLOSE else "clearly behind"
        return (
            f"structure chosen: {self.chosen.name}; runner-up: {self.runner_up.name}, {clear} "
            f"({plain(behind, 3)} behind in left-out likelihood)"
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

    def describe(self) -> Description:
        """The ladder, the best structure first."""
        rows = tuple(
            (
                rung.name,
                str(len(rung.structure.free)),
                plain(rung.score - self.chosen.score, 4),
                plain(rung.estimate.chi2 / rung.estimate.dof, 3),
                plain(rung.estimate.p_value, 2),
            )
            for rung in self.rungs
        )
        return Description(
            title=f"Structures tried for {self.condition}",
            facts=(self.sentence, *(f"the trials do not tell {each}" for each in self.undecided)),
            table=Table(("structure", "free", "score - best", "chi2/dof", "p"), rows),
        )


def choose_structure(group: Group, method: Method = "record") -> Choice:
    """Fit the structures of the ladder to the trials of one condition, and choose.

    Args:
      group: the trials; its structure does not matter.
      method: of the likelihood, see `maximum_likelihood.estimate`.

    Raises:
      ValueError: as `estimate`, of every structure that was tried.
    """
    tried: dict[tuple[Inertia, Grip, Reflex], Rung] = {}
    refusals: list[ValueError] = []

    def attempt(inertia: Inertia, grip: Grip, reflex: Reflex) -> None:
        structure = composed(inertia=inertia, grip=grip, reflex=reflex)
        try:
            found = estimate([group.with_structure(structure)], method)
        except ValueError as error:
            refusals.append(error)
            return
        loss = left_out_loss(group.with_structure(structure), found, method)
        score = found.objective + CAUTION * loss
        tried[inertia, grip, reflex] = Rung(inertia, grip, reflex, structure, found, loss, score)

    for grip in get_args(Grip):
        for reflex in get_args(Reflex):
            attempt("free", grip, reflex)
    if tried:
        _, grip, reflex = min(tried, key=lambda place: tried[place].score)
        attempt("points", grip, reflex)
        attempt("tied", grip, reflex)
    if not tried:
        raise refusals[0]
    return Choice(condition=group.label, rungs=tuple(sorted(tried.values(), key=lambda rung: rung.score)))


def left_out_loss(group: Group, fitted: Estimate, method: Method) -> float:
    """Loss of likelihood on trials that are left out one by one, see the module [-].

    Args:
      group: the trials.
      fitted: the estimate from all.
      method: of its likelihood.
    """
    problem = JointLikelihood([group], method, ())
    values = np.array(list(fitted.values.values()))
    problem.weigh(values)
    scores = problem.scores(values, problem.no_effects())
    whole = np.sum([trial.information for trial in scores], axis=0)
    free = ~np.isin(list(fitted.values), fitted.at_bound)
    loss = 0.0
    for trial in scores:
        scale, power, directions = scaled((whole - trial.information)[np.ix_(free, free)])
        known = power > max(SINGULAR, 1e-8)
        along = directions[:, known].T @ (trial.score[free] / scale)
        change = directions[:, known] @ (along / power[known]) / scale
        loss += float(2.0 * trial.score[free] @ change + change @ trial.information[np.ix_(free, free)] @ change)
    return loss
