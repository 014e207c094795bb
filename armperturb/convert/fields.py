"""Fields of a JSON file, read one by one with messages that say where they are."""

from collections.abc import Collection, Mapping
from typing import Any

from armperturb.convert.tables import TABLES
from armperturb.convert.units import quantity
from armperturb.validation import require_number, require_one_of

LONGEST_TEXT = 200
"""Characters of a label or of the name of a channel."""

MEANINGS: Mapping[str, str] = TABLES["meanings"]
"""Field to what a person should know to fill it in."""


class Fields(dict[str, Any]):
    """An object of the file, with its place for messages."""

    def __init__(self, content: object, file: str, place: str) -> None:
        if not isinstance(content, dict):
            raise TypeError(f"{file}: {place or 'the file'} = {content!r:.60}; expected an object, {{...}}")
        super().__init__(content)
        self.file, self.place = file, place

    def place_of(self, name: str) -> str:
        """Where a field is in the file, as messages say it."""
        shown = (name if name.isprintable() else ascii(name))[:60]
        return f"{self.place}.{shown}" if self.place else shown

    def where(self, name: str) -> str:
        """File and place of a field, as messages begin."""
        return f"{self.file}: {self.place_of(name)}"

    def fields(self, name: str, known: Collection[str] = (), required: Collection[str] = ()) -> "Fields":
        """An object in this one, empty if it is missing; with `known`, refused if it has other fields."""
        fields = Fields(self.get(name, {}), self.file, self.place_of(name))
        if known:
            fields.require_only(known, required)
        return fields

    def without(self, name: str) -> "Fields":
        """The same object without a field."""
        return Fields({each: value for each, value in self.items() if each != name}, self.file, self.place)

    def require_only(self, known: Collection[str], required: Collection[str] = ()) -> None:
        """Refuse other fields than the known ones, and missing ones that are required."""
        for name in self:
            if name not in known:
                raise ValueError(f"{self.where(name)}: unknown field; expected {', '.join(known)}")
        for name in required:
            if name not in self:
                raise ValueError(f"{self.where(name)} is missing; expected {MEANINGS.get(name, ', '.join(required))}")

    def text(self, name: str) -> str:
        """A field that holds a printable text of limited length."""
        value = self[name]
        if not isinstance(value, str):
            raise TypeError(f"{self.where(name)} = {value!r:.60}; expected text")
        if not value.isprintable() or not 0 < len(value) <= LONGEST_TEXT:
            raise ValueError(
                f"{self.where(name)} = {value!r:.60}; expected printable text of 1 to {LONGEST_TEXT} characters"
            )
        return value

    def choice(self, name: str, known: Collection[str], default: str | None = None) -> str:
        """A field that holds one of the known texts."""
        value = self.get(name, default)
        require_one_of(self.file, self.place_of(name), value, tuple(known))
        return str(value)

    def rate(self, name: str) -> float | None:
        """A sampling rate [Hz]; None if it is missing."""
        if name not in self:
            return None
        rate = quantity(self[name], "Hz", self.where(name))
        require_number(self.file, self.place_of(name), rate, at_least=1.0, at_most=1e6)
        return rate
