"""How long the simulation of the whole study takes, how much memory, and how much a plain loop would have taken.

Run `python -m benchmarks.study_speed [--workers N] [--practice]`; about two minutes. The study is the thesis's (10
linear people, 32 trials of 36 s) with published forces, noise and all instruments, from drawing people to files;
`--practice` adds the practice session. Targets: at most 60 s on 4 cores (120 s on 2), less than 2 GiB, and at least 15
times faster than the loop with 4 cores.

The loop is what one would write first: each trial alone, `mj_step`, and a Python callback (`mjcb_control`) for reflexes
and perturbation. Under RK4 MuJoCo calls it four times a step. It runs the beginning of some trials of both tasks and is
scaled to all; it has neither noise nor instruments.
"""

import argparse
import resource
import tempfile
import threading
import time
from pathlib import Path

import joblib
import mujoco
import numpy as np
import psutil
from armperturb.controllers.reflex import activate, initial_activation, reflex_gains, spindle_excitation

from armperturb.cohort import draw_cohort
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.models.rig import JOINTS, REFLEXES, SLIDES, STRAIN_GAUGE, build_model
from armperturb.study.protocol import THESIS
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings

N_SUBJECTS, TIMESTEP, DECIMATION = 10, 1e-3, 5
LOOP_TRIALS, LOOP_SECONDS = 6, 4.0


def looped(trial: Trial, seconds: float) -> tuple[np.ndarray, float]:
    """Displacement of one trial in a plain loop [m], (time, axis), and the time that it took [s]."""
    model = build_model(trial.subject, Environment(), timestep=TIMESTEP, visual=False)
    data = mujoco.MjData(model)
    n_steps = round(seconds / TIMESTEP)
    force = trial.perturbation.sample(1 / TIMESTEP, n_steps, 0.0)
    hinge = [int(model.joint(name).qposadr[0]) for name in JOINTS]
    slide = [int(model.joint(name).qposadr[0]) for name in SLIDES]
    motor = [model.actuator(name).id for name in REFLEXES]
    gauge = int(model.sensor(STRAIN_GAUGE).adr[0])
    gains = reflex_gains([trial.subject], TIMESTEP)
    state = following = initial_activation(1)
    step = 0

    def control(_: mujoco.MjModel, now: mujoco.MjData) -> None:
        nonlocal following
        active, following = activate(
            gains, state, spindle_excitation(gains, now.qpos[None, hinge], now.qvel[None, hinge])
        )
        now.ctrl[motor] = -active[0]
        now.qfrc_applied[slide] = force[step]

    log = np.empty((n_steps // DECIMATION, 3, 2))
    start = time.perf_counter()
    before = mujoco.get_mjcb_control()
    mujoco.set_mjcb_control(control)
    try:
        for step in range(n_steps):
            sample, rest = divmod(step, DECIMATION)
            if not rest:
                log[sample, 0], log[sample, 1] = data.qpos[slide], data.qpos[hinge]
            mujoco.mj_step(model, data)
            state = following
            if not rest:
                log[sample, 2] = data.sensordata[gauge : gauge + 2]
    finally:
        mujoco.set_mjcb_control(before)
    return log[:, 0], time.perf_counter() - start


def loop_time() -> tuple[float, float]:
    """Time that the loop would take for all trials [s], and how far it is off the batch [-]."""
    person = draw_cohort(1, 0, muscles="linear")[0]
    trials = THESIS.trials(person, THESIS.given_forces(), 0, 0, noisy=False)
    chosen = [
        trial for task in ("PT", "RT") for trial in trials if trial.subject.task == task and "0" not in trial.condition
    ]
    half = LOOP_TRIALS // 2
    chosen = [*chosen[:half], *chosen[-half:]]
    results = [looped(trial, LOOP_SECONDS) for trial in chosen]
    batch = run_experiment(chosen, timestep=TIMESTEP)["displacement"].values[:, : len(results[0][0])]
    alone = np.stack([displacement for displacement, _ in results])
    off = float(np.sqrt(np.mean((alone - batch) ** 2) / np.mean(batch**2)))
    per_second = sum(took for _, took in results) / (LOOP_SECONDS * len(chosen))
    return per_second * N_SUBJECTS * len(trials) * THESIS.trial_duration, off


class Memory(threading.Thread):
    """The largest memory of this process and all below it together, shared pages once (PSS) [bytes]."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.peak = 0
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

    def stop(self) -> None:
        self._ended.set()
        self.join()


def main(arguments: list[str] | None = None) -> None:
    """Print times, memory and ratio."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--practice", action="store_true")
    options = parser.parse_args([] if arguments is None else arguments)
    forces = "practice" if options.practice else "published"
    memory = Memory()
    memory.start()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        settings = StudySettings(subjects=N_SUBJECTS, forces=forces, muscles="linear")
        record_study(settings, Path(folder), workers=options.workers)
        took = time.perf_counter() - start
    memory.stop()
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    busy = sum(each.ru_utime + each.ru_stime for each in usage)
    simulated = N_SUBJECTS * len(THESIS.planned_trials()) * THESIS.trial_duration
    print(
        f"study: {took:.1f} s wall on {joblib.cpu_count()} cores ({busy:.0f} s of processor time, "
        f"{simulated / took:.0f} x real time), forces {forces}; target 60 s on 4 cores, 120 s on 2"
    )
    print(
        f"memory: {memory.peak / 2**20:.0f} MiB of all processes together, largest single one "
        f"{max(each.ru_maxrss for each in usage) / 2**10:.0f} MiB; target below 2048 MiB"
    )
    loop, off = loop_time()
    print(
        f"plain loop with mjcb_control on one core: {loop:.0f} s (scaled from {LOOP_TRIALS} x {LOOP_SECONDS:g} s; its "
        f"displacement is {100 * off:.1f} % off the batch's), {loop / took:.1f} x the study; target at least 15 x"
    )


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
