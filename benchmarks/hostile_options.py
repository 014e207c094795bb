"""Gives every option of commands hostile values, and looks at how they end, how long it takes and how much memory.

Run `python -m benchmarks.hostile_options [COMMAND ...] [--most N] [--keep FOLDER]`: every option and argument of a
command, one at a time, with nothing, numbers that are none or too large, texts, folders and files that are missing; or
N of these runs that are spread evenly. With a folder, what was seen is kept there and the rest can follow later. Each
ends as in `benchmarks.hostile`, or as a command line that cannot be parsed.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from armperturb import cli
from armperturb.commands.command import option_name
from benchmarks.hostile import outcome, told
from benchmarks.kept_rows import Row, with_kept_rows
from benchmarks.kills import COMMANDS, inputs_of

VALUES = (
    "", "nan", "inf", "-1", "0", "1e30", "1000000000000000000000000000000", "Zoë Ünïcödé ☃", "x" * 5000, "..",
    "none.nc", "a=b:c", "$\\frac", "\x1b[2J",
)  # fmt: skip
"""What each option gets."""


def options_of(kind: type) -> Iterator[tuple[str | None, int]]:
    """Name of each option of a command that takes values, None of its argument, and how many values belong together."""
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = plain = hints[field.name]
        while get_origin(plain) is Annotated:
            plain = get_args(plain)[0]
        kinds = [each for each in get_args(plain) if each is not NoneType]
        if NoneType in get_args(plain) and len(kinds) == 1:
            plain = kinds[0]
        if isinstance(plain, type) and is_dataclass(plain) and plain not in cli.files():
            yield from options_of(plain)
        elif plain is not bool:
            parts: tuple[Any, ...] = get_args(plain) if get_origin(plain) is tuple else (plain,)
            yield option_name(field.name, hint), 1 if ... in parts else len(parts)


def with_value(command: list[str], option: str | None, values: list[str]) -> list[str]:
    """A command line in which an option, or the argument, has these values instead."""
    begin = command.index(option) if option in command else None
    if option is None:
        begin = 1
        if command[1].startswith("--"):
            return [command[0], *values, *command[1:]]
    if begin is None:
        return [*command, str(option), *values]
    end = next((place for place in range(begin + 1, len(command)) if command[place].startswith("--")), len(command))
    return [*command[:begin], *([option] if option else []), *values, *command[end:]]


def outcomes(command: str, lines: list[list[str]], inputs: Path, numbers: list[int]) -> Iterator[Row]:
    """`benchmarks.hostile.outcome` of command lines by their numbers (`seed`), and what each was (`case`)."""
    for number in numbers:
        line = lines[number]

        def run(_: str, line: list[str] = line) -> int:
            return cli.main(line)

        ended = outcome(run, lambda folder: folder, inputs, inputs.parent / "now")
        yield {"seed": number, "case": " ".join(f"{word:.40}" for word in line)} | ended


def main(arguments: list[str] | None = None) -> None:
    """Print for each command how its runs ended, and the most time and memory."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[[], *COMMANDS])
    parser.add_argument("--most", type=int, default=10**6)
    parser.add_argument("--keep", type=Path, help="folder for what was seen, from which the next run goes on")
    options = parser.parse_args([] if arguments is None else arguments)
    commands, total = options.commands or list(COMMANDS), Counter[str]()
    keep = options.keep and options.keep.absolute()
    with inputs_of(commands) as inputs:
        for command in commands:
            base = COMMANDS[command][1]
            lines = [
                with_value(base, option, [value] * count)
                for option, count in options_of(cli.command_class(command))
                for value in VALUES
            ]
            numbers = range(0, len(lines), max(-(-len(lines) // options.most), 1))
            path = keep / f"{command}.jsonl" if keep else None
            rows = with_kept_rows(path, numbers, partial(outcomes, command, lines, inputs))
            total += told(command, rows)
    print(f"all: {dict(total)}")


if __name__ == "__main__":
    main(sys.argv[1:])
