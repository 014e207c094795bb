"""The nonlinear part of intrinsic muscle: short-range stiffness with yielding and recovery, shear-thinning damping.

The linear part is in the MJCF model, and the torque of this law is added to it. docs/muscle.md has the equations,
symbols and literature. Only elementwise arithmetic is used, summed over parts in a fixed order, so that a trial has the
same bits alone and beside others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import numpy as np
from scipy import special

from armperturb.arrays import Array, Indices
from armperturb.controllers.layout import trials_adjacent
from armperturb.muscle_law import MuscleLaw
from armperturb.subject import Subject

NEVER = 1e6
"""Stands for an elastic limit that is infinite [rad], where infinity times a vanished stiffness would be undefined."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MuscleParameters:
    """What differs between trials and elements, as arrays; made by `muscle_parameters`.

    Attributes:
      stiffness: short-range stiffness of one part, (trial, element) [Nm/rad].
      limit: elastic limits of the parts at rest, (part, trial, element) [rad].
      limit_slope: their growth with speed, (part, trial, element) [s]; None if no limit grows.
      loss: inverse of the angle of loss, (trial, element) [1/rad].
      persistence: share of the lost stiffness that is still lost a step later, (trial, element) [-].
      damping: linear damping of the element's muscle group, (trial, element) [Nms/rad].
      thinning: inverse of the thinning velocity, (trial, element) [s/rad].
    """

    stiffness: Array
    limit: Array
    limit_slope: Array | None
    loss: Array
    persistence: Array
    damping: Array
    thinning: Array


class MuscleState(NamedTuple):
    """What the muscles remember from step to step.

    Attributes:
      bond: torque of each elasto-plastic part over its stiffness [rad], (part, trial, element).
      intact: share of the short-range stiffness that is intact [-], (trial, element), above 0 to 1.
      stretch: of the elements at the last step [rad], (trial, element).
    """

    bond: Array
    intact: Array
    stretch: Array


def elastic_limit_shape(spread: float, parts: int) -> Array:
    """Elastic limits over their mean [-], (part,): middle quantiles of a log-normal distribution, scaled to mean one.

    Args:
      spread: SD over mean of the distribution [-], >= 0.
      parts: how many quantiles.
    """
    middle = (np.arange(parts) + 0.5) / parts
    shape = np.exp(np.sqrt(np.log1p(spread**2)) * special.ndtri(middle))
    return np.ones(parts) if spread == 0 else shape / shape.mean()


def element_motion(motion: Array) -> Array:
    """What joint angles or velocities are for the elements (shoulder, two-joint, elbow), (trial, element)."""
    elements = np.empty((len(motion), 3), order="F")
    elements[:, ::2] = motion
    np.add(motion[:, 0], motion[:, 1], out=elements[:, 1])
    return elements


def joint_torque(torque: Array) -> Array:
    """What torques of the elements are for the joints, (trial, joint)."""
    return torque[:, ::2] + torque[:, 1:2]


def muscle_parameters(subjects: Sequence[Subject], timestep: float) -> MuscleParameters:
    """Parameters of one subject per trial; a subject without a law gets one that adds nothing.

    Args:
      subjects: the person in each trial.
      timestep: of the simulation [s].
    """
    laws = [subject.muscle or MuscleLaw() for subject in subjects]

    def each(field: str) -> Array:
        return trials_adjacent([law.of_elements(field) for law in laws], 0)

    # Parts that a trial does not have yield at once.
    shape = trials_adjacent(np.zeros((max(law.parts for law in laws), len(laws), 3)), 1)
    for trial, law in enumerate(laws):
        for element, spread in enumerate(law.of_elements("elastic_limit_spread")):
            shape[: law.parts, trial, element] = elastic_limit_shape(spread, law.parts)
    slope = each("elastic_limit_slope")
    return MuscleParameters(
        stiffness=each("short_range_stiffness") / np.array([[law.parts] for law in laws]),
        limit=shape * np.minimum(np.radians(each("elastic_limit_deg")), NEVER),
        limit_slope=shape * slope if slope.any() else None,
        loss=1.0 / np.radians(each("loss_angle_deg")),
        persistence=np.exp(-timestep / each("recovery_time")),
        damping=trials_adjacent([subject.muscle_groups("b") for subject in subjects], 0),
        thinning=1.0 / each("thinning_velocity"),
    )


def rested(parameters: MuscleParameters) -> MuscleState:
    """State of muscles that have been at rest for long, at zero stretch."""
    return MuscleState(
        np.zeros_like(parameters.limit), np.ones_like(parameters.stiffness), np.zeros_like(parameters.stiffness)
    )


