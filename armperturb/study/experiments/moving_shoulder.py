"""What a moving shoulder does to joint rotations and velocities that are taken from the handle's path.

The thesis saw the shoulder move under its belt, and computed rotations as if it stayed (chapter 4). A simulated person
whose shoulder is held, and the same one on a belt that gives way (`Strap`), tell what that does: the joints' own motion
is known, and beside it stand inverse kinematics about a fixed shoulder and about the shoulder where its marker is.
There are no noise and no instruments, so that nothing but the shoulder and the grip's deflection is in the difference.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from armperturb.analysis.arm.state_space import largest_real_pole
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

STRETCH = PERIOD / 2
"""Its length [s]. Half a period is enough, as what is compared is compared over the same stretch."""

AFTER = max(WINDOWS.values()) + 0.1
"""Time after the onset of a pulse [s]."""


@dataclass(frozen=True, kw_only=True)
class MovingShoulder:
    """What a moving shoulder does.

    Attributes:
      person: name of whom it was done to.
      strap: the belt that gave way.
      rows: a measure of one joint each, as a mean over trials, by condition, with the belt that holds before the one
        that gives way. Columns:

        - condition, e.g. "PT7.5", and joint, "s" or "e";
        - quantity: "rms_rotation", "max_rotation", "rms_velocity" or "max_velocity" under the multisine,
          "peak_rotation" or "peak_velocity" after the pulse, as in tables F.2 to F.5;
        - strap: whether the belt gives way;
        - true: of the joint itself [rad, rad/s];
        - fixed_shoulder and with_shoulder: from the handle's path, about a shoulder that stays, and about the shoulder
          where it is [rad, rad/s], and their errors in percent of the truth;
        - translation: of the shoulder, its distance from where it started, of the same stretch of time: RMS if the
          quantity is an RMS, else the largest [m].
      left_out: why trials are in no row; one line each.
    """

    person: str
    strap: Strap
    rows: tuple[Row, ...]
    left_out: tuple[str, ...]


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
      ValueError: the person is unstable on the environment.
    """
    environment, strap = environment or Environment(), strap or Strap()
    chosen = [protocol.condition(name) for name in conditions]
    rows_of: dict[str, list[Row]] = {name: [] for name in conditions}
    left_out: list[str] = []
    # Those without a multisine are shorter.
    for has_multisine, belt in itertools.product((True, False), (None, strap)):
        mine = [condition for condition in chosen if condition.has_multisine == has_multisine]
        if belt is not None:
            pole = {c.name: largest_real_pole(c.subject_of(person), environment, belt) for c in mine}
            left_out += [f"{name}, shoulder on the strap: the arm is unstable" for name in pole if pole[name] >= 0.0]
            mine = [condition for condition in mine if pole[condition.name] < 0.0]
        if mine:
            short = _shortened(protocol, mine)
            trials = short.trials(person, short.given_forces() if forces is None else forces, seed, 0, noisy=False)
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


def _rows(recording: xr.Dataset, condition: Condition, strap: bool) -> Iterator[Row]:
    """All rows of one condition's trials, which have their pulse at one time; none without trials."""
    if not recording.sizes["trial"]:
        return
    rate = float(recording.attrs["rate"])
    shoulder = recording["shoulder_marker"].values if strap else np.zeros(recording["displacement"].shape)
    rotations = [true_rotations(recording), *(joint_rotations(recording, shoulder=at) for at in (None, shoulder))]
    signals = {"rotation": rotations, "velocity": [joint_velocities(rotation, rate) for rotation in rotations]}
    moved = np.linalg.norm(shoulder, axis=-1)
    stretch = slice(round(SETTLING * rate), round((SETTLING + STRETCH) * rate))
    windows = {"rms": stretch, "max": stretch} if condition.has_multisine else {}
    if condition.pulse_levels:
        windows["peak"] = pulse_span(recording, 0)
    for (kind, window), (name, paths) in itertools.product(windows.items(), signals.items()):
        for joint, letter in enumerate(JOINT_LETTERS):
            shown = [*(path[:, window, joint] for path in paths), moved[:, window]]
            # As in tables F.2 to F.5: an RMS pools trials, largest values are averaged.
            true, fixed_shoulder, with_shoulder, translation = (
                float(_rms(_rms(values)) if kind == "rms" else np.abs(values).max(axis=-1).mean()) for values in shown
            )
            yield {
                "condition": condition.name,
                "joint": letter,
                "quantity": f"{kind}_{name}",
                "strap": strap,
                "true": true,
                "fixed_shoulder": fixed_shoulder,
                "with_shoulder": with_shoulder,
                "translation": translation,
                "fixed_shoulder_error_percent": _error_percent(fixed_shoulder, true),
                "with_shoulder_error_percent": _error_percent(with_shoulder, true),
            }


def _error_percent(value: float, true: float) -> float:
    return 100.0 * (value / true - 1.0) if true else math.nan


def _rms(values: Array) -> Array:
    """Over the last axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)))
