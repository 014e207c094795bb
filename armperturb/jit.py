"""Functions that numba compiles, with compiled code that is kept as `compile_cache` says."""

from collections.abc import Callable
from threading import Lock
from typing import Any

from armperturb.compile_cache import cache_folder

_SETTING = Lock()


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator that compiles a function with these options of `numba.njit`.

    Raises:
      ModuleNotFoundError: numba is not installed.
    """
    import numba

    config: Any = numba.config

    def decorate(function: Callable[..., Any]) -> Any:
        folder = cache_folder(function.__module__)
        with _SETTING:
            usual = config.CACHE_DIR
            config.CACHE_DIR = str(folder or usual)
            try:
                return numba.njit(cache=folder is not None, error_model="numpy", **options)(function)
            finally:
                config.CACHE_DIR = usual

    return decorate


def jit(function: Callable[..., Any]) -> Any:
    """The function, compiled where numba is installed; plain Python, a hundred times slower, where it is not."""
    try:
        return compiled()(function)
    except ModuleNotFoundError:
        return function
