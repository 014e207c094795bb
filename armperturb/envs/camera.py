"""Stills of the rig, drawn without a window."""

import os
import sys

import mujoco
import numpy as np
import numpy.typing as npt

GL_HELP = "on Debian or Ubuntu: apt-get install libegl1 libopengl0 libgl1-mesa-dri"


def render(
    model: mujoco.MjModel,
    qpos: npt.ArrayLike | None = None,
    camera: str = "oblique",
    *,
    width: int = 640,
    height: int = 480,
) -> npt.NDArray[np.uint8]:
    """Draw the rig as one of its cameras sees it, in one pose or in several, which together are faster.

    Args:
      model: from `armperturb.models.build_model`, with its visuals.
      qpos: joint angles [rad] and handle displacements [m] to draw, before them those of a shoulder that moves [m],
        (..., nq); default: the start posture.
      camera: "oblique" or "top" (x right, y up in the picture).
      width: of the picture [pixel].
      height: of the picture [pixel].

    Returns:
      RGB pictures, (..., height, width, 3).

    Raises:
      ValueError: the model has no such camera, qpos has another shape, or the picture is empty or larger than the
        model's offscreen buffer.
      RuntimeError: this machine cannot draw; the message names what to install.
    """
    cameras = [model.camera(i).name for i in range(model.ncam)]
    if camera not in cameras:
        known = f"one of {', '.join(cameras)}" if cameras else "a model built with visual=True"
        raise ValueError(f"render: camera = {camera!r}; expected {known}")
    limits = model.vis.global_
    for field, value, largest in (("width", width, limits.offwidth), ("height", height, limits.offheight)):
        if not 1 <= value <= largest:
            raise ValueError(f"render: {field} = {value!r}; expected 1 to {largest} pixels")
    poses = np.asarray(model.qpos0 if qpos is None else qpos, dtype=float)
    if poses.shape[-1:] != (model.nq,):
        raise ValueError(f"render: qpos of shape {poses.shape}; expected (..., {model.nq})")
    pictures = np.empty((*poses.shape[:-1], height, width, 3), dtype=np.uint8)
    data = mujoco.MjData(model)

    _draw_without_window()
    try:
        renderer = mujoco.Renderer(model, height=height, width=width)
    except (ImportError, RuntimeError, OSError, mujoco.FatalError) as error:
        raise RuntimeError(f"render: no OpenGL context ({error}); {GL_HELP}") from error
    # Closed here: left to the garbage collector, it prints EGL errors when the interpreter exits.
    with renderer:
        for index in np.ndindex(poses.shape[:-1]):
            data.qpos[:] = poses[index]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera)
            renderer.render(out=pictures[index])
    return pictures


def _draw_without_window() -> None:
    """Let MuJoCo draw with EGL where there is no display and nobody chose otherwise.

    MuJoCo reads MUJOCO_GL only when it is first imported, and then defaults to a window library. Setting the variable
    here would come too late, and setting it earlier would make `import mujoco` fail where EGL is missing.

    Raises:
      RuntimeError: EGL is missing.
    """
    chosen = any(os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"))
    if chosen or sys.platform != "linux":
        return
    from mujoco.rendering.classic import gl_context

    try:
        from mujoco.egl import GLContext
    except (ImportError, AttributeError, OSError) as error:  # AttributeError: PyOpenGL found no libEGL
        raise RuntimeError(f"render: no EGL library ({error}); {GL_HELP}") from error
    gl_context.GLContext = GLContext
