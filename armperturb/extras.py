"""Optional dependencies, by the extra of the package that installs them."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Around the import of an optional dependency: where that is missing, say what to install.

    Args:
      name: of the extra in pyproject.toml, e.g. "sim".

    Raises:
      ModuleNotFoundError: an import within this context found no such module; the message names the extra.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        raise ModuleNotFoundError(
            f"{module} is not installed; expected it for this part of armperturb (pip install 'armperturb[{name}]')",
            name=error.name,
        ) from None
