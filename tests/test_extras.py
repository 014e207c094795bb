"""Each optional library is needed by its own part of the package alone, and its absence is named with the extra."""

import json
import re
import subprocess
import sys
from importlib.util import find_spec

import pytest

LABORATORY = (
    "import armperturb as ap",
    "trial = ap.Trial(subject=ap.RELAX, perturbation=ap.Pulse(peak=1, direction_deg=20, onset=0.1, duration=0.3))",
    "assert ap.run_experiment([trial], instruments=ap.Instruments()).sizes['time'] == 60",
)
# Gymnasium itself imports the package, which nothing has imported before.
AGENT = ("import gymnasium as gym", "gym.make_vec('armperturb:ArmPerturb/Pulse-v1', num_envs=2).reset(seed=0)")
PICTURE = ("from armperturb.envs.render.camera import render", "from armperturb.envs.render.viewer import watch_trial")
DM = ("ap.load_dm_env('ArmPerturb/Pulse-v1').reset()",)

CASES = {
    "dm": (
        ("dm_control", "dm_env"),
        (*AGENT, *LABORATORY, *PICTURE),
        DM[0],
        "load_dm_env needs dm_.*armperturb.dm.",
    ),
    "learn and video": (
        ("gymnasium", "mediapy", "imageio_ffmpeg"),
        (*LABORATORY, *PICTURE, *(DM if find_spec("dm_control") else ())),
        "ap.write_video(None, 'trial.mp4')",
        "write_video needs imageio_ffmpeg, .*armperturb.video.",
    ),
}

PROCESS = """
import json, os, sys, traceback

sys.modules["dask"] = None  # xarray would import it, which takes long
import mujoco, numba, pandas, scipy.optimize, scipy.signal, xarray  # which take longest, and nobody lacks here

assert not any(name.startswith("armperturb") and "editable" not in name for name in sys.modules)
for name, missing, code in json.loads(sys.argv[1]):
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        for number, stream in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{name}.{stream}", os.O_WRONLY | os.O_CREAT), number)
        sys.modules.update(dict.fromkeys(missing))
        try:
            exec(code)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        os._exit(0)  # to take down what a process has loaded takes longer than to work with it
    os.waitpid(child, 0)
"""


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """A function of a case: what a process without its libraries prints, which nobody has imported the package in."""
    folder = tmp_path_factory.mktemp("extras")
    asked = [
        (name, missing, "\n".join((*works, "print('works')", fails)))
        for name, (missing, works, fails, _) in CASES.items()
    ]
    subprocess.run([sys.executable, "-c", PROCESS, json.dumps(asked)], cwd=folder, check=True)
    return lambda name: [(folder / f"{name}.{stream}").read_text() for stream in ("out", "err")]


@pytest.mark.slow(reason="imports the package in processes of their own")
@pytest.mark.parametrize("name", CASES)
def test_a_missing_extra_takes_its_own_part_alone(name, said):
    printed, errors = said(name)
    assert printed == "works\n", errors
    assert re.search(f"^armperturb.extras.MissingExtraError: {CASES[name][3]}", errors, re.MULTILINE)
