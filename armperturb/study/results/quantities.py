"""Cells of the published tables that a person's recordings fill: tables 2.1 and F.2 to F.6.

| table | condition | quantity | unit |
|---|---|---|---|
| 2.1 | with a multisine | `rms_force`, `rms_displacement` | N, m |
| 2.1 | all | `peak_displacement_min`, `peak_displacement_max` | m |
| F.2 | with a multisine | `rms_velocity_s`, `max_velocity_s`, likewise `_e` | rad/s |
| F.3 | all | `peak_velocity_min_s`, `peak_velocity_max_s`, likewise `_e` | rad/s |
| F.4 | with a multisine | `rms_rotation_s`, `max_rotation_s`, likewise `_e` | rad |
| F.5 | all | `peak_rotation_min_s`, `peak_rotation_max_s`, likewise `_e` | rad |
| F.6 | two repetitions | `peak_rotation_left_s`, `peak_rotation_right_s`, likewise `_e` | rad |

Everything is taken from perturbation and displacement, joints by `armperturb.analysis.measures.kinematics`, and counted
from the start of the trial. The multisine is measured over the whole periods from `WINDOW_START` on (one, of the
thesis's), in which a person's RMS pools all trials, and of force and displacement both axes; largest values are means
over trials. Peaks are the largest values in the window of `armperturb.analysis.measures.pulse`, as means over the
trials that a cell pools: repetitions and all directions of a level (min 1, max 2), or repetitions and levels of a
direction. The thesis numbers levels with a sign, negative at 20 deg and positive at 200 deg from the x axis (note d of
table 2.1); a pulse to the right is one at 20 deg, as x points right, whatever the sign, one to the left at 200 deg, and
table F.6 has no other directions. The pulse unit of table 2.1 is no cell: it is ten times the force of PT7.5.

A condition that the thesis does not have fills cells likewise, of what was recorded: of a multisine if the handle is
perturbed in its window, and of each level of its pulses, by its number. So does a level that the thesis does not have
in one of its conditions, but for table F.6. No published value stands beside them.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import onset_samples
from armperturb.analysis.defaults import SETTLED, SETTLING, WINDOW_START
from armperturb.analysis.measures import kinematics
from armperturb.analysis.measures.pulse import peak_norm, pulse_span
from armperturb.analysis.numerics.periodicity import find_period
from armperturb.analysis.periods import settled_start
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array
from armperturb.copied_trials import without_copies
from armperturb.perturbations.multisine import PERIOD
from armperturb.recording import REQUIRED_SIGNALS, check_recording
from armperturb.study.published import tables as published
from armperturb.study.published.tables import MeanSD

JOINT_LETTERS = ("s", "e")
"""Shoulder and elbow, in the order of a recording."""

FAINT = 0.002
"""SD of the force before a pulse over the range of a recording's perturbation [-], up to which it is noise of the
instrument."""

LIMITS = (0.5, 1.0, 2.0)
"""Distances from the published mean within which cells are counted [published SD]."""

PULSE_LEVELS = {"min": 1.0, "max": 2.0}
"""Name of the thesis's pulse levels to the level [-]."""

DIRECTIONS = {"right": 20.0, "left": 200.0}
"""Name of the thesis's directions of pulses to the angle from the x axis [degree]."""

NEAR = 10.0
"""How far from these a pulse still has that direction [degree]."""


class Cell(NamedTuple):
    """A cell of a published table.

    Attributes:
      table: as printed, e.g. "F.2".
      condition: e.g. "PT7.5", or one of a protocol's own.
      quantity: what is measured, see the head of this module.
    """

    table: str
    condition: str
    quantity: str


class Measured(NamedTuple):
    """What a person's recordings fill.

    Attributes:
      cells: to the value of this person, SI.
      left_out: why trials, or parts of them, fill none; one line each.
    """

    cells: dict[Cell, float]
    left_out: tuple[str, ...]


def level_name(condition: str, level: float) -> str:
    """What a level of pulses is called in tables: "min" (1) or "max" (2) in conditions of the thesis, else the number.

    Args:
      condition: of the pulses.
      level: multiple of the unit.
    """
    names = PULSE_LEVELS if condition in published.conditions() else {}
    return next((name for name, value in names.items() if value == level), f"{level:g}")


