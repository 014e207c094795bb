"""What mkdocs adds to the pages: references of commands, public names and modules, from the code itself."""

import ast
import inspect
import itertools
import re
import types
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from armperturb.cli import COMMANDS, command_class, files
from armperturb.commands.command import Command, field_texts, option_name
from armperturb.live.page import write_live

PLACE = "<!-- commands -->"
"""Where the reference stands in `commands.md`."""

NAMES = "<!-- names -->"
"""Where the public names stand in `api/public.md`."""

ROOT = Path(__file__).parents[1]


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
    generated = {"commands.md": (PLACE, reference), "api/public.md": (NAMES, public_names)}
    if page.file.src_uri in generated:
        place, write = generated[page.file.src_uri]
        return markdown.replace(place, write())
    return re.sub(r"^::: (\S+)\.\*$", lambda folder: modules(folder[1]), markdown, flags=re.MULTILINE)


def on_post_build(config: Any, **_: Any) -> None:
    """Called by mkdocs when the site is there; writes the live laboratory beside its page."""
    write_live(Path(config["site_dir"]) / "live.html")


def modules(package: str) -> str:
    """The modules of a package, each as a line that mkdocstrings renders."""
    names = sorted(path.stem for path in (ROOT / package.replace(".", "/")).glob("*.py") if path.stem[0] != "_")
    return "\n\n".join(f"::: {package}.{name}" for name in names)


def public_names() -> str:
    """The names of `import armperturb` as a table, each with the first sentence of its text."""
    lines = ["| name | meaning |", "|---|---|"]
    for node in ast.parse((ROOT / "armperturb" / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            module, name = f"armperturb.{node.module}", node.names[0].name
            path, text = _defined(module, name)
            lines.append(f"| [`{name}`][{path}.{name}] | {text} |")
    return "\n".join(lines)


def _defined(module: str, name: str) -> tuple[str, str]:
    """Module that defines a name, and the first sentence of the name's text."""
    path = ROOT / module.replace(".", "/")
    body = ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text("utf-8")).body
    for node, after in itertools.zip_longest(body, body[1:]):
        if isinstance(node, ast.ImportFrom) and name in {alias.name for alias in node.names}:
            return _defined(str(node.module), name)
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return module, _sentence(ast.get_docstring(node) or "")
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return module, _sentence(after.value.value if isinstance(after, ast.Expr) else "")
    raise ValueError(f"docs: {module} has no {name}; expected what armperturb/__init__.pyi imports")


def _sentence(text: str) -> str:
    first = text.strip().partition("\n\n")[0]
    return " ".join(first.split()).replace("|", "\\|")


def reference() -> str:
    """All commands as markdown."""
    return "\n\n".join(_section(name, kind) for name, kind in commands().items())


def commands() -> dict[str, type[Command]]:
    """Name of each command, as typed, to the dataclass of its options."""
    return {name: command_class(name) for name in COMMANDS}


def arguments(kind: type) -> Iterator[Argument]:
    """The arguments of a command, those of settings that it holds among them."""
    meanings, hints = field_texts(kind), get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        option = option_name(field.name, hint)
        hint = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if is_dataclass(hint) and hint not in files():
            yield from arguments(hint)
            continue
        yield Argument(option or field.name.upper(), _values(hint), _default(field), meanings[field.name])


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
    for argument in arguments(kind):
        cells = (f"`{argument.name}`", argument.values, argument.default or "required", argument.meaning)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def _usage(name: str, kind: type) -> str:
    names = [argument.name for argument in arguments(kind) if not argument.default]
    parts = [name if not name.startswith("-") else f"{name} {name[2:].upper()}" for name in names]
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
    if hint in files():
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
