"""EMG of antagonists as outputs of the arm's model: what a fit of reflexes needs of the envelopes."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from armperturb.analysis.arm.geometry import hand_jacobian
from armperturb.analysis.emg.envelope import Envelopes
from armperturb.analysis.emg.matching import rows_of
from armperturb.analysis.emg.rotation import rotation
from armperturb.analysis.response.record_window import RecordWindow
from armperturb.analysis.trials import ConditionTrials
from armperturb.arrays import Array, Indices

GROUPS = ("s", "e", "se")
"""Joints that the muscles of a group cross: shoulder, elbow, both."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReflexOutputs:
    """Trials of one condition up to the first pulse, sampled like the records of a fit (`RecordWindow`).

    Attributes:
      groups: those of `GROUPS` of which there is EMG.
      difference: mean amplitude of a group's extensors less that of its flexors, over the reference's [-], (trial,
        time, group). Of a group of flexors or extensors alone, theirs.
      rotation: of shoulder and elbow, or J^-1 x of the handle [rad], (trial, time, joint).
      grip_load: J^-1 f, which times the admittance of the grip is what the handle shows too much of rotation [rad N/m],
        (trial, time, joint); None where joint angles were recorded.
      rate: of both [Hz].
      averaging: time over which the amplitude is averaged [s].
      from_rest: whether the trials start at rest.
    """

    groups: tuple[str, ...]
    difference: Array
    rotation: Array
    grip_load: Array | None
    rate: float
    averaging: float
    from_rest: bool = True

    def take(self, numbers: Indices) -> Self:
        """Some of the trials."""
        load = None if self.grip_load is None else self.grip_load[numbers]
        return replace(self, difference=self.difference[numbers], rotation=self.rotation[numbers], grip_load=load)


def require_known_muscles(envelopes: Envelopes) -> None:
    """Refuse EMG that cannot be an output of an arm.

    Raises:
      ValueError: of no muscle is it known what it does.
    """
    if not any(action.joints in GROUPS and action.sign for action in envelopes.muscles.values()):
        raise ValueError(
            "EMG is not used: of no muscle is it known what it does; expected joints and sign (signals.emg.muscles of "
            "the sidecar)"
        )


def dead_muscles(trials: ConditionTrials, envelopes: Envelopes) -> list[str]:
    """Muscles whose channel is dead in any of the trials of a condition, before the first pulse.

    Args:
      trials: of the condition.
      envelopes: of the person.

    Raises:
      ValueError: the envelopes hold other trials of the condition.
    """
    power = envelopes.power[rows_of(trials, envelopes), : RecordWindow.of(trials).end]
    names = list(envelopes.muscles)
    return [names[column] for column in np.flatnonzero(~np.isfinite(power).all(axis=(0, 1)))]


def reflex_outputs(trials: ConditionTrials, envelopes: Envelopes) -> ReflexOutputs:
    """EMG of the trials of one condition as outputs of the arm's model.

    Args:
      trials: of the condition; no others of it are in the envelopes.
      envelopes: of the person.

    A muscle whose channel is dead in any of the trials is left out, as what is left would change with the trial.

    Raises:
      ValueError: the envelopes hold other trials of the condition; of no muscle is it known what it does; or each of
        these is dead in a trial.
    """
    require_known_muscles(envelopes)
    window = RecordWindow.of(trials)
    dead = dead_muscles(trials, envelopes)
    amplitude = np.nan_to_num(envelopes.amplitudes(rows_of(trials, envelopes)))
    groups, differences = [], []
    for joints in GROUPS:
        sides = [
            [
                column
                for column, (name, action) in enumerate(envelopes.muscles.items())
                if action.joints == joints and action.sign == sign and name not in dead
            ]
            for sign in (-1, 1)
        ]
        if any(sides):
            extensors, flexors = (amplitude[..., side].mean(axis=2) if side else 0.0 for side in sides)
            groups.append(joints)
            differences.append(np.asarray(extensors - flexors))
    if not groups:
        raise ValueError(
            f"EMG is not used: every muscle is dead in some trial of {trials.label}; expected one that is recorded in "
            "all of them"
        )
    difference, turned = np.stack(differences, axis=2), rotation(trials)
    has_angles = "joint_angle" in trials.recording.data_vars
    load = None if has_angles else window(trials.force @ np.linalg.inv(hand_jacobian(trials.body)).T)
    return ReflexOutputs(
        groups=tuple(groups),
        # What is thinned has to begin at zero.
        difference=window(difference - difference.mean(axis=1, keepdims=True)),
        rotation=window(turned - turned[:, :1]),
        grip_load=load,
        rate=envelopes.rate / window.factor,
        averaging=envelopes.averaging,
        from_rest=trials.from_rest,
    )
