"""dm_control imported with the library that draws here."""

import ctypes.util
import os
import subprocess
import sys

import pytest

needs_gl = pytest.mark.skipif(
    sys.platform == "linux" and not (ctypes.util.find_library("EGL") or ctypes.util.find_library("GL")),
    reason="no GL library on this machine",
)


@pytest.mark.slow(reason="imports dm_control in a process of its own")
@needs_gl
def test_a_camera_that_is_left_open_says_nothing_at_exit(tmp_path):
    # dm_control ends EGL at exit, as MuJoCo does; whichever was imported last would do so first.
    code = (
        "from armperturb.envs.render.camera import Camera, simplify\n"
        "from armperturb.models.rig import build_model\nfrom armperturb.subject import RELAX\n"
        "model = build_model(RELAX)\nsimplify(model, 16)\n"
        "camera = Camera(model, width=16, height=16)\nimport armperturb.envs.learning.dm\n"
        "camera.circle = camera\nprint(camera.draw().shape)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True)
    assert (done.stdout, done.stderr) == ("(16, 16, 3)\n", "")
    assert not list(tmp_path.iterdir()), "nor in MuJoCo's log"


@pytest.mark.slow(reason="imports dm_control in a process of its own")
def test_dm_control_loads_without_gl():
    code = (
        "import os, warnings; warnings.simplefilter('error', UserWarning)\n"
        "import armperturb.envs.learning.dm\n"
        "import dm_control.mujoco; print(os.environ['MUJOCO_GL'])"
    )
    unset = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")
    clean = {name: value for name, value in os.environ.items() if name not in unset}
    clean["MUJOCO_EGL_DEVICE_ID"] = "99"  # which is not there
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=clean, check=False)
    assert done.stdout.strip() in ("osmesa", "off"), done.stderr
    assert done.stderr == ""
