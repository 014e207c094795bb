"""Calibration: the average person whose muscles yield as those of the thesis's people did (docs/calibration.md).

The objective, in the unknowns' logarithms: squared deviations of the calibrated cells from their published means, in
published standard deviations, plus squared deviations of the unknowns from what is typical, in the factors that the
literature leaves open, plus how much nearer to instability than others the person is. The average person, noisy as
people are, is simulated under the published mean forces; nothing else of the thesis is seen. The objective is minimised
by trust regions (Gauss-Newton); all slopes of an iteration are one batch.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import tomli_w
from scipy import optimize

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.measures.pulse import WINDOWS
from armperturb.analysis.results import Description, Result, Table
from armperturb.arrays import Array
from armperturb.cohort import STABILITY_MARGIN
from armperturb.controllers.remnant import HUMAN_NOISE, HumanNoise
from armperturb.environment import ENGINES, Environment
from armperturb.files import write_whole
from armperturb.perturbations.multisine import PERIOD
from armperturb.study.experiments.candidates import Candidate, Unknown, unknowns
from armperturb.study.experiments.cohort_cells import cells_of_trials
from armperturb.study.protocol import PULSE_LEAD, THESIS, Protocol, with_published_forces
from armperturb.study.published.tables import MeanSD
from armperturb.study.results.quantities import LIMITS, Cell, published_cells
from armperturb.study.results.uses import CALIBRATED, HELD_OUT
from armperturb.subject import TASKS
from armperturb.validation import require_number, require_one_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SLOPE_STEP = 0.03
"""Of the logarithm of an unknown, for slopes."""

WIDEST = 3.0
"""Unknowns stay within this many of their factors [-]."""

MARGIN = STABILITY_MARGIN
"""Poles of the linear arms between which a candidate works should lie left of minus this [1/s], as those of drawn
people do. A condition in which one lies to the right of it adds to the objective."""

MARGIN_SD = 0.25
"""How far to the right counts as one standard deviation [1/s]."""

MOST = 1000
"""Sets of multisines, and steps of the search, that anybody would wait for."""

TOLERANCE = 5e-3
"""The search ends when an iteration lowers the objective by less than this share."""


def steady(noise: HumanNoise) -> HumanNoise:
    """The noise without change of the muscles from trial to trial: draws that jump would hide slopes."""
    return replace(noise, spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)


SEEN, UNSEEN = 500, 900
"""First seeds of the multisines of the search, and of those on which its result is judged."""

N_UNSEEN = 6
"""Sets of multisines on which the result is judged."""


def schedules(task: str) -> tuple[Protocol, Protocol]:
    """The task's conditions with multisines and those without, each as long as the cells see of it.

    Every condition with a multisine has four trials per seed.
    """
    after = WINDOWS[task] + 0.1
    both = []
    for with_multisine, onset in ((True, WINDOW_START + PERIOD), (False, PULSE_LEAD)):
        conditions = [
            replace(condition, repetitions=2 // len(condition.pulse_levels) if with_multisine else 1)
            for condition in THESIS.conditions
            if condition.task == task and condition.has_multisine is with_multisine
        ]
        both.append(with_published_forces(conditions, onset, onset + after))
    return both[0], both[1]


def simulated_cells(
    candidates: Sequence[Candidate],
    seeds: Sequence[int],
    *,
    noisy: bool = True,
    noise: HumanNoise | None = None,
    environment: Environment | None = None,
    engine: str = "compiled",
    **options: Any,
) -> list[dict[Cell, float] | None]:
    """Cells of several candidates of one task, side by side and under the same multisines.

    Args:
      candidates: who is perturbed by the published mean forces.
      seeds: of the multisines; each adds four trials to every condition that has one.
      noisy: whether they are noisy, but with the same muscles in every trial.
      noise: how noisy; as people are in the task if not given.
      environment: what the hand holds; the thesis's manipulator if not given.
      engine: see `run_experiment`.
      **options: further ones of `run_experiment`.

    Returns:
      Per candidate its cells, SI; None for one that is unstable or leaves the workspace.
    """
    environment = environment or Environment()
    able = [number for number, candidate in enumerate(candidates) if poles(candidate, environment).max() < 0]
    cells_of: dict[int, dict[Cell, float]] = {number: {} for number in able}
    if able:
        continuous, alone = schedules(candidates[0].subject.task)
        of_all = steady(noise or HUMAN_NOISE[candidates[0].subject.task]) if noisy else None
        for protocol, own_seeds in ((continuous, seeds), (alone, seeds[:1])):
            forces = protocol.given_forces()
            people = [candidates[number].person for number in able]
            trials = [
                [
                    replace(trial, noise=of_all)
                    for seed in own_seeds
                    for trial in protocol.trials(person, forces, seed, 0)
                ]
                for person in people
            ]
            measured = cells_of_trials(trials, environment, engine=engine, **options)
            for number, cells in zip(able, measured, strict=True):
                cells_of[number].update(cells)
    needed = _cells(candidates[0].subject.task, CALIBRATED + HELD_OUT)
    return [
        cells_of[number] if number in cells_of and cells_of[number].keys() >= needed.keys() else None
        for number in range(len(candidates))
    ]


def poles(candidate: Candidate, environment: Environment) -> Array:
    """Largest real part over the linear arms between which the candidate works, per condition [1/s], (condition,)."""
    return np.array(
        [
            max(largest_real_pole(arm, environment) for arm in condition.subject_of(candidate.person).linear_arms)
            for protocol in schedules(candidate.subject.task)
            for condition in protocol.conditions
        ]
    )


def _cells(task: str, tables: Sequence[str]) -> dict[Cell, MeanSD]:
    """Published cells of some tables and a task, in the order of the tables; force is given, and so none of them."""
    return {
        cell: value
        for cell, value in published_cells().items()
        if cell.table in tables and cell.condition.startswith(task) and cell.quantity != "rms_force"
    }


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Calibration(Result):
    """The average person in one task under one law.

    Attributes:
      task: "PT" or "RT".
      law: of `LAWS`.
      values: of the unknowns, by name.
      candidate: the person.
      objective: at the end of the search [-].
      converged: whether the search ended at a minimum, and not because its steps were used up.
      cells: of the person, on multisines that the search did not see, SI.
    """

    task: str
    law: str
    values: Mapping[str, float]
    candidate: Candidate
    objective: float
    converged: bool
    cells: Mapping[Cell, float]

    def deviations(self, tables: Sequence[str]) -> dict[Cell, float]:
        """Cells of some tables to their deviation from the published mean in published standard deviations [-]."""
        return {
            cell: (self.cells[cell] - published.mean) / published.sd
            for cell, published in _cells(self.task, tables).items()
        }

    def agreement(self) -> list[dict[str, Any]]:
        """How near the calibrated cells are to the published ones, and those that were held out; a row each."""
        rows = []
        for kind, tables in (("calibrated", CALIBRATED), ("held out", HELD_OUT)):
            deviation = np.abs(list(self.deviations(tables).values()))
            rows.append(
                {
                    "law": self.law,
                    "task": self.task,
                    "cells": kind,
                    "n": len(deviation),
                    **{f"within_{limit:g}_sd": float(np.mean(deviation <= limit)) for limit in LIMITS},
                    "rms_deviation": float(np.sqrt(np.mean(deviation**2))),
                    "unknowns": len(self.values),
                    "objective": self.objective,
                }
            )
        return rows

    def describe(self) -> Description:
        """How near its cells are to the published ones, and its values."""
        return Description(
            title=f"Average person in {self.task}, {self.law} law: {len(self.values)} unknowns, objective "
            f"{self.objective:.4g}",
            facts=tuple(
                f"{row['n']} cells {row['cells']}: {row['within_0.5_sd']:.0%} within 0.5, {row['within_1_sd']:.0%} "
                f"within 1, {row['within_2_sd']:.0%} within 2 SD; RMS {row['rms_deviation']:.2f} SD"
                for row in self.agreement()
            ),
            table=Table(("unknown", "value"), tuple((name, f"{value:.4g}") for name, value in self.values.items())),
            remarks=() if self.converged else ("the search used up its steps before a minimum; expected more of them",),
        )

    def to_frame(self) -> pd.DataFrame:
        """One row per published cell, beside that of the person."""
        published = _cells(self.task, CALIBRATED + HELD_OUT)
        rows = [
            {
                **cell._asdict(),
                "calibrated": cell.table in CALIBRATED,
                "published_mean": published[cell].mean,
                "published_sd": published[cell].sd,
                "ours": self.cells[cell],
                "z": deviation,
            }
            for cell, deviation in self.deviations(CALIBRATED + HELD_OUT).items()
        ]
        return pd.DataFrame(rows)

    def plot(self, figure: "Figure | None" = None) -> Any:
        """Draw how far each cell is from the published one, in published SDs, one row per table.

        Args:
          figure: where to draw; its height is set. None makes a new one of pyplot.

        Returns:
          Matplotlib axes, a single one.
        """
        from armperturb.plots.scores import plot_scores

        return plot_scores(self.to_frame(), LIMITS, figure)


def calibrate(
    task: str,
    law: str = "full",
    *,
    seed: int = 0,
    n_multisines: int = 6,
    max_iterations: int = 20,
    n_threads: int = 0,
    noise: HumanNoise | None = None,
    environment: Environment | None = None,
    engine: str = "compiled",
    progress: Callable[[str], object] | None = None,
) -> Calibration:
    """Find the average person of a task.

    Args:
      task: "PT" or "RT".
      law: of `LAWS`.
      seed: of the multisines; those of the final judgement are others.
      n_multisines: sets of multisines that the search sees.
      max_iterations: of the search.
      n_threads: 0 takes all cores; no effect on the result.
      noise: of the people whom the cells are compared with; that of all people in the task if not given.
      environment: what the hand holds; the thesis's manipulator if not given.
      engine: what simulates the candidates, see `run_experiment`.
      progress: called with a line per evaluation.

    Raises:
      TypeError: a number is none.
      ValueError: task, law or engine is unknown, or a number out of its range.
      RuntimeError: what the literature makes likely cannot be simulated.
    """
    sought = unknowns(task, law)
    require_number("calibrate", "seed", seed, at_least=0)
    require_number("calibrate", "n_multisines", n_multisines, at_least=1, at_most=MOST)
    require_number("calibrate", "max_iterations", max_iterations, at_least=1, at_most=MOST)
    require_one_of("calibrate", "engine", engine, ENGINES)
    environment = environment or Environment()
    simulate = partial(simulated_cells, noise=noise, environment=environment, engine=engine, n_threads=n_threads)
    search = _Search(
        task=task,
        unknowns=sought,
        seeds=[SEEN + 1000 * seed + number for number in range(n_multisines)],
        environment=environment,
        simulate=simulate,
        progress=progress or (lambda line: None),
    )
    start = np.array([np.log(u.start / u.typical) / np.log(u.factor) for u in sought])
    if search.residuals([start])[0] is None:
        raise RuntimeError(f"calibrate: the typical person in {task} is unstable or leaves the workspace")
    ends: dict[str, Any] = {"ftol": TOLERANCE, "xtol": 1e-3, "gtol": None, "max_nfev": max_iterations}
    solution = optimize.least_squares(
        search.residuals_at, start, jac=search.slopes, bounds=(-WIDEST, WIDEST), x_scale=1.0, **ends
    )
    values = search.values(solution.x)
    candidate = Candidate.of(task, values)
    unseen = [UNSEEN + 1000 * seed + number for number in range(N_UNSEEN)]
    cells = simulate([candidate], unseen)[0]
    if cells is None:
        raise RuntimeError(f"calibrate: the average person in {task} leaves the workspace on multisines not seen")
    return Calibration(
        task=task,
        law=law,
        values=values,
        candidate=candidate,
        objective=2.0 * solution.cost,
        converged=solution.status > 0,
        cells=cells,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """Residuals and slopes over points: the unknowns' logarithms relative to what is typical, over their factors'."""

    task: str
    unknowns: tuple[Unknown, ...]
    seeds: Sequence[int]
    environment: Environment
    simulate: Callable[[Sequence[Candidate], Sequence[int]], list[dict[Cell, float] | None]]
    progress: Callable[[str], object]

    def values(self, point: Array) -> dict[str, float]:
        """Unknowns by name."""
        return {
            unknown.name: float(unknown.typical * unknown.factor**step)
            for unknown, step in zip(self.unknowns, point, strict=True)
        }

    @property
    def n_residuals(self) -> int:
        """Cells, unknowns and conditions."""
        n_conditions = sum(len(protocol.conditions) for protocol in schedules(self.task))
        return len(_cells(self.task, CALIBRATED)) + len(self.unknowns) + n_conditions

    def residuals(self, points: Sequence[Array]) -> list[Array | None]:
        """Deviations of cells, unknowns and poles, in standard deviations; None where nothing can be simulated."""
        candidates = [Candidate.of(self.task, self.values(point)) for point in points]
        answers = self.simulate(candidates, self.seeds)
        wanted = _cells(self.task, CALIBRATED)
        residuals: list[Array | None] = []
        for candidate, cells, point in zip(candidates, answers, points, strict=True):
            if cells is None:
                residuals.append(None)
                continue
            deviations = [(cells[cell] - value.mean) / value.sd for cell, value in wanted.items()]
            too_far = np.maximum(poles(candidate, self.environment) + MARGIN, 0.0) / MARGIN_SD
            residuals.append(np.concatenate([deviations, point, too_far]))
        return residuals

    def residuals_at(self, point: Array) -> Array:
        """Residuals at a point; infinite where nothing can be simulated, so that the search turns back."""
        residuals = self.residuals([point])[0]
        if residuals is None:
            self.progress("unstable, or out of the workspace: a smaller step")
            return np.full(self.n_residuals, np.inf)
        self.progress(f"objective {np.sum(residuals**2):.2f}")
        return residuals

    def slopes(self, point: Array) -> Array:
        """Slopes of the residuals, by differences towards the stable side."""
        steps = np.array([(-1.0 if u.slope_down else 1.0) * SLOPE_STEP / np.log(u.factor) for u in self.unknowns])
        steps = np.where(np.abs(point + steps) > WIDEST, -steps, steps)
        here, *there = self.residuals([point, *(point + np.diag(steps))])
        assert here is not None
        slopes = np.zeros((len(here), len(point)))
        for number, (step, answer) in enumerate(zip(steps, there, strict=True)):
            if answer is not None:
                slopes[:, number] = (answer - here) / step
        return slopes


def save_calibrations(path: str | Path, calibrations: Sequence[Calibration]) -> None:
    """Write the average person, its cells, and how well it and the persons of other laws fit, to a TOML file.

    The person is that of the full law, as `armperturb.cohort.average_person` reads it.

    Args:
      path: of the file.
      calibrations: of both tasks under the full law, and of other laws to compare.

    Raises:
      ValueError: the full law is missing in a task.
      OSError: the file cannot be written.
    """
    full = {calibration.task: calibration for calibration in calibrations if calibration.law == "full"}
    for task in TASKS:
        if task not in full:
            raise ValueError(f"calibrations: none of the full law in {task}; expected one per task")
    person = {task: replace(full[task].candidate.subject, name="average").to_dict() for task in TASKS}
    levels = {name: level for calibration in full.values() for name, level in calibration.candidate.levels.items()}
    document = {
        "calibrated": list(CALIBRATED),
        "held_out": list(HELD_OUT),
        **person,
        "levels": levels,
        "summary": [row for calibration in calibrations for row in calibration.agreement()],
        "cells": [row for calibration in full.values() for row in calibration.to_frame().to_dict("records")],
    }
    write_whole(path, tomli_w.dumps(_rounded(document)))


def _rounded(value: Any) -> Any:
    """Seven digits: more say nothing, and differ between machines."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value
