"""What determines the recordings in a study folder, as `manifest.json` tells it."""

import hashlib
import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

from armperturb.cohort import MUSCLES, Person, draw_cohort
from armperturb.environment import ENGINES, Environment
from armperturb.study.protocol import Protocol
from armperturb.study.recording.folder import MANIFEST, kept_manifest
from armperturb.study.recording.settings import StudySettings
from armperturb.validation import require_one_of, require_ranges

UNSAID_TIMESTEP = 1e-3
"""Step of the simulation in folders whose manifest does not say it [s]."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """How the recordings of a study were made.

    Attributes:
      versions: of this package and the libraries that the recordings depend on.
      subjects: number of people.
      seed: of everything random.
      ideal: whether people and instruments are free of noise.
      muscles: "nonlinear" or "linear" people.
      timestep: of the simulation [s].
      engine: what simulated the recordings, "mujoco" or "compiled".
      people: digest of the people: another calibration, or other spreads, make other people of the same seed.
      protocol: what everyone went through.
    """

    versions: Mapping[str, str]
    subjects: int
    seed: int
    ideal: bool
    muscles: str
    timestep: float
    engine: str
    people: str
    protocol: Protocol

    @classmethod
    def of(cls, people: Sequence[Person], protocol: Protocol, settings: StudySettings) -> Self:
        """That of a study which begins now."""
        given: dict[str, Any] = {
            name: getattr(settings, name) for name in ("seed", "ideal", "muscles", "timestep", "engine")
        }
        given |= {"versions": current_versions(), "people": _digest(people)}
        return cls(subjects=len(people), protocol=protocol, **given)

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
            values = {"timestep": UNSAID_TIMESTEP, "engine": ENGINES[0], **values}
            given = {field.name: values[field.name] for field in fields(cls)}
            if not isinstance(given["protocol"], Mapping) or not isinstance(given["versions"], Mapping):
                raise ValueError(f"{source}: protocol or versions is no table; expected what a run wrote")
            protocol = Protocol.from_dict(given["protocol"], source=f"{source}, protocol")
            made = cls(**{**given, "protocol": protocol})
            require_ranges(source, made)
            require_one_of(source, "muscles", made.muscles, MUSCLES)
            require_one_of(source, "engine", made.engine, ENGINES)
            return made
        except KeyError as error:
            raise ValueError(f"{source}: no {error.args[0]!r}; expected what a run of this version writes") from None
        except TypeError as error:
            raise ValueError(str(error)) from None

    def to_dict(self) -> dict[str, Any]:
        """Name to value, as JSON holds it."""
        return {**vars(self), "protocol": self.protocol.to_dict()}

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
    values = kept_manifest(root)
    return None if values is None else Manifest.from_dict(values, str(root / MANIFEST))


def current_versions() -> dict[str, str]:
    """Of this package and the libraries that recordings depend on."""
    return {name: importlib.metadata.version(name) for name in ("armperturb", "mujoco", "numpy", "scipy")}


def _digest(people: Sequence[Person]) -> str:
    return hashlib.sha256(repr(tuple(people)).encode()).hexdigest()
