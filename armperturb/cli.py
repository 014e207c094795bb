"""The command line: the list of commands, and `main`."""

import ast
import functools
import importlib
import importlib.metadata
import io
import os
import shutil
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import MISSING, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Any, Union, get_type_hints

import tyro
from tyro import constructors

from armperturb.commands.command import Command, field_texts
from armperturb.envs.render.gl import require_simulator
from armperturb.extras import naming_the_extra
from armperturb.files import inputs_untouched, remove_unfinished

_NAMES = """
study report score simulate joint sidecar convert identify response compare validate design calibrate video view live
"""

COMMANDS = tuple(_NAMES.split())
"""The commands as they are typed, in the order in which help and documentation show them."""

BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""How many threads linear algebra takes, if the user says so; by default one, as more only wait for each other: the
matrices of this package are small."""

NARROWEST = 40
"""Width that help is laid out for at least [character]; in a few characters it could not be."""

MOMENT = 0.02
"""Time after which an interruption that could not be raised is repeated [s]."""

REFUSED = (ValueError, TypeError, OSError, RuntimeError, ArithmeticError, MemoryError, ImportError)
"""What an invalid input, or this machine, makes a command raise."""


class _Invalid(RuntimeError):
    """An option's value was refused by its type: tyro would turn a ValueError into its own error of several lines."""


def command_class(name: str) -> type[Command]:
    """The dataclass of a command; its module is imported only now, as it may need much."""
    kind: type[Command] = getattr(importlib.import_module(f"armperturb.commands.{name}"), name.capitalize())
    return kind


def files() -> dict[Any, Callable[[str], Any]]:
    """Type of an option whose value is read from the file that is named, to what reads it."""
    from armperturb.perturbations import Perturbation, load_perturbation
    from armperturb.subject import Subject

    return {Subject: Subject.load, Perturbation: load_perturbation}


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run the command.

    Args:
      arguments: as typed after `armperturb`; by default those of this process.

    Returns:
      The exit status: 0, 1 for invalid input (one line on stderr says why), 130 for Ctrl-C, and 128 more than the
      number of another signal that asked this process to end.
    """
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")  # read by NumPy when it is loaded, which is later
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        print(f"armperturb {importlib.metadata.version('armperturb')}")
        return 0
    command: Command | None = None
    new_folder: Path | None = None
    try:
        with ended_in_order(), warnings_in_a_line(), inputs_untouched():
            command = _parse(arguments)
            new_folder = _missing(getattr(command, "out", None))
            with naming_the_extra(f"armperturb {type(command).__name__.lower()}"):
                if command.needs_simulator:
                    require_simulator()
                show(list(command.run()))
    except REFUSED as error:
        if command is None and isinstance(error, BrokenPipeError):  # nobody reads the rest of the help
            _nothing_more_to_show()
            return 0
        _remove_empty(new_folder)
        tell("error", error)
        return 1
    except KeyboardInterrupt as interrupt:
        remove_unfinished()
        _remove_empty(new_folder)
        is_kept = new_folder is None or new_folder.exists()  # a folder in which nothing was finished is gone
        resumes = "; the same command continues from here" if command and command.resumes and is_kept else ""
        number = interrupt.args[0] if interrupt.args else signal.SIGINT
        with suppress(OSError):  # the terminal may be gone
            print(f"armperturb: interrupted{resumes}", file=sys.stderr, flush=True)
        return 128 + int(number)
    return 0


@contextmanager
def ended_in_order() -> Iterator[None]:
    """Within the block, SIGTERM and SIGHUP interrupt as Ctrl-C does, so that nothing half-written is left.

    Further signals change nothing once the end has begun, and nothing is said of what was interrupted half-made and
    therefore cannot be taken down without an error.
    """
    before: dict[int, Any] = {}
    again: list[threading.Timer] = []
    is_ending = False

    def interrupt(number: int, _: object) -> None:
        nonlocal is_ending
        is_ending = True
        for each in before:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt(signal.Signals(number))

    def lost(unraisable: Any) -> None:
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):
            if not is_ending:
                reported(unraisable)
            return
        # It came within a destructor or the like, which cannot raise: it comes again a moment later.
        for each in before:
            signal.signal(each, interrupt)
        number = int(next(iter(unraisable.exc_value.args), signal.SIGINT))
        again.append(threading.Timer(MOMENT, _signal_main_thread, (number,)))
        again[-1].start()

    reported, sys.unraisablehook = sys.unraisablehook, lost
    try:
        if threading.current_thread() is threading.main_thread():
            for name in ("SIGINT", "SIGTERM", "SIGHUP"):
                number = getattr(signal, name, None)
                # `nohup` ignores SIGHUP, and a shell SIGINT of what it runs in the background.
                if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                    before[number] = signal.signal(number, interrupt)
        yield
    except KeyboardInterrupt as interruption:
        # What was interrupted is taken down here, where errors of that are not said, and not at any later moment.
        error: BaseException | None = interruption
        while error is not None:
            traceback.clear_frames(error.__traceback__)
            error = error.__context__
        raise
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = reported
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def warnings_in_a_line() -> Iterator[None]:
    """Within the block, a warning is one line of the command's, without a place in its code."""

    def show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
        with suppress(OSError):  # the terminal may be gone
            tell("warning", message)

    with warnings.catch_warnings():
        warnings.showwarning = show_warning
        yield


