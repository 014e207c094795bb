"""Pictures of the rig, drawn without a window: stills, and frames with forces and the handle's path."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import mujoco
import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.envs.render.gl import (
    Context,
    close_at_exit,
    gl_help,
    new_context,
    require_own_process,
)
from armperturb.memory import give_memory_back
from armperturb.validation import require_one_of

DISTURBANCE, REACTION, PATH = "#D55E00", "#0072B2", "#CC79A7"
"""Colours of the force on the manipulator, the force on the hand, and the handle's path, from Okabe and Ito's
colour-blind-safe palette (vermillion, blue, reddish purple)."""

ARROW_HEIGHT = 0.105
"""Height of the arrows over the middle of the handle [m]: just over its end."""

TRAIL = 1.0
"""How long a path of the handle a trail shows [s]."""

MAX_SEGMENTS = 240
"""Of a trail; more would not show."""

_OF_PARENT: list[object] = []
"""What a forked child must neither use nor free."""


class Arrow(NamedTuple):
    """An arrow that starts over the handle.

    Attributes:
      vector: from start to tip, to the right and forward [m].
      colour: as #rrggbb.
      radius: of the shaft [m].
      lift: of the arrow over `ARROW_HEIGHT` [m], so that one that lies on another shows.
    """

    vector: tuple[float, float]
    colour: str
    radius: float = 0.008
    lift: float = 0.0


def force_arrows(disturbance: ArrayLike, reaction: ArrayLike, scale: float) -> tuple[Arrow, Arrow]:
    """The disturbance d, wide, and on it the reaction force f that the handle exerts on the hand, narrow.

    Args:
      disturbance: d [N], (axis,).
      reaction: f [N], (axis,).
      scale: length of an arrow per force [m/N].
    """
    d, f = (scale * np.asarray(force, dtype=float) for force in (disturbance, reaction))
    return (
        Arrow((float(d[0]), float(d[1])), DISTURBANCE, radius=0.013),
        Arrow((float(f[0]), float(f[1])), REACTION, radius=0.0065, lift=0.02),
    )


class Camera:
    """Draws a model's poses, from one OpenGL context; a context manager, or to be closed with `close`.

    Any thread may draw and close it; cameras take turns. A child that is forked afterwards may not.

    One that is left open is closed before the interpreter exits. It does without `mujoco.Renderer`, which frees its
    textures in whatever context is current: closing one spoils the pictures of another.

    Args:
      model: from `armperturb.models.rig.build_model`, with its visuals.
      width: of the pictures [pixel].
      height: of the pictures [pixel].

    Raises:
      ValueError: the model has no cameras, or a picture is empty or larger than the model's offscreen buffer.
      RuntimeError: this machine cannot draw; the message names what to install.
    """

    def __init__(self, model: mujoco.MjModel, *, width: int = 640, height: int = 480) -> None:
        self.views = [model.camera(i).name for i in range(model.ncam)]
        if not self.views:
            raise ValueError("Camera: the model has no cameras; expected a model built with visual=True")
        limits = model.vis.global_
        for field, value, largest in (("width", width, limits.offwidth), ("height", height, limits.offheight)):
            if not 1 <= value <= largest:
                raise ValueError(f"Camera: {field} = {value!r}; expected 1 to {largest} pixels")
        self.model, self.width, self.height = model, width, height
        self._data: Any = mujoco.MjData(model)
        self._scene: Any = mujoco.MjvScene(model, maxgeom=model.ngeom + model.nsite + model.ntendon + 2 * MAX_SEGMENTS)
        self._options, self._eye = mujoco.MjvOption(), mujoco.MjvCamera()
        self._eye.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._window: Context | None = new_context(width, height)
        try:
            with self._window:
                self._context: Any = _small_context(model, width, height)
        except Exception as error:
            self._window.free()
            raise RuntimeError(f"Camera: MuJoCo cannot draw ({' '.join(str(error).split())}); {gl_help()}") from error
        close_at_exit(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_context"):
            self.close()

    def close(self) -> None:
        """Give the context back; a second time does nothing."""
        if self._window is None:
            return
        if self._window.usable:
            with self._window:  # what is freed is what belongs to the current context
                self._context.free()
            self._window.free()
        else:
            _OF_PARENT.append((self._window, self._context))
        self._window = self._context = self._scene = self._data = self.model = None
        give_memory_back()  # where the processor draws, some 40 MB would be kept for each context

    def draw(
        self,
        qpos: ArrayLike | None = None,
        view: str = "oblique",
        *,
        arrows: Sequence[Arrow] = (),
        trail: ArrayLike | None = None,
        out: npt.NDArray[np.uint8] | None = None,
    ) -> npt.NDArray[np.uint8]:
        """Draw one pose.

        Args:
          qpos: joint angles [rad] and handle displacements [m] to draw, before them those of a shoulder that moves
            [m], (nq,); default: the start posture.
          view: "oblique" or "top" (x right, y up in the picture).
          arrows: to draw over the handle, such as `force_arrows`.
          trail: displacements that the handle had until now, oldest first [m], (n, axis); older ones fade.
          out: where to write the picture.

        Returns:
          An RGB picture, (height, width, 3).

        Raises:
          ValueError: the model has no such view, or qpos or trail has another shape.
          RuntimeError: the camera is closed, or of the process that this one was forked from.
        """
        if self._window is None:
            raise RuntimeError("Camera: is closed; expected an open one")
        require_own_process()
        fixed = self._view(view)
        pose = np.asarray(self.model.qpos0 if qpos is None else qpos, dtype=float)
        if pose.shape != (self.model.nq,):
            raise ValueError(f"Camera: qpos of shape {pose.shape}; expected ({self.model.nq},)")
        picture = np.empty((self.height, self.width, 3), dtype=np.uint8) if out is None else out
        with self._window:  # the scene is the camera's, too: one thread at a time
            self._eye.fixedcamid = fixed
            self._update(pose)
            if trail is not None:
                self._add_trail(np.asarray(trail, dtype=float))
            for arrow in arrows:
                self._add_arrow(arrow)
            mujoco.mjr_render(self._rectangle, self._scene, self._context)
            mujoco.mjr_readPixels(picture, None, self._rectangle, self._context)
        picture[:] = picture[::-1].copy()  # OpenGL's first row is the lowest
        return picture

    def project(self, points: ArrayLike, view: str) -> Array:
        """Where points of the world show in a picture: columns from the left and rows from the top [pixel], (..., 2).

        Args:
          points: [m], (..., 3).
          view: "oblique" or "top".

        Raises:
          ValueError: the model has no such view.
        """
        camera = self.model.camera(self._view(view))
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, camera.quat)
        right, up, back = np.moveaxis((np.asarray(points, dtype=float) - camera.pos) @ axes.reshape(3, 3), -1, 0)
        focal = self.height / 2 / math.tan(math.radians(camera.fovy[0]) / 2)
        return np.stack([self.width / 2 - focal * right / back, self.height / 2 + focal * up / back], axis=-1)

    def handle(self, displacement: ArrayLike = (0.0, 0.0)) -> Array:
        """Where arrows start at a displacement of the handle [m], (..., 3).

        Args:
          displacement: of the handle from its start [m], (..., axis).
        """
        moved = np.asarray(displacement, dtype=float)
        over = np.concatenate([moved, np.full((*moved.shape[:-1], 1), ARROW_HEIGHT)], axis=-1)
        return np.asarray(self.model.body("manipulator").pos + over)

    def _view(self, view: str) -> int:
        require_one_of("Camera", "view", view, self.views)
        return self.views.index(view)

    def _update(self, pose: Array) -> None:
        """Let the scene show a pose."""
        self._data.qpos[:] = pose
        mujoco.mj_forward(self.model, self._data)
        mujoco.mjv_updateCamera(self.model, self._data, self._eye, self._scene)  # before its headlight is placed
        mujoco.mjv_updateScene(
            self.model, self._data, self._options, None, self._eye, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )

    def _add_arrow(self, arrow: Arrow) -> None:
        length = math.hypot(*arrow.vector)
        if length < 1e-4:
            return
        start = self._data.body("carriage").xpos + np.array([0.0, 0.0, ARROW_HEIGHT + arrow.lift])
        tip = start + 2.0 * np.array([*arrow.vector, 0.0])  # MuJoCo draws arrows half as long as their connector
        # A short arrow is thin, so that its head does not stand out over its tip.
        width = min(arrow.radius, length / 5)
        self._add_segment(mujoco.mjtGeom.mjGEOM_ARROW, width, start, tip, _rgba(arrow.colour))

    def _add_trail(self, trail: Array) -> None:
        if trail.ndim != 2 or trail.shape[1] != 2:
            raise ValueError(f"Camera: trail of shape {trail.shape}; expected (n, 2)")
        # From the newest backwards, so that the trail ends at the handle.
        points = self.handle(trail[:: -max(1, math.ceil(len(trail) / MAX_SEGMENTS))])
        points[:, 2] -= 0.01  # under the arrows
        # Lines, whose width is in pixels: tubes would cost more than all else.
        width = max(1.5, self.height / 130)
        for i in range(len(points) - 1):
            if np.linalg.norm(points[i] - points[i + 1]) > 1e-5:
                rgba = _rgba(PATH, 1.0 - i / len(points))
                self._add_segment(mujoco.mjtGeom.mjGEOM_LINE, width, points[i + 1], points[i], rgba)

    def _add_segment(
        self, kind: mujoco.mjtGeom, width: float, start: Array, end: Array, rgba: npt.NDArray[np.float32]
    ) -> None:
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        mujoco.mjv_connector(geom, kind, width, start, end)
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
        geom.emission, geom.specular, geom.shininess = 0.15, 0.0, 0.0
        self._scene.ngeom += 1


def render(
    model: mujoco.MjModel,
    qpos: ArrayLike | None = None,
    camera: str = "oblique",
    *,
    width: int = 640,
    height: int = 480,
) -> npt.NDArray[np.uint8]:
    """Draw the rig as one of its cameras sees it, in one pose or in several, which together are faster.

    Args:
      model: as for `Camera`.
      qpos: as for `Camera.draw`, (..., nq); default: the start posture.
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
    poses = np.asarray(model.qpos0 if qpos is None else qpos, dtype=float)
    if poses.shape[-1:] != (model.nq,):
        raise ValueError(f"render: qpos of shape {poses.shape}; expected (..., {model.nq})")
    with Camera(model, width=width, height=height) as eye:
        pictures = np.empty((*poses.shape[:-1], height, width, 3), dtype=np.uint8)
        for index in np.ndindex(poses.shape[:-1]):
            eye.draw(poses[index], camera, out=pictures[index])
    return pictures