@functools.cache
def published_cells() -> Mapping[Cell, MeanSD]:
    """All cells of tables 2.1 and F.2 to F.6, mean (SD) over the thesis's subjects, SI."""
    cells = {}
    for condition in published.conditions():
        if published.has_multisine(condition):
            cells[Cell("2.1", condition, "rms_force")] = published.applied_force(condition)
            cells[Cell("2.1", condition, "rms_displacement")] = published.rms_displacement(condition)
        for level in published.pulse_levels(condition):
            cells[Cell("2.1", condition, f"peak_displacement_{level}")] = published.peak_displacement(condition, level)
    for entry in published.joint_motions():
        pulse = "" if entry.pulse == "none" else f"_{entry.pulse}"
        cell = Cell(entry.table, entry.condition, f"{entry.quantity}{pulse}_{entry.joint}")
        cells[cell] = published.joint_motion(entry.condition, entry.joint, entry.quantity, entry.pulse)
    return MappingProxyType(cells)


def measured_cells(
    recording: xr.Dataset, *, window_start: float = WINDOW_START, period: float | None = None
) -> dict[Cell, float]:
    """Published cells that the recordings of one person fill, SI; `measure` also tells what is missing and why.

    Args:
      recording: trials of one person, of people or simulated, with or without instruments; conditions of the thesis
        that are missing give no cells.
      window_start: start of the multisine's window [s].
      period: of the multisine [s]; None to find it in each condition.

    Raises:
      ValueError: the recording is refused (see `check_recording`), or holds several people.
    """
    check_recording(recording)
    return measure(recording, window_start=window_start, period=period).cells


def measure(
    recording: xr.Dataset,
    *,
    window_start: float = WINDOW_START,
    period: float | None = None,
    simulated_joints: bool = False,
) -> Measured:
    """As `measured_cells`, with the reasons why trials, or parts of them, fill no cell.

    Args:
      recording: as there.
      window_start: as there.
      period: as there.
      simulated_joints: take the joints as the simulation has them, `joint_angle`, and not from the handle's path.

    Raises:
      ValueError: as there, or there are no simulated joints.
    """
    people = list(dict.fromkeys(recording["subject"].values.tolist()))
    if len(people) > 1:
        raise ValueError(f"recordings of {', '.join(map(str, people))}; expected those of one person")
    each_once = without_copies(recording)
    recording = each_once.recording
    inside, left_out = _cut_at_limits(recording[list(REQUIRED_SIGNALS)])
    left_out[:0] = each_once.remarks
    rotation = kinematics.true_rotations(recording) if simulated_joints else kinematics.joint_rotations(inside)
    rate = float(inside.attrs["rate"])
    path = _Path(inside, rate, rotation, kinematics.joint_velocities(rotation, rate))
    pools: dict[Cell, dict[str, list[float]]] = {}
    levels: dict[str, set[str]] = {}
    conditions = inside["condition"].values
    windows = {
        str(each): multisine_window(
            inside.isel(trial=conditions == each),
            window_start,
            period,
            may_be_earlier=each not in published.conditions(),
        )
        for each in dict.fromkeys(conditions.tolist())
    }
    largest = float(np.ptp(inside["perturbation"].values, axis=1).max(initial=0.0))
    for trial, condition in enumerate(conditions.tolist()):
        window = windows[condition]
        of_thesis = condition in published.conditions()
        has_pulse = not np.isnan(inside["pulse_onset"].values[trial])
        parts: list[Callable[[], Iterator[_Value]]] = []
        if published.has_multisine(condition) if of_thesis else _is_perturbed(inside, trial, window, largest):
            parts.append(partial(_multisine_values, path, trial, window))
        if has_pulse and not of_thesis:
            levels.setdefault(condition, set()).add(_level_of(inside, trial))
        if has_pulse:
            parts.append(partial(_pulse_values, path, trial))
        for part in parts:
            try:
                values = list(part())
            except ValueError as error:
                left_out.append(f"{error} ({_where(inside, trial)})")
                continue
            of_print = of_thesis and (not has_pulse or _level_of(inside, trial) in published.pulse_levels(condition))
            for cell, kind, value in values:
                if of_print and cell not in published_cells():
                    continue
                pools.setdefault(cell, {}).setdefault(kind, []).append(value)
    cells = {}
    for cell in dict.fromkeys((*published_cells(), *pools)):
        kinds = pools.get(cell, {})
        # Without one of its levels a cell would not mean what the thesis's does: a level more makes peaks larger.
        all_levels = levels.get(cell.condition, published.pulse_levels(cell.condition))
        missing = set(all_levels if cell.table == "F.6" else ()) - kinds.keys()
        if kinds and not missing:
            mean = float(np.mean([np.mean(values) for values in kinds.values()]))
            cells[cell] = math.sqrt(mean) if cell.quantity.startswith("rms") else mean
        elif kinds:
            left_out.append(f"{cell.table}, {cell.condition}, {cell.quantity}: no trial of level {', '.join(missing)}")
    return Measured(cells, tuple(left_out))


