"""Quick fits, good enough to compare structures."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armperturb.analysis.fit.group import Group, Method
from armperturb.analysis.fit.joint_likelihood import JointLikelihood
from armperturb.analysis.fit.likelihood_search import SKETCHED, search_from, with_usual_delays
from armperturb.analysis.fit.trial_effects import TrialScore
from armperturb.arrays import Array

PLENTY = 600.0
"""Duration of all trials together from which on their spectra lead a search to the right delays [s]."""

SKETCH_ROUNDS = 12
"""Steps after which the search of a sketch ends."""


class Sketch(NamedTuple):
    """A fit that is good enough to compare structures.

    Attributes:
      values: of the free parameters, (parameter,).
      objective: as `Estimate.objective`.
      chi2: as `Estimate.chi2`.
      dof: its degrees of freedom.
      scores: what each trial tells at the estimate; of a single trial that is long, each of its segments.
    """

    values: Array
    objective: float
    chi2: float
    dof: int
    scores: tuple[TrialScore, ...]


def sketch(group: Group, starts: Sequence[Array], method: Method = "record", *, most: int = SKETCH_ROUNDS) -> Sketch:
    """Fit a structure with few steps and quick derivatives, all trials alike, long ones in `Group.segments`.

    Where delays are free and trials are not hours, the search also starts from the most likely values with usual ones.

    Args:
      group: the trials and the structure.
      starts: values of the free parameters, the most likely of which the search starts from, (parameter,) each.
      method: of the likelihood, see `estimate`.
      most: steps after which the search ends in any case.
    """
    problem = JointLikelihood([group], method, (), sketchy=True)
    stable = [problem.stabilised(np.clip(start, problem.lower, problem.upper)) for start in starts]
    start = min(stable, key=problem.objective)
    ends = [search_from(problem, start, settled=SKETCHED, most=most).values]
    seconds = sum(part.n_trials * part.end / part.rate for part in group.parts)
    if seconds < PLENTY and any(name.startswith("Td_") for name in problem.names):
        usual = with_usual_delays(problem)
        ends.append(search_from(problem, usual, settled=SKETCHED, most=most).values)
    values = min(ends, key=problem.objective)
    objective = problem.objective(values)
    fit = problem.lack_of_fit(values)
    scores = problem.scores(values, problem.no_effects())
    n_trials = sum(part.n_trials for part in group.parts)
    if 1 < n_trials < problem.n_trials:
        scores = _of_whole_trials(scores, group)
    return Sketch(values, objective, fit.chi2, fit.dof, tuple(scores))


def _of_whole_trials(scores: Sequence[TrialScore], group: Group) -> list[TrialScore]:
    """The scores of segments, those of a trial together."""
    left, summed = iter(scores), []
    for part, likelihood in zip(group.of_records, group.segments, strict=True):
        for _ in range(part.n_trials):
            same = [next(left) for _ in range(likelihood.n_trials // part.n_trials)]
            score = np.sum([each.score for each in same], axis=0)
            information = np.sum([each.information for each in same], axis=0)
            summed.append(same[0]._replace(score=score, information=information))
    return [*summed, *left]
