"""Which reflex path a joint has: the structures among which left-out data choose, and how they are scored."""

from collections.abc import Sequence
from typing import NamedTuple

from armperturb.analysis.fit.ladder import CAUTION, CLOSE
from armperturb.analysis.joint.model import REFLEXES, JointStructure, Reflex
from armperturb.analysis.results import plain

EVIDENCE = CLOSE
"""What is added to the score of a reflex [-]: delay and dynamics of a path that is not there fit any noise a little."""


class ScoredStructure(NamedTuple):
    """A structure that was tried.

    Attributes:
      structure: of the joint.
      score: minus twice the log-likelihood, with the loss on what is left out, and `EVIDENCE` for a reflex; smaller is
        better [-].
    """

    structure: JointStructure
    score: float


def structures(reflex: Reflex | None, *, short_range: bool = False) -> list[JointStructure]:
    """Structures to try, the simplest first, a half-wave in both directions.

    Args:
      reflex: that all have; None for any.
      short_range: whether they have short-range stiffness.
    """
    return [
        JointStructure(reflex=each, side=side, short_range=short_range)
        for each in (REFLEXES if reflex is None else (reflex,))
        for side in ((1, -1) if each == "half-wave" else (1,))
    ]


def score_of(structure: JointStructure, objective: float, loss: float) -> float:
    """Score of a structure.

    Args:
      structure: of the joint.
      objective: minus twice the log-likelihood, but for a constant that structures share [-].
      loss: of likelihood on what is left out, see `fit.ladder` [-].
    """
    return objective + CAUTION * loss + EVIDENCE * (structure.reflex != "none")


def sentence_of(tried: Sequence[ScoredStructure]) -> str:
    """What was chosen, and how clearly.

    Args:
      tried: the best first.
    """
    (best, least), *others = tried
    rivals = [each for each in others if each.structure.reflex != best.reflex]
    if not rivals:
        side = ", its direction chosen by left-out data" if others else ""
        return f"structure as asked for{side}: {best.name}"
    rival = rivals[0]
    behind = rival.score - least
    clear = "nearly as good" if behind < CLOSE else "clearly behind"
    return (
        f"structure chosen by left-out data: {best.name}; runner-up: {rival.structure.name}, "
        f"{clear} ({plain(behind, 3)} behind in left-out likelihood)"
    )
