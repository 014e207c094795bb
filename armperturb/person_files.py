"""People whose parameters stand in TOML files, one key for each."""

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import tomli_w

from armperturb.files import read_toml, write_whole
from armperturb.muscle_law import MuscleLaw
from armperturb.validation import require_keys


@dataclass(frozen=True, kw_only=True)
class PersonInFile:
    """Base of people whose fields are the keys of a TOML file; `muscle` is a table, see `MuscleLaw`."""

    OPTIONAL: ClassVar[Collection[str]] = ("muscle",)
    """Keys that a file may leave out."""
    LEFT_OUT: ClassVar[Mapping[str, Any]] = {"muscle": None}
    """Keys that a file does leave out where they have these values; TOML cannot say None."""
    EXAMPLE: ClassVar[str] = ""
    """Line that a file may have, for messages."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str | None = None) -> Self:
        """A person from parameters by name.

        Args:
          values: parameter name to value, SI units, angles in degrees; `muscle` to a table, see `MuscleLaw`. Those of
            `OPTIONAL` may be left out.
          source: where the values come from, for the message; None for the name of the class.

        Raises:
          ValueError: a key is unknown or missing, or a value is refused.
          TypeError: a value has the wrong type.
        """
        source = cls.__name__.lower() if source is None else source
        known = [field.name for field in fields(cls)]
        require_keys(source, values, known, [key for key in known if key not in cls.OPTIONAL])
        try:
            if values.get("muscle") is not None:
                values = {**values, "muscle": MuscleLaw.from_dict(values["muscle"])}
            return cls(**values)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{source}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Parameter name to value, as `from_dict` reads it, without those of `LEFT_OUT`."""
        left_out = self.LEFT_OUT
        return {name: value for name, value in asdict(self).items() if name not in left_out or value != left_out[name]}

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a person from a TOML file whose keys are the parameter names.

        Raises:
          ValueError: the file is no TOML, or a key or value is refused.
          OSError: the file cannot be read.
        """
        return cls.from_dict(read_toml(path, cls.EXAMPLE), source=str(path))

    def save(self, path: str | Path) -> None:
        """Write the person to a TOML file that `load` reads back exactly."""
        write_whole(path, tomli_w.dumps(self.to_dict()))
