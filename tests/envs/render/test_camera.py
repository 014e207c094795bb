import ctypes.util
import gc
import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from armperturb.envs.render import gl
from armperturb.envs.render.camera import DISTURBANCE, REACTION, Arrow, Camera, force_arrows, render, simplify
from armperturb.models.rig import build_model
from armperturb.subject import RELAX


@pytest.fixture(scope="module")
def model():
    model = build_model(RELAX)
    simplify(model, 240)  # or shadows and smooth edges would take most of the time
    return model


@pytest.fixture(scope="module")
def large(model):
    """A camera whose pictures are large; a context takes as long as many of them."""
    with Camera(model, width=640, height=480) as camera:
        yield camera


needs_gl = pytest.mark.skipif(
    sys.platform == "linux" and not (ctypes.util.find_library("EGL") or ctypes.util.find_library("GL")),
    reason="no GL library on this machine",
)


@pytest.mark.slow(reason="draws pictures")
@needs_gl
@pytest.mark.parametrize("camera", ["top", "oblique"])
def test_draws_a_picture(camera):
    model = build_model(RELAX)
    model.vis.quality.shadowsize = 256  # a fine one takes most of the time
    picture = render(model, camera=camera, width=64, height=48)
    assert picture.shape == (48, 64, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10.0


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
def test_top_view_has_x_right_and_y_up(model):
    start = render(model, camera="top", width=320, height=240).astype(int)
    poses = [[*RELAX.posture, x, y] for x, y in ((0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3))]

    def changed(moved) -> tuple[float, float]:
        """Mean row and column of the pixels that change when the carriage moves."""
        rows, columns = np.nonzero(np.abs(moved.astype(int) - start).sum(axis=2) > 100)
        return rows.mean(), columns.mean()

    right, left, forward, backward = map(changed, render(model, poses, "top", width=320, height=240))
    assert right[1] > left[1] + 20
    assert forward[0] < backward[0] - 20


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
def test_poses_drawn_together_look_as_drawn_alone(model):
    poses = np.array([[[*RELAX.posture, x, y] for x in (-0.2, 0.0, 0.2)] for y in (0.0, 0.1)])
    pictures = render(model, poses, "top", width=64, height=48)
    assert pictures.shape == (2, 3, 48, 64, 3)
    with Camera(model, width=64, height=48) as camera:
        for index in np.ndindex(2, 3):
            np.testing.assert_array_equal(pictures[index], camera.draw(poses[index], "top"))
    assert (pictures[0, 0] != pictures[1, 2]).any()


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
def test_closing_one_camera_leaves_another_as_it_was(model):
    with Camera(model, width=64, height=48) as stays:
        before = stays.draw()
        with Camera(model, width=64, height=48) as goes:
            np.testing.assert_array_equal(goes.draw(), before)
        np.testing.assert_array_equal(stays.draw(), before)
    goes.close()
    with pytest.raises(RuntimeError, match="is closed"):
        goes.draw()


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
def test_a_state_has_one_picture_whatever_was_drawn_before(model):
    pose = [0.5, 1.5, 0.01, 0.01]
    with Camera(model, width=320, height=240) as camera:
        first, second = camera.draw(pose), camera.draw(pose)
        camera.draw(view="top")
        np.testing.assert_array_equal(second, first)
        np.testing.assert_array_equal(camera.draw(pose), first)
    np.testing.assert_array_equal(render(model, pose, width=320, height=240), first)


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
def test_any_thread_may_draw_and_close(model):
    camera = Camera(model, width=64, height=48)
    poses = [[*RELAX.posture, x, 0.0] for x in (-0.15, -0.05, 0.05, 0.15)]
    expected = [camera.draw(pose, "top") for pose in poses]
    with ThreadPoolExecutor(4) as threads:
        for pictures in zip(expected, threads.map(lambda pose: camera.draw(pose, "top"), poses), strict=True):
            np.testing.assert_array_equal(*pictures)
        np.testing.assert_array_equal(camera.draw(poses[0], "top"), expected[0])
        threads.submit(camera.close).result()
    with pytest.raises(RuntimeError, match="is closed"):
        camera.draw()


PROCESS = """
import os, sys
from pathlib import Path
import gymnasium as gym
import armperturb
from armperturb.envs.render.camera import Camera, simplify
from armperturb.models.rig import build_model
from armperturb.subject import RELAX

def used():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

def made():
    env = gym.make("ArmPerturb/Position-v1", render_mode="rgb_array", width=320, height=240, duration=0.2)
    env.reset(seed=0)
    env.render()
    return env

made().close()
before = used()
envs = [made() for _ in range(10)]
while envs:
    envs.pop().close()
together = used() - before
for _ in range(4):
    made().close()
print(together, used() - before - together)
env = gym.make("ArmPerturb/Position-v1", duration=0.2)
for number in range(25):
    env.reset(seed=number)
before = used()
for number in range(100):
    env.reset(seed=number % 25)
again = used() - before
for _ in range(200):
    env.reset()
print(again, used() - before - again, flush=True)

model = build_model(RELAX)
simplify(model, 16)
camera = Camera(model, width=16, height=16)
camera.draw()
child = os.fork()
if not child:
    for attempt in (camera.draw, lambda: Camera(model, width=16, height=16)):
        try:
            attempt()
        except RuntimeError as error:
            print(error)
    sys.exit()
assert os.waitpid(child, 0)[1] == 0
camera.draw()
"""


@pytest.fixture(scope="module")
def process(once):
    """What a process of its own says: of its memory in two lines, then its forked child."""

    def run(_):
        command = [sys.executable, "-W", "ignore", "-c", PROCESS]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
        return done.stdout.splitlines(), done.stderr

    return once("drawing process", run)


@pytest.mark.slow(reason="opens fifteen contexts")
@needs_gl
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_comes_back(process):
    together, one_by_one, again, anew = map(float, " ".join(process[0][:2]).split())  # MB
    assert together < 10.0
    assert one_by_one < 1.0  # what four contexts may keep once ten others have filled the caches
    assert again < 0.2  # 2 kB for each of 100 resets
    assert anew < 1.5  # 7.5 kB for each of 200 people who are not known yet; some are kept


@pytest.mark.slow(reason="needs a process of its own")
@needs_gl
@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_a_forked_child_is_told_that_it_cannot_draw(process):
    said, errors = process[0][2:], process[1]
    assert len(said) == 2
    assert all(
        line.startswith("no pictures in this process: it was forked after its parent had drawn") for line in said
    )
    assert errors == ""


def pinhole(point, width, height):
    """Column and row at which the camera above the rig sees a point: rig.xml puts it at (0.06, 0.22, 7), 13.5 deg."""
    per_metre = height / 2 / math.tan(math.radians(13.5 / 2)) / (7.0 - point[2])
    return width / 2 + per_metre * (point[0] - 0.06), height / 2 - per_metre * (point[1] - 0.22)


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
@pytest.mark.parametrize(("which", "force"), [("d", (40.0, 10.0)), ("f", (-20.0, 35.0)), ("d", (-15.0, -40.0))])
def test_arrows_point_where_forces_do_and_are_to_scale(large, which, force):
    scale, moved = 0.006, (0.05, -0.04)
    colour = DISTURBANCE if which == "d" else REACTION
    d, f = (force, (0.0, 0.0)) if which == "d" else ((0.0, 0.0), force)
    pose = [*RELAX.posture, *moved]
    empty = large.draw(pose, "top")
    picture = large.draw(pose, "top", arrows=force_arrows(d, f, scale))
    rows, columns = np.nonzero(np.abs(picture.astype(int) - empty).sum(axis=2) > 20)
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    assert np.median(picture[rows, columns], axis=0).argmax() == wanted.argmax()
    # The hand starts where eq. B.28 puts it; the arrow lies over the handle, whose middle is 1.05 m high.
    shoulder, elbow = RELAX.posture
    start = np.array(
        [
            RELAX.l_h * math.cos(shoulder) + RELAX.l_f * math.cos(shoulder + elbow) + moved[0],
            RELAX.l_h * math.sin(shoulder) + RELAX.l_f * math.sin(shoulder + elbow) + moved[1],
            1.05 + 0.11,
        ]
    )
    tip = start + scale * np.array([*force, 0.0])
    begin, end = (np.array(pinhole(point, 640, 480)) for point in (start, tip))
    along = (end - begin) / np.linalg.norm(end - begin)
    pixels = np.column_stack([columns + 0.5, rows + 0.5]) - begin
    assert (pixels @ along).max() == pytest.approx(np.linalg.norm(end - begin), abs=2.5)
    assert (pixels @ along).min() > -4.0
    assert abs((pixels @ [-along[1], along[0]]).mean()) < 1.0


@needs_gl
def test_projection_is_a_pinhole_camera(large):
    points = np.array([[0.0, 0.0, 1.05], [0.4, -0.2, 0.8]])
    top, oblique = large.project(points, "top"), large.project(points, "oblique")
    # What a camera looks at is in the middle of its picture: rig.xml's oblique one from here along its own z.
    middle = np.array([-1.889, 3.628, 2.44]) - 3.0 * np.cross([-0.866, -0.5, 0.0], [0.1954, -0.3384, 0.9205])
    np.testing.assert_allclose(large.project(middle, "oblique"), [320.0, 240.0], atol=0.1)
    np.testing.assert_allclose(large.handle([0.1, 0.2]) - large.handle(), [0.1, 0.2, 0.0])
    np.testing.assert_allclose(top, [pinhole(point, 640, 480) for point in points])
    # Its x points to the left and up, its y to the left and down.
    assert oblique.shape == (2, 2)


@pytest.mark.slow(reason="draws many pictures")
@needs_gl
def test_trail_ends_at_the_handle_and_fades(large):
    pose = [*RELAX.posture, 0.0, 0.2]
    path = np.column_stack([np.linspace(-0.3, 0.0, 50), np.full(50, 0.2)])
    empty = large.draw(pose, "top")
    change = np.abs(large.draw(pose, "top", trail=path).astype(int) - empty).sum(axis=2)
    long = large.draw(pose, "top", trail=np.repeat(path, 100, axis=0))
    np.testing.assert_array_equal(large.draw(pose, "top", trail=path[:1]), empty)
    first, last = large.project(large.handle(path[[0, -1]]), "top")
    with pytest.raises(ValueError, match=r"trail of shape \(3,\); expected \(n, 2\)"):
        large.draw(trail=[0.0, 0.1, 0.2])
    rows, columns = np.nonzero(change > 10)
    assert abs(rows.mean() - last[1]) < 2.0
    assert columns.max() == pytest.approx(last[0], abs=3.0)
    assert columns.min() == pytest.approx(first[0], abs=8.0)
    strength = change[rows.min() : rows.max() + 1].max(axis=0)
    third = round((last[0] - first[0]) / 3)
    old, new = (strength[round(x) :][:third].mean() for x in (first[0], last[0] - third))
    assert old < 0.6 * new
    assert long.shape == (480, 640, 3)


def test_arrows_for_the_forces_of_one_instant():
    d, f = force_arrows([10.0, -5.0], [2.0, 4.0], 0.01)
    assert d == Arrow((0.1, -0.05), DISTURBANCE, radius=d.radius)
    np.testing.assert_allclose(f.vector, (0.02, 0.04))
    assert d.radius > f.radius, "the one below must show"
    assert f.lift > d.lift


@pytest.fixture
def headless(monkeypatch):
    """A Linux machine without a display on which nobody has chosen a library, nor tried one."""
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM"):
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    monkeypatch.setattr("sys.platform", "linux")
    choose = gl.headless_backend
    choose.cache_clear()
    yield monkeypatch
    choose.cache_clear()


def library(works):
    """In place of mujoco.egl or mujoco.osmesa."""

    class Context:
        def __init__(self, width, height):
            if not works:
                raise RuntimeError("no driver")

        def make_current(self):
            pass

        def free(self):
            pass

    return SimpleNamespace(GLContext=Context)


@pytest.mark.parametrize(("egl", "osmesa", "chosen"), [(True, True, "egl"), (False, True, "osmesa")])
def test_egl_is_preferred_and_osmesa_stands_in(headless, egl, osmesa, chosen):
    headless.setitem(sys.modules, "mujoco.egl", library(egl))
    headless.setitem(sys.modules, "mujoco.osmesa", library(osmesa))
    assert gl.choose_backend() == chosen
    assert os.environ["MUJOCO_GL"] == chosen
    assert "PYOPENGL_PLATFORM" not in os.environ
    assert isinstance(gl.new_context(8, 8)._window, sys.modules[f"mujoco.{chosen}"].GLContext)


@pytest.mark.parametrize(("name", "value"), [("MUJOCO_GL", "osmesa"), ("DISPLAY", ":0"), ("WAYLAND_DISPLAY", "wl")])
def test_what_the_user_has_stands(headless, name, value):
    headless.setattr(gl, "headless_backend", lambda: pytest.fail("nothing is to be chosen"))
    headless.setenv(name, value)
    assert gl.choose_backend() == ("osmesa" if name == "MUJOCO_GL" else "")


def test_says_what_to_install_without_gl(model, headless):
    headless.setitem(sys.modules, "mujoco.egl", None)
    headless.setitem(sys.modules, "mujoco.osmesa", None)
    with pytest.raises(RuntimeError, match=r"egl: .*osmesa: .*apt-get install libegl1"):
        render(model, width=16, height=16)
    assert "MUJOCO_GL" not in os.environ
    headless.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=osmesa.*apt-get install libosmesa6$"):
        render(model, width=16, height=16)
    headless.setenv("MUJOCO_GL", "Off")
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=off: drawing is switched off; expected MUJOCO_GL unset or egl$"):
        render(model, width=16, height=16)


@pytest.mark.slow(reason="opens a GL context")
def test_a_window_that_does_not_open_leaves_no_error_behind(headless):
    class Context:
        def __init__(self, width, height):
            raise RuntimeError("no display")

        def __del__(self):
            freed.append(self._context)

    freed = []
    headless.setitem(sys.modules, "mujoco.gl_context", SimpleNamespace(GLContext=Context))
    headless.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=glfw: no display; a window library needs a display"):
        gl.new_context(8, 8)
    gc.collect()
    assert freed == [None]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"camera": "front"}, "view = 'front'; expected one of top, oblique"),
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
