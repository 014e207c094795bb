"""Whether the parts of trials tell of the same joint.

With delay and dynamics held, torque is linear in inertia, damping, stiffness and reflex gain: with score s_p and
information F_p of a part p at the estimate, F_p^-1 s_p is by how much least squares of that part alone differs from it.
The variance between parts beyond noise is that of DerSimonian & Laird (1986, Control. Clin. Trials 7, 177-188). Parts
are compared within their trial, as trials may differ, see `trial_differences`: those of each, and what all trials have
in common at the same time.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import stats

from armperturb.analysis.fit.trial_effects import SINGULAR, inverse, scaled
from armperturb.analysis.joint.estimate import JointEstimate
from armperturb.analysis.joint.likelihood import N_BLOCKS, JointLikelihood, Loop
from armperturb.analysis.joint.signals import JointSignals
from armperturb.analysis.results import plain
from armperturb.arrays import Array, Indices

QUANTITIES = ("inertia", "damping", "stiffness", "reflex_gain")
"""What is compared."""

DIFFERENT = 0.1
"""Standard deviation over parts, over the estimate, from which on they differ [-]. Stiffness of people who hold a
contraction varies by 5 % within a minute."""

CHANCE = 1e-4
"""Of a difference that is none in a recording, where the structure is right and the noise is stationary [-]."""

SHORTEST_PART = 1.0
"""[s]."""

PIECE = 0.25
"""Resolution of the instant at which a joint changes [s]."""


class PartDifferences(NamedTuple):
    """How parts of a record differ, beyond noise.

    Attributes:
      spread: quantity to its standard deviation over parts, over its estimate [-]; empty where parts do not differ.
      n_parts: number of parts.
      where: whose parts these are, in words.
      at: instant before and after which they differ most [s].
      before: quantity to its estimate from what is before that instant alone, reflex dynamics held.
      after: the same of what follows.
    """

    spread: Mapping[str, float]
    n_parts: int = 0
    where: str = ""
    at: float = 0.0
    before: Mapping[str, float] = {}
    after: Mapping[str, float] = {}

    @property
    def largest(self) -> float:
        """Largest spread [-]."""
        return max(self.spread.values(), default=0.0)

    @property
    def sentence(self) -> str:
        """In words, without full stop; empty where parts do not differ."""
        if not self.spread:
            return ""
        names = [name.replace("_", " ") for name in self.spread]
        spreads = ", ".join(
            f"{name} {100.0 * each:.0f} %" for name, each in zip(names, self.spread.values(), strict=True)
        )
        sides = (
            ", ".join(f"{name} {plain(side[key], 3)}" for key, name in zip(self.spread, names, strict=True))
            for side in (self.before, self.after)
        )
        return (
            f"parts of {self.where} differ by more than noise (SD over {self.n_parts} parts: {spreads}), "
            f"most before and after {self.at:.1f} s ({'; then '.join(sides)}): no value holds throughout; leave out "
            "what is not valid (limit_time of the sidecar), or fit the parts apart"
        )


class WhiteSlopes(NamedTuple):
    """Derivatives of torque at an estimate, white under its noise.

    Attributes:
      likelihood: of the trials, weighed.
      names: of the quantities.
      values: of these, (quantity,).
      slopes: (quantity, trial, number).
    """

    likelihood: JointLikelihood
    names: tuple[str, ...]
    values: Array
    slopes: Array


def part_differences(fit: JointEstimate, signals: JointSignals, loop: Loop | None) -> PartDifferences:
    """How much parts of trials differ, if it is significant.

    Args:
      fit: of all trials.
      signals: of these.
      loop: the virtual environment of a force servo; None of a position servo.
    """
    duration = (signals.used.stop - signals.used.start) / signals.rate
    n_parts = min(N_BLOCKS, int(duration / SHORTEST_PART))
    white = white_slopes(fit, signals, loop)
    if n_parts < 2 or white is None:
        return PartDifferences({})
    likelihood, names, estimates, slopes = white
    n_pieces = int(duration / PIECE)
    pieces = likelihood.block_scores(likelihood.residual(fit.values), slopes, n_pieces)
    score = np.array([each.score for each in pieces]).reshape(-1, n_pieces, len(names))
    information = np.array([each.information for each in pieces]).reshape(*score.shape, len(names))
    shifts = [inverse(each) @ s for each, s in zip(information.sum(axis=1), score.sum(axis=1), strict=True)]
    score -= np.einsum("tpij,tj->tpi", information, shifts)
    courses = [("the record", np.zeros(len(names)), score.sum(axis=0), information.sum(axis=0))]
    if likelihood.n_trials > 1:
        courses = [("all trials", *courses[0][1:])]
        telling = telling_trials(information.sum(axis=1)).tolist()
        courses += [(f"trial {signals.numbers[t]}", shifts[t], score[t], information[t]) for t in telling]
    differences = []
    for where, change, s, f in courses:
        values = estimates + change
        spread = _spread(values, s, f, n_parts, CHANCE / (len(courses) * len(names)))
        differing = {name: float(each) for name, each in zip(names, spread, strict=True) if each >= DIFFERENT}
        if differing:
            cut, sides = _most_apart(s, f, round(SHORTEST_PART / PIECE))
            before, after = (
                {name: float(each) for name, each in zip(names, values + side, strict=True)} for side in sides
            )
            at = (signals.used.start / signals.rate) + cut * duration / n_pieces
            differences.append(PartDifferences(differing, n_parts, where, at, before, after))
    largest = max((each.largest for each in differences), default=0.0)
    # The first is what all trials have in common: it is named unless the parts of a single trial differ by much more.
    return next((each for each in differences if each.largest >= 0.5 * largest), PartDifferences({}))


def white_slopes(fit: JointEstimate, signals: JointSignals, loop: Loop | None) -> WhiteSlopes | None:
    """Derivatives by the quantities in which torque is linear, but for those at a bound; None where all are.

    Args:
      fit: of all trials.
      signals: of these.
      loop: the virtual environment of a force servo; None of a position servo.
    """
    names = fit.structure.parameters
    places = [place for place, name in enumerate(names) if name in QUANTITIES and not fit.at_bound[place]]
    if not places:
        return None
    likelihood = JointLikelihood(fit.structure, signals, loop)
    likelihood.weigh(fit.values)
    slopes = likelihood.derivatives(fit.values, likelihood.movement(fit.values))[places]
    return WhiteSlopes(likelihood, tuple(names[place] for place in places), fit.values[places], slopes)


def telling_trials(information: Array) -> Indices:
    """Trials that tell of all that is compared, (telling trial,): one without movement tells of nothing but round-off.

    Args:
      information: of each trial, (trial, quantity, quantity).
    """
    most = np.diagonal(information, axis1=1, axis2=2).max(axis=0)
    is_telling = [
        bool((np.diag(each) > SINGULAR * most).all() and scaled(each)[1][0] > SINGULAR) for each in information
    ]
    return np.flatnonzero(is_telling)


def _spread(values: Array, score: Array, information: Array, n_parts: int, chance: float) -> Array:
    """Standard deviation over parts, over the values [-], (quantity,); zero where it is not significant.

    Args:
      values: of the quantities, (quantity,).
      score: of pieces of time, (piece, quantity).
      information: the same, (piece, quantity, quantity).
      n_parts: number of parts.
      chance: of a result that counts as significant [-].
    """
    cuts = np.array_split(np.arange(len(score)), n_parts)
    covariance = np.array([inverse(information[cut].sum(axis=0)) for cut in cuts])
    apart = np.einsum("pij,pj->pi", covariance, np.array([score[cut].sum(axis=0) for cut in cuts]))
    weight = 1.0 / np.diagonal(covariance, axis1=1, axis2=2)
    total = weight.sum(axis=0)
    chi2 = np.sum(weight * (apart - np.sum(weight * apart, axis=0) / total) ** 2, axis=0)
    beyond = (chi2 - (n_parts - 1)) / (total - np.sum(weight**2, axis=0) / total)
    significant = stats.chi2.sf(chi2, n_parts - 1) < chance
    apart_by = np.sqrt(np.where(significant, np.maximum(beyond, 0.0), 0.0))
    return np.divide(apart_by, np.abs(values), out=np.zeros_like(apart_by), where=apart_by > 0.0)


def _most_apart(score: Array, information: Array, least: int) -> tuple[int, tuple[Array, Array]]:
    """Piece that begins what differs most from what is before it, and by how much either side is off.

    Args:
      score: of pieces of time, (piece, quantity), with a sum of zero.
      information: the same, (piece, quantity, quantity).
      least: pieces on either side.
    """
    s, f = np.cumsum(score, axis=0), np.cumsum(information, axis=0)
    largest, best = -np.inf, (0, (s[0], s[0]))
    for cut in range(least, len(s) - least + 1):
        before, after = inverse(f[cut - 1]) @ s[cut - 1], inverse(f[-1] - f[cut - 1]) @ -s[cut - 1]
        if (gain := float(s[cut - 1] @ (before - after))) > largest:
            largest, best = gain, (cut, (before, after))
    return best
