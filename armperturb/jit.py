"""Compiled by numba where it is installed; plain Python, a hundred times slower, where it is not."""

from collections.abc import Callable
from typing import Any


def jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator that compiles a function with these options of `numba.njit`, or leaves it as it is."""
    try:
        from numba import njit
    except ModuleNotFoundError:
        return lambda function: function
    decorator: Callable[[Callable[..., Any]], Any] = njit(**options)
    return decorator
