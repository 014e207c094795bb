"""How pictures are drawn without a window: the one place that chooses between EGL, OSMesa and a window library.

MuJoCo and dm_control read MUJOCO_GL once, when they are first imported, and unset take a window library, which draws
nothing where there is no display. Who has set MUJOCO_GL has chosen; with a display MuJoCo's own choice stands;
otherwise it is EGL, and OSMesa where EGL gives no context.
"""

import atexit
import functools
import importlib
import os
import sys
import warnings
import weakref
from typing import Any, Protocol

GL_HELP = "on Debian or Ubuntu: apt-get install libegl1 libopengl0 libgl1-mesa-dri"
"""What to install where nothing draws."""

HEADLESS = ("egl", "osmesa")
"""Libraries that draw without a window, the better one first."""


class Closeable(Protocol):
    """What can be closed more than once."""

    def close(self) -> None:
        """Close it."""


_OPEN: weakref.WeakSet[Closeable] = weakref.WeakSet()


def has_display() -> bool:
    """Whether a window could open: on Linux with DISPLAY or WAYLAND_DISPLAY, elsewhere always."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def choose_backend() -> str:
    """Settle MUJOCO_GL for this process and those that it starts, where nobody has and there is no display.

    Returns:
      MUJOCO_GL as it is then; empty where a window library draws.

    Raises:
      RuntimeError: nothing draws here; the message names what to install, and MUJOCO_GL stays unset.
    """
    if not os.environ.get("MUJOCO_GL") and not has_display():
        os.environ["MUJOCO_GL"] = _headless()
    return os.environ.get("MUJOCO_GL", "")


def load_dm_control() -> None:
    """Import dm_control with the library that draws here: by itself it tries a window library first, and warns.

    Where nothing draws, MUJOCO_GL is set to "off": dm_control is imported all the same, and refuses to render.
    """
    import mujoco  # noqa: F401 - first, as with a MUJOCO_GL whose library is missing it cannot be imported

    try:
        choose_backend()
    except RuntimeError:
        os.environ["MUJOCO_GL"] = "off"
    importlib.import_module("dm_control.mujoco")
    _stay_last()


def close_at_exit(owner: Closeable) -> None:
    """Close what holds a context before the interpreter exits, if nobody does earlier.

    Once the OpenGL library is gone, a context that is freed prints errors.
    """
    _OPEN.add(owner)
    _stay_last()


def new_context(width: int, height: int) -> Any:
    """An OpenGL context to draw in, with `make_current()` and `free()`.

    Args:
      width: of the largest picture [pixel].
      height: of the largest picture [pixel].

    Raises:
      RuntimeError: this machine cannot draw; the message names what to install.
    """
    chosen = choose_backend()
    # Not by mujoco.GLContext alone: MuJoCo may have been imported before anyone chose.
    module = f"mujoco.{chosen}" if chosen in HEADLESS else "mujoco.gl_context"
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", category=UserWarning)  # which is all that glfw makes of its errors
            return importlib.import_module(module).GLContext(width, height)
    except Exception as error:  # whatever a window library raises, or that there is none with MUJOCO_GL=off
        tried = f"MUJOCO_GL={chosen}" if chosen else "the display of this session (MUJOCO_GL=egl needs none)"
        raise RuntimeError(f"no OpenGL context with {tried}: {_said(error)}; {GL_HELP}") from error


@functools.cache
def _headless() -> str:
    """The first of `HEADLESS` that gives a context.

    Raises:
      RuntimeError: none does.
    """
    reasons = []
    for name in HEADLESS:
        before, modules = os.environ.get("PYOPENGL_PLATFORM"), set(sys.modules)
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(16, 16)  # a driver may be missing, too
            context.make_current()
            context.free()
            return name
        except Exception as error:  # PyOpenGL has errors of its own, and AttributeError for a missing library
            reasons.append(f"{name}: {_said(error)}")
        # The library that failed has claimed PyOpenGL for itself, which would refuse the next one.
        if before is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
        for module in set(sys.modules) - modules:
            if module.split(".")[0] == "OpenGL" or module.startswith(f"mujoco.{name}"):
                del sys.modules[module]
    raise RuntimeError(f"no OpenGL context ({'; '.join(reasons)}); {GL_HELP}")


def _said(error: Exception) -> str:
    """An error in one line."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # PyOpenGL's errors may fail to describe themselves
        text = ""
    return text or type(error).__name__


def _stay_last() -> None:
    """Register `_close_all` anew: what is registered last runs first, so before the ends of the OpenGL libraries."""
    atexit.unregister(_close_all)
    atexit.register(_close_all)


def _close_all() -> None:
    for owner in list(_OPEN):
        owner.close()
