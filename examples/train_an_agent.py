"""Can an agent learn to keep position with little effort?

Run `python examples/train_an_agent.py [--out FOLDER] [--fast]`. The cross-entropy method, in NumPy: candidates drawn
around a policy try side by side in the vector environment, and the best quarter becomes the next policy. It has five
numbers: levels of co-contraction, velocity and position feedback, which it holds, and of torque against felt
velocity at each joint. Effort is ten times as dear as usual, else to be as stiff as one can is nearly all
that there is to learn. Beside it stand who does nothing, and who holds the best levels without any torque; on trials
that nobody has trained on. Judge it by its distance to the latter.
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

import armperturb  # noqa: F401, registers the environments
from armperturb.envs.learning.task import TaskSettings

TASK = {
    "duration": 2.0,
    "timestep": 2.5e-3,
    "co_contraction": "common",
    "co_contraction_weight": 3.0,
    "reflex_weight": 1.0,
}
N_LEVELS, N_PARAMETERS = 3, 5
FAST = 1.0
"""Velocity of a joint at which a gain of 1 asks for the highest torque [rad/s]."""
NEVER_SEEN = 1_000_000
"""First seed of the trials by which policies are judged."""


def act(policies: np.ndarray, senses: np.ndarray) -> np.ndarray:
    """What policies (person, 5) do about their senses (person, 8): co-contraction, 3 + 3 reflex gains, 2 torques."""
    levels = np.repeat(policies[:, :N_LEVELS], (1, 3, 3), axis=1)
    torque = -policies[:, N_LEVELS:] * senses[:, 2:4] / FAST
    return np.concatenate([np.clip(levels, 0.0, 1.0), np.clip(torque, -1.0, 1.0)], axis=1).astype(np.float32)


def rewards(policies: np.ndarray, seeds: range) -> np.ndarray:
    """Mean reward per decision of each policy in each trial, (policy, trial); all meet the same trials."""
    people = np.repeat(policies, len(seeds), axis=0)
    env = gym.make_vec("ArmPerturb/Position-v0", num_envs=len(people), **TASK)
    senses, _ = env.reset(seed=[*seeds] * len(policies))
    total, going, decisions = np.zeros(len(people)), np.ones(len(people), dtype=bool), round(TASK["duration"] * 50)
    for _ in range(decisions):
        senses, reward, terminated, _, _ = env.step(act(people, senses))
        total += np.where(going, reward, 0.0)  # who has left the workspace has been charged for the rest
        going &= ~terminated
    env.close()
    return total.reshape(len(policies), len(seeds)) / decisions


def train(generations: int, candidates: int, trials: int) -> np.ndarray:
    """Policy after each generation, that of the start first, (generation + 1, 5)."""
    rng = np.random.default_rng(0)
    policy = np.repeat([0.5, 0.0], (N_LEVELS, N_PARAMETERS - N_LEVELS))
    first_spread = spread = np.repeat([0.3, 0.2], (N_LEVELS, N_PARAMETERS - N_LEVELS))
    history = [policy]
    for generation in tqdm(range(generations), "train", unit="generation"):
        tried = policy + spread * rng.normal(size=(candidates, N_PARAMETERS))
        tried[:, :N_LEVELS] = np.clip(tried[:, :N_LEVELS], 0.0, 1.0)
        scores = rewards(tried, range(generation * trials, (generation + 1) * trials)).mean(axis=1)
        best = tried[np.argsort(scores)[-max(candidates // 4, 2) :]]
        # Chance makes the best alike too early: their spread is not believed below one that falls slowly.
        policy, spread = best.mean(axis=0), np.maximum(best.std(axis=0), first_spread * 0.8 ** (generation + 1))
        history.append(policy)
    return np.array(history)


def best_levels(steps: int, trials: int) -> np.ndarray:
    """The best of a grid of constant levels, on trials of its own, (5,)."""
    level = np.linspace(0.0, 1.0, steps)
    grid = np.stack(np.meshgrid(level[1:], level, level, indexing="ij"), axis=-1).reshape(-1, N_LEVELS)
    grid = np.pad(grid, ((0, 0), (0, N_PARAMETERS - N_LEVELS)))
    return grid[rewards(grid, range(NEVER_SEEN // 2, NEVER_SEEN // 2 + trials)).mean(axis=1).argmax()]


def difference(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Mean difference over trials, and its standard error."""
    return float(np.mean(one - other)), float(np.std(one - other, ddof=1) / np.sqrt(len(one)))


def main(folder: Path, generations: int, candidates: int, trials: int, judged_on: int) -> None:
    history = train(generations, candidates, trials)
    still, without_torque = np.zeros(N_PARAMETERS), np.where(np.arange(N_PARAMETERS) < N_LEVELS, history[-1], 0.0)
    held = best_levels(5 if generations > 5 else 2, trials)
    seeds = range(NEVER_SEEN, NEVER_SEEN + judged_on)
    nothing, constant, levels_alone, *learning = rewards(np.array([still, held, without_torque, *history]), seeds)
    learnt = learning[-1]

    print(f"mean reward per decision, {judged_on} trials that nobody trained on:")
    print(f"  does nothing          {nothing.mean():8.2f}")
    print(f"  before training       {learning[0].mean():8.2f}")
    print(f"  best constant levels  {constant.mean():8.2f}   levels {held[:N_LEVELS].round(2).tolist()}, of a grid")
    print(f"  learnt                {learnt.mean():8.2f}   levels {history[-1, :N_LEVELS].round(2).tolist()}")
    print(f"  the same, no torque   {levels_alone.mean():8.2f}")
    # All meet the same trials: differences are known better than either.
    gain, error = difference(learnt, constant)
    of_torque, its_error = difference(learnt, levels_alone)
    print(f"learnt over constant: {gain:+.2f} +- {error:.2f} (standard error)")
    print(f"by torque alone:      {of_torque:+.2f} +- {its_error:.2f}")
    more = min(gain - 2.0 * error, of_torque - 2.0 * its_error) > 0.0
    print("it learnt something" if more else "it learnt no more than to hold levels")
    damping = history[-1, N_LEVELS:] * TaskSettings().highest_torque / FAST
    print(
        f"  torque: {damping[0]:.1f} Nms/rad at the shoulder, {damping[1]:.1f} at the elbow, late by senses and muscles"
    )

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    curve, spread = -np.mean(learning, axis=1), np.std(learning, axis=1, ddof=1) / np.sqrt(judged_on)
    axes.errorbar(range(generations + 1), curve, spread, fmt="ko-", markersize=4, label="policy, with standard error")
    axes.axhline(-constant.mean(), color="C1", ls="--", label="best constant levels")
    axes.set(xlabel="generation", ylabel="mean cost per decision, trials not trained on")
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"who does nothing pays {-nothing.mean():.0f}", fontsize=10)
    axes.legend(frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "train_an_agent.png", dpi=110)
    print(f"wrote {folder / 'train_an_agent.png'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("example"), metavar="FOLDER")
    parser.add_argument("--fast", action="store_true", help="two generations of six candidates")
    given = parser.parse_args()
    size = (2, 6, 2, 4) if given.fast else (12, 16, 4, 16)
    main(given.out, *size)
