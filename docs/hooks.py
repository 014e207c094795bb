"""What mkdocs puts into pages that it builds: the command reference, from the dataclasses that parse the commands."""

import inspect
import types
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import tyro

from armperturb.cli import COMMANDS, FILES
from armperturb.commands.command import Command, field_texts

PLACE = "<!-- commands -->"
"""Where the reference stands in `commands.md`."""


class Argument(NamedTuple):
    """An argument of a command.

    Attributes:
      name: as typed.
      values: what may follow it.
      default: empty if it must be given.
      meaning: in words.
    """

    name: str
    values: str
    default: str
    meaning: str


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by mkdocs for each page; gives the markdown that is rendered."""
    return markdown.replace(PLACE, reference()) if page.file.src_uri == "commands.md" else markdown


def reference() -> str:
    """All commands as markdown."""
    return "\n\n".join(_section(name, kind) for name, kind in commands().items())


def commands() -> dict[str, type[Command]]:
    """Name of each command, as typed, to the dataclass of its options."""
    return {kind.__name__.lower(): kind for kind in COMMANDS}


def arguments(kind: type) -> Iterator[Argument]:
    """The arguments of a command, those of settings that it holds among them."""
    meanings, hints = field_texts(kind), get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        positional = get_origin(hint) is Annotated and tyro.conf.Positional in hint.__metadata__
        hint = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if is_dataclass(hint) and hint not in FILES:
            yield from arguments(hint)
            continue
        name = field.name.upper() if positional else "--" + field.name.replace("_", "-")
        yield Argument(name, _values(hint), _default(field), meanings[field.name])


def _section(name: str, kind: type) -> str:
    lines = [
        f"## {name}",
        "",
        inspect.getdoc(kind) or "",
        "",
        f"`{_usage(name, kind)}`",
        "",
        "| argument | value | default | meaning |",
        "|---|---|---|---|",
    ]
    for one in arguments(kind):
        cells = (f"`{one.name}`", one.values, one.default or "must be given", one.meaning)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def _usage(name: str, kind: type) -> str:
    needed = [one for one in arguments(kind) if not one.default]
    parts = [one.name if not one.name.startswith("-") else f"{one.name} {one.name[2:].upper()}" for one in needed]
    return " ".join(["armperturb", name, *parts, "[options]"])


def _values(hint: Any) -> str:
    """Values of a type, in words."""
    if hint is bool:
        return "none: it is a switch"
    if get_origin(hint) is Literal:
        return ", ".join(f"`{value}`" for value in get_args(hint))
    if get_origin(hint) in (Union, types.UnionType):
        return _values(next(kind for kind in get_args(hint) if kind is not type(None)))
    if get_origin(hint) is tuple:
        each, *others = get_args(hint)
        return f"{'one or more' if others == [...] else len(others) + 1}: {_values(each)}"
    if hint in FILES:
        return "path"
    return {int: "whole number", float: "number", str: "text", Path: "path"}[hint]


def _default(field: "Field[Any]") -> str:
    if field.default is MISSING:
        return ""
    if field.default is None or field.default == ():
        return "none"
    if isinstance(field.default, bool):
        return "off"
    return f"`{' '.join(map(str, field.default)) if isinstance(field.default, tuple) else field.default}`"
