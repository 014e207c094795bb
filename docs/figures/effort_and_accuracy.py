"""Does a trade-off between effort and accuracy predict that people who keep position stiffen in larger movements?

Run `python docs/figures/effort_and_accuracy.py FOLDER [--fast]`. The position task's own reward chooses levels of
co-contraction and reflexes, from candidates that try side by side in the vector environment, and the arms that result
are identified. It writes the picture of docs/effort.md and prints its numbers; --fast only shows that it runs.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from effort import chosen_level, derived_levels, weight_of
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.optimize import differential_evolution
from tqdm import tqdm

from armperturb import Multisine, Subject, Trial, run_experiment
from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.response.spectra import estimate_spectra, line_spectra
from armperturb.cohort import average_person
from armperturb.envs.learning.levels import subject_at
from armperturb.envs.learning.task import TaskSettings
from armperturb.perturbations.multisine import PERIOD
from armperturb.plots.panels import AXES, label_frequency, legend
from armperturb.plots.style import COLOURS, GREY, INK, PUBLISHED, in_style, new_figure, save_png, shades
from armperturb.study.protocol import THESIS
from armperturb.study.published import tables as published

FORCES = {name: THESIS.given_forces()[name] for name in ("PT2.5", "PT7.5", "PT22.5")}
SHADES = dict(zip(FORCES, shades(COLOURS["PT"], len(FORCES)), strict=True))
KNOWN = "PT7.5"  # where the person's level is 1, which tells the weight of effort
TASK = TaskSettings(task="PT", reward="cost", co_contraction_weight=0.3, reflex_weight=0.1)
UNIT = TASK.co_contraction_weight + TASK.reflex_weight  # effort of level 1, by the weights of `TASK`
HIGHEST = 4.0  # level that an action of 1 stands for
LOST = 1e6  # cost of a trial that ends at the limit of the workspace
CHOSEN, FIXED, OWN_LEVELS = "effort × 1", "level 1", "three levels"
OWN = "#E69F00"
FALL = published.headline("admittance_amplitude_factor_pt")


@dataclass(frozen=True, kw_only=True)
class Size:
    """How much is tried: levels alike, realisations, candidates of a generation, generations; times in s."""

    levels: int = 13
    realisations: int = 2
    candidates: int = 16
    generations: int = 14
    lead: float = 2.0  # before the reward counts
    scored: float = PERIOD / 2
    step: float = 2.5e-3  # of the simulation
    settle: float = 8.0  # before the admittance is estimated


FAST = Size(levels=4, realisations=1, candidates=5, generations=1, lead=0.2, scored=0.4, settle=0.5)


def arm_at(levels: np.ndarray) -> Subject:
    """The average person at levels of co-contraction, velocity and position feedback, (3,)."""
    return subject_at(TASK, np.repeat(levels[:, None], 3, axis=1))


def mean_cost(force: float, levels: np.ndarray, effort: float, size: Size, noise: bool = False) -> np.ndarray:
    """Minus the mean reward per decision of candidates who keep to their levels, (candidate,).

    All candidates meet the same multisines and the same noise: what differs between them is their doing. Who is
    unstable for small or for large movements is lost, even if it takes longer than a trial to show.

    Args:
      force: RMS per axis [N].
      levels: of co-contraction, velocity and position feedback, (candidate, 3).
      effort: factor on the weights of effort.
      size: how much is tried.
      noise: whether candidates are noisy.
    """
    env = gym.make_vec(
        "ArmPerturb/Position-v1",
        reward=TASK.reward,
        num_envs=len(levels) * size.realisations,
        rms=force,
        noise=noise,
        duration=size.lead + size.scored,
        timestep=size.step,
        co_contraction="common",
        torque=False,
        highest_level=HIGHEST,
        co_contraction_weight=effort * TASK.co_contraction_weight,
        reflex_weight=effort * TASK.reflex_weight,
    )
    actions = np.repeat(np.repeat(levels / HIGHEST, (1, 3, 3), axis=1), size.realisations, axis=0)
    env.reset(seed=list(range(size.realisations)) * len(levels))
    first, last = (round(time * TASK.control_rate) for time in (size.lead, size.lead + size.scored))
    cost = np.zeros(env.num_envs)
    lost = np.repeat([largest_real_pole(arm_at(own), TASK.environment) >= 0.0 for own in levels], size.realisations)
    for decision in range(last):
        _, reward, terminated, _, _ = env.step(actions)
        lost |= terminated
        if decision >= first:
            cost -= reward / (last - first)
    env.close()
    return np.where(lost, LOST, cost).reshape(-1, size.realisations).mean(axis=1)


@dataclass(frozen=True, eq=False)
class OneLevel:
    """Mean squared error, in units of reward, over one level of everything: levels and errors per condition."""

    levels: dict[str, np.ndarray]
    error: dict[str, np.ndarray]

    def weight(self, power: float = 2.0) -> float:
        """Of the level to a power, with which a person stays at level 1 in the known condition."""
        return weight_of(self.levels[KNOWN] ** (power / 2.0), np.sqrt(self.error[KNOWN]), 1.0)

    def optimum(self, factor: float = 1.0, power: float = 2.0) -> dict[str, np.ndarray]:
        """Condition to the best levels (3,), alike, with a multiple of that weight."""
        result = {}
        for name in FORCES:
            levels = self.levels[name] ** (power / 2.0)
            best = chosen_level(levels, np.sqrt(self.error[name]), factor * self.weight(power))
            result[name] = np.full(3, best ** (2.0 / power))
        return result


def try_one_level(size: Size, noise: bool) -> OneLevel:
    grid = np.geomspace(0.25, 2.5, size.levels)
    result = OneLevel({}, {})
    for name, force in tqdm(FORCES.items(), f"one level, {'noisy' if noise else 'calm'}", unit="condition"):
        alike = np.repeat(grid[:, None], 3, axis=1)
        error = mean_cost(force, alike, 0.0, size, noise)
        # Who meets the limit of the workspace in one trial is no choice.
        held = error < LOST / size.realisations
        result.levels[name], result.error[name] = grid[held], error[held]
    return result


def best_of_three(force: float, start: np.ndarray, effort: float, size: Size, bar: tqdm) -> np.ndarray:
    """Best levels of co-contraction, velocity and position feedback (3,), each its own."""
    spread = np.random.default_rng(0).normal(scale=0.4, size=(size.candidates, 3))
    spread[0] = 0.0

    def cost(levels: np.ndarray) -> np.ndarray:
        bar.update()
        return mean_cost(force, levels.T, effort, size)

    result = differential_evolution(
        cost,
        [(0.0, HIGHEST)] * 3,
        init=np.clip(start * np.exp(spread), 0.0, HIGHEST),
        maxiter=size.generations,
        vectorized=True,
        updating="deferred",
        polish=False,
        tol=0.005,
        seed=0,
    )
    return result.x


class Arm(NamedTuple):
    """Frequency [Hz], gain of the diagonal [m/N], (frequency, axis), and RMS displacement per axis [m]."""

    frequency: np.ndarray
    gain: np.ndarray
    displacement: float


def identified(arms: dict[str, dict[str, np.ndarray]], size: Size) -> dict[tuple[str, str], Arm]:
    """Arms, by name and condition, under the published forces, without noise."""
    duration = size.settle + PERIOD
    multisines = [Multisine.draw(seed=seed, rms=1.0, duration=duration) for seed in range(size.realisations)]
    trials = {
        (name, condition): [
            Trial(subject=arm_at(levels), perturbation=replace(multisine, rms=FORCES[condition]))
            for multisine in multisines
        ]
        for name, chosen in arms.items()
        for condition, levels in chosen.items()
    }
    everything = [trial for own in trials.values() for trial in own]
    with tqdm(total=round(len(everything) * duration), desc="admittances", unit="s", mininterval=1.0) as bar:
        # Not a rounding error more than all, which tqdm would complain about.
        recording = run_experiment(
            everything, timestep=size.step, progress=lambda done: bar.update(min(done, bar.total - bar.n))
        )
    result = {}
    for number, (key, own) in enumerate(trials.items()):
        part = recording.isel(trial=slice(number * len(own), (number + 1) * len(own)))
        spectra = estimate_spectra(line_spectra(part, window_start=size.settle, period=PERIOD))
        moved = part["displacement"].values[:, round(size.settle * part.attrs["rate"]) :]
        gain = np.abs(np.diagonal(spectra.arm, axis1=1, axis2=2))
        result[key] = Arm(spectra.frequency, gain, float(np.sqrt(np.mean(moved**2))))
    return result


@in_style()
def picture(
    calm: OneLevel, own_cost: dict[str, float], result: dict[tuple[str, str], Arm], falls: dict[str, float]
) -> Figure:
    figure = new_figure(5.9)
    panels = figure.subplots(2, 3)
    dashed, dotted = {"linestyle": (0, (4, 2)), "linewidth": 1.0}, {"color": GREY, "linestyle": (0, (1, 1.2))}
    for ax, (name, colour) in zip(panels[0], SHADES.items(), strict=True):
        levels, error, effort = calm.levels[name], calm.error[name], calm.weight() * calm.levels[name] ** 2
        ax.loglog(levels, error, color=GREY)
        ax.loglog(levels, effort, **dotted)
        ax.loglog(levels, error + effort, color=colour, linewidth=1.8)
        best = calm.optimum()[name][0]
        ax.plot(best, np.interp(best, levels, error + effort), "o", color=colour, markersize=7)
        ax.axhline(own_cost[name], color=OWN, linewidth=1.0)
        ax.set(title=f"{name}: level {best:.2f} is best", xlabel="level [-]", xlim=(0.22, 2.9))
        ax.set_ylim(0.6 * min(error.min(), effort.min()), 30.0 * own_cost[name])
        ax.set_xticks([0.25, 0.5, 1, 2], ["0.25", "0.5", "1", "2"])
        ax.set_xticks([], minor=True)
    panels[0, 0].set_ylabel("cost per decision [-]")
    for axis, ax in enumerate(panels[1, :2]):
        for name, colour in SHADES.items():
            chosen, fixed = result[CHOSEN, name], result[FIXED, name]
            ax.loglog(chosen.frequency, chosen.gain[:, axis], color=colour, marker="o", markersize=2.5)
            ax.loglog(fixed.frequency, fixed.gain[:, axis], color=colour, **dashed)
        smallest = result[CHOSEN, "PT2.5"]
        ax.plot(
            smallest.frequency[:2], smallest.gain[:2, axis] / FALL, "x", markersize=6, markeredgewidth=1.6, **PUBLISHED
        )
        ax.set_title(f"$|H_{{{2 * AXES[axis]}}}|$ [m/N]")
        label_frequency(ax)
    ax = panels[1, 2]
    for row, (name, fall) in enumerate(falls.items()):
        ax.plot(fall, row, "o", color=COLOURS["PT"] if name == CHOSEN else GREY, markersize=6)
        ax.annotate(f"{fall:.2f}", (fall, row), (0, 5), textcoords="offset points", ha="center", fontsize=8)
    ax.axvline(FALL, **PUBLISHED)
    ax.axvline(1.0, color=GREY, linewidth=0.8)
    ax.set_yticks(range(len(falls)), list(falls))
    ax.set(title="fall from PT2.5 to PT22.5 [-]", ylim=(len(falls) - 0.5, -0.9), xlim=(0.2, 1.15 * max(falls.values())))
    ax.grid(axis="y", visible=False)
    lines = [Line2D([], [], color=colour, label=name) for name, colour in SHADES.items()]
    lines += [
        Line2D([], [], color=GREY, label="error"),
        Line2D([], [], label="effort", **dotted),
        Line2D([], [], color=OWN, linewidth=1.0, label=OWN_LEVELS),
        Line2D([], [], color=INK, label=FIXED, **dashed),
        Line2D([], [], marker="x", linestyle="", label=f"PT2.5 over {FALL:g}, as published", **PUBLISHED),
    ]
    legend(figure, *lines, n_columns=4)
    return figure


def main(folder: Path, size: Size) -> None:
    calm, noisy = (try_one_level(size, noise) for noise in (False, True))
    effort = calm.weight() / UNIT
    with tqdm(total=len(FORCES) * (size.generations + 1), desc=OWN_LEVELS, unit="generation") as bar:
        own = {name: best_of_three(force, calm.optimum()[name], effort, size, bar) for name, force in FORCES.items()}
    person = average_person()
    arms = {
        FIXED: {name: np.ones(3) for name in FORCES},
        **{f"effort × {factor:g}": calm.optimum(factor) for factor in (0.5, 1.0, 2.0)},
        "effort cubed": calm.optimum(power=3.0),
        "noisy": noisy.optimum(),
        OWN_LEVELS: own,
        "calibrated": {name: np.full(3, person.levels.get(name, 1.0)) for name in FORCES},
    }
    result = identified(arms, size)
    falls = {name: float(np.mean(result[name, "PT2.5"].gain[:2] / result[name, "PT22.5"].gain[:2])) for name in arms}
    own_cost = {name: float(mean_cost(FORCES[name], own[name][None], effort, size)[0]) for name in FORCES}
    folder.mkdir(parents=True, exist_ok=True)
    save_png(picture(calm, own_cost, result, falls), folder / "effort_and_accuracy.png", 110.0)

    print(f"effort: {effort:.3g} times the environment's weights ({noisy.weight() / UNIT:.3g} with noise)")
    print(f"{'':18}" + "".join(f"{name:>24}" for name in FORCES) + f"{'fall':>7}")
    for name, chosen in arms.items():
        cells = ""
        for condition, levels in chosen.items():
            stated = " ".join(f"{level:.2f}" for level in dict.fromkeys(levels.tolist()))
            cells += f"{f'{stated} {1e3 * result[name, condition].displacement:5.1f} mm':>24}"
        print(f"{name:18}{cells}{falls[name]:7.2f}")
    print(f"{'people, published':18}" + " " * 72 + f"{FALL:7.2f}")
    print(f"cost of {OWN_LEVELS}: " + ", ".join(f"{name} {cost:.3g}" for name, cost in own_cost.items()))
    alike = {name: mean_cost(FORCES[name], calm.optimum()[name][None], effort, size)[0] for name in FORCES}
    print("cost of one level: " + ", ".join(f"{name} {cost:.3g}" for name, cost in alike.items()))
    if size == FAST:
        return
    rule = derived_levels(person, THESIS, FORCES)
    print("study/effort.py: " + ", ".join(f"{name} {rule[name]:.2f}" for name in FORCES))


if __name__ == "__main__":
    places = [argument for argument in sys.argv[1:] if argument != "--fast"]
    main(Path(places[0] if places else "effort"), FAST if "--fast" in sys.argv else Size())
