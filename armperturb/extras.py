"""The optional parts of the package: which library belongs to which, and the error that names it."""

from collections.abc import Iterator
from contextlib import contextmanager

from armperturb.files import packaged_table

EXTRAS = packaged_table(__package__, "extras.toml")
"""Library, as imported, to the extra that installs it."""


class MissingExtraError(ModuleNotFoundError):
    """A library of an optional part is missing; the message says how to install it."""


@contextmanager
def naming_the_extra(wanted: str) -> Iterator[None]:
    """Name the extra to install if a library of an optional part is missing.

    Args:
      wanted: what needs the library, for the message.

    Raises:
      MissingExtraError: the library is missing; the message says how to install it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if isinstance(error, MissingExtraError) or library not in EXTRAS:
            raise
        raise MissingExtraError(
            f"{wanted} needs {library}, which is not installed; expected `pip install 'armperturb[{EXTRAS[library]}]'`",
            name=library,
        ) from error
