"""What determines a study."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from armperturb.cohort import MUSCLES, Person, draw_cohort
from armperturb.environment import ENGINES, TIMESTEP, Environment
from armperturb.study.protocol import FORCES, THESIS, Protocol, load_protocol
from armperturb.validation import require_one_of, require_ranges

BLOCK = 96
"""Default number of trials that are simulated side by side: more are hardly faster, but take more memory."""


@dataclass(frozen=True, kw_only=True)
class StudySettings:
    """What determines a study.

    Raises:
      TypeError: a value is not a number.
      ValueError: a value is out of its range.
    """

    subjects: int = 10
    """Number of synthetic people."""
    seed: int = 0
    """Seed of everything random."""
    protocol: Path | None = None
    """TOML file of the experiment that each person goes through; by default the thesis's protocol."""
    ideal: bool = False
    """People and instruments without noise."""
    forces: Literal["practice", "published"] | None = None
    """Where the forces come from, instead of what the protocol says: each person's practice session, or the protocol's
    own, the same for everyone."""
    muscles: Literal["nonlinear", "linear"] = "nonlinear"
    """People around a calibrated average person with nonlinear muscles, or people with linear ones, whose true
    parameters estimates can be compared with."""
    timestep: float = TIMESTEP
    """Step of the simulation [s]; a sample of a recording must be a whole number of steps."""
    engine: Literal["mujoco", "compiled"] = "mujoco"
    """What simulates the recordings: MuJoCo, or the same arm by compiled equations of motion, within 2e-4 and some ten
    times faster. Practice is always compiled, unless a strap lets shoulders move."""

    def __post_init__(self) -> None:
        require_ranges("study", self)
        require_one_of("study", "forces", self.forces, (*FORCES, None))
        require_one_of("study", "muscles", self.muscles, MUSCLES)
        require_one_of("study", "engine", self.engine, ENGINES)

    def load_protocol(self) -> Protocol:
        """The protocol, with the `forces` of the settings.

        Raises:
          TypeError: a value in the file has the wrong type.
          ValueError: the file is refused.
          OSError: the file cannot be read.
        """
        protocol = THESIS if self.protocol is None else load_protocol(self.protocol)
        _require_names(protocol, str(self.protocol))
        return protocol if self.forces is None else replace(protocol, forces=self.forces)

    def draw_people(self, environment: Environment) -> tuple[Person, ...]:
        """The people, each stable on the environment.

        Raises:
          RuntimeError: no stable person was found, which only an unusual environment can cause.
        """
        return draw_cohort(self.subjects, self.seed, environment, muscles=self.muscles)


def _require_names(protocol: Protocol, source: str) -> None:
    """Refuse other conditions under names of the thesis's: reports would set them beside its tables."""
    published = {condition.name: condition for condition in THESIS.conditions}
    for condition in protocol.conditions:
        meant = published.get(condition.name, condition)
        for what, value, expected in (
            ("task", condition.task, meant.task),
            ("has a multisine", condition.has_multisine, meant.has_multisine),
        ):
            if value != expected:
                raise ValueError(
                    f"{source}: condition {condition.name!r}: {what} = {value!r}; expected {expected!r}, as of the "
                    "thesis's condition of that name (or another name)"
                )
