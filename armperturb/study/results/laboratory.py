"""What is known of a study whose recordings nobody says how they were made, as of a laboratory's."""

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from armperturb.perturbations.perturbation import LARGEST_RMS_DISPLACEMENT
from armperturb.recording_files import load_recording
from armperturb.study.protocol import THESIS, Protocol
from armperturb.study.results.cases import Case


def recorded_protocol(root: Path, paths: Sequence[Path], missing: list[str]) -> tuple[Protocol, dict[str, int]]:
    """Conditions of the thesis that recordings of an unknown study hold, and how many trials of each.

    Levels and directions of pulses are those that were recorded.

    Args:
      root: the folder.
      paths: its recordings, at least one.
      missing: takes what is assumed, and what is left out, one line each.

    Raises:
      ValueError: there are none of these conditions.
    """
    counts, levels, directions = Counter[str](), dict[str, set[float]](), set[float]()
    for path in paths:
        recording = load_recording(path, [])
        _require_tasks(path, recording)
        names, pulsed = recording["condition"].values.tolist(), np.isfinite(recording["pulse_onset"].values)
        counts.update(names)
        given = zip(names, recording["pulse_level"].values, recording["pulse_direction"].values, pulsed, strict=True)
        for name, level, direction, has_pulse in given:
            if has_pulse and abs(level) > 0.0:
                levels.setdefault(name, set()).add(abs(float(level)))
            if has_pulse and np.isfinite(direction):
                directions.add(round(float(direction), 1) % 360.0)
    conditions = tuple(
        replace(condition, pulse_levels=tuple(sorted(levels[condition.name])))
        if condition.name in levels
        # One without a multisine cannot be without pulses.
        else replace(condition, pulse_levels=() if condition.has_multisine else condition.pulse_levels)
        for condition in THESIS.conditions
        if condition.name in counts
    )
    others = ", ".join(name for name in counts if name not in {condition.name for condition in conditions})
    if not conditions:
        raise ValueError(
            f"{root}: no manifest.json, and condition = {others}; expected the folder of a study, or conditions of the "
            f"thesis (recordings of a laboratory: {_command(paths[0])})"
        )
    missing.append("how the recordings were made is not known: conditions are those of the thesis of the same names")
    if others:
        missing.append(f"conditions that the thesis lacks are left out: {others}")
    unit = THESIS.pulse_unit_condition
    known = {condition.name for condition in conditions}
    protocol = replace(
        THESIS,
        conditions=conditions,
        pulse_unit_condition=unit if unit in known else "",
        pulse_directions_deg=tuple(sorted(directions)) or THESIS.pulse_directions_deg,
    )
    return protocol, {condition.name: counts[condition.name] for condition in conditions}


def _require_tasks(path: Path, recording: xr.Dataset) -> None:
    """Refuse trials whose task is not that of the condition of the thesis that they are called."""
    task_of = {condition.name: condition.task for condition in THESIS.conditions}
    for name, task in zip(recording["condition"].values.tolist(), recording["task"].values.tolist(), strict=True):
        if task != task_of.get(name, task):
            raise ValueError(
                f"{path}: task = {task!r} in condition {name}; expected {task_of[name]!r} (labels.task of the sidecar)"
            )


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


def _command(path: Path) -> str:
    """What identifies the condition of a recording that is perturbed for the longest time."""
    recording = load_recording(path, [])
    names, moves = recording["condition"].values, np.any(recording["perturbation"].values, axis=2).mean(axis=1)
    subject, condition = (str(each) for each in (recording["subject"].values[0], names[np.argmax(moves)]))
    chosen = " ".join(
        f"--{label} {shlex.quote(name)}" for label, name in (("subject", subject), ("condition", condition))
    )
    return f"armperturb identify {shlex.quote(str(path))} {chosen} --out DIR"
