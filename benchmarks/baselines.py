"""What agents reach in the environments: zero, random, the person's own action, and linear policies that are trained.

Run `python -m benchmarks.baselines --out FOLDER`. Policies are trained by the cross-entropy method (Rubinstein & Kroese
2004, The Cross-Entropy Method): each generation draws candidates around a mean, lets all meet the same trials, and goes
on with mean and spread of the best. Everything has a seed; each training is one process and one core. FOLDER gets the
learning curves, and with --ship the package gets the best policy of each environment.
"""

import argparse
import json
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import tomli_w

import armperturb.envs.learning
from armperturb.envs.learning.linear_policy import LinearPolicy

TASKS = ("Position", "Relax", "Pulse")
SEEDS, GENERATIONS, CANDIDATES, BEST, TRIALS = 3, 30, 48, 8, 2
JUDGED = range(1000, 1024)
"""Seeds of the trials that policies are judged on; those of training begin at zero."""

DECISIONS = 500


def run(name: str, act, seeds, n_people: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean reward per decision and success of each person, and all observations of the first people.

    Args:
      name: of the environment.
      act: from observations, (person, 8), to actions, (person, 11).
      seeds: of the people's trials.
      n_people: how many people the observations are kept of.
    """
    envs = gym.make_vec(name, num_envs=len(seeds), engine="compiled", n_threads=1)
    observations, info = envs.reset(seed=list(seeds))
    total, running, success, seen = np.zeros(len(seeds)), np.ones(len(seeds), dtype=bool), 0, []
    for _ in range(DECISIONS):
        seen.append(observations[:n_people].copy())
        observations, reward, terminated, _, info = envs.step(act(observations))
        total += np.where(running, reward, 0.0)
        running &= ~terminated
        success = np.asarray(info["success"]) & running
    envs.close()
    return total / DECISIONS, success, np.array(seen)


def train(name: str, seed: int) -> dict:
    """A policy and how its reward on trials that training does not see rose, generation by generation."""
    rng, start = np.random.default_rng(seed), time.process_time()
    shape = (11, 9)
    mean, spread = np.zeros(shape), np.full(shape, 0.1)
    mean[:9, -1], spread[:9, -1] = 0.5, 0.3
    curve = []
    for generation in range(GENERATIONS):
        drawn = mean + spread * rng.normal(size=(CANDIDATES, *shape))
        drawn[0] = mean
        of_person = np.repeat(drawn, TRIALS, axis=0)
        trials = [TRIALS * generation + trial for trial in range(TRIALS)] * CANDIDATES

        def act(observations, of_person=of_person):
            return (np.einsum("pao,po->pa", of_person[..., :-1], observations) + of_person[..., -1]).astype(np.float32)

        reward, _, _ = run(name, act, trials, 0)
        score = reward.reshape(CANDIDATES, TRIALS).mean(axis=1)
        best = drawn[np.argsort(score)[-BEST:]]
        mean = 0.3 * mean + 0.7 * best.mean(axis=0)
        spread = 0.3 * spread + 0.7 * best.std(axis=0) + 0.02 * 0.9**generation
        curve.append(float(score[0]))
    return {"weights": mean.round(4).tolist(), "curve": curve, "seconds": time.process_time() - start}


def judge(name: str, act) -> dict:
    """Mean and standard deviation over trials of the reward per decision, successes, and SDs of the observations."""
    reward, success, seen = run(name, act, JUDGED, len(JUDGED))
    spread = seen.reshape(-1, seen.shape[-1]).std(axis=0)
    return {
        "mean": float(reward.mean()),
        "sd": float(reward.std(ddof=1)),
        "success": int(np.sum(success)),
        "observation_sd": spread.round(2).tolist(),
    }


def policies(name: str) -> dict:
    """Policies that learn nothing."""
    envs = gym.make_vec(name, num_envs=1, engine="compiled")
    person, low, high = envs.own_action, envs.single_action_space.low, envs.single_action_space.high
    envs.close()
    rng = np.random.default_rng(0)
    return {
        "zero": lambda seen: np.zeros((len(seen), len(person)), dtype=np.float32),
        "random": lambda seen: rng.uniform(low, high, (len(seen), len(person))).astype(np.float32),
        "own action": lambda seen: np.repeat(person[None], len(seen), axis=0),
    }


def main() -> None:
    """Judge, train what is not in the folder yet, and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the learning curves")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="trainings of each environment")
    parser.add_argument("--only", choices=TASKS, nargs="+", default=TASKS, help="environments to train in")
    parser.add_argument(
        "--ship",
        action="store_true",
        help="write the best policies of these environments into the package, in the place of all that are there",
    )
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    results: dict = {}
    for seed in range(asked.seeds):
        for name in (f"ArmPerturb/{task}-v1" for task in asked.only):
            file = asked.out / f"{name.rpartition('/')[2]}_{seed}.json"
            if not file.exists():
                trained = train(name, seed)
                trained |= {"judged": judge(name, LinearPolicy(np.array(trained["weights"])))}
                file.write_text(json.dumps(trained), encoding="utf-8")
            results.setdefault(name, []).append(json.loads(file.read_text(encoding="utf-8")))
    shipped = {}
    for name, trained in results.items():
        print(f"{name}\n  {'policy':14}{'reward':>8}{'SD':>7}  success  SDs of observations")
        rows = {policy: judge(name, act) for policy, act in policies(name).items()}
        rows |= {f"linear, seed {seed}": each["judged"] for seed, each in enumerate(trained)}
        for policy, row in rows.items():
            numbers = f"{row['mean']:8.3f}{row['sd']:7.3f}{row['success']:6d}/{len(JUDGED)}"
            print(f"  {policy:14}{numbers}  {row['observation_sd']}")
        print(f"  training: {np.mean([each['seconds'] for each in trained]):.0f} s of processor time each")
        best = max(trained, key=lambda each: each["judged"]["mean"])
        shipped[name] = {"weights": best["weights"], "reward": round(best["judged"]["mean"], 3)}
    if asked.ship:
        folder = Path(armperturb.envs.learning.__file__).parent
        (folder / "policies.toml").write_text(tomli_w.dumps(shipped), encoding="utf-8")


if __name__ == "__main__":
    main()
