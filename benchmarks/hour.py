"""What an hour in one trial costs `identify`: processor time, and memory of all its processes together.

Run `python -m benchmarks.hour [--minutes N] [--periodic] [--recording FILE.nc] [-- OPTION ...]`; two minutes. A person
is perturbed for an hour by multisines of new phases every 32 s, or with `--periodic` by a single one, recorded at
200 Hz with eight channels of EMG at 2 kHz, and identified with model 3b, where the trials choose the structure, and
likewise with the EMG; with options after `--`, only with these. Targets on idle cores: 60 s and 1 GB. A recording that
is there already is not simulated again.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from armperturb.controllers.remnant import HumanNoise
from armperturb.envs.lab.emg import Emg
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, Sampled
from armperturb.recording_files import save_recording
from armperturb.subject import POSITION

WAYS: tuple[list[str], ...] = (["--model", "3b"], [], ["--emg"])
RATE, PERIOD = 200.0, 32.0


def record(path: Path, minutes: float, *, periodic: bool) -> None:
    """Records one person under one multisine, or several of random phases one after the other."""
    n_samples = round(60.0 * minutes * RATE)
    n_each = n_samples if periodic else round(PERIOD * RATE)
    drawn = [Multisine.draw(seed=seed, rms=3.0, crested=False) for seed in range(-(-n_samples // n_each))]
    force = np.concatenate([multisine.periodic(RATE, n_each) for multisine in drawn])[:n_samples]
    noise = HumanNoise(remnant_share=0.1, voluntary_share=0.1)
    trial = Trial(subject=POSITION, perturbation=Sampled(force=force, rate=RATE), noise=noise, seed=1)
    instruments = Instruments(emg=Emg(), marker_noise=None)
    save_recording(run_experiment([trial], engine="compiled", timestep=2.5e-3, instruments=instruments), path)


def cost(command: list[str]) -> tuple[float, float, float]:
    """Time by the clock and of the processor [s], and the largest memory of the command and all below it [byte]."""
    start, largest = time.perf_counter(), 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as run:
        processes = psutil.Process(run.pid)
        while True:
            pid, status, usage = os.wait4(run.pid, os.WNOHANG)
            if pid:
                break
            try:
                every = [processes, *processes.children(recursive=True)]
                largest = max(largest, sum(each.memory_info().rss for each in every))
            except psutil.Error:
                pass  # one has just ended
            time.sleep(0.02)
        run.returncode = os.waitstatus_to_exitcode(status)
    if run.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit status {run.returncode}")
    # A peak between two looks is in what the system noted of the largest process.
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, max(largest, 1024 * usage.ru_maxrss)


def main(arguments: list[str] | None = None) -> None:
    """Print the costs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--periodic", action="store_true")
    parser.add_argument("--recording", type=Path)
    parser.add_argument("options", nargs="*", help="of identify")
    asked = parser.parse_args([] if arguments is None else arguments)
    with tempfile.TemporaryDirectory() as name:
        path = asked.recording or Path(name) / "hour.nc"
        if not path.exists():
            call = f"record(Path({str(path)!r}), {asked.minutes}, periodic={asked.periodic})"
            made = [sys.executable, "-c", f"from benchmarks.hour import *; {call}"]
            subprocess.run(made, check=True)
        for options in [asked.options] if asked.options else WAYS:
            command = [
                sys.executable,
                "-m",
                "armperturb.cli",
                "identify",
                str(path),
                "--out",
                f"{name}/o",
                "--overwrite",
                *options,
            ]
            wall, processor, memory = cost(command)
            print(
                f"identify {' '.join(options) or '(the trials choose)'}: {wall:.1f} s by the clock, {processor:.1f} s "
                f"of processor time, {memory / 1e9:.2f} GB",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
