"""Compiled by numba where it is installed; plain Python, a hundred times slower, where it is not."""

from collections.abc import Callable
from typing import Any

try:
    from numba import njit as jit
except ModuleNotFoundError:

    def jit(**_: Any) -> Callable[..., Any]:  # type: ignore[no-redef]
        """Leave the function as it is."""
        return lambda function: function


__all__ = ["jit"]
