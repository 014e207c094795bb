"""Where numba keeps compiled code if neither the package nor the user's folder of caches can be written to."""

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path


def provide_cache() -> None:
    """Set NUMBA_CACHE_DIR to a private temporary folder where numba would find no folder and refuse to compile."""
    if os.environ.get("NUMBA_CACHE_DIR") or any(map(_can_be_written_to, _usual_folders())):
        return
    folder = Path(tempfile.gettempdir()) / f"armperturb-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        status = folder.lstat()
        # What somebody else left there would be executed.
        if not stat.S_ISDIR(status.st_mode) or status.st_mode & 0o077 or status.st_uid != os.getuid():
            return
    except OSError:
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)


def _usual_folders() -> list[Path]:
    """The package, and the user's folder of caches if there is one."""
    folders = [Path(__file__).parent]
    with suppress(RuntimeError):  # the user has no home
        folders.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"))
    return folders


def _can_be_written_to(folder: Path) -> bool:
    """Whether the folder, or the nearest above it that exists, can be written to."""
    return os.access(next(each for each in (folder, *folder.parents) if each.exists()), os.W_OK)
