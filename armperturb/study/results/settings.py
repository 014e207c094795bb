"""What determines the analysis of a study, beside its recordings and its protocol."""

from dataclasses import dataclass

STRUCTURES = tuple("123456")
"""Structures of appendix C."""


STARTS_OF = "PT7.5"
"""Condition of appendices D and E, which try several starts."""


@dataclass(frozen=True, kw_only=True)
class AnalysisSettings:
    """Which fits of the thesis's appendices are made; by default all of them.

    Attributes:
      structures: those that are fitted as in appendix C, see `armperturb.analysis.fit.structures`.
      starts_of: condition that is fitted as in appendices D and E, from several starts; None for none.

    Raises:
      ValueError: a structure is unknown.
    """

    structures: tuple[str, ...] = STRUCTURES
    starts_of: str | None = STARTS_OF

    def __post_init__(self) -> None:
        unknown = [structure for structure in self.structures if structure not in STRUCTURES]
        if unknown:
            raise ValueError(
                f"analysis: structures = {list(self.structures)!r}; expected some of {', '.join(STRUCTURES)}"
            )
