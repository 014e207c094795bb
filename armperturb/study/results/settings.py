"""What determines the analysis of a study, beside its recordings and its protocol."""

from dataclasses import dataclass
from typing import Literal, get_args

from armperturb.validation import require_one_of

STRUCTURES = tuple("123456")
"""Structures of appendix C."""


STARTS_OF = "PT7.5"
"""Condition of appendices D and E, which try several starts."""

Start = Literal["neutral", "published", "scattered"]
"""Where the fits of the first step of appendix C start, see `AnalysisSettings.start`."""


@dataclass(frozen=True, kw_only=True)
class AnalysisSettings:
    """Which fits of the thesis's appendices are made; by default all of them.

    Attributes:
      structures: those that are fitted as in appendix C, see `armperturb.analysis.fit.structures`.
      starts_of: condition that is fitted as in appendices D and E, from several starts; None for none.
      start: where the first step of appendix C starts: "neutral", at the masses, intrinsic parameters and grip of model
        1 with no feedback (`structures.neutral_start`); "published", at the means that the thesis came to (tables C.3
        and C.13); "scattered", at these times log-normal factors of SD 0.4, which are the same for all people. The
        thesis began at values of De Vlugt et al. (2006), which it does not print.

    Raises:
      ValueError: a structure or start is unknown.
    """

    structures: tuple[str, ...] = STRUCTURES
    starts_of: str | None = STARTS_OF
    start: Start = "neutral"

    def __post_init__(self) -> None:
        require_one_of("analysis", "start", self.start, get_args(Start))
        unknown = [structure for structure in self.structures if structure not in STRUCTURES]
        if unknown:
            raise ValueError(
                f"analysis: structures = {list(self.structures)!r}; expected some of {', '.join(STRUCTURES)}"
            )