def simplify(model: mujoco.MjModel, height: int) -> None:
    """Leave out what takes long and shows little: fine shadows or, in small pictures, all, fine facets, reflections.

    Nor are edges smoothed: several samples per pixel take twice the time where the processor draws.

    Args:
      model: to be drawn, changed in place before its camera is made.
      height: of the pictures [pixel].
    """
    quality = model.vis.quality
    quality.offsamples = 0
    quality.shadowsize = 1024 if height <= 480 else 2048
    if height <= 240:
        model.light_castshadow[:] = False  # they take two thirds of the time
    quality.numslices, quality.numstacks = 20, 10
    model.mat_reflectance[:] = 0.0


def _small_context(model: mujoco.MjModel, width: int, height: int) -> mujoco.MjrContext:
    """A context whose buffers are as large as the picture: larger ones cost time at each picture."""
    limits = model.vis.global_
    before = limits.offwidth, limits.offheight
    limits.offwidth, limits.offheight = width, height
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    finally:
        limits.offwidth, limits.offheight = before
    return context


def _rgba(colour: str, opacity: float = 1.0) -> npt.NDArray[np.float32]:
    """Shares of red, green and blue of #rrggbb, and the opacity."""
    shares = [part / 255 for part in bytes.fromhex(colour.removeprefix("#"))]
    return np.array([*shares, opacity], dtype=np.float32)
