"""Whether memory that is free goes back to the system, where the C library is glibc."""

import ctypes
import sys

THRESHOLDS = {-3: 2**24, -1: 2**26}
"""glibc's M_MMAP_THRESHOLD and M_TRIM_THRESHOLD to their values in `keep_memory` [byte]: the memory of the largest
arrays is returned at once, and that of others kept."""


def give_memory_back() -> None:
    """Let the C library return what is free and what it would keep otherwise."""
    _call("malloc_trim", 0)


def keep_memory() -> None:
    """Let the C library keep the memory of arrays from now on.

    Fetching it anew from the system for every array would double the time of a simulation. Dask sets thresholds for its
    workers that do so.
    """
    for option, value in THRESHOLDS.items():
        _call("mallopt", option, value)


def _call(name: str, *arguments: int) -> None:
    """Call a function of glibc, if there is one."""
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*arguments)
