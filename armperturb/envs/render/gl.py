"""How pictures are drawn without a window: the one place that chooses between EGL, OSMesa and a window library.

MuJoCo reads MUJOCO_GL once, when it is first imported, and without it takes a window library, which draws nothing where
there is no display. A value that the user has set stands, and so does MuJoCo's own choice where there is a display;
otherwise this module chooses EGL, or OSMesa where EGL gives no context.
"""

import atexit
import functools
import importlib
import os
import sys
import threading
import warnings
import weakref
from typing import Any, Protocol, Self

PACKAGES = {"egl": "libegl1 libopengl0 libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""Libraries that draw without a window, the better one first, and their packages in Debian and Ubuntu."""

OFF = ("disable", "disabled", "off", "false", "0")
"""Values of MUJOCO_GL with which MuJoCo draws nothing."""


class Closeable(Protocol):
    """What can be closed more than once."""

    def close(self) -> None:
        """Close it."""


_OPEN: weakref.WeakSet[Closeable] = weakref.WeakSet()


_DRAWING = threading.RLock()
"""Held by the thread that draws."""

_STARTED_IN: list[int] = []
"""The process that OpenGL was started in, once it was: children that are forked afterwards cannot draw."""


class Context:
    """An OpenGL context to draw in: `with context: ...`, in any thread, one after the other."""

    def __init__(self, window: Any) -> None:
        """Take over a context.

        Args:
          window: MuJoCo's, with `make_current()` and `free()`.
        """
        self._window, self._process = window, os.getpid()

    @property
    def usable(self) -> bool:
        """Whether this is the process that it was opened in."""
        return self._process == os.getpid()

    def __enter__(self) -> Self:
        _DRAWING.acquire()
        self._window.make_current()
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._window is not None:
                _release(self._window)
        finally:
            _DRAWING.release()

    def free(self) -> None:
        """Give it back."""
        with _DRAWING:
            self._window.free()
            self._window = None


def _release(window: Any) -> None:
    """Let no context be current in this thread: another thread cannot use one that is."""
    library = sys.modules[type(window).__module__]
    if hasattr(library, "EGL"):
        library.EGL.eglReleaseThread()
    elif hasattr(library, "osmesa"):
        library.osmesa.OSMesaMakeCurrent(None, None, library.GL.GL_FLOAT, 0, 0)
    else:
        library.glfw.make_context_current(None)


def _leave_to_parent() -> None:
    """Let a forked child not end EGL at its exit: it would wait for threads that only its parent has."""
    for name in ("mujoco.egl", "dm_control._render.pyopengl.egl_renderer"):
        library = sys.modules.get(name)
        if library is not None:
            atexit.unregister(library.EGL.eglTerminate)


os.register_at_fork(after_in_child=_leave_to_parent)


def require_own_process() -> None:
    """Refuse to draw in a child that was forked after OpenGL had been started: it would hang.

    Raises:
      RuntimeError: this is such a child.
    """
    if _STARTED_IN and _STARTED_IN[0] != os.getpid():
        raise RuntimeError(
            "no pictures in this process: it was forked after its parent had drawn; expected the start method 'spawn' "
            "or 'forkserver', or a fork before the first picture"
        )


def has_display() -> bool:
    """Whether a window could open: on Linux with DISPLAY or WAYLAND_DISPLAY, elsewhere always."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def gl_help() -> str:
    """What to do where this process cannot draw, given MUJOCO_GL."""
    chosen = _requested()
    if chosen in OFF:
        return "drawing is switched off; expected MUJOCO_GL unset or egl"
    if chosen in PACKAGES or not (chosen or has_display()):
        return f"on Debian or Ubuntu: apt-get install {PACKAGES[chosen or 'egl']}"
    return "a window library needs a display that works; MUJOCO_GL=egl needs none"


def require_simulator() -> None:
    """Import MuJoCo, which loads the library that MUJOCO_GL names.

    Raises:
      ModuleNotFoundError: it is not installed.
      RuntimeError: it cannot be imported; the message says why, and what helps.
    """
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # of MuJoCo, PyOpenGL, or ctypes
        if isinstance(error, ModuleNotFoundError) and error.name == "mujoco":
            raise
        if "invalid value" in str(error) and "MUJOCO_GL" in str(error):
            given = os.environ["MUJOCO_GL"]
            raise RuntimeError(f"MUJOCO_GL = {given!r}; expected egl, osmesa, glfw or off, or unset") from error
        with_gl = f" with MUJOCO_GL={_requested()}; {gl_help()}" if _requested() else ""
        raise RuntimeError(f"MuJoCo does not load ({_in_one_line(error)}){with_gl}") from error


def choose_backend() -> str:
    """Set MUJOCO_GL for this process and its children, where the user has not and there is no display.

    Returns:
      MUJOCO_GL as it is then, in small letters; empty where a window library draws.

    Raises:
      RuntimeError: nothing draws here; the message names what to install, and MUJOCO_GL stays unset.
    """
    if not _requested() and not has_display():
        os.environ["MUJOCO_GL"] = headless_backend()
    return _requested()


def close_at_exit(owner: Closeable) -> None:
    """Close what holds a context before the interpreter exits, unless it is closed earlier.

    Once the OpenGL library is gone, a context that is freed prints errors.
    """
    _OPEN.add(owner)
    stay_last()


def stay_last() -> None:
    """Close contexts first when the interpreter exits: before OpenGL libraries that were imported since end themselves.

    What is registered last runs first.
    """
    atexit.unregister(_close_all)
    atexit.register(_close_all)


def new_context(width: int, height: int) -> Context:
    """An OpenGL context to draw in.

    Args:
      width: of the largest picture [pixel].
      height: of the largest picture [pixel].

    Raises:
      RuntimeError: this machine cannot draw, and the message names what to install; or this process was forked after
        its parent had drawn.
    """
    require_own_process()
    chosen = choose_backend()
    tried = f"MUJOCO_GL={chosen}" if chosen else "the display of this session"
    if chosen in OFF:
        raise RuntimeError(f"no OpenGL context with {tried}: {gl_help()}")
    # Not by mujoco.GLContext alone: MuJoCo may have been imported before anyone chose.
    module = f"mujoco.{chosen}" if chosen in PACKAGES else "mujoco.gl_context"
    try:
        kind = importlib.import_module(module).GLContext
        if not hasattr(kind, "_context"):
            kind._context = None  # or one that does not open would print an error when it is freed
        with _DRAWING, warnings.catch_warnings():
            warnings.filterwarnings("error", category=UserWarning)  # which is all that glfw makes of its errors
            _STARTED_IN[:] = [os.getpid()]
            return Context(kind(width, height))
    except Exception as error:  # whatever a window library raises
        raise RuntimeError(f"no OpenGL context with {tried}: {_in_one_line(error)}; {gl_help()}") from error


@functools.cache
def headless_backend() -> str:
    """The first of `PACKAGES` that gives a context.

    Raises:
      RuntimeError: none does.
    """
    reasons = []
    for name in PACKAGES:
        before, modules = os.environ.get("PYOPENGL_PLATFORM"), set(sys.modules)
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(16, 16)  # a driver may be missing, too
            context.make_current()
            context.free()
            return name
        except Exception as error:  # PyOpenGL has errors of its own, and AttributeError for a missing library
            reasons.append(f"{name}: {_in_one_line(error)}")
        # The library that failed has claimed PyOpenGL for itself, which would refuse the next one.
        if before is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
        for module in set(sys.modules) - modules:
            if module.split(".")[0] == "OpenGL" or module.startswith(f"mujoco.{name}"):
                del sys.modules[module]
    raise RuntimeError(f"no OpenGL context ({'; '.join(reasons)}); {gl_help()}")


def _requested() -> str:
    """MUJOCO_GL as MuJoCo reads it."""
    return os.environ.get("MUJOCO_GL", "").lower().strip()


def _in_one_line(error: Exception) -> str:
    """An error in one line."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # PyOpenGL's errors may fail to describe themselves
        text = ""
    return text or type(error).__name__


def _close_all() -> None:
    for owner in list(_OPEN):
        owner.close()
