"""What determines the recordings in a study folder, as `manifest.json` tells it."""

import hashlib
import importlib.metadata
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from armperturb.cohort import MUSCLES, Person, draw_cohort
from armperturb.environment import Environment
from armperturb.study.protocol import Protocol
from armperturb.study.recording.folder import MANIFEST
from armperturb.study.recording.settings import StudySettings
from armperturb.validation import require_number, require_one_of

UNSAID_TIMESTEP = 1e-3
"""Step of the simulation in folders whose manifest does not say it [s]."""

MOST_SUBJECTS = 100_000
"""More people than this are a slip in a manifest: drawing them would take hours."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """How the recordings of a study were made.

    Attributes:
      subjects: number of people.
      seed: of everything random.
      ideal: whether people and instruments are free of noise.
      muscles: "nonlinear" or "linear" people.
      timestep: of the simulation [s].
      protocol: what everyone went through.
      people: digest of the people: another calibration, or other spreads, make other people of the same seed.
      versions: of this package and the libraries that the recordings depend on.
    """

    subjects: int
    seed: int
    ideal: bool
    muscles: str
    timestep: float
    protocol: Protocol
    people: str
    versions: Mapping[str, str]

    @classmethod
    def of(cls, people: Sequence[Person], protocol: Protocol, settings: StudySettings) -> Self:
        """That of a study which begins now."""
        return cls(
            subjects=len(people),
            seed=settings.seed,
            ideal=settings.ideal,
            muscles=settings.muscles,
            timestep=settings.timestep,
            protocol=protocol,
            people=_digest(people),
            versions=current_versions(),
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str) -> Self:
        """From what `to_dict` gives.

        Args:
          values: name to value.
          source: where they come from, for the message.

        Raises:
          ValueError: a value is missing or makes no sense.
        """
        try:
            for name, least, most in (("subjects", 1, MOST_SUBJECTS), ("seed", 0, math.inf)):
                require_number(source, name, values[name], at_least=least, at_most=most)
            require_number(source, "timestep", values.get("timestep", UNSAID_TIMESTEP), above=0.0)
            require_one_of(source, "muscles", values["muscles"], MUSCLES)
            if not isinstance(values["protocol"], Mapping) or not isinstance(values["versions"], Mapping):
                raise ValueError(f"{source}: protocol or versions is no table; expected what a run wrote")
            return cls(
                subjects=int(values["subjects"]),
                seed=int(values["seed"]),
                ideal=bool(values["ideal"]),
                muscles=values["muscles"],
                timestep=float(values.get("timestep", UNSAID_TIMESTEP)),
                protocol=Protocol.from_dict(values["protocol"], source=f"{source}, protocol"),
                people=str(values["people"]),
                versions=dict(values["versions"]),
            )
        except KeyError as error:
            raise ValueError(f"{source}: no {error.args[0]!r}; expected what a run of this version writes") from None
        except TypeError as error:
            raise ValueError(str(error)) from None

    def to_dict(self) -> dict[str, Any]:
        """Name to value, as JSON holds it."""
        return {
            "versions": dict(self.versions),
            "subjects": self.subjects,
            "seed": self.seed,
            "ideal": self.ideal,
            "muscles": self.muscles,
            "timestep": self.timestep,
            "people": self.people,
            "protocol": self.protocol.to_dict(),
        }

    def draw_people(self, environment: Environment) -> tuple[Person, ...] | None:
        """Those who were recorded; None if this version draws others.

        Raises:
          RuntimeError: no stable person was found, which only an odd environment can cause.
        """
        people = draw_cohort(self.subjects, self.seed, environment, muscles=self.muscles)
        return people if _digest(people) == self.people else None


def read_manifest(root: Path) -> Manifest | None:
    """That of a study folder; None if it has none, as a laboratory's own.

    Raises:
      ValueError: it cannot be read.
      OSError: likewise.
    """
    path = root / MANIFEST
    if not path.is_file():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON ({error}); expected what a run wrote") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path}: holds a {type(values).__name__}; expected what a run wrote")
    return Manifest.from_dict(values, str(path))


def current_versions() -> dict[str, str]:
    """Of this package and the libraries that recordings depend on."""
    return {name: importlib.metadata.version(name) for name in ("armperturb", "mujoco", "numpy", "scipy")}


def _digest(people: Sequence[Person]) -> str:
    return hashlib.sha256(repr(tuple(people)).encode()).hexdigest()
