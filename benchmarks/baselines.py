"""What agents reach in the environments: policies that learn nothing, and two methods that learn, with some seeds each.

Run `python -m benchmarks.baselines --out FOLDER --seeds 1`, as docs/environments.md has it; it needs the extra
`baselines`. Methods are those of `benchmarks.policies`. FOLDER gets a file for each training, which a second run does
not train again, the learning curves as `learning_curves.png`, and the table of docs/environments.md as `table.md`. With
--ship the package gets, of each environment, the policy that earned most on the trials of its learning curve; all are
judged on other ones.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import armperturb.envs.learning
from armperturb.arrays import Array
from armperturb.envs.learning.policy import Policy
from armperturb.plots.style import GREY, PALETTE, in_style, new_figure, save_png
from benchmarks.policies import JUDGED, METHODS, judge, untrained

TASKS = ("Position", "Relax", "Pulse")


def environment(task: str) -> str:
    """Name of a task's environment."""
    return f"ArmPerturb/{task}-v1"


def training_file(folder: Path, task: str, method: str, seed: int) -> Path:
    """Where a training's result is kept."""
    return folder / f"{task}_{method.partition(',')[0]}_{seed}.json"


def train(task: str, method: str, seed: int) -> dict[str, Any]:
    """A trained policy, its learning curve, what it cost, and how it is judged; weights are rounded as they ship."""
    policy, curve = METHODS[method](environment(task), seed)
    layers = [layer.round(4).tolist() for layer in policy.layers]
    judged = judge(environment(task), Policy(tuple(np.array(layer) for layer in layers)))
    return {"layers": layers, "curve": curve.points, "seconds": curve.seconds(), "judged": judged}


def interval(values: Array) -> tuple[float, float]:
    """Mean of values, and half the width of its interval of 95 %."""
    half = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values)), float(half)


def table(results: dict[tuple[str, str], list[dict[str, Any]]]) -> str:
    """Mean reward of each policy in each task, the best first.

    Means of what learns nothing, and of a single training, have the interval over trials, others that over trainings.
    """
    lines = [
        "| environment | policy | mean reward, 95 % | trainings | success | SDs of observations | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for task in TASKS:
        rows = []
        for policy, act in untrained(environment(task)).items():
            judged = judge(environment(task), act)
            rows.append((*interval(judged["rewards"]), policy, "", [judged], ""))
        for method in METHODS:
            if not (trained := results.get((task, method))):
                continue
            means = [float(np.mean(each["judged"]["rewards"])) for each in trained]
            each_mean = ", ".join(f"{mean:.3f}" for mean in means)
            seconds = f"{np.mean([each['seconds'] for each in trained]):.0f}"
            over = means if len(means) > 1 else trained[0]["judged"]["rewards"]
            rows.append((*interval(over), method, each_mean, [each["judged"] for each in trained], seconds))
        for mean, half, policy, each_mean, judged, seconds in sorted(rows, key=lambda row: -row[0]):
            spread = np.array([each["observation_sd"] for each in judged])
            success = sum(each["success"] for each in judged)
            cells = (f"{mean:.3f} ± {half:.3f}", each_mean, f"{success} of {len(judged) * len(JUDGED)}")
            cells += (f"{spread.min():.2f} to {spread.max():.2f}", seconds)
            lines.append(f"| {task} | {policy} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


@in_style()
def draw_curves(results: dict[tuple[str, str], list[dict[str, Any]]], file: Path) -> None:
    """Learning curves: each training, their mean, and its interval of 95 %."""
    figure = new_figure(2.9)
    for ax, task in zip(figure.subplots(1, len(TASKS)), TASKS, strict=True):
        own = np.mean(judge(environment(task), untrained(environment(task))["own action"])["rewards"])
        ax.axhline(own, color=GREY, linestyle=":", label="own action")
        for method, colour in zip(METHODS, PALETTE, strict=False):
            curves = [np.array(each["curve"]) for each in results.get((task, method), [])]
            if not curves:
                continue
            decisions, rewards = curves[0][:, 0] / 1e6, np.array([curve[:, 1] for curve in curves])
            middle = rewards.mean(axis=0)
            if len(curves) > 2:  # of two the interval is wider than the picture
                half = np.array([interval(of_moment)[1] for of_moment in rewards.T])
                ax.fill_between(decisions, middle - half, middle + half, color=colour, alpha=0.15, linewidth=0)
            ax.plot(decisions, rewards.T, color=colour, linewidth=0.5)
            ax.plot(decisions, middle, color=colour, linewidth=1.6, label=method)
        ax.set(title=task, xlabel="decisions [million]", ylim=(max(0.4, own - 0.15), min(1.01, own + 0.22)))
        if task == TASKS[0]:
            ax.set_ylabel("mean reward per decision")
            ax.legend(loc="lower right")
    save_png(figure, file)


def ship(results: dict[tuple[str, str], list[dict[str, Any]]]) -> None:
    """Write the best policy of each environment into the package."""
    lines = ["# Policies that `python -m benchmarks.baselines --ship` trained: weights and, last in a row, the bias."]
    for task in TASKS:
        trainings = {method: results.get((task, method), []) for method in METHODS}
        trained = {(method, seed): each for method in METHODS for seed, each in enumerate(trainings[method])}
        method, seed = max(trained, key=lambda key: trained[key]["curve"][-1][1])
        best = trained[method, seed]
        lines += ["", f'["{environment(task)}"]', f'trained = "{method}, seed {seed}"']
        lines += [f"reward = {np.mean(best['judged']['rewards']):.3f}", "layers = ["]
        for layer in best["layers"]:
            lines += ["  [", *(f"    [{', '.join(f'{value:g}' for value in row)}]," for row in layer), "  ],"]
        lines += ["]"]
    folder = Path(armperturb.envs.learning.__file__).parent
    (folder / "policies.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    """Train what is not in the folder yet, judge, draw and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--jobs", type=int, default=2, help="trainings side by side")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of a method in an environment")
    parser.add_argument("--methods", nargs="+", choices=("PPO", "CEM"), default=("PPO", "CEM"))
    parser.add_argument("--ship", action="store_true", help="write the best policies into the package")
    asked = parser.parse_args()
    if find_spec("stable_baselines3") is None:  # before the trainings that need it fail, and the others with them
        parser.error("stable-baselines3 is not installed; expected `pip install 'armperturb[baselines]'`")
    asked.out.mkdir(parents=True, exist_ok=True)
    methods = [method for method in METHODS if method.partition(",")[0] in asked.methods]
    wanted = [(task, method, seed) for method in methods for seed in range(asked.seeds) for task in TASKS]
    left = [each for each in wanted if not training_file(asked.out, *each).exists()]
    with ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as pool:
        waiting = {pool.submit(train, *each): each for each in left}
        for future in as_completed(waiting):
            training_file(asked.out, *waiting[future]).write_text(json.dumps(future.result()), encoding="utf-8")
            print(*waiting[future], flush=True)
    results: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for task, method, seed in wanted:
        retained = training_file(asked.out, task, method, seed).read_text(encoding="utf-8")
        results.setdefault((task, method), []).append(json.loads(retained))
    text = table(results)
    (asked.out / "table.md").write_text(text, encoding="utf-8")
    print(text)
    draw_curves(results, asked.out / "learning_curves.png")
    if asked.ship:
        ship(results)


if __name__ == "__main__":
    main()
