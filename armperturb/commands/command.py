"""What every command of the command line is."""

import ast
import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import ClassVar

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
