"""Decisions per second of the vectorised gymnasium environment, beside gymnasium's own vector environments.

Run `python -m benchmarks.vector_env`, with `--people` for another number than 256. All sides run in turns, and what
counts is the ratio of their times in a turn.
Targets with 256 people: 10 times `SyncVectorEnv`, 4 times `AsyncVectorEnv`, and within 1.15 of bare `Batch.step`.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable

import gymnasium as gym
import numpy as np
from mujoco.batch import Batch

from armperturb.cohort import average_person
from armperturb.environment import TIMESTEP
from armperturb.envs.learning.gym_vector_env import ArmPerturbVectorEnv
from armperturb.models.rig import build_model

STEPS = round(0.02 / TIMESTEP)
NAME, TURNS = "ArmPerturb/Position-v1", 7
DECISIONS = {"bare Batch.step": 20, "vector": 20, "compiled": 20, "async": 4, "sync": 1}
"""Side to the decisions of everybody that are timed in a turn."""


def actions(n: int) -> np.ndarray:
    """Around what the person does, (decision, person, action): people who change their minds all the time."""
    envs = ArmPerturbVectorEnv(1)
    rng = np.random.default_rng(0)
    drawn = envs.own_action + rng.uniform(-0.1, 0.1, (20, n, len(envs.own_action)))
    return np.clip(drawn, envs.single_action_space.low, envs.single_action_space.high).astype(np.float32)


def bare(n: int) -> Callable[[int], object]:
    """As many steps as lie between two decisions, on the same model, alone."""
    batch = Batch(build_model(average_person().subjects["PT"], visual=False), n)
    batch.reset()

    def decide(_: int) -> None:
        for _ in range(STEPS):
            batch.step()

    return decide


def main() -> None:
    """Compare the five."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=256, help="side by side")
    people = parser.parse_args().people
    modes = {"vector": None, "compiled": None, "async": "async", "sync": "sync"}
    # Processes first, while this one is small.
    envs = {
        name: gym.make_vec(
            NAME,
            num_envs=people,
            vectorization_mode=modes[name],
            engine="compiled" if name == "compiled" else "mujoco",
        )
        for name in ("async", "sync", "vector", "compiled")
    }
    chosen = actions(people)
    sides = {"bare Batch.step": bare(people)} | {
        name: lambda i, env=env: env.step(chosen[i % len(chosen)]) for name, env in envs.items()
    }
    for env in envs.values():
        env.reset(seed=0)
    times: dict[str, list[float]] = {name: [] for name in DECISIONS}
    for turn in range(TURNS + 1):
        for name, n in DECISIONS.items():
            start = time.perf_counter()
            for i in range(n):
                sides[name](turn * n + i)
            if turn:  # the first warms up
                times[name].append((time.perf_counter() - start) / n)
    for env in envs.values():
        env.close()
    for name, values in times.items():
        middle = statistics.median(values)
        print(f"{name:>16}: {1e3 * middle:8.1f} ms, {people / middle:9.0f} decisions/s")
    print(
        f"{people} people, {STEPS} steps of {1e3 * TIMESTEP:g} ms a decision, {os.cpu_count()} cores; ratios of a turn:"
    )
    for over, under, target in (
        ("sync", "vector", "at least 10"),
        ("async", "vector", "at least 4"),
        ("vector", "bare Batch.step", "at most 1.15"),
        ("sync", "compiled", "at least 100"),
    ):
        ratios = [a / b for a, b in zip(times[over], times[under], strict=True)]
        print(
            f"{over} over {under}: {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}); "
            f"target {target}"
        )


if __name__ == "__main__":
    main()
