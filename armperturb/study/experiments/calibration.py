"""Calibration: the average person whose muscles yield as those of the thesis's people did (docs/calibration.md).

The objective, in the unknowns' logarithms: squared deviations of the calibrated cells from their published means, in
published standard deviations, plus squared deviations of the unknowns from what is typical, in the factors that the
literature leaves open, plus how much nearer to instability than others the person is. The average person, noisy as
people are, is simulated under the published mean forces; nothing else of the thesis is seen. The objective is minimised
by trust regions (Gauss-Newton); all slopes of an iteration are one batch.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from scipy import optimize

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.measures.pulse import WINDOWS
from armperturb.arrays import Array
from armperturb.cohort import STABILITY_MARGIN, Person, average_body
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.files import written_whole
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations.multisine import PERIOD
from armperturb.study.protocol import THESIS, Protocol, with_published_forces
from armperturb.study.published.tables import MeanSD
from armperturb.study.results.quantities import Cell, measured_cells, published_cells
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from armperturb.validation import require_number

CALIBRATED = ("2.1", "F.2", "F.3", "F.4")
"""Tables that the calibration sees."""

HELD_OUT = ("F.5", "F.6")
"""Tables of the same kind that it does not see."""

STEP = 2.5e-3
"""Of the simulation [s]; cells differ by less than 0.1 % from those at 1 ms."""

SLOPE_STEP = 0.03
"""Of the logarithm of an unknown, for slopes."""

WIDEST = 3.0
"""Unknowns stay within this many of their factors [-]."""

MARGIN = STABILITY_MARGIN
"""Poles of the linear arms between which a candidate works should lie left of minus this [1/s], as those of drawn
people do. A condition in which one lies to the right of it adds to the objective."""

MARGIN_SD = 0.25
"""How far to the right counts as one standard deviation [1/s]."""

TOLERANCE = 5e-3
"""The search ends when an iteration lowers the objective by less than this share."""

PARTS = 8
"""Elasto-plastic parts per element."""

_STEADY = {
    task: replace(noise, spread_b=0.0, spread_k=0.0, spread_kv=0.0, spread_kp=0.0)
    for task, noise in HUMAN_NOISE.items()
}
"""People's noise, but no change of their muscles from trial to trial: draws that jump would hide slopes."""

SEEN, UNSEEN = 500, 900
"""First seeds of the multisines of the search, and of those on which its result is judged."""

N_UNSEEN = 6
"""Sets of multisines on which the result is judged."""


class Unknown(NamedTuple):
    """What is calibrated.

    Attributes:
      name: in a person's dictionary of unknowns.
      typical: value that the literature makes likely.
      factor: one standard deviation of it, as a factor.
      start: where the search starts; people with typical values of everything may be unstable.
      slope_down: whether slopes are taken towards smaller values, as larger ones may be unstable.
    """

    name: str
    typical: float
    factor: float
    start: float
    slope_down: bool = False


_SHORT_RANGE = ("S_s", "S_se", "S_e", "L", "c")
_REST = ("A", "T", "w", "w_s")

LAWS: dict[str, tuple[str, ...]] = {
    "linear": (),
    "short-range": _SHORT_RANGE,
    "full": _SHORT_RANGE + _REST,
}
"""Laws to compare: name to the unknowns that they have beside those of the linear arm."""

