"""How long the recording of the whole study takes with either engine, and how much memory.

Run `python -m benchmarks.study_speed [--workers N]`; about a minute. The study is the thesis's: ten people, 32 trials
of 36 s, practice, noise and all instruments, from drawing people to files. Targets on 2 cores: at most 35 s with MuJoCo
and 12 s with the compiled engine, and less than 2 GiB.
"""

import argparse
import os
import resource
import tempfile
import threading
import time
from pathlib import Path

import psutil

from armperturb.study.protocol import THESIS
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings

N_SUBJECTS = 10


class Memory(threading.Thread):
    """The largest memory of this process and all below it together, shared pages once (PSS) [bytes]."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak = 0
        self.processor_time = 0.0  # its own [s], which is no cost of what it watches
        self._ended = threading.Event()

    def run(self) -> None:
        me = psutil.Process()
        while not self._ended.wait(0.25):
            total = 0
            for process in (me, *me.children(recursive=True)):
                try:
                    total += process.memory_full_info().pss
                except psutil.Error:
                    continue  # it has just ended
            self.peak = max(self.peak, total)
        self.processor_time = time.thread_time()

    def stop(self) -> None:
        self._ended.set()
        self.join()


def main(arguments: list[str] | None = None) -> None:
    """Print times and memory."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--workers", type=int, default=None)
    options = parser.parse_args([] if arguments is None else arguments)
    for engine, target in (("mujoco", 35), ("compiled", 12)):
        memory = Memory()
        memory.start()
        start, before = time.perf_counter(), processor_time()
        with tempfile.TemporaryDirectory() as folder:
            settings = StudySettings(subjects=N_SUBJECTS, engine=engine)
            record_study(settings, Path(folder), workers=options.workers)
            took = time.perf_counter() - start
        memory.stop()
        spent = processor_time() - before - memory.processor_time
        simulated = N_SUBJECTS * len(THESIS.planned_trials()) * THESIS.trial_duration
        print(
            f"{engine}: {took:.1f} s wall on {os.cpu_count()} cores ({spent:.0f} s of processor "
            f"time, {simulated / took:.0f} x real time); target {target} s on 2 cores; {memory.peak / 2**20:.0f} MiB "
            "of all processes together"
        )


def processor_time() -> float:
    """Of this process and of those below it that have ended [s]."""
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in usage)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