def _level_of(recording: xr.Dataset, trial: int) -> str:
    """Name of the level of a trial's pulse, whatever its sign."""
    return level_name(str(recording["condition"].values[trial]), abs(float(recording["pulse_level"].values[trial])))


def _where(recording: xr.Dataset, trial: int) -> str:
    """Condition of a trial, and the direction of its pulse if it has any."""
    direction = float(recording["pulse_direction"].values[trial])
    pulse = "" if math.isnan(direction) else f", pulse at {direction:g}°"
    return f"{recording['condition'].values[trial]}{pulse}"


_Value = tuple[Cell, str, float]
"""What a trial adds to a cell: its kind of pulse, which count alike, and the square of an RMS or a largest value."""


class _Path(NamedTuple):
    """A recording, its rate [Hz], and its joints' rotations [rad] and velocities [rad/s], (trial, time, joint)."""

    recording: xr.Dataset
    rate: float
    rotation: Array
    velocity: Array


def _cut_at_limits(recording: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    """Handles that stand still from where they met the workspace limit or left the arm's reach, as told in limit_time.

    Beyond it signals mean nothing, and joint angles may not exist.
    """
    lengths = (recording[name].values[:, None] for name in ("l_h", "l_f"))
    beyond = ~kinematics.within_reach(kinematics.hand_path(recording), *lengths)
    rate, limit_time = float(recording.attrs["rate"]), recording["limit_time"].values.astype(float)
    displacement = recording["displacement"].values.copy()
    left_out = []
    for trial in range(len(limit_time)):
        if beyond[trial].any():
            time = int(np.argmax(beyond[trial])) / rate
            if not limit_time[trial] <= time:
                where = _where(recording, trial)
                left_out.append(f"trial {trial}: the handle is out of the arm's reach at {time:.3f} s ({where})")
                limit_time[trial] = time
        if np.isfinite(limit_time[trial]):
            last = max(_first_sample_from(limit_time[trial], rate) - 1, 0)
            displacement[trial, last:] = displacement[trial, last]
    changed = recording.assign(
        displacement=(recording["displacement"].dims, displacement, recording["displacement"].attrs)
    )
    return changed.assign_coords(limit_time=("trial", limit_time)), left_out


def _first_sample_from(time: float, rate: float) -> int:
    """The first sample at a time or later.

    A time that was made as sample over rate is that sample's, whatever rounding makes of it: 3645 / 200 * 200 exceeds
    3645.
    """
    samples = time * rate
    return round(samples) if math.isclose(samples, round(samples), abs_tol=1e-6) else math.ceil(samples)


def multisine_window(
    recording: xr.Dataset,
    window_start: float = WINDOW_START,
    period: float | None = None,
    *,
    may_be_earlier: bool = False,
) -> slice:
    """Samples in which a condition's multisine is measured: whole periods, one at least.

    Args:
      recording: trials of one condition.
      window_start: where they begin [s].
      period: of the multisine [s]; None to find it. Where nothing repeats, it is the thesis's.
      may_be_earlier: whether they begin earlier where there is none from then on, see `whole_periods_start`; trials
        without any are measured whole.
    """
    rate, ends = float(recording.attrs["rate"]), onset_samples(recording)
    before = [d[:end] for d, end in zip(recording["perturbation"].values, ends, strict=True)]
    trials = [ConditionTrials.prepare(recording, is_checked=True)]
    if period is None:
        first = round(min(window_start, settled_start(trials, SETTLED)) * rate)
        try:
            period = find_period([d[first:] for d in before if len(d) > first + 1 and d[first:].any()], rate)
        except ValueError:
            period = PERIOD
    earlier = [settled_start(trials, each) for each in (SETTLING, SETTLED)] if may_be_earlier else []
    for start in (window_start, *(each for each in earlier if each < window_start)):
        first = round(start * rate)
        if (n_periods := int((ends.min() - first + 0.5) // (period * rate))) >= 1:
            return slice(first, first + round(n_periods * period * rate))
    if may_be_earlier:
        return slice(0, int(ends.min()))
    first = round(window_start * rate)
    return slice(first, first + round(period * rate))


def is_faint(force: Array, largest: float) -> bool:
    """Whether a force is noise of the instrument, or none.

    Args:
      force: before a pulse, or part of it [N], (time, axis).
      largest: range of the perturbation over all trials of the recording [N].
    """
    return len(force) == 0 or bool(force.std(axis=0).max() <= FAINT * largest)


def _is_perturbed(recording: xr.Dataset, trial: int, window: slice, largest: float) -> bool:
    """Whether the handle is perturbed in the multisine's window, before any pulse."""
    onset = float(recording["pulse_onset"].values[trial])
    end = window.stop if np.isnan(onset) else min(window.stop, round(onset * float(recording.attrs["rate"])))
    return not is_faint(recording["perturbation"].values[trial, window.start : end], largest)


def _multisine_values(path: _Path, trial: int, window: slice) -> Iterator[_Value]:
    recording = path.recording
    onset = float(recording["pulse_onset"].values[trial])
    end = recording.sizes["time"] if np.isnan(onset) else round(onset * path.rate)
    if window.stop > end:
        ends, expected = end / path.rate, window.stop / path.rate
        raise ValueError(f"trial {trial}: the multisine ends at {ends:g} s; expected {expected:g} s or more")
    limit = float(recording["limit_time"].values[trial])
    if limit * path.rate < window.stop:
        raise ValueError(
            f"trial {trial}: the workspace limit is reached at {limit:.3f} s, within the multisine's window"
        )
    condition = str(recording["condition"].values[trial])
    for name, signal in (("rms_force", "perturbation"), ("rms_displacement", "displacement")):
        yield Cell("2.1", condition, name), "", float(np.mean(recording[signal].values[trial, window] ** 2))
    for table, name, values in (("F.2", "velocity", path.velocity), ("F.4", "rotation", path.rotation)):
        for joint, of_joint in zip(JOINT_LETTERS, values[trial, window].T, strict=True):
            yield Cell(table, condition, f"rms_{name}_{joint}"), "", float(np.mean(of_joint**2))
            yield Cell(table, condition, f"max_{name}_{joint}"), "", float(np.abs(of_joint).max())


def _pulse_values(path: _Path, trial: int) -> Iterator[_Value]:
    recording = path.recording
    window = pulse_span(recording, trial)
    condition, named = str(recording["condition"].values[trial]), _level_of(recording, trial)
    printed = published.pulse_levels(condition)
    angle = float(recording["pulse_direction"].values[trial])
    side = next((name for name, of in DIRECTIONS.items() if abs((angle - of + 180.0) % 360.0 - 180.0) <= NEAR), None)
    direction = side or f"{angle % 360.0:.0f}"
    distance = peak_norm(recording["displacement"].values[trial, window])
    yield Cell("2.1", condition, f"peak_displacement_{named}"), direction, distance
    for index, joint in enumerate(JOINT_LETTERS):
        velocity, rotation = (float(np.abs(of[trial, window, index]).max()) for of in (path.velocity, path.rotation))
        yield Cell("F.3", condition, f"peak_velocity_{named}_{joint}"), direction, velocity
        yield Cell("F.5", condition, f"peak_rotation_{named}_{joint}"), direction, rotation
        if side and (not printed or named in printed):  # else table F.6 would pool a level that the thesis has not
            yield Cell("F.6", condition, f"peak_rotation_{side}_{joint}"), named, rotation