_TYPICAL: dict[str, tuple[Unknown, ...]] = {
    "RT": (
        Unknown("k_s", 2.0, 2.0, start=2.38),
        Unknown("k_se", 1.0, 2.0, start=0.772),
        Unknown("k_e", 2.0, 2.0, start=1.38),
        Unknown("b_s", 0.75, 2.0, start=0.885),
        Unknown("b_se", 1.4, 2.0, start=1.33),
        Unknown("b_e", 0.5, 2.0, start=0.46),
        Unknown("S_s", 11.0, 2.5, start=15.9),
        Unknown("S_se", 11.0, 2.5, start=15.7),
        Unknown("S_e", 11.0, 2.5, start=9.83),
        Unknown("L", 0.7, 2.5, start=0.805),
        Unknown("c", 0.5, 2.0, start=0.463),
        Unknown("A", 30.0, 2.7, start=29.1),
        Unknown("T", 1.7, 3.3, start=1.39),
        Unknown("w", 0.13, 2.2, start=0.115),
    ),
    "PT": (
        Unknown("k_s", 30.0, 2.2, start=44.6),
        Unknown("k_se", 60.0, 2.2, start=23.7),
        Unknown("k_e", 50.0, 2.2, start=37.2),
        Unknown("b_s", 2.5, 2.7, start=2.33),
        Unknown("b_se", 3.0, 2.7, start=1.38),
        Unknown("b_e", 4.0, 2.7, start=4.95),
        Unknown("kv_s", 5.0, 2.2, start=2.95),
        Unknown("kv_se", 12.0, 2.2, start=12.5),
        Unknown("kv_e", 10.0, 2.2, start=4.03),
        Unknown("kp_s", 5.0, 2.7, start=5.92),
        Unknown("kp_se", 15.0, 2.7, start=19.3),
        Unknown("kp_e", 15.0, 2.7, start=10.4),
        Unknown("S_s", 40.0, 2.2, start=41.9),
        Unknown("S_se", 60.0, 2.2, start=75.2),
        Unknown("S_e", 40.0, 2.2, start=29.6),
        Unknown("L", 0.8, 1.8, start=1.47),
        Unknown("c", 0.5, 2.0, start=0.43),
        Unknown("A", 40.0, 2.7, start=42.5),
        Unknown("T", 1.7, 2.7, start=1.82),
        Unknown("w", 1.5, 2.7, start=1.24),
        Unknown("w_s", 1.5, 2.7, start=1.1),
        Unknown("level PT0", 0.5, 1.6, start=0.395, slope_down=True),
        Unknown("level PT2.5", 0.5, 1.6, start=0.628, slope_down=True),
        Unknown("level PT22.5", 1.5, 1.4, start=1.61, slope_down=True),
    ),
}


