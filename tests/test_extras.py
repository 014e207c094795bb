"""Each optional library is needed by its own part of the package alone, and its absence is named with the extra."""

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
DM = ("ap.load_dm_env('ArmPerturb/Position-v1').reset()",)


@pytest.mark.slow(reason="imports the package in processes of their own")
@pytest.mark.parametrize(
    ("missing", "works", "fails", "message"),
    [
        (("dm_control", "dm_env"), (*AGENT, *LABORATORY, *PICTURE), DM[0], "load_dm_env needs dm_.*armperturb.dm."),
        (
            ("gymnasium", "mediapy", "imageio_ffmpeg"),
            (*LABORATORY, *PICTURE, *(DM if find_spec("dm_control") else ())),
            "ap.write_video(None, 'trial.mp4')",
            "write_video needs imageio_ffmpeg, .*armperturb.video.",
        ),
    ],
    ids=["dm", "learn and video"],
)
def test_a_missing_extra_takes_its_own_part_alone(missing, works, fails, message):
    code = [
        "import sys",
        f"sys.modules.update(dict.fromkeys({missing!r}))",
        *works,
        "print('works')",
        fails,
    ]
    run = subprocess.run([sys.executable, "-c", "\n".join(code)], capture_output=True, text=True, check=False)
    assert run.stdout == "works\n", run.stderr
    assert re.search(f"^armperturb.extras.MissingExtraError: {message}", run.stderr, re.MULTILINE)
