"""Runs a study in other ways, and killed with SIGKILL at ten random moments, and compares what it holds in the end.

Run `python -m benchmarks.study_kills [--seed N] [--workers N]`; ten minutes and more. All conditions of the thesis, in
trials of 8 s, with published forces. First the study is run undisturbed at 1, 2 and 4 workers and two block sizes. Then
with `--workers`, and each run is killed within 3 s from when it has written, in all, a random number of files; half of
the numbers are none, so that the start is hit as well. What is compared is all that the recordings hold.
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

from armperturb.recording_files import load_recording
from armperturb.study.protocol import THESIS

N_KILLS, N_SUBJECTS = 10, 12
WAYS = tuple((workers, block) for workers in (1, 2, 4) for block in (16, 320))


def short_protocol(path: Path) -> None:
    """The thesis's conditions in trials of 8 s."""
    short = dataclasses.replace(
        THESIS, forces="published", trial_duration=8.0, multisine_duration=6.0, onset_window=(1.0, 4.0)
    )
    path.write_text(tomli_w.dumps(short.to_dict()))


def difference(here: Path, there: Path) -> str:
    """What the recordings of two studies differ in, in words."""
    names = [{path.name for path in out.glob("recordings/*")} for out in (here, there)]
    if names[0] != names[1]:
        return f"DIFFERENT FILES: {sorted(names[0] ^ names[1])}"
    recordings = sorted(name for name in names[0] if name.endswith(".nc"))
    pairs = [[out / "recordings" / name for out in (here, there)] for name in recordings]
    other = [a.name for a, b in pairs if not load_recording(a).identical(load_recording(b))]
    same_bytes = sum(a.read_bytes() == b.read_bytes() for a, b in pairs)
    content = f"DIFFERENT CONTENT: {other}" if other else "identical content"
    return f"{content} in {len(pairs)} files, {same_bytes} of them to the last byte"


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
        command += ["--subjects", str(N_SUBJECTS), "--record-only"]
        undisturbed, killed = folder / "undisturbed", folder / "killed"
        subprocess.run([*command, "--out", str(undisturbed)], check=True)
        for workers, block in WAYS:
            out = folder / f"{workers}-{block}"
            way = ["--workers", str(workers), "--block", str(block)]
            subprocess.run([*command, "--out", str(out), *way], check=True)
            print(f"{workers} workers, blocks of {block}: {difference(out, undisturbed)}")
        command += ["--workers", str(options.workers), "--out", str(killed)]
        enough = np.sort(np.where(rng.random(N_KILLS) < 0.5, 0, rng.integers(1, N_SUBJECTS, N_KILLS)))
        for n_files in enough:
            with subprocess.Popen(command, stderr=subprocess.DEVNULL) as run:
                while run.poll() is None and len(list(killed.glob("recordings/*.nc"))) < n_files:
                    time.sleep(0.01)
                time.sleep(rng.uniform(0.0, 3.0))
                ended = run.poll() is not None
                run.kill()
            result = len(list(killed.glob("recordings/*.nc")))
            print(f"{'had ended by itself' if ended else 'killed'}, {result} of {N_SUBJECTS} finished")
        subprocess.run(command, check=True)
        print(f"after {N_KILLS} kills, {options.workers} workers: {difference(killed, undisturbed)}")


if __name__ == "__main__":
    main(sys.argv[1:])
