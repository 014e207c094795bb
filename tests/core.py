"""What the core does without any extra: `python tests/core.py FOLDER`, which `make test-core` runs in a core install.

With `--hide` the optional libraries are hidden, and with them what only POSIX systems have; pictures are empty then,
which take longer than all else.
"""

import signal
import sys
from importlib import import_module
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import ClassVar

DATA = Path(__file__).parents[1] / "examples" / "data"
LIBRARIES = {"mujoco", "numba", "loky", "filelock", "gymnasium", "dm_control", "mediapy", "ezc3d", "joblib"}
POSIX = {"fcntl", "resource"}
XARRAYS = {"dask", "distributed"}  # looks for them itself, and imports them where they are, which takes long


# Importing these asks for no simulator, not even to see whether there is one.
WITHOUT_SIMULATOR = ("armperturb", "armperturb.analysis", "armperturb.analysis.fit.identify", "armperturb.cli")


class Hidden(MetaPathFinder):
    """Refuses to import libraries as if they were not installed, and keeps the names of those that were asked for."""

    asked: ClassVar[set[str]] = set()

    def find_spec(self, fullname, path=None, target=None):
        if fullname.partition(".")[0] in LIBRARIES | POSIX:
            self.asked.add(fullname)
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


def hide():
    for name in (LIBRARIES | POSIX) & set(sys.modules):
        del sys.modules[name]
    sys.meta_path.insert(0, Hidden())
    sys.modules.update(dict.fromkeys(XARRAYS))
    del signal.pthread_sigmask


def check(folder, with_pictures):
    """Run the commands of the core on the examples' recordings, and see that the others name their extra."""
    for name in WITHOUT_SIMULATOR:
        import_module(name)
        assert "mujoco" not in Hidden.asked, name
    import armperturb
    from armperturb.cli import main
    from armperturb.extras import MissingExtraError
    from armperturb.pages import page
    from armperturb.plots import style

    assert not LIBRARIES & set(sys.modules)
    if not with_pictures:
        page.svg = style.svg = lambda _: b""
    recording = str(folder / "recording.nc")
    for command in (
        ("convert", str(DATA / "position.csv"), "--out", recording),
        ("identify", recording, "--model", "3b", "--out", str(folder / "fit")),
        ("response", recording, "--out", str(folder / "response")),
        ("--version",),
    ):
        assert main(command) == 0, command
    assert (folder / "fit" / "parameters.csv").is_file()
    assert (folder / "fit" / "identify.html").is_file()
    assert (folder / "response" / "response.svg").is_file()
    for command in (("study", "--out", "none"), ("identify", recording, "--model", "nonlinear", "--out", "none")):
        assert main(command) == 1, command
    from armperturb.analysis.arm.linear_arm import arm_admittance
    from armperturb.analysis.fit.admittance_fit import fit_admittance

    # The thesis's search is compiled where there is a compiler, and slow here.
    frequency = [0.5, 1.0, 2.0, 4.0, 8.0, 16.0]
    relaxed = arm_admittance(armperturb.RELAX, frequency, "pade")
    fit = fit_admittance(
        frequency, relaxed, armperturb.RELAX, "1", armperturb.Environment(), as_published=True, delay="pade"
    )
    assert fit.converged, fit
    missing = {}
    for name in dir(armperturb):
        try:
            getattr(armperturb, name)
        except MissingExtraError as error:
            missing[name] = str(error)
    assert {"run_experiment", "run_study", "write_video"} <= set(missing)
    assert missing["build_model"] == (
        "armperturb.build_model needs mujoco, which is not installed; expected `pip install 'armperturb[sim]'`"
    )
    there = {"identify", "response", "best_linear", "import_recording", "load_protocol", "StudySettings", "design"}
    assert not {*there, "draw_cohort"} & set(missing)
    assert not LIBRARIES & set(sys.modules)
    print(f"the core is whole without {', '.join(sorted(missing))}")


if __name__ == "__main__":
    if "--hide" in sys.argv:
        hide()
    check(Path(sys.argv[1]), with_pictures="--hide" not in sys.argv)
