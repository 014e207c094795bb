"""People whose nervous system is an agent: from its actions to what drives their arms, and to what they sense.

The simulation (the batch, or dm_control) calls, in this order: `start` at the begin of a trial; `decide` for each
decision; `drive` before and `sense` after each step; then `judge` and `observe`.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl, Strength
from armperturb.controllers.layout import trials_adjacent
from armperturb.controllers.reflex import activate, initial_activation
from armperturb.envs.lab.trial import Trial, held_force, noise_torque, subject_in
from armperturb.envs.learning.levels import strength_between, strength_of
from armperturb.envs.learning.task import TaskSettings
from armperturb.muscle_law import ELEMENTS
from armperturb.subject import Subject

SENSES = (
    *("stretch of the shoulder", "stretch of the elbow", "velocity of the shoulder", "velocity of the elbow"),
    *("force on the hand, x", "force on the hand, y", "handle seen, x", "handle seen, y"),
)
"""What an observation holds: proprioception [rad, rad/s], force [N], and displacement times the visual gain [m]."""

SENSE_LIMITS = np.array([np.pi, np.pi, 100.0, 100.0, 2000.0, 2000.0, 1.0, 1.0])
"""Where senses saturate, the last two times the visual gain: far beyond what happens inside the workspace."""


ONLY = np.zeros(1, dtype=int)
"""Index of a single person."""


def action_names(settings: TaskSettings) -> tuple[str, ...]:
    """What each number of an action sets."""
    names: list[str] = []
    if settings.co_contraction == "groups":
        names += [f"co-contraction, {group}" for group in ELEMENTS]
    elif settings.co_contraction == "common":
        names.append("co-contraction")
    if settings.reflexes:
        names += [f"{kind} feedback, {group}" for kind in ("velocity", "position") for group in ELEMENTS]
    if settings.torque:
        names += ["torque, shoulder", "torque, elbow"]
    return tuple(names)


def action_bounds(settings: TaskSettings) -> tuple[Array, Array]:
    """Lowest and highest action, (action,) each: levels from 0 to 1, torques from -1 to 1."""
    names = action_names(settings)
    return np.array([-1.0 if name.startswith("torque") else 0.0 for name in names]), np.ones(len(names))


def own_action(settings: TaskSettings) -> Array:
    """The action by which the person does the task as in the study, (action,).

    It is exact where 1 over `highest_level` is: at powers of two.
    """
    level = 1.0 / settings.highest_level if settings.task == "PT" else 0.0
    return np.array([0.0 if name.startswith("torque") else level for name in action_names(settings)])


def observation_bounds(settings: TaskSettings) -> Array:
    """Largest absolute value of each part of an observation, (sense,)."""
    # In darkness everything seen is zero; a space must have some extent all the same.
    return SENSE_LIMITS * np.append(np.ones(6), [max(settings.visual_gain, 1e-3)] * 2)


class Participants:
    """n people in trials of a task, apart from their physics; arrays have the person as first axis.

    Attributes:
      settings: the task.
      control: reflexes and muscle law of their arms.
      levels: of co-contraction, velocity and position feedback in the steps of a decision, (person, 3, element) [-].
      reached: level that co-contraction has reached after them, (person, element) [-].
      step: of each trial, from 0, (person,).
      n_steps: at which each trial is over, (person,).
      lags: steps after which joints and hand are felt, and after which the handle is seen.
    """

    def __init__(self, settings: TaskSettings, n: int, n_history: int = 0) -> None:
        """Begin without trials.

        Args:
          settings: the task.
          n: how many people.
          n_history: steps that force feedback remembers, if more than the task's person needs.
        """
        self.settings = settings
        self.control = ArmControl([settings.subject] * n, settings.timestep, n_history)
        self.levels, self.reached = np.zeros((n, 3, 3)), np.zeros((n, 3))
        self.step, self.n_steps = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
        self._n, self._every = np.arange(n), settings.steps_per_decision
        self._low, self._high = action_bounds(settings)
        self._names = action_names(settings)
        # Of the way to a new level: what is left after a decision, and on average during it.
        self._left = self._left_on_average = 0.0
        if settings.activation_time:
            decay = 1.0 / (settings.control_rate * settings.activation_time)
            self._left, self._left_on_average = np.exp(-decay), -np.expm1(-decay) / decay
        self._relaxed, self._position = (strength_of([subject] * n) for subject in settings.people)
        self._posture = np.zeros((n, 2))
        self._push, self._noise = np.zeros((2, n, self._every, 2))  # longer with the first trials
        self._recorded = np.zeros((n, 1, 2))
        self._command = np.zeros((n, 2))
        self._activation = initial_activation(n)
        self._push_now = self._noise_now = np.zeros((self._every, n, 2))
        self.lags = tuple(
            round(delay / settings.timestep) for delay in (settings.proprioceptive_delay, settings.visual_delay)
        )
        # At least what happens between decisions, to tell how far the handle was.
        self._senses = trials_adjacent(np.zeros((max(*self.lags, self._every) + 1, n, len(SENSES))), 1)
        self._newest = 0

    def start(self, people: Indices, trials: Sequence[Trial]) -> list[Subject]:
        """Begin trials at rest, with the person's own levels.

        Args:
          people: indices of those whose trials begin, in rising order.
          trials: one for each of them.

        Returns:
          The people as they are in these trials.
        """
        settings = self.settings
        # All that may be refused comes before all that changes.
        subjects = [subject_in(trial, settings.environment) for trial in trials]
        n_decisions = [int(round(t.perturbation.duration * settings.control_rate, 6)) for t in trials]
        signals = [
            (
                held_force(trial.perturbation, settings.timestep, n * self._every),
                noise_torque(trial, settings.timestep, n * self._every),
                trial.perturbation.sample(settings.control_rate, n + 1),
            )
            for trial, n in zip(trials, n_decisions, strict=True)
        ]
        self._put(people, subjects)
        self.step[people] = 0
        self._make_room(max(n_decisions))
        for person, (push, noise, recorded) in zip(people.tolist(), signals, strict=True):
            n_steps = self.n_steps[person] = len(push)
            self._push[person, n_steps:] = self._noise[person, n_steps:] = 0.0
            self._push[person, :n_steps] = push
            self._noise[person, :n_steps] = 0.0 if noise is None else noise
            self._recorded[person, : len(recorded)] = recorded
        return subjects

    def rest(self, people: Indices) -> list[Subject]:
        """Put the task's person, at rest, in the place of some people; their trials continue.

        Args:
          people: indices of those, rising.

        Returns:
          As many times the person.
        """
        subjects = [self.settings.subject] * len(people)
        self._put(people, subjects)
        return subjects

    def _put(self, people: Indices, subjects: Sequence[Subject]) -> None:
        strength = self._position if self.settings.task == "PT" else self._relaxed
        for name, values in strength_of(subjects).items():
            strength[name][people] = values
        self.control.replace(people, subjects)
        self.levels[people] = self.reached[people] = 1.0 if self.settings.task == "PT" else 0.0
        self._posture[people] = [subject.posture for subject in subjects]
        self._senses[:, people] = self._command[people] = 0.0
        self._senses[:, people, 0:2] = self._posture[people]
        self._activation[:, people] = 0.0

    def _make_room(self, n_decisions: int) -> None:
        missing = n_decisions + 1 - self._recorded.shape[1]
        if missing > 0:
            n = len(self._n)
            self._push, self._noise = (
                np.concatenate([old, np.zeros((n, missing * self._every, 2))], axis=1)
                for old in (self._push, self._noise)
            )
            self._recorded = np.concatenate([self._recorded, np.zeros((n, missing, 2))], axis=1)

    def decide(self, actions: ArrayLike) -> tuple[Indices, Strength]:
        """Take everybody's action for the steps up to the next decision.

        Args:
          actions: (person, action), see `action_names`.

        Returns:
          Indices of those whose muscles change, and the muscles that they have from now on.

        Raises:
          TypeError: actions are no numbers.
          ValueError: they have the wrong shape, or one of them is not finite or out of its bounds.
        """
        actions = self._checked(actions)
        settings = self.settings
        before = self.levels.copy()
        column = {"groups": 3, "common": 1, "off": 0}[settings.co_contraction]
        if column:
            wanted = actions[:, :column] * settings.highest_level
            self.levels[:, 0] = wanted + (self.reached - wanted) * self._left_on_average
            self.reached = wanted + (self.reached - wanted) * self._left
        if settings.reflexes:
            self.levels[:, 1:] = actions[:, column : column + 6].reshape(-1, 2, 3) * settings.highest_level
            column += 6
        if settings.torque:
            self._command = trials_adjacent(actions[:, column:] * settings.highest_torque, 0)
        changed = np.flatnonzero((self.levels != before).any(axis=(1, 2)))
        ends = self._relaxed, self._position
        relaxed, position = ({name: values[changed] for name, values in end.items()} for end in ends)
        strength = strength_between(relaxed, position, self.levels[changed])
        if len(changed):
            self.control.set_strength(changed, strength)
        # Where a trial is over, signals are zero until the next one begins.
        rows = np.minimum(self.step[:, None] + np.arange(self._every), self._push.shape[1] - 1)
        self._push_now, self._noise_now = (
            trials_adjacent(signal[self._n[:, None], rows].swapaxes(0, 1), 1) for signal in (self._push, self._noise)
        )
        self._within = 0
        return changed, strength

    def _checked(self, actions: ArrayLike) -> Array:
        values = np.asarray(actions)
        if values.dtype.kind not in "fiub":
            raise TypeError(f"action of type {values.dtype}; expected numbers")
        shape = len(self._n), len(self._names)
        if values.shape != shape:
            first = int(len(shape) == values.ndim and len(values) == len(self._n) == 1)  # that of a single person
            given, expected = values.shape[first:], shape[first:]
            raise ValueError(f"action of shape {given}; expected {expected}: {', '.join(self._names)}")
        values = values.astype(float)
        good = (values >= self._low) & (values <= self._high)
        if not good.all():
            person, column = np.argwhere(~good)[0]
            raise ValueError(
                f"action[{column}] ({self._names[column]}) = {values[person, column].item()!r}"
                f"{f' of environment {person}' if len(values) > 1 else ''}; expected {self._low[column]:g} to "
                f"{self._high[column]:g}"
            )
        return values

    def drive(self, angle: Array, velocity: Array) -> tuple[Array, Array, Array]:
        """What acts during the next step.

        Args:
          angle: of the joints at its start [rad], (person, joint).
          velocity: of the joints [rad/s], (person, joint).

        Returns:
          Force on the handle [N], (person, axis), torque on the joints and controls of the reflex motors [Nm], (person,
          joint) both.
        """
        torque = self._noise_now[self._within]
        if self.settings.torque:
            active, self._activation = activate(self.control.gains, self._activation, self._command)
            torque = torque + active
        applied, delayed = self.control.torque(angle, velocity, torque)
        return self._push_now[self._within], np.asarray(applied), delayed

    def sense(self, angle: Array, velocity: Array, handle: Array, force: Array) -> None:
        """Take in what the step led to; arguments as the attributes of `Simulation`, (person, 2) each."""
        self._newest = (self._newest + 1) % len(self._senses)
        row = self._senses[self._newest]
        row[:, 0:2], row[:, 2:4], row[:, 4:6], row[:, 6:8] = angle, velocity, force, handle
        self._within += 1

    def observe(self) -> NDArray[np.float32]:
        """What everybody senses now, late and within bounds, (person, sense) as in `SENSES`."""
        felt, seen = (self._sensed(lag) for lag in self.lags)
        felt[:, 6:8] = seen[:, 6:8]
        return felt.astype(np.float32)

    def undelayed(self) -> Array:
        """What everybody will sense of this moment when it has reached them, (person, sense)."""
        return self._sensed(0)

    def _sensed(self, lag: int) -> Array:
        sensed = self._senses[(self._newest - lag) % len(self._senses)].copy()
        sensed[:, 0:2] -= self._posture
        sensed[:, 6:8] *= self.settings.visual_gain
        bounds = observation_bounds(self.settings)
        return np.clip(sensed, -bounds, bounds)

    def judge(self, handle: Array, diverged: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """End of the steps of a decision.

        Args:
          handle: its displacement [m], (person, axis).
          diverged: whether the arm could not be integrated, (person,).

        Returns:
          Rewards, terminations and truncations, (person,) each: minus displacement_weight |x|^2, minus the weighted
          effort. A trial terminates at the limit of the workspace, or where it cannot be integrated: this decision and
          all that were to come then cost the worst, so that to give up never pays. It is truncated when it is over.
        """
        settings = self.settings
        self.step += self._every
        level = np.square(self.levels).mean(axis=2)
        effort = settings.co_contraction_weight * level[:, 0] + settings.reflex_weight * level[:, 1:].mean(axis=1)
        effort += settings.torque_weight * np.square(self._command / settings.highest_torque).mean(axis=1)
        steps = np.arange(self._newest - self._every + 1, self._newest + 1)  # below 0, from the other end
        reach = np.abs(self._senses[steps, :, 6:8]).max(axis=0)
        terminated = (reach >= settings.environment.workspace).any(axis=1) | diverged
        rewards = -settings.displacement_weight * np.square(handle).sum(axis=1) - effort
        lost = 1 + np.maximum(self.n_steps - self.step, 0) // self._every
        return np.where(terminated, -settings.worst * lost, rewards), terminated, self.step >= self.n_steps

    def perturbation(self) -> Array:
        """Disturbance at this moment [N], (person, axis)."""
        return self._recorded[self._n, np.minimum(self.step // self._every, self._recorded.shape[1] - 1)]
