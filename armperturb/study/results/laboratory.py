"""What is known of a study whose recordings nobody says how they were made, as of a laboratory's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from armperturb.perturbations.perturbation import LARGEST_RMS_DISPLACEMENT
from armperturb.recording_files import load_recording
from armperturb.study.protocol import THESIS, Condition, Protocol
from armperturb.study.results.cases import Case
from armperturb.study.results.quantities import is_faint
from armperturb.study.results.recordings import with_pulse_labels
from armperturb.subject import TASKS

STILL = 1e-6
"""RMS displacement that stands for a handle that does not move [m], as a multisine has to move it."""


@dataclass
class _Seen:
    """What trials of a condition show.

    Attributes:
      task: of all of them; empty before the first.
      n_trials: of all people.
      levels: of their pulses, without sign [-].
      unlabelled: whether the recordings do not say the level or the direction of a pulse.
      movements: mean square displacement per axis under each multisine, until its pulse [m^2].
    """

    task: str = ""
    n_trials: int = 0
    levels: set[float] = field(default_factory=set)
    unlabelled: bool = False
    movements: list[float] = field(default_factory=list)

    def add(self, trial: xr.Dataset, path: Path, largest: float) -> None:
        """Count a trial, as recorded.

        Args:
          trial: alone.
          path: of its recording.
          largest: range of the perturbation over all trials of that recording [N].

        Raises:
          ValueError: its task is not that of the condition.
        """
        name, task = str(trial["condition"].values), str(trial["task"].values)
        self.task = self.task or next((each.task for each in THESIS.conditions if each.name == name), task)
        if task != self.task:
            raise ValueError(
                f"{path}: task = {task!r} in condition {name}; expected {self.task!r} (labels.task of the sidecar, or "
                "another labels.condition)"
            )
        self.n_trials += 1
        labels = "pulse_onset", "pulse_level", "pulse_direction"
        onset, level, direction = (float(trial[key].values) for key in labels)
        if has_pulse := bool(np.isfinite(onset)):
            known = np.isfinite(level) and level != 0.0
            self.levels.add(abs(level) if known else 1.0)
            self.unlabelled |= not (known and np.isfinite(direction))
        end = round(onset * float(trial.attrs["rate"])) if has_pulse else trial.sizes["time"]
        force = trial["perturbation"].values
        if not is_faint(force[:end], largest):
            self.movements.append(float(np.mean(trial["displacement"].values[:end] ** 2)))

    def pulse_levels(self, known: Condition) -> tuple[float, ...]:
        """Those that were recorded; without any, those of a condition that has to have some."""
        return tuple(sorted(self.levels)) or (() if known.has_multisine else known.pulse_levels)

    def condition(self, name: str) -> Condition:
        """A condition that the thesis lacks."""
        moved = math.sqrt(np.mean(self.movements)) if self.movements else 0.0
        return Condition(
            name=name,
            task=self.task,
            rms_displacement=min(max(moved, STILL), LARGEST_RMS_DISPLACEMENT) if self.movements else 0.0,
            pulse_levels=tuple(sorted(self.levels)),
        )


def recorded_protocol(root: Path, paths: Sequence[Path], missing: list[str]) -> tuple[Protocol, dict[str, int]]:
    """Conditions that recordings of an unknown study hold, and how many trials of each.

    Those with a name of the thesis are the thesis's; of all others the trials show whether there is a multisine. Levels
    and directions of pulses are those that were recorded.

    Args:
      root: the folder.
      paths: its recordings, at least one.
      missing: takes what is assumed, and what is left out, one line each.

    Raises:
      ValueError: a condition is of two tasks, or nothing perturbs the handle in any.
    """
    seen: dict[str, _Seen] = {}
    directions = set[float]()
    for path in paths:
        recording = load_recording(path, [])
        largest = float(np.ptp(recording["perturbation"].values, axis=1).max(initial=0.0))
        for trial, name in enumerate(recording["condition"].values.tolist()):
            seen.setdefault(name, _Seen()).add(recording.isel(trial=trial), path, largest)
        pulsed = with_pulse_labels(recording)["pulse_direction"].values[np.isfinite(recording["pulse_onset"].values)]
        directions.update(round(float(each), 1) % 360.0 for each in pulsed[np.isfinite(pulsed)])
    of_thesis = [condition for condition in THESIS.conditions if condition.name in seen]
    others = {name: trials for name, trials in seen.items() if name not in {each.name for each in of_thesis}}
    at_rest = [name for name, trials in others.items() if not trials.movements and not trials.levels]
    foreign = [trials.condition(name) for name, trials in others.items() if name not in at_rest]
    conditions = (
        *(replace(each, pulse_levels=seen[each.name].pulse_levels(each)) for each in of_thesis),
        *sorted(foreign, key=lambda each: (TASKS.index(each.task), not each.has_multisine, each.rms_displacement)),
    )
    if not conditions:
        raise ValueError(
            f"{root}: no manifest.json, and nothing perturbs the handle in condition {', '.join(at_rest)}; expected "
            "the folder of a study, or trials with a perturbation"
        )
    assumed = "conditions of the thesis's names are the thesis's" if of_thesis else ""
    shown = f"{', '.join(each.name for each in foreign)} are as their trials show" if foreign else ""
    missing.append("how the recordings were made is not known: " + "; ".join(part for part in (assumed, shown) if part))
    if unlabelled := [condition.name for condition in conditions if seen[condition.name].unlabelled]:
        missing.append(
            "pulses that have no level (pulse_level) count as level 1, those without a pulse_direction have that of "
            f"their largest force: {', '.join(unlabelled)}"
        )
    if at_rest:
        missing.append(f"conditions in which nothing perturbs the handle are left out: {', '.join(at_rest)}")
    unit = THESIS.pulse_unit_condition
    protocol = replace(
        THESIS,
        conditions=conditions,
        pulse_unit_condition=unit if unit in seen else "",
        pulse_directions_deg=tuple(sorted(directions)) or THESIS.pulse_directions_deg,
    )
    return protocol, {condition.name: seen[condition.name].n_trials for condition in conditions}


def as_measured(protocol: Protocol, cases: Sequence[Case]) -> tuple[Protocol, tuple[Case, ...]]:
    """Conditions with the RMS displacement that people reached, as nobody knows what was intended.

    Args:
      protocol: as `recorded_protocol` has it.
      cases: of all people.
    """
    reached: dict[str, list[float]] = {}
    for case in cases:
        if 0.0 < case.displacement <= LARGEST_RMS_DISPLACEMENT:  # what a condition may have
            reached.setdefault(case.condition.name, []).append(case.displacement)
    changed = {
        condition.name: replace(condition, rms_displacement=float(np.mean(reached[condition.name])), reached=1.0)
        for condition in protocol.conditions
        if condition.has_multisine and condition.name in reached
    }
    conditions = tuple(changed.get(condition.name, condition) for condition in protocol.conditions)
    return replace(protocol, conditions=conditions), tuple(
        replace(case, condition=changed.get(case.condition.name, case.condition)) for case in cases
    )
