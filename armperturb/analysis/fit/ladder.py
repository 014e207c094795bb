"""Which structure? A ladder of them, of which the trials choose.

The rungs are combinations of three choices (`own_structures.composed`): the joint inertia (three free numbers, or the
thesis's tie of one), the grip (rigid, or spring and damper) and the reflexes (none, velocity feedback, velocity and
position feedback; delays, cut-offs and damping ratio free). All are fitted to the estimated admittance first, which
takes no time; those that come near the nearest are fitted to the trials by maximum likelihood.

Of two structures, that one predicts better whose parameters, found from all trials but one, make that one more likely.
To first order the loss of likelihood that leaving trial t out costs it follows from its score s_t and information I_t
at the estimate, with I the sum of I_t:

    loss_t = 2 s_t^T v + v^T I_t v,    v = (I - I_t)^-1 s_t,

about two for each parameter, and more where a person differs from trial to trial. The score of a structure is minus
twice its log-likelihood plus `CAUTION` times that loss, as further parameters must not come in by chance. Where even
the best structure leaves more than noise, its lack of fit (chi2 over degrees of freedom) is the unit of likelihoods.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np

from armperturb.analysis.fit.group import Group, Method
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.maximum_likelihood import SUSPICIOUS, Estimate, estimate
from armperturb.analysis.fit.own_structures import Grip, Inertia, Reflex, composed
from armperturb.analysis.fit.structures import Structure
from armperturb.analysis.fit.trial_effects import SINGULAR, scaled
from armperturb.analysis.response.best_linear import best_linear
from armperturb.analysis.results import Description, Result, Table, plain
from armperturb.analysis.trials import ConditionTrials

CAUTION = 2.0
"""Weight of the loss on left-out trials [-]; 1 would be the expected likelihood of a further trial."""

NEAR = 60.0
"""Difference of the squared distances from the estimated admittance within which a structure is fitted to the trials,
over what a right one leaves [-]."""

MOST = 5
"""Structures that are fitted to the trials."""

FREE_OR_TIED: tuple[Inertia, ...] = ("free", "tied")

Place = tuple[Inertia, Grip, Reflex]

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

    def remarks(self, parts: Sequence[ConditionTrials]) -> tuple[str, ...]:
        """What a reader must know of the choice before trusting the parameters.

        Args:
          parts: the trials; of multisines in two or more, the distortion tells whether the arm is linear.
        """
        said = [self.sentence, *(f"the trials do not tell {each}" for each in self.undecided)]
        if self.chosen.estimate.is_suspicious:
            causes = ["inertia", "grip", "wrong geometry", "delay"]
            distorted = _distorted_band(parts)
            causes.insert(0 if distorted else len(causes), f"nonlinearity{distorted}")
            said.append(
                "no structure that was tried fits, and parameters are not to be trusted; likely causes in order: "
                + ", ".join(causes)
            )
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
    fitted: list[tuple[Place, Structure, Estimate, float]] = []
    refusal: ValueError | None = None
    for place in _near(group):
        inertia, grip, reflex = place
        candidate = group.with_structure(composed(inertia=inertia, grip=grip, reflex=reflex))
        try:
            result = estimate([candidate], method)
        except ValueError as error:
            refusal = error
            continue
        fitted.append((place, candidate.structure, result, left_out_loss(candidate, result, method)))
    if not fitted:
        assert refusal is not None
        raise refusal
    likelihood_unit = min(result.dispersion for _, _, result, _ in fitted)
    rungs = [
        Rung(*place, structure, result, loss, result.objective / likelihood_unit + CAUTION * loss)
        for place, structure, result, loss in fitted
    ]
    return Choice(condition=group.label, rungs=tuple(sorted(rungs, key=lambda rung: rung.score)))


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


def _near(group: Group) -> list[Place]:
    """The rungs whose fit to the estimated admittance comes near the nearest, as many as `MOST`."""
    distance, least = {}, np.inf
    for inertia, grip, reflex in itertools.product(FREE_OR_TIED, get_args(Grip), get_args(Reflex)):
        structure = composed(inertia=inertia, grip=grip, reflex=reflex)
        far = group.with_structure(structure).fit_of_spectra[1]
        distance[inertia, grip, reflex] = far + 2.0 * len(structure.free)
        least = min(least, far)
    # Neighbouring lines share noise and an arm is never quite linear: the nearest fit sets the scale.
    scale = max(1.0, least / (8 * len(group.spectra.frequency)))
    ordered = sorted(distance, key=lambda place: distance[place])
    near = [place for place in ordered if distance[place] - distance[ordered[0]] < NEAR * scale]
    return near[:MOST] if len(near) > 1 else ordered[:2]


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
