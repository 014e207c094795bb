"""People whose nervous system is an agent: from its actions to what drives their arms, and to what they sense.

The simulation (the batch, or dm_control) calls, in this order: `start` at the begin of a trial; `decide` for each
decision; `drive` before and `sense` after each step; then `judge` and `observe`.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armperturb.arrays import Array, Indices
from armperturb.controllers.arm_control import ArmControl, Strength
from armperturb.envs.lab.trial import Trial, known_ahead, subject_in
from armperturb.envs.learning.levels import strength_between, strength_of
from armperturb.envs.learning.task import TaskSettings
from armperturb.models.rig import AHEAD, KNOWN
from armperturb.muscle_law import ELEMENTS
from armperturb.subject import Subject

SENSES = (
    *("stretch of the shoulder", "stretch of the elbow", "velocity of the shoulder", "velocity of the elbow"),
    *("force on the hand, x", "force on the hand, y", "handle seen, x", "handle seen, y"),
)
"""What an observation holds: proprioception [rad, rad/s], force [N], and displacement times the visual gain [m]."""

SENSE_LIMITS = np.array([np.pi, np.pi, 100.0, 100.0, 2000.0, 2000.0, 1.0, 1.0])
"""Where senses saturate, the last two times the visual gain: far beyond what happens inside the workspace."""


NORMALISED_LIMIT = 20.0
"""Where normalised senses saturate [-]: beyond all that happens with a person's own muscles and reflexes."""

TOLERANCE = 2.0
"""Root-mean-square displacement in a trial that is a success, in displacements that halve the accuracy."""

TERMS = ("reward_accuracy", "reward_co_contraction", "reward_reflexes", "reward_torque")
"""What a bounded reward is the sum of."""

START = AHEAD + 1
"""Samples of what is known ahead that motors are told before the first step."""

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
    if settings.senses == "normalised":
        return NORMALISED_LIMIT * np.append(np.ones(6), [max(settings.visual_gain, 1.0)] * 2)
    # In darkness everything seen is zero; a space must have some extent all the same.
    return SENSE_LIMITS * np.append(np.ones(6), [max(settings.visual_gain, 1e-3)] * 2)


def as_array(name: str, values: ArrayLike) -> NDArray:
    """Values that a caller gave.

    Args:
      name: what they are, for the message.
      values: of equally long rows, whatever their type.

    Raises:
      ValueError: rows differ in length.
    """
    try:
        return np.asarray(values)
    except ValueError:
        raise ValueError(f"{name} has rows of different lengths; expected equally long ones") from None