def muscle_torque(
    parameters: MuscleParameters, state: MuscleState, stretch: Array, velocity: Array
) -> tuple[Array, MuscleState]:
    """One step of the law: the torque with which elements oppose stretch, beside the linear spring and damper.

    Bonds that movement breaks let go of their torque; bonds that rest forms are unstrained, so that recovery changes
    no torque. The stored energy, the sum over parts of stiffness x bond^2 / (2 x intact), never grows by more than the
    work that is done on the element and its linear damper.

    Args:
      parameters: of each trial.
      state: after the step before.
      stretch: of the elements at this step [rad], (trial, element).
      velocity: of the elements at this step [rad/s], (trial, element).

    Returns:
      The torque [Nm], (trial, element), and the state for the next step.

    Source: Iwan (1966) for the parallel elasto-plastic parts, thesis F.1 for limits that grow with speed; the rest in
    docs/muscle.md.
    """
    move = stretch - state.stretch
    speed = np.abs(velocity)
    survival = 1.0 / (1.0 + np.abs(move) * parameters.loss)
    intact = state.intact * survival
    if parameters.limit_slope is None:
        limit = parameters.limit * intact
    else:
        limit = parameters.limit_slope * speed
        limit += parameters.limit
        limit *= intact
    bond = state.bond * survival
    bond += intact * move
    np.minimum(bond, limit, out=bond)
    np.maximum(bond, np.negative(limit, out=limit), out=bond)
    torque = np.zeros_like(stretch)
    for part in bond:  # not sum(), whose order depends on the shape
        torque += part
    torque *= parameters.stiffness
    thinned = speed * parameters.thinning
    torque -= parameters.damping * velocity * (thinned / (1.0 + thinned))
    return torque, MuscleState(bond, 1.0 - (1.0 - intact) * parameters.persistence, stretch)


class NonlinearMuscles:
    """The law in all trials of a batch, one that adds nothing where a subject has none: `torque` once per step."""

    def __init__(self, subjects: Sequence[Subject], timestep: float) -> None:
        """Begin at rest.

        Args:
          subjects: the person in each trial.
          timestep: of the simulation [s].
        """
        self.needed = any(subject.muscle is not None for subject in subjects)
        self._posture = trials_adjacent([subject.posture for subject in subjects], 0)
        self._parameters = muscle_parameters(subjects, timestep)
        self._parts = np.array([[(subject.muscle or MuscleLaw()).parts] for subject in subjects])
        self._state = rested(self._parameters)
        self._velocity = np.zeros((len(subjects), 2))
        self._torque = self._before = np.zeros((len(subjects), 2))
        self._timestep = timestep

    def torque(self, angle: Array, velocity: Array) -> Array:
        """Torque with which the muscles oppose movement, beside their linear part.

        A torque that is held over a step acts at its middle: the law sees the motion drawn on to there.

        Args:
          angle: of the joints at the start of the step [rad], (trial, joint).
          velocity: of the joints [rad/s], (trial, joint).

        Returns:
          The torque to hold over the step [Nm], (trial, joint).
        """
        middle = 1.5 * velocity - 0.5 * self._velocity
        stretch = angle - self._posture + (0.5 * self._timestep) * velocity
        torque, self._state = muscle_torque(
            self._parameters, self._state, element_motion(stretch), element_motion(middle)
        )
        self._velocity = np.copy(velocity)
        self._before, self._torque = self._torque, joint_torque(torque)
        return self._torque

    @property
    def at_start(self) -> Array:
        """The torque at the start of the last step [Nm], (trial, joint): halfway between two that were held."""
        return 0.5 * (self._torque + self._before)

    def set_strength(self, trials: Indices, short_range: Array, damping: Array) -> None:
        """Change how much muscle there is in some trials, as co-contraction does.

        Bonds that come in are unstrained, and bonds that go take their torque along: neither gives energy.

        Args:
          trials: indices of those trials.
          short_range: short-range stiffness [Nm/rad], (trial, element).
          damping: linear damping of the muscle groups [Nms/rad], (trial, element).
        """
        before = self._parameters.stiffness
        stiffness = short_range / self._parts[trials]
        share = np.divide(before[trials], stiffness, out=np.ones_like(stiffness), where=stiffness > 0.0)
        self._state.bond[:, trials] *= np.minimum(share, 1.0)
        before[trials], self._parameters.damping[trials] = stiffness, damping

    def replace(self, trials: Indices, fresh: Self) -> None:
        """Put other people, at rest, in the place of some trials.

        Args:
          trials: indices of those trials.
          fresh: as many trials.
        """
        self.needed |= fresh.needed
        self._make_room_for(fresh)
        fresh._make_room_for(self)
        self._posture[trials], self._parts[trials] = fresh._posture, fresh._parts
        self._velocity[trials] = self._torque[trials] = 0.0
        for field in fields(MuscleParameters):
            into = getattr(self._parameters, field.name)
            if into is not None:
                into[..., trials, :] = getattr(fresh._parameters, field.name)
        for into, values in zip(self._state, fresh._state, strict=True):
            into[..., trials, :] = values

    def _make_room_for(self, other: Self) -> None:
        """Have as many parts as other trials, which yield at once where a law has fewer, and limits that may grow."""
        parameters = self._parameters
        missing = len(other._state.bond) - len(self._state.bond)
        if parameters.limit_slope is None and other._parameters.limit_slope is not None:
            parameters = replace(parameters, limit_slope=np.zeros_like(parameters.limit))
        if missing > 0:
            more = trials_adjacent(np.zeros((missing, *parameters.stiffness.shape)), 1)

            def extended(values: Array) -> Array:
                return np.concatenate([values, more])

            self._state = self._state._replace(bond=extended(self._state.bond))
            slope = parameters.limit_slope
            parameters = replace(
                parameters,
                limit=extended(parameters.limit),
                limit_slope=None if slope is None else extended(slope),
            )
        self._parameters = parameters
