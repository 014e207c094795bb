"""What every command of the command line is."""

import ast
import inspect
import shlex
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import fields
from typing import Annotated, Any, ClassVar, cast, get_origin, get_type_hints

from tyro.conf import Positional as Positional


class Command(ABC):
    """A subcommand of `armperturb`: a frozen dataclass of its options, and what runs it.

    A string below each field of a command, or of settings that it holds, documents the option.

    Attributes:
      needs_simulator: whether MuJoCo must load before the command starts.
    """

    needs_simulator: ClassVar[bool] = False

    @property
    def resumes(self) -> bool:
        """Whether the same command continues after an interruption."""
        return False

    @abstractmethod
    def run(self) -> Iterable[str]:
        """Do the work and return the lines to print.

        Raises:
          TypeError: an option or a field of a file has the wrong type.
          ValueError: an option is out of its range, or a file is refused.
          RuntimeError: worker processes died repeatedly, or this machine lacks a library.
          OSError: a file cannot be read or written.
        """


def option_name(field: str, hint: Any) -> str | None:
    """How the option of a field is typed, from its annotation; None of one that is told by its place."""
    metadata = getattr(hint, "__metadata__", ()) if get_origin(hint) is Annotated else ()
    if Positional in metadata:
        return None
    names = [each.name for each in metadata if getattr(each, "name", None)]
    return f"--{(names or [field])[0].replace('_', '-')}"


def command_line(command: Command) -> str:
    """How a command is typed that does the same: what is not as by default."""
    words = ["armperturb", type(command).__name__.lower()]
    for field in fields(cast(Any, command)):
        value = getattr(command, field.name)
        if value == field.default:
            continue
        option = option_name(field.name, get_type_hints(type(command), include_extras=True)[field.name])
        if option is not None:
            words.append(option)
        if value is True:  # an option without a value
            continue
        words += [f"{each}" for each in (value if isinstance(value, tuple) else (value,))]
    return shlex.join(words)


def field_texts(kind: type) -> dict[str, str]:
    """Name of each field of a dataclass to the string below it, in one line."""
    (definition,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(definition, ast.ClassDef)
    texts = {}
    for field, text in zip(definition.body, definition.body[1:], strict=False):
        match field, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                texts[name] = " ".join(words.split())
    return texts
