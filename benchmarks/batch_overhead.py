"""What recording, reflexes and perturbations cost on top of bare simulation: 320 trials at 1 ms.

Run `python -m benchmarks.batch_overhead`. Times on shared machines are noisy, so both sides run in turns and what
counts is their ratio; the target is at most 1.5.
"""

import os
import statistics
import time
from collections.abc import Callable

from mujoco.batch import Batch

from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.models.rig import build_model
from armperturb.perturbations import Multisine
from armperturb.subject import POSITION, RELAX, Subject

N_TRIALS, DURATION, TIMESTEP, REPEATS = 320, 2.0, 1e-3, 5


def experiment(people: tuple[Subject, Subject] = (RELAX, POSITION)) -> Callable[[], object]:
    """The whole experiment, from perturbations to recording: half of the trials on each of two people."""
    trials = [
        Trial(
            subject=people[number % 2],
            perturbation=Multisine.draw(seed=number, rms=1.0, duration=DURATION, crested=False),
        )
        for number in range(N_TRIALS)
    ]
    return lambda: run_experiment(trials, timestep=TIMESTEP)


def bare() -> Callable[[], object]:
    """`Batch.step` on the same model, alone."""
    batch = Batch(build_model(POSITION, timestep=TIMESTEP, visual=False), N_TRIALS)
    batch.reset()

    def step() -> None:
        for _ in range(round(DURATION / TIMESTEP)):
            batch.step()

    return step


def seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def compare(sides: dict[str, Callable[[], object]]) -> None:
    """Print the microseconds per trial and step of both, run in turns, and the ratio of the first to the second."""
    for function in sides.values():
        function()  # warm-up
    times: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(REPEATS):
        for name, function in sides.items():
            times[name].append(seconds(function))
    per_step = N_TRIALS * DURATION / TIMESTEP
    for name, values in times.items():
        print(f"{name:>16}: {1e6 * statistics.median(values) / per_step:6.2f} us per trial and step")
    ratios = [a / b for a, b in zip(*times.values(), strict=True)]
    print(
        f"{N_TRIALS} trials at {1e3 * TIMESTEP:g} ms on {os.cpu_count()} cores: ratio {statistics.median(ratios):.2f} "
        f"({min(ratios):.2f} to {max(ratios):.2f}); target at most 1.5"
    )


def main() -> None:
    """Compare the experiment with the bare batch."""
    compare({"experiment": experiment(), "bare Batch.step": bare()})


if __name__ == "__main__":
    main()
