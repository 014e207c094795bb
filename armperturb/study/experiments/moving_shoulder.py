"""What a moving shoulder does to joint rotations and velocities that are taken from the handle's path.

The thesis saw the shoulder move under its belt, and computed rotations as if it stayed (chapter 4). A simulated person
whose shoulder is held, and the same one on a belt that gives way (`Strap`), tell what that does: the joints' own motion
is known, and beside it stand inverse kinematics about a fixed shoulder and about the shoulder where its marker is.
There are no noise and no instruments, so that nothing but the shoulder and the grip's deflection is in the difference.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from armperturb.analysis.defaults import SETTLING
from armperturb.analysis.measures.kinematics import joint_rotations, joint_velocities, true_rotations
from armperturb.analysis.measures.pulse import WINDOWS, pulse_span
from armperturb.arrays import Array
from armperturb.cohort import Person
from armperturb.environment import TIMESTEP, Environment, Strap
from armperturb.envs.lab.experiment import run_experiment
from armperturb.perturbations.multisine import PERIOD
from armperturb.study.protocol import PULSE_LEAD, THESIS, Condition, Protocol
from armperturb.study.results.quantities import JOINT_LETTERS

Row = dict[str, Any]

CONDITIONS = ("PT0", "PT7.5", "PT22.5", "RT0", "RT22.5")
"""Pulses alone, and the largest movements under a multisine."""

MEASURES = ("true", "fixed_shoulder", "with_shoulder", "translation")
"""Fields of a row that are measured."""

STRETCH = PERIOD / 2
"""Its length [s]. Half a period is enough, as what is compared is compared over the same stretch."""

AFTER = max(WINDOWS.values()) + 0.1
"""Time after the onset of a pulse [s]."""


@dataclass(frozen=True, kw_only=True)
class ShoulderRow:
    """A measure of one joint in one condition, true and as computed, as a mean over trials.

    Attributes:
      condition: e.g. "PT7.5".
      joint: "s" or "e".
      quantity: "rms_rotation", "max_rotation", "rms_velocity" or "max_velocity" under the multisine, "peak_rotation" or
        "peak_velocity" after the pulse, as in tables F.2 to F.5.
      strap: whether the belt gives way.
      true: of the joint itself [rad, rad/s].
      fixed_shoulder: from the handle's path, about a shoulder that stays [rad, rad/s].
      with_shoulder: from the handle's path, about the shoulder where it is [rad, rad/s].
      translation: of the shoulder, its distance from where it started: RMS if the quantity is an RMS, else the largest,
        of the same stretch of time [m].
    """

    condition: str
    joint: str
    quantity: str
    strap: bool
    true: float
    fixed_shoulder: float
    with_shoulder: float
    translation: float


@dataclass(frozen=True, kw_only=True)
class MovingShoulder:
    """What a moving shoulder does.

    Attributes:
      person: name of whom it was done to.
      strap: the belt that gave way.
      rows: by condition, with the belt that holds before the one that gives way.
      left_out: why trials are in no row; one line each.
    """

    person: str
    strap: Strap
    rows: tuple[ShoulderRow, ...]
    left_out: tuple[str, ...]

    def table(self) -> list[Row]:
        """The rows as mappings, with the errors of both computations in percent of the truth."""
        return [
            {
                **asdict(row),
                "fixed_shoulder_error_percent": _error_percent(row.fixed_shoulder, row.true),
                "with_shoulder_error_percent": _error_percent(row.with_shoulder, row.true),
            }
            for row in self.rows
        ]


def moving_shoulder(
    person: Person,
    protocol: Protocol = THESIS,
    environment: Environment | None = None,
    *,
    forces: Mapping[str, float] | None = None,
    conditions: Sequence[str] = CONDITIONS,
    strap: Strap | None = None,
    seed: int = 0,
    **options: Any,
) -> MovingShoulder:
    """Perturb a person whose shoulder is held, and again with a belt that gives way.

    Each condition has its highest pulse level, once in each direction, after half a period of multisine if it has one.

    Args:
      person: who is perturbed, without noise.
      protocol: that has the conditions.
      environment: what the hand holds; the thesis's manipulator if not given.
      forces: of this person, as `Protocol.trials` takes them; the protocol's own if not given.
      conditions: names of those to run.
      strap: the belt that gives way; `Strap()` if not given.
      seed: of the multisines.
      **options: further ones of `run_experiment`.

    Raises:
      KeyError: the protocol lacks a condition, the forces one of them, or the person its task.
      ValueError: the person is unstable on the environment, with or without the strap.
    """
    strap = strap or Strap()
    chosen = [protocol.condition(name) for name in conditions]
    rows_of: dict[str, list[ShoulderRow]] = {name: [] for name in conditions}
    left_out: list[str] = []
    # Those without a multisine are shorter.
    for mine in (
        [condition for condition in chosen if condition.has_multisine],
        [condition for condition in chosen if not condition.has_multisine],
    ):
        if not mine:
            continue
        short = _shortened(protocol, mine)
        trials = short.trials(person, short.given_forces() if forces is None else forces, seed, 0, noisy=False)
        for belt in (None, strap):
            recording = run_experiment(trials, environment, timestep=TIMESTEP, strap=belt, **options)
            for condition in mine:
                of_condition = recording.isel(trial=np.flatnonzero(recording["condition"].values == condition.name))
                inside = np.isnan(of_condition["limit_time"].values)
                left_out += [
                    f"{condition.name}, shoulder {'held' if belt is None else 'on the strap'}: a trial reached the "
                    f"workspace limit at {limit:.3f} s"
                    for limit in of_condition["limit_time"].values[~inside]
                ]
                rows_of[condition.name] += _rows(of_condition.isel(trial=inside), condition, belt is not None)
    rows = tuple(row for name in conditions for row in rows_of[name])
    return MovingShoulder(person=person.name, strap=strap, rows=rows, left_out=tuple(left_out))


def _shortened(protocol: Protocol, conditions: Sequence[Condition]) -> Protocol:
    """These conditions, all with or all without a multisine, in trials no longer than what is measured."""
    onset = SETTLING + STRETCH if conditions[0].has_multisine else PULSE_LEAD
    return replace(
        protocol,
        conditions=tuple(
            replace(condition, repetitions=1, pulse_levels=tuple(sorted(condition.pulse_levels)[-1:]))
            for condition in conditions
        ),
        pulse_unit_condition="",
        multisine_duration=onset,
        trial_duration=onset + AFTER,
        onset_window=(onset, onset),
        strap=None,
    )


def _rows(recording: xr.Dataset, condition: Condition, strap: bool) -> Iterator[ShoulderRow]:
    """All rows of one condition's trials; none without trials."""
    rate = float(recording.attrs["rate"])
    shoulder = recording["shoulder_marker"].values if strap else np.zeros(recording["displacement"].shape)
    rotations = (
        true_rotations(recording),
        joint_rotations(recording),
        joint_rotations(recording, shoulder=shoulder),
    )
    signals = {"rotation": rotations, "velocity": tuple(joint_velocities(rotation, rate) for rotation in rotations)}
    moved = np.linalg.norm(shoulder, axis=-1)
    values: dict[tuple[str, int], list[list[Array]]] = defaultdict(list)
    for trial in range(recording.sizes["trial"]):
        windows: dict[str, slice] = {}
        if condition.has_multisine:
            stretch = slice(round(SETTLING * rate), round((SETTLING + STRETCH) * rate))
            windows |= {"rms": stretch, "max": stretch}
        if condition.pulse_levels:
            windows["peak"] = pulse_span(recording, trial)
        for kind, window in windows.items():
            measure = _rms if kind == "rms" else _largest
            for name, paths in signals.items():
                for joint in range(len(JOINT_LETTERS)):
                    values[f"{kind}_{name}", joint].append(
                        [*(measure(path[trial, window, joint]) for path in paths), measure(moved[trial, window])]
                    )
    for (quantity, joint), of_trials in values.items():
        # As in tables F.2 to F.5: an RMS pools trials, largest values are averaged.
        pooled = _rms(np.array(of_trials)) if quantity.startswith("rms") else np.mean(of_trials, axis=0)
        yield ShoulderRow(
            condition=condition.name,
            joint=JOINT_LETTERS[joint],
            quantity=quantity,
            strap=strap,
            **dict(zip(MEASURES, pooled.tolist(), strict=True)),
        )


def _error_percent(value: float, true: float) -> float:
    return 100.0 * (value / true - 1.0) if true else math.nan


def _rms(values: Array) -> Array:
    """Over the first axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _largest(values: Array) -> Array:
    """Size, over the first axis."""
    return np.asarray(np.abs(values).max(axis=0))