def _signal_main_thread(number: int) -> None:
    """Send this process a signal so that what its main thread waits for ends."""
    main_thread = threading.main_thread().ident
    if main_thread is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main_thread, number)
    else:
        signal.raise_signal(number)


def tell(kind: str, message: object) -> None:
    """Print an error or a warning as one line."""
    print(f"armperturb: {kind}: {printable(' '.join(str(message).split()))}", file=sys.stderr)


def show(lines: Iterable[str]) -> None:
    """Print what a command tells when its results are written.

    Raises:
      OSError: there is no space for it, or nobody who reads it.
    """
    if sys.stdout is None:  # closed before this process began
        return
    encoding = sys.stdout.encoding or "utf-8"
    try:
        for line in lines:
            print(printable(line).encode(encoding, "backslashreplace").decode(encoding))
        sys.stdout.flush()
    except OSError as error:
        _nothing_more_to_show()
        explained = f"standard output: cannot be written ({error.strerror}); the results are"
        raise type(error)(explained) from error


def _nothing_more_to_show() -> None:
    """Discard what standard output still holds, which the end of the process would try to write again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _missing(folder: Path | None) -> Path | None:
    """A folder that is not there yet; None if it is."""
    if folder is None:
        return None
    folder = Path(os.path.realpath(folder))  # of "new/.." that which is meant
    return None if folder.exists() else folder


def _remove_empty(folder: Path | None) -> None:
    """Remove a folder that was made meanwhile, and those in it, if there is no file in any.

    Files may be those of another process, to whom the folders are then left too.
    """
    if folder is None or any(names for _, _, names in os.walk(folder)):
        return
    for path, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):
            os.rmdir(path)


def printable(text: str) -> str:
    """The text with its control characters, which a terminal would obey, as Python writes them."""
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def _parse(arguments: Sequence[str]) -> Command:
    if "" in arguments:  # an empty path would be the current folder
        before = " ".join([*arguments[: arguments.index("")][-1:], "''"])
        raise ValueError(f"{before}: an empty argument; expected a value (is a variable unset?)")
    kinds = [command_class(name) if name in arguments[:1] else _without_options(name) for name in COMMANDS]
    any_command: Any = Union[tuple(kinds)]  # noqa: UP007
    registry = constructors.ConstructorRegistry()
    registry.primitive_rule(_from_file)
    registry.struct_rule(_settings)
    with _usable_terminal():
        command: Command = tyro.cli(
            any_command,
            prog="armperturb",
            description="Human-arm perturbation experiments on synthetic people in MuJoCo, and their analysis; "
            "`armperturb --version` prints the version.",
            args=arguments,
            config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
            registry=registry,
        )
    return command


@contextmanager
def _usable_terminal() -> Iterator[None]:
    """Within the block, standard streams are there and wide enough for help to be laid out."""
    with ExitStack() as stack:
        if sys.stdout is None:
            stack.enter_context(redirect_stdout(io.StringIO()))
        if sys.stderr is None:
            stack.enter_context(redirect_stderr(io.StringIO()))
        width = os.environ.get("COLUMNS")
        if shutil.get_terminal_size().columns < NARROWEST:
            os.environ["COLUMNS"] = str(NARROWEST)
        try:
            yield
        finally:
            os.environ.pop("COLUMNS", None)
            if width is not None:
                os.environ["COLUMNS"] = width


@functools.cache
def _without_options(name: str) -> type:
    """A command that is not typed: what the list of commands shows of it, without its module."""
    source = Path(__file__).with_name("commands") / f"{name}.py"
    body = ast.parse(source.read_text(encoding="utf-8")).body
    text = next(ast.get_docstring(node) for node in body if isinstance(node, ast.ClassDef))
    return make_dataclass(name.capitalize(), (), namespace={"__doc__": text})


def _settings(of: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
    """Settings that a command holds, as options beside the command's own."""
    kind = of.type
    if not is_dataclass(kind) or issubclass(kind, Command) or not kind.__module__.startswith("armperturb."):
        return None
    hints, texts = get_type_hints(kind), field_texts(kind)
    return constructors.StructConstructorSpec(
        instantiate=_refusing(kind),
        fields=tuple(
            constructors.StructFieldSpec(
                name=field.name,
                type=hints[field.name],
                default=tyro.MISSING_NONPROP if field.default is MISSING else field.default,
                helptext=texts[field.name],
            )
            for field in fields(kind)
        ),
    )


def _from_file(of: constructors.PrimitiveTypeInfo) -> constructors.PrimitiveConstructorSpec[Any] | None:
    """An option whose value is read from the file that is named."""
    readers = files() if str(getattr(of.type, "__module__", "")).startswith("armperturb.") else {}
    if of.type not in readers:
        return None
    read = _refusing(readers[of.type])
    return constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda typed: read(typed[0]),
        is_instance=lambda value: isinstance(value, of.type),
        str_from_instance=lambda value: [str(value)],
    )


def _refusing(make: Callable[..., Any]) -> Callable[..., Any]:
    def refusing(*values: Any, **named: Any) -> Any:
        try:
            return make(*values, **named)
        except (ValueError, TypeError) as error:
            raise _Invalid(str(error)) from error

    return refusing


if __name__ == "__main__":
    sys.exit(main())
