"""Memory that is free goes back to the system."""

import ctypes
import sys


def give_memory_back() -> None:
    """Let the C library return what is free and what it would keep otherwise."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None  # glibc has it
    if trim is not None:
        trim(0)
