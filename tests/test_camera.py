import ctypes.util
import sys

import numpy as np
import pytest

from armperturb.envs.camera import render
from armperturb.models import build_model
from armperturb.subject import RELAX


@pytest.fixture(scope="module")
def model():
    return build_model(RELAX)


needs_gl = pytest.mark.skipif(
    sys.platform == "linux" and not (ctypes.util.find_library("EGL") or ctypes.util.find_library("GL")),
    reason="no GL library on this machine",
)


@needs_gl
@pytest.mark.parametrize("camera", ["top", "oblique"])
def test_draws_a_picture(model, camera):
    picture = render(model, camera=camera, width=64, height=48)
    assert picture.shape == (48, 64, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10.0


@needs_gl
def test_top_view_has_x_right_and_y_up(model):
    start = render(model, camera="top", width=320, height=240).astype(int)

    def changed(x: float, y: float) -> tuple[float, float]:
        """Mean row and column of the pixels that change when the carriage moves."""
        moved = render(model, [*RELAX.posture, x, y], "top", width=320, height=240).astype(int)
        rows, columns = np.nonzero(np.abs(moved - start).sum(axis=2) > 100)
        return rows.mean(), columns.mean()

    assert changed(0.3, 0.0)[1] > changed(-0.3, 0.0)[1] + 20
    assert changed(0.0, 0.3)[0] < changed(0.0, -0.3)[0] - 20


@needs_gl
def test_qpos_moves_the_arm(model):
    start = render(model, width=64, height=48)
    bent = render(model, [*RELAX.posture, 0.1, 0.1], width=64, height=48)
    assert (start != bent).any()


@needs_gl
def test_poses_drawn_together_look_as_drawn_alone(model):
    poses = np.array([[[*RELAX.posture, x, y] for x in (-0.2, 0.0, 0.2)] for y in (0.0, 0.1)])
    pictures = render(model, poses, "top", width=64, height=48)
    assert pictures.shape == (2, 3, 48, 64, 3)
    for index in ((0, 0), (1, 2)):
        np.testing.assert_array_equal(pictures[index], render(model, poses[index], "top", width=64, height=48))
    assert (pictures[0, 0] != pictures[1, 2]).any()


def test_says_what_to_install_without_gl(model, monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(RuntimeError, match=r"apt-get install libegl1"):
        render(model, width=16, height=16)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"camera": "front"}, "camera = 'front'; expected one of top, oblique"),
        ({"width": 0}, "width = 0; expected 1 to 1920 pixels"),
        ({"height": 10_000}, "height = 10000; expected 1 to 1440 pixels"),
        ({"qpos": [0.0, 0.0]}, r"qpos of shape \(2,\); expected \(..., 4\)"),
        ({"qpos": 0.1}, r"qpos of shape \(\); expected \(..., 4\)"),
    ],
)
def test_refuses_what_it_cannot_draw(model, settings, message):
    with pytest.raises(ValueError, match=message):
        render(model, **settings)


def test_refuses_a_model_without_visuals():
    with pytest.raises(ValueError, match="expected a model built with visual=True"):
        render(build_model(RELAX, visual=False))
