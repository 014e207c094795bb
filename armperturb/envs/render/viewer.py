"""MuJoCo's interactive viewer on a recorded trial, or on the rig at rest."""

import time
import warnings
from typing import Any

import mujoco

from armperturb.envs.render.gl import has_display
from armperturb.envs.render.replay import Replay
from armperturb.models.rig import build_model
from armperturb.subject import Subject


def watch_trial(replay: Replay, *, slow: float = 1.0) -> None:
    """Replay a trial over and over, as far as the limit of the workspace, until its window is closed.

    Args:
      replay: the trial.
      slow: how many times slower than life, > 0.

    Raises:
      ValueError: the handle is at the limit of the workspace from the start.
      RuntimeError: no window can be opened.
    """
    if replay.end <= 0.0:
        raise ValueError("view: the handle is at the limit of the workspace from the start; expected another trial")
    data = mujoco.MjData(replay.model)
    with open_window(replay.model, data) as window:
        begin = time.monotonic()
        while window.is_running():
            now = (time.monotonic() - begin) / slow % replay.end
            with window.lock():
                data.time = now
                data.qpos[:] = replay.at(replay.qpos, now)
                mujoco.mj_forward(replay.model, data)
            window.sync()
            time.sleep(0.01)


def watch_rig(subject: Subject) -> None:
    """Simulate a person at rest, in real time, until the window is closed; the mouse can push and pull.

    The arm is held by its linear intrinsic muscles alone: no reflexes, no perturbation.

    Args:
      subject: who grips the handle.

    Raises:
      RuntimeError: no window can be opened.
    """
    model = build_model(subject)
    data = mujoco.MjData(model)
    with open_window(model, data) as window:
        begin = time.monotonic()
        while window.is_running():
            with window.lock():
                behind = time.monotonic() - begin - data.time
                if not 0.0 <= behind < 0.5:  # someone reset the simulation, or this machine is too slow
                    begin, behind = time.monotonic() - data.time, 0.0
                for _ in range(int(behind / model.opt.timestep)):
                    mujoco.mj_step(model, data)
            window.sync()
            time.sleep(0.005)


def require_display() -> None:
    """Refuse to open a window where there is no display.

    Raises:
      RuntimeError: no window can be opened.
    """
    if not has_display():
        raise RuntimeError(
            "view: no display (DISPLAY and WAYLAND_DISPLAY are not set); expected a desktop session, or "
            "'armperturb video' for a film"
        )
    import glfw

    with warnings.catch_warnings(record=True) as heard:  # glfw reports its errors as warnings
        warnings.simplefilter("always")
        opened = glfw.init()
    if not opened:
        reason = " ".join(str(heard[-1].message).split()) if heard else "GLFW does not start"
        raise RuntimeError(f"view: no window can be opened ({reason}); expected a display that works")


def open_window(model: mujoco.MjModel, data: mujoco.MjData) -> Any:
    """MuJoCo's viewer, which leaves the simulation to its caller.

    Raises:
      RuntimeError: no window can be opened.
    """
    require_display()
    import mujoco.viewer

    return mujoco.viewer.launch_passive(model, data)
