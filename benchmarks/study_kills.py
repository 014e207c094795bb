"""Kills a study with SIGKILL at ten random moments, starts it again each time, and compares with an undisturbed run.

Run `python -m benchmarks.study_kills [--seed N] [--workers N]`; about two minutes. All conditions of the thesis, in
trials of 8 s, with published forces. Each run is killed within 3 s from when it has written, in all, a random number of
files; half of the numbers are none, so that the start is hit as well. What is compared at the end is all that the
recordings hold.
"""

import argparse
import dataclasses
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tomli_w

from armperturb.recording import load_recording
from armperturb.study.protocol import THESIS

N_KILLS, N_SUBJECTS = 10, 12


def short_protocol(path: Path) -> None:
    """The thesis's conditions in trials of 8 s."""
    short = dataclasses.replace(
        THESIS, forces="published", trial_duration=8.0, multisine_duration=6.0, onset_window=(1.0, 4.0)
    )
    path.write_text(tomli_w.dumps(short.to_dict()))


def main(arguments: list[str] | None = None) -> None:
    """Print how the runs ended, and whether the files are the same."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args([] if arguments is None else arguments)
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        short_protocol(folder / "short.toml")
        command = [sys.executable, "-m", "armperturb.cli", "study", "--protocol", str(folder / "short.toml")]
        command += ["--subjects", str(N_SUBJECTS), "--workers", str(options.workers), "--record-only", "--out"]
        subprocess.run([*command, str(folder / "undisturbed")], check=True)
        killed = folder / "killed"
        enough = np.sort(np.where(rng.random(N_KILLS) < 0.5, 0, rng.integers(1, N_SUBJECTS, N_KILLS)))
        for n_files in enough:
            with subprocess.Popen([*command, str(killed)], stderr=subprocess.DEVNULL) as run:
                while run.poll() is None and len(list(killed.glob("recordings/*.nc"))) < n_files:
                    time.sleep(0.01)
                time.sleep(rng.uniform(0.0, 3.0))
                ended = run.poll() is not None
                run.kill()
            found = len(list(killed.glob("recordings/*.nc")))
            print(f"{'had ended by itself' if ended else 'killed'}, {found} of {N_SUBJECTS} finished")
        subprocess.run([*command, str(killed)], check=True)
        there = {path.name: load_recording(path) for path in (folder / "undisturbed" / "recordings").glob("*.nc")}
        here = {path.name: load_recording(path) for path in (killed / "recordings").glob("*.nc")}
        same = here.keys() == there.keys() and all(here[file].identical(there[file]) for file in there)
        left = sorted(path.name for path in killed.rglob("*") if path.suffix in (".part", ".corrupt"))
        print(f"content of {len(here)} files {'identical' if same else 'DIFFERENT'}; left behind: {left or 'nothing'}")


if __name__ == "__main__":
    main(sys.argv[1:])