def unknowns(task: str, law: str) -> tuple[Unknown, ...]:
    """What is calibrated of a law in a task.

    Raises:
      ValueError: the task or the law is unknown.
    """
    if task not in TASKS:
        raise ValueError(f"calibrate: task = {task!r}; expected one of {', '.join(TASKS)}")
    if law not in LAWS:
        raise ValueError(f"calibrate: law = {law!r}; expected one of {', '.join(LAWS)}")
    left_out = set(LAWS["full"]) - set(LAWS[law])
    return tuple(unknown for unknown in _TYPICAL[task] if unknown.name not in left_out)


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An average person in one task.

    Attributes:
      subject: at level 1.
      levels: condition to the level of co-contraction [-]; 1 where it is not named.
    """

    subject: Subject
    levels: Mapping[str, float]

    @classmethod
    def of(cls, task: str, values: Mapping[str, float]) -> "Candidate":
        """The candidate with these values of the unknowns (by name)."""

        def groups(quantity: str) -> dict[str, float]:
            s, se, e = (values[f"{quantity}_{joint}"] for joint in ("s", "se", "e"))
            return {f"{quantity}_s": s + se, f"{quantity}_se": se, f"{quantity}_e": e + se}

        changes: dict[str, Any] = {**average_body(), **groups("k"), **groups("b")}
        if task == "PT":
            changes.update(**groups("kv"), **groups("kp"))
        law: dict[str, Any] = {}
        if "L" in values:
            law.update(
                short_range_stiffness=(values["S_s"], values["S_se"], values["S_e"]),
                elastic_limit_deg=values["L"],
                elastic_limit_spread=values["c"],
                parts=PARTS,
            )
        if "A" in values:
            law.update(loss_angle_deg=values["A"], recovery_time=values["T"], thinning_velocity=values["w"])
        if "w_s" in values:
            law.update(spindle_saturation=values["w_s"])
        start = POSITION if task == "PT" else RELAX
        subject = replace(start, **changes, muscle=MuscleLaw(**law) if law else None)
        levels = {name.split()[1]: value for name, value in values.items() if name.startswith("level ")}
        return cls(subject=subject, levels=levels)

    @property
    def person(self) -> Person:
        """The candidate as somebody who can go through a protocol."""
        return Person(
            name=self.subject.name,
            height=1.0,
            mass=1.0,
            subjects={self.subject.task: self.subject},
            levels=dict(self.levels),
        )


def schedules(task: str) -> tuple[Protocol, Protocol]:
    """The task's conditions with multisines and those without, each as long as the cells see of it.

    Every condition with a multisine has four trials per seed.
    """
    after = WINDOWS[task] + 0.1
    both = []
    for with_multisine, onset in ((True, WINDOW_START + PERIOD), (False, 0.5)):
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
    environment: Environment | None = None,
    n_threads: int = 0,
    progress: Callable[[float], object] | None = None,
) -> list[dict[Cell, float] | None]:
    """Cells of several candidates of one task, side by side and under the same multisines.

    Args:
      candidates: who is perturbed by the published mean forces, noisy as people are but the same in every trial.
      seeds: of the multisines; each adds four trials to every condition that has one.
      environment: what the hand holds; the thesis's manipulator if not given.
      n_threads: 0 takes all cores.
      progress: called with the simulated seconds since the last call.

    Returns:
      Per candidate its cells, SI; None for one that is unstable or leaves the workspace.
    """
    environment = environment or Environment()
    able = [number for number, candidate in enumerate(candidates) if poles(candidate, environment).max() < 0]
    found: dict[int, dict[Cell, float]] = {number: {} for number in able}
    if able:
        continuous, alone = schedules(candidates[0].subject.task)
        for protocol, own_seeds in ((continuous, seeds), (alone, seeds[:1])):
            forces = protocol.given_forces()
            people = [candidates[number].person for number in able]
            trials = [
                [
                    replace(trial, noise=_STEADY[trial.subject.task])
                    for seed in own_seeds
                    for trial in protocol.trials(person, forces, seed, 0)
                ]
                for person in people
            ]
            recording = run_experiment(
                [trial for own in trials for trial in own],
                environment,
                timestep=STEP,
                n_threads=n_threads,
                progress=progress,
            )
            n_own = len(trials[0])
            for place, number in enumerate(able):
                found[number].update(measured_cells(recording.isel(trial=slice(place * n_own, (place + 1) * n_own))))
    needed = _cells(candidates[0].subject.task, CALIBRATED + HELD_OUT)
    return [
        found[number] if number in found and found[number].keys() >= needed.keys() else None
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


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """The average person in one task under one law.

    Attributes:
      task: "PT" or "RT".
      law: of `LAWS`.
      values: of the unknowns, by name.
      candidate: the person.
      objective: at the end of the search [-].
      cells: of the person, on multisines that the search did not see, SI.
    """

    task: str
    law: str
    values: Mapping[str, float]
    candidate: Candidate
    objective: float
    cells: Mapping[Cell, float]

    def deviations(self, tables: Sequence[str]) -> dict[Cell, float]:
        """Cells of some tables to their deviation from the published mean in published standard deviations [-]."""
        return {
            cell: (self.cells[cell] - published.mean) / published.sd
            for cell, published in _cells(self.task, tables).items()
        }

    def rows(self) -> list[dict[str, Any]]:
        """All cells as rows of a table."""
        published = _cells(self.task, CALIBRATED + HELD_OUT)
        return [
            {
                "table": cell.table,
                "condition": cell.condition,
                "quantity": cell.quantity,
                "calibrated": cell.table in CALIBRATED,
                "published_mean": published[cell].mean,
                "published_sd": published[cell].sd,
                "ours": self.cells[cell],
                "z": deviation,
            }
            for cell, deviation in self.deviations(CALIBRATED + HELD_OUT).items()
        ]


def calibrate(
    task: str,
    law: str = "full",
    *,
    seed: int = 0,
    n_multisines: int = 1,
    max_iterations: int = 20,
    n_threads: int = 0,
    environment: Environment | None = None,
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
      environment: what the hand holds; the thesis's manipulator if not given.
      progress: called with a line per evaluation.

    Raises:
      TypeError: a number is none.
      ValueError: task or law is unknown, or a number out of its range.
      RuntimeError: what the literature makes likely cannot be simulated.
    """
    sought = unknowns(task, law)
    require_number("calibrate", "seed", seed, at_least=0)
    require_number("calibrate", "n_multisines", n_multisines, at_least=1)
    require_number("calibrate", "max_iterations", max_iterations, at_least=1)
    search = _Search(
        task=task,
        unknowns=sought,
        seeds=[SEEN + 1000 * seed + number for number in range(n_multisines)],
        environment=environment or Environment(),
        n_threads=n_threads,
        progress=progress or (lambda line: None),
    )
    start = np.array([np.log(u.start / u.typical) / np.log(u.factor) for u in sought])
    if search.residuals([start])[0] is None:
        raise RuntimeError(f"calibrate: the typical person in {task} is unstable or leaves the workspace")
    solution = optimize.least_squares(
        search.one,
        start,
        jac=search.slopes,
        bounds=(-WIDEST, WIDEST),
        x_scale=1.0,
        ftol=TOLERANCE,
        xtol=1e-3,
        gtol=None,
        max_nfev=max_iterations,
    )
    values = search.values(solution.x)
    candidate = Candidate.of(task, values)
    unseen = [UNSEEN + 1000 * seed + number for number in range(N_UNSEEN)]
    cells = simulated_cells([candidate], unseen, environment=environment, n_threads=n_threads)[0]
    if cells is None:
        raise RuntimeError(f"calibrate: the average person in {task} leaves the workspace on multisines not seen")
    return Calibration(
        task=task, law=law, values=values, candidate=candidate, objective=2.0 * solution.cost, cells=cells
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """Residuals and slopes over points: the unknowns' logarithms relative to what is typical, over their factors'."""

    task: str
    unknowns: tuple[Unknown, ...]
    seeds: Sequence[int]
    environment: Environment
    n_threads: int
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
        answers = simulated_cells(candidates, self.seeds, environment=self.environment, n_threads=self.n_threads)
        wanted = _cells(self.task, CALIBRATED)
        found: list[Array | None] = []
        for candidate, cells, point in zip(candidates, answers, points, strict=True):
            if cells is None:
                found.append(None)
                continue
            deviations = [(cells[cell] - value.mean) / value.sd for cell, value in wanted.items()]
            too_far = np.maximum(poles(candidate, self.environment) + MARGIN, 0.0) / MARGIN_SD
            found.append(np.concatenate([deviations, point, too_far]))
        return found

    def one(self, point: Array) -> Array:
        """Residuals at a point; infinite where nothing can be simulated, so that the search turns back."""
        found = self.residuals([point])[0]
        if found is None:
            self.progress("unstable, or out of the workspace: a smaller step")
            return np.full(self.n_residuals, np.inf)
        self.progress(f"objective {np.sum(found**2):.2f}")
        return found

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


def summary(calibrations: Sequence[Calibration]) -> list[dict[str, Any]]:
    """Per law, task and kind of table: shares of cells within 0.5, 1 and 2 published SDs [-] and RMS deviation [SD]."""
    rows = []
    for found in calibrations:
        for kind, tables in (("calibrated", CALIBRATED), ("held out", HELD_OUT)):
            deviation = np.abs(list(found.deviations(tables).values()))
            rows.append(
                {
                    "law": found.law,
                    "task": found.task,
                    "cells": kind,
                    "n": len(deviation),
                    **{f"within_{limit:g}_sd": float(np.mean(deviation <= limit)) for limit in (0.5, 1.0, 2.0)},
                    "rms_deviation": float(np.sqrt(np.mean(deviation**2))),
                    "unknowns": len(found.values),
                    "objective": found.objective,
                }
            )
    return rows


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
    full = {found.task: found for found in calibrations if found.law == "full"}
    for task in TASKS:
        if task not in full:
            raise ValueError(f"calibrations: none of the full law in {task}; expected one per task")
    person = {task: replace(full[task].candidate.subject, name="average").to_dict() for task in TASKS}
    levels = {name: level for found in full.values() for name, level in found.candidate.levels.items()}
    document = {
        "calibrated": list(CALIBRATED),
        "held_out": list(HELD_OUT),
        **person,
        "levels": levels,
        "summary": summary(calibrations),
        "cells": [row for found in full.values() for row in found.rows()],
    }
    with written_whole(path) as temporary:
        temporary.write_text(tomli_w.dumps(_rounded(document)), encoding="utf-8")


def _rounded(value: Any) -> Any:
    """Seven digits: more say nothing, and differ between machines."""
    if isinstance(value, dict):
        return {key: _rounded(own) for key, own in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(own) for own in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value