class Participants:
    """n people in trials of a task, apart from their physics; arrays have the person as first axis.

    Attributes:
      settings: the task.
      control: reflexes and muscle law of their arms; it is the simulation's.
      everybody: indices of all.
      levels: of co-contraction, velocity and position feedback in the steps of a decision, (person, 3, element) [-].
      reached: level that co-contraction has reached after them, (person, element) [-].
      step: of each trial, from 0, (person,).
      n_steps: at which each trial is over, (person,).
      lags: steps after which joints and hand are felt, and after which the handle is seen.
    """

    def __init__(self, settings: TaskSettings, control: ArmControl) -> None:
        """Begin without trials.

        Args:
          settings: the task.
          control: reflexes and muscle law of as many arms as there are people.
        """
        self.settings, self.control = settings, control
        n = len(control.table)
        self.levels, self.reached = np.zeros((n, 3, 3)), np.zeros((n, 3))
        self.step, self.n_steps = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
        self.everybody, self._every = np.arange(n), settings.steps_per_decision
        self._low, self._high = action_bounds(settings)
        self._names = action_names(settings)
        # Of the way to a new level: what is left after a decision, and on average during it.
        self._left = self._left_on_average = 0.0
        if settings.activation_time:
            decay = 1.0 / (settings.control_rate * settings.activation_time)
            self._left, self._left_on_average = np.exp(-decay), -np.expm1(-decay) / decay
        self._relaxed, self._position = (strength_of([subject] * n) for subject in settings.people)
        self._posture = np.zeros((n, 2))
        self._known = np.zeros((n, 1, len(KNOWN)))  # longer with the first trials
        self._recorded = np.zeros((n, 1, 2))
        self._command = np.zeros((n, 2))
        self._within = 0
        self.lags = tuple(
            round(delay / settings.timestep) for delay in (settings.proprioceptive_delay, settings.visual_delay)
        )
        # At least what happens between decisions, to tell how far the handle was.
        self._senses = np.zeros((max(*self.lags, self._every) + 1, n, len(SENSES)))
        self._newest = 0
        normalised = settings.senses == "normalised"
        self._scales = np.repeat(settings.sense_scales, 2) if normalised else np.ones(len(SENSES))
        self._terms, self._square, self._success = np.zeros((n, len(TERMS))), np.zeros(n), np.zeros(n, dtype=bool)

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
                known_ahead(trial, settings.timestep, n * self._every),
                trial.perturbation.sample(settings.control_rate, n + 1),
            )
            for trial, n in zip(trials, n_decisions, strict=True)
        ]
        self._put(people, subjects)
        self.step[people] = 0
        self._terms[people], self._square[people], self._success[people] = 0.0, 0.0, False
        self._make_room(max(n_decisions))
        for person, n, (known, recorded) in zip(people.tolist(), n_decisions, signals, strict=True):
            self.n_steps[person] = n * self._every
            self._known[person, : len(known)] = known
            self._known[person, len(known) :] = 0.0
            self._recorded[person, : len(recorded)] = recorded
            self._recorded[person, len(recorded) :] = 0.0
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
        self.levels[people] = self.reached[people] = 1.0 if self.settings.task == "PT" else 0.0
        self._posture[people] = [subject.posture for subject in subjects]
        self._senses[:, people] = self._command[people] = 0.0
        self._senses[:, people, 0:2] = self._posture[people]

    def _make_room(self, n_decisions: int) -> None:
        missing = n_decisions + 1 - self._recorded.shape[1]
        if missing > 0:
            n, n_rows = len(self.everybody), n_decisions * self._every + START + 1 - self._known.shape[1]
            self._known = np.concatenate([self._known, np.zeros((n, n_rows, len(KNOWN)))], axis=1)
            self._recorded = np.concatenate([self._recorded, np.zeros((n, missing, 2))], axis=1)

    def lone(self, action: ArrayLike) -> NDArray:
        """A single person's action, (action,), as `decide` takes it, (1, action).

        Raises:
          TypeError: the action is no array of numbers.
          ValueError: it has the wrong shape.
        """
        return self._shaped(action, (len(self._names),))[np.newaxis]

    def decide(self, actions: ArrayLike) -> tuple[Indices, Strength]:
        """Take everybody's action for the steps up to the next decision.

        Args:
          actions: (person, action), see `action_names`.

        Returns:
          Indices of those whose muscles change, and the muscles that they have from now on.

        Raises:
          TypeError: actions are no numbers.
          ValueError: they have the wrong shape, or one of them is not finite, or refused.
        """
        actions = self.checked(actions)
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
            self._command = actions[:, column:] * settings.highest_torque
            self.control.table["commanded"], self.control.memory["command"] = 1.0, self._command
        self._within = 0
        changed = np.flatnonzero((self.levels != before).any(axis=(1, 2)))
        if not len(changed):
            return changed, {}
        ends = self._relaxed, self._position
        relaxed, position = ({name: values[changed] for name, values in end.items()} for end in ends)
        return changed, strength_between(relaxed, position, self.levels[changed])

    def known(self, people: Indices, first: int, n_samples: int) -> Array:
        """Torque on the joints [Nm] and force on the handle [N] that are known ahead, (person, sample, motor).

        Args:
          people: indices of those.
          first: sample to begin with, counted from one step before this decision's first step.
          n_samples: how many.
        """
        # Where a trial is over, signals are zero until the next one begins.
        rows = self.step[people, None] + first + np.arange(n_samples)
        return self._known[people[:, None], np.minimum(rows, self._known.shape[1] - 1)]

    def _shaped(self, actions: ArrayLike, shape: tuple[int, ...]) -> NDArray:
        values = as_array("action", actions)
        if values.dtype.kind not in "fiub":
            raise TypeError(f"action of type {values.dtype}; expected numbers")
        if values.shape != shape:
            raise ValueError(f"action of shape {values.shape}; expected {shape}: {', '.join(self._names)}")
        return values

    def checked(self, actions: ArrayLike) -> Array:
        """Everybody's actions within their bounds; arguments and errors as in `decide`."""
        values = self._shaped(actions, (len(self.everybody), len(self._names))).astype(float)
        good = np.isfinite(values)
        if self.settings.out_of_bounds == "refuse":
            good &= (values >= self._low) & (values <= self._high)
        if not good.all():
            person, column = np.argwhere(~good)[0]
            raise ValueError(
                f"action[{column}] ({self._names[column]}) = {values[person, column].item()!r}"
                f"{f' of environment {person}' if len(values) > 1 else ''}; expected {self._low[column]:g} to "
                f"{self._high[column]:g}"
            )
        return np.clip(values, self._low, self._high)

    def drive(self, angle: Array, velocity: Array) -> tuple[Array, Array]:
        """What acts during the next step, of a simulation that asks for each.

        Args:
          angle: of the joints at its start [rad], (person, joint).
          velocity: of the joints [rad/s], (person, joint).

        Returns:
          Torque to hold on the joints [Nm], (person, joint), and controls of all motors, (person, motor).
        """
        held, sent = self.control.torque(angle, velocity)
        return held, np.concatenate([sent, self.known(self.everybody, START + self._within, 1)[:, 0]], axis=1)

    def sense(self, angle: Array, velocity: Array, handle: Array, force: Array) -> None:
        """Take in what steps led to.

        Args:
          angle: of the joints after each [rad], (person, step, joint).
          velocity: of the joints [rad/s], likewise.
          handle: displacement of the handle [m], (person, step, axis).
          force: that it exerted on the hand at the start of each [N], likewise.
        """
        n_steps = angle.shape[1]
        rows = (self._newest + 1 + np.arange(n_steps)) % len(self._senses)
        self._senses[rows] = np.concatenate([angle, velocity, force, handle], axis=2).swapaxes(0, 1)
        self._newest = int(rows[-1])
        self._within += n_steps

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
        sensed /= self._scales
        bounds = observation_bounds(self.settings)
        return np.clip(sensed, -bounds, bounds)

    def judge(self, handle: Array, diverged: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """End of the steps of a decision.

        Args:
          handle: its displacement [m], (person, axis).
          diverged: whether the arm could not be integrated, (person,).

        Returns:
          Rewards, terminations and truncations, (person,) each. A trial terminates at the limit of the workspace, or
          where it cannot be integrated, and is truncated when it is over. With the reward "bounded", a decision is
          worth from 0 to 1, see `verdict`; the one that ends a trial early is worth 0, and so are those that were to
          come, so that to give up never pays. With "cost" it is minus the cost displacement_weight |x|^2 and the
          weighted effort; to end early costs the worst, at once for all decisions that were to come.
        """
        settings = self.settings
        self.step += self._every
        steps = np.arange(self._newest - self._every + 1, self._newest + 1)  # below 0, from the other end
        reach = np.abs(self._senses[steps, :, 6:8]).max(axis=0)
        terminated = (reach >= settings.environment.workspace).any(axis=1) | diverged
        level, square = np.square(self.levels).mean(axis=2), np.square(handle).sum(axis=1)
        weights = settings.co_contraction_weight, settings.reflex_weight, settings.torque_weight
        torque = np.square(self._command / settings.highest_torque).mean(axis=1)
        squares = level[:, 0], level[:, 1:].mean(axis=1), torque
        truncated = self.step >= self.n_steps
        self._square += square
        mean = self._square * self._every / self.step
        self._success = (settings.displacement_weight * mean <= TOLERANCE**2) & ~terminated
        if settings.reward == "cost":
            efforts = [weight * mean for weight, mean in zip(weights, squares, strict=True)]
            rewards = -settings.displacement_weight * square - (efforts[0] + efforts[1] + efforts[2])
            lost = 1 + np.maximum(self.n_steps - self.step, 0) // self._every
            return np.where(terminated, -settings.worst * lost, rewards), terminated, truncated
        # Where the agent sets no levels, they are the person's own.
        highest = (settings.highest_level if settings.sets_levels else max(settings.highest_level, 1.0)) ** 2
        spared = [1.0 - mean / most for mean, most in zip(squares, (highest, highest, 1.0), strict=True)]
        terms = [1.0 / (1.0 + settings.displacement_weight * square)]
        terms += [weight * share for weight, share in zip(weights, spared, strict=True)]
        self._terms = np.where(terminated[:, None], 0.0, np.stack(terms, axis=1) / (1.0 + sum(weights)))
        return self._terms.sum(axis=1), terminated, truncated

    def verdict(self) -> dict[str, NDArray]:
        """Whether the trial is a success so far, and what the last decision's bounded reward is the sum of, (person,).

        With w the weights over 1 plus the sum of the weights of effort, the terms are w / (1 + displacement_weight
        |x|^2), and for co-contraction, reflexes and torque w (1 - mean square of what was set over the most that can be
        set). A success is a trial up to now in which the root-mean-square displacement is at most `TOLERANCE` over the
        root of displacement_weight.
        """
        terms = {} if self.settings.reward == "cost" else dict(zip(TERMS, self._terms.T.copy(), strict=True))
        return terms | {"success": self._success.copy()}

    def perturbation(self) -> Array:
        """Disturbance at this moment [N], (person, axis)."""
        return self._recorded[self.everybody, np.minimum(self.step // self._every, self._recorded.shape[1] - 1)]

    def largest_forces(self) -> Array:
        """Largest force of each trial's perturbation [N], (person,)."""
        return np.asarray(np.linalg.norm(self._recorded, axis=2).max(axis=1))
