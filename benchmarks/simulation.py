"""Microseconds per trial and step of every way to simulate the same trials, and their ratios within one run.

Run `python -m benchmarks.simulation`; about a minute. Sides run in turns, as times on shared machines are noisy, and
what counts is the ratio of their times in a turn. All are at the same step, with reflexes that are delayed:

- a loop with a Python callback (`mjcb_control`) for reflexes and perturbation, which RK4 calls four times a step, of
  one trial at a time;
- `mujoco.batch.Batch.step` and `mujoco.rollout` of the bare model, without reflexes, on all cores;
- `run_experiment` with MuJoCo and with the compiled engine, from perturbation to recording, on all cores.
"""

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
from mujoco import rollout
from mujoco.batch import Batch

from armperturb.controllers.lanes import activation_filter
from armperturb.environment import TIMESTEP
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.models.rig import build_model
from armperturb.perturbations import Multisine
from armperturb.subject import POSITION, RELAX, Subject
from benchmarks.history import remembered

N_TRIALS, DURATION, TURNS = 64, 4.0, 5
LOOPED = 2
"""Trials of the loop, whose time is scaled to all."""


def trials_of(people: Sequence[Subject]) -> list[Trial]:
    """As many trials of each of these people, under small multisines."""
    return [
        Trial(
            subject=people[number % len(people)],
            perturbation=Multisine.draw(seed=number, rms=1.0, duration=DURATION, crested=False),
        )
        for number in range(N_TRIALS)
    ]


def looped(trial: Trial) -> None:
    """One trial as one would write it first."""
    person = trial.subject
    model = build_model(person, visual=False)
    data = mujoco.MjData(model)
    n_steps = round(DURATION / TIMESTEP)
    force = trial.perturbation.sample(1.0 / TIMESTEP, n_steps, 0.0)
    velocity, position = (person.joint_matrix(name) for name in ("kv", "kp"))
    (b0, b1, b2), (_, a1, a2) = activation_filter(person.fact_s, person.zeta_act, TIMESTEP)
    memory, step = np.zeros((2, 2)), 0

    def control(_: mujoco.MjModel, now: mujoco.MjData) -> None:
        now.ctrl[4:] = force[step]
        now.ctrl[:2] = -(b0 * (velocity @ now.qvel[:2] + position @ (now.qpos[:2] - person.posture)) + memory[0])

    before = mujoco.get_mjcb_control()
    mujoco.set_mjcb_control(control)
    try:
        while step < n_steps:
            excitation = velocity @ data.qvel[:2] + position @ (data.qpos[:2] - person.posture)
            mujoco.mj_step(model, data)
            active = -data.ctrl[:2]
            memory = np.stack([b1 * excitation - a1 * active + memory[1], b2 * excitation - a2 * active])
            step += 1
    finally:
        mujoco.set_mjcb_control(before)


def batch() -> Callable[[], object]:
    """`Batch.step` on the same model, alone."""
    simulations = Batch(build_model(POSITION, visual=False), N_TRIALS)
    simulations.reset()

    def step() -> None:
        for _ in range(round(DURATION / TIMESTEP)):
            simulations.step()

    return step


def rolled_out() -> Callable[[], object]:
    """`mujoco.rollout` on the same model, with controls that are known."""
    model = build_model(POSITION, visual=False)
    n_threads = os.cpu_count() or 1
    datas = [mujoco.MjData(model) for _ in range(n_threads)]
    state = np.zeros((N_TRIALS, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    for row in state:
        mujoco.mj_getState(model, datas[0], row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    control = np.zeros((N_TRIALS, round(DURATION / TIMESTEP), model.nu))
    return lambda: rollout.rollout([model] * N_TRIALS, datas, state, control)


def in_turns(sides: Mapping[str, Callable[[], object]], turns: int = TURNS) -> dict[str, list[float]]:
    """Seconds of each side in each turn, after one that warms up."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for turn in range(turns + 1):
        for name, function in sides.items():
            start = time.perf_counter()
            function()
            if turn:
                times[name].append(time.perf_counter() - start)
    return times


def main() -> None:
    """Print the table."""
    trials = trials_of((RELAX, POSITION))
    times = in_turns(
        {
            "callback loop": lambda: [looped(trial) for trial in trials[:LOOPED]],
            "Batch.step, bare": batch(),
            "rollout, bare": rolled_out(),
            "run_experiment": lambda: run_experiment(trials),
            "run_experiment, compiled": lambda: run_experiment(trials, engine="compiled"),
        }
    )
    times["callback loop"] = [took * N_TRIALS / LOOPED for took in times["callback loop"]]
    n_steps = N_TRIALS * DURATION / TIMESTEP
    print(f"{N_TRIALS} trials of {DURATION:g} s at {1e3 * TIMESTEP:g} ms on {os.cpu_count()} cores")
    ratios = {}
    for name, values in times.items():
        over = statistics.median(a / b for a, b in zip(values, times["Batch.step, bare"], strict=True))
        ratios[f"{name} over Batch.step, bare"] = over
        print(f"{name:>26}: {1e6 * statistics.median(values) / n_steps:7.2f} us per trial and step, {over:7.2f} x")
    print("the last column is over Batch.step; target of run_experiment: at most 1.15")
    remembered(ratios)


if __name__ == "__main__":
    main()
