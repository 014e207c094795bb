"""Where compiled code is kept: in a folder that can be written to, named after what it was compiled from.

Into a function, numba compiles constants and compiled functions that its module imports, but it looks for changes in
the function's own file alone: after an upgrade, it would run code that is partly of the version before.
"""

import hashlib
import os
import stat
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np


def cache_folder(module: str) -> Path | None:
    """Folder for what a module compiles with what it imports now; None if none can be written to.

    Args:
      module: full name, of what has been imported.
    """
    folder = _writable_folder()
    return folder / _digest_of_imports(module) if folder else None


@cache
def _digest_of_imports(module: str) -> str:
    """Of constants, fields of tuples and compiled functions in a module, where numba sees changes of its own alone."""
    digest = hashlib.sha256()
    for name, value in sorted(vars(sys.modules[module]).items()):
        if hasattr(value, "py_func"):
            if value.__module__ != module:
                digest.update(f"{name} {_digest_of_source(value.__module__)}\n".encode())
        elif hasattr(value, "_fields") or _is_constant(value):
            digest.update(f"{name} {getattr(value, '_fields', value)!r}\n".encode())
        elif isinstance(value, np.ndarray | np.generic):
            digest.update(value.tobytes())
    return digest.hexdigest()[:16]


@cache
def _digest_of_source(module: str) -> str:
    """Of a module's file and of what it imports."""
    content = Path(str(sys.modules[module].__file__)).read_bytes()
    return hashlib.sha256(content + _digest_of_imports(module).encode()).hexdigest()


def _is_constant(value: object) -> bool:
    return all(map(_is_constant, value)) if isinstance(value, tuple) else isinstance(value, int | float | complex | str)


def _writable_folder() -> Path | None:
    """The user's choice; or the package, the user's caches or a private folder, whichever can be written to."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    for folder in _usual_folders():
        # The nearest above it that exists decides.
        if os.access(next(each for each in (folder, *folder.parents) if each.exists()), os.W_OK):
            return folder
    folder = Path(tempfile.gettempdir()) / f"armperturb-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        status = folder.lstat()
        # What somebody else left there would be executed.
        if not stat.S_ISDIR(status.st_mode) or status.st_mode & 0o077 or status.st_uid != os.getuid():
            return None
    except OSError:
        return None
    return folder


def _usual_folders() -> list[Path]:
    """In the package, and in the user's folder of caches if there is one."""
    folders = [Path(__file__).parent / "__pycache__" / "compiled"]
    with suppress(RuntimeError):  # the user has no home
        folders.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armperturb")
    return folders
