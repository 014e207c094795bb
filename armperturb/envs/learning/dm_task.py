"""The dm_control face: one person in trials of a task, whose nervous system is the agent, as a composer task."""

import copy
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import fields
from types import NoneType
from typing import Any, ClassVar

import dm_env
import numpy as np
from dm_env import specs
from numpy.typing import ArrayLike

from armperturb.arrays import Array
from armperturb.controllers.arm_control import ArmControl
from armperturb.envs.lab.simulation import body_of
from armperturb.envs.lab.stepping import DIVERGED
from armperturb.envs.lab.trial import Trial
from armperturb.envs.learning import participants
from armperturb.envs.learning.dm import composer, mjcf, observable
from armperturb.envs.learning.entities import Rig
from armperturb.envs.learning.state import Turn, Types, in_turn, require_open, require_state
from armperturb.envs.learning.task import TaskSettings, task_settings
from armperturb.models.rig import REFLEXES, start_motors

SENSES = {"joint_stretch": 0, "joint_velocity": 2, "hand_force": 4, "handle_seen": 6}
"""Name of an observable to the first of its two places in an observation of `Participants`."""


class Sense(observable.Generic):
    """What the person senses, within bounds; composer delays it."""

    def __init__(self, people: participants.Participants, columns: slice, bound: Array, delay: int) -> None:
        """Enable it.

        Args:
          people: of whom the first senses it.
          columns: where it is among the senses.
          bound: its largest absolute values.
          delay: after which it is sensed [steps].
        """
        super().__init__(lambda _: people.undelayed()[0, columns], delay=delay)
        self._spec = specs.BoundedArray(bound.shape, np.float64, -bound, bound)
        self.enabled = True

    @property
    def array_spec(self) -> specs.BoundedArray:
        """Shape, type and bounds."""
        return self._spec


class ArmPerturbTask(composer.Task):
    """A person holds a handle that is perturbed; docs/environments.md says what is sensed, set and rewarded.

    What the person senses is enabled: `joint_stretch` [rad], `joint_velocity` [rad/s] and `hand_force` [N] after the
    proprioceptive delay, `handle_seen` [m] after the visual delay. What no person knows can be enabled: `time` of the
    trial [s], `perturbation` [N] and the level of `co_contraction` [-] of the muscle groups, each once per decision,
    and the observables of arm and manipulator, undelayed.

    Attributes:
      settings: the task.
      own_action: by which the person does the task as in the study, (action,).
      trial: of this episode; None before the first.
    """

    def __init__(self, settings: TaskSettings) -> None:
        """Put the person in the rig.

        Args:
          settings: the task.
        """
        self.settings = settings
        self.own_action = participants.own_action(settings)
        self.trial: Trial | None = None
        self._options: dict[str, Any] = {}
        self._people = participants.Participants(settings, ArmControl([settings.subject], settings.timestep))
        self._rig = Rig(settings.subject, settings.environment, timestep=settings.timestep)
        self.set_timesteps(1.0 / settings.control_rate, settings.timestep)
        self._task_observables = self._make_observables()
        self._tolerant = ExitStack()
        self._reward, self._terminated, self._truncated = 0.0, False, False

    def _make_observables(self) -> OrderedDict[str, observable.Observable]:
        people, settings = self._people, self.settings
        bounds = participants.observation_bounds(settings)
        made: OrderedDict[str, observable.Observable] = OrderedDict()
        for name, first in SENSES.items():
            both = slice(first, first + 2)
            made[name] = Sense(people, both, bounds[both], people.lags[name == "handle_seen"])
        for name, read in {
            "time": lambda _: people.step[0] * settings.timestep,
            "perturbation": lambda _: people.perturbation()[0],
            "co_contraction": lambda _: people.reached[0].copy(),  # composer would keep a view as padding
        }.items():
            made[name] = observable.Generic(read, update_interval=settings.steps_per_decision)
        return made

    @property
    def root_entity(self) -> Rig:
        """The rig."""
        return self._rig

    @property
    def task_observables(self) -> OrderedDict[str, observable.Observable]:
        """What the person senses, and what no person knows."""
        return self._task_observables

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """Bounds and, parted by tabs, names of what an action sets."""
        low, high = participants.action_bounds(self.settings)
        return specs.BoundedArray(low.shape, np.float64, low, high, "\t".join(participants.action_names(self.settings)))

    def choose(self, **options: Any) -> None:
        """Choose what the next episode differs in from the settings; the one after it follows them again.

        Args:
          **options: as in `reset(options=...)` of the gymnasium environment, see `learning.task.OPTIONS`. The
            subject of a `trial` must have the body and the delays of the task's person, which are in the model.

        Raises:
          TypeError: an option has the wrong type.
          ValueError: an option is unknown or out of its range, or the trial's subject has another body.
        """
        self._require_choice(options)
        self._options = options

    def _require_choice(self, options: dict[str, Any]) -> None:
        trial = self.settings.drawing(options)(np.random.default_rng(0))
        needed, given = body_of(self.settings.subject), body_of(trial.subject)
        for field in fields(needed):
            value, expected = getattr(given, field.name), getattr(needed, field.name)
            if value != expected:
                raise ValueError(
                    f"choose: trial has a subject with {field.name} = {value!r}; expected {expected!r}, "
                    "which the task's person has; for others, load an environment with the setting person"
                )

    def require_episode(self, options: dict[str, Any], actions: Iterable[ArrayLike]) -> None:
        """Refuse what would be refused on the way through an episode.

        Args:
          options: as in `choose`.
          actions: decisions of the agent.

        Raises:
          TypeError: an option or an action has the wrong type.
          ValueError: `choose` refuses the options, or `before_step` an action.
        """
        self._require_choice(options)
        for action in actions:
            self._people.checked(self._people.lone(action))

    @property
    def chosen(self) -> dict[str, Any]:
        """What the next episode differs in from the settings."""
        return dict(self._options)

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Find everything in a new model."""
        arm, manipulator = self._rig.arm, self._rig.manipulator
        model, data = physics.model.ptr, physics.data.ptr
        hinge, slide = (
            slice(first, first + 2)
            for first in (
                model.joint(joints[0].full_identifier).qposadr[0] for joints in (arm.joints, manipulator.slides)
            )
        )
        self._motor, gauge = int(physics.bind(arm.reflexes[0]).element_id), physics.bind(manipulator.gauge).adr
        two_joint = physics.bind(arm.biarticular).element_id
        tendon = slice(two_joint, two_joint + 1)
        self._springs = model.jnt_stiffness[hinge], model.tendon_stiffness[tendon]
        self._dampers = model.dof_damping[hinge], model.tendon_damping[tendon]
        # Live, and not by a binding: after a write to one, dm_control may compute forces anew in the middle of a step.
        self._angle, self._velocity = data.qpos[np.newaxis, hinge], data.qvel[np.newaxis, hinge]
        self._handle, self._force = data.qpos[np.newaxis, slide], data.sensordata[np.newaxis, gauge : gauge + 2]
        self._torque, self._control = data.qfrc_applied[np.newaxis, hinge], data.ctrl[np.newaxis, self._motor :]
        self._warnings = data.warning.number

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Begin the next trial, at rest; nothing is left of those before."""
        self._tolerant.close()
        rng = np.random.default_rng(random_state.randint(2**63, dtype=np.int64))
        options, self._options = self._options, {}
        self.trial = self.settings.drawing(options)(rng)
        subjects = self._people.start(participants.ONLY, [self.trial])
        self._people.control.replace(participants.ONLY, subjects)
        self._set_muscles(*(np.array(subjects[0].muscle_groups(name)) for name in ("k", "b")))
        known = self._people.known(participants.ONLY, 0, participants.START)[0]
        start_motors(physics.model.ptr, physics.data.ptr, self._motor + len(REFLEXES), known)

    def _set_muscles(self, stiffness: Array, damping: Array) -> None:
        """Springs and dampers of the muscle groups (shoulder, two-joint, elbow), beside the short-range stiffness."""
        stiffness = stiffness + self._people.control.table["short_range"][0]
        for (joints, tendon), groups in ((self._springs, stiffness), (self._dampers, damping)):
            joints[:], tendon[:] = groups[::2], groups[1]

    def before_step(self, physics: mjcf.Physics, action: ArrayLike, random_state: np.random.RandomState) -> None:
        """Take the agent's decision.

        Raises:
          TypeError: the action is no array of numbers.
          ValueError: it has the wrong shape, or part of it is not finite, or out of its bounds where these are refused.
        """
        changed, strength = self._people.decide(self._people.lone(action))
        if len(changed):
            self._people.control.set_strength(changed, strength)
            self._set_muscles(strength["k_groups"][0], strength["b_groups"][0])
        # What cannot be integrated ends the trial with its reward; composer would have none for it.
        self._tolerant.enter_context(physics.suppress_physics_errors())

    def before_substep(self, physics: mjcf.Physics, action: ArrayLike, random_state: np.random.RandomState) -> None:
        """Reflexes, muscles and the perturbation act."""
        self._torque[:], self._control[:] = self._people.drive(self._angle, self._velocity)

    def after_substep(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """The person feels and sees what came of it."""
        self._people.sense(self._angle[None], self._velocity[None], self._handle[None], self._force[None])

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Judge what came of the decision."""
        self._tolerant.close()
        diverged = (self._warnings[[*DIVERGED]] > 0).any(keepdims=True)
        rewards, terminated, truncated = self._people.judge(self._handle, diverged)
        self._reward, self._terminated, self._truncated = float(rewards[0]), bool(terminated[0]), bool(truncated[0])

    def get_reward(self, physics: mjcf.Physics) -> float:
        """Of the last decision, see `Participants.judge`."""
        return self._reward

    def get_discount(self, physics: mjcf.Physics) -> float:
        """0 where the handle reached the limit of the workspace, else 1: a trial that is over is truncated."""
        return 0.0 if self._terminated else 1.0

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        """Whether the handle reached the limit of the workspace or the trial is over."""
        return self._terminated or self._truncated


class ArmPerturbDmEnv(composer.Environment):
    """A composer environment that can be copied, pickled, and returned to a saved state.

    A state is what an episode began with and the actions since: the way there is taken again. So it holds what steps
    have led to, and nothing that was written into the physics by hand.
    """

    STATE: ClassVar[Types] = {
        "began": (tuple, NoneType),
        "actions": list,
        "random": (tuple, dict),
        "next": dict,
        "enabled": list,
    }
    """What a state holds beside the settings, and of which type."""

    def __init__(self, settings: TaskSettings, random_state: int | np.random.RandomState | None) -> None:
        """Make the environment; arguments and errors as in `load_dm_env`."""
        self._turn, self._closed = Turn(), False
        # Generator, options and observables at the beginning of the episode; None before the first.
        self._began: tuple[Any, dict[str, Any], list[str]] | None = None
        self._actions: list[Array] = []
        super().__init__(
            ArmPerturbTask(settings),
            random_state=random_state,
            strip_singleton_obs_buffer_dim=True,
            recompile_mjcf_every_episode=False,
            delayed_observation_padding=composer.ObservationPadding.INITIAL_VALUE,
        )

    @in_turn
    def reset(self) -> dm_env.TimeStep:
        """Begin the next trial.

        Raises:
          RuntimeError: another thread is in here, or the environment is closed.
        """
        require_open(self._closed, "reset")
        self._began, self._actions = (self.random_state.get_state(), self.task.chosen, self._enabled), []
        return super().reset()

    @in_turn
    def step(self, action: ArrayLike) -> dm_env.TimeStep:
        """One decision; after the last one of a trial, the beginning of the next.

        Raises:
          TypeError: the action is no array of numbers.
          ValueError: it has the wrong shape, or part of it is refused.
          RuntimeError: another thread is in here, or the environment is closed.
        """
        require_open(self._closed, "step")
        taken = super().step(action)
        if not taken.first():
            self._actions.append(np.array(action))
        return taken

    @in_turn
    def close(self) -> None:
        """Free the physics; a second time does nothing.

        Raises:
          RuntimeError: another thread is in here.
        """
        if not self._closed:
            self._closed = True
            super().close()

    @property
    def _enabled(self) -> list[str]:
        """Names of the observables that are enabled; composer begins and ends to observe at the next reset."""
        return [name for name, item in self.task.observables.items() if item.enabled]

    @_enabled.setter
    def _enabled(self, names: list[str]) -> None:
        for name, item in self.task.observables.items():
            item.enabled = name in names

    @in_turn
    def get_state(self) -> dict[str, Any]:
        """All that trials to come depend on, and the rest of this one; it can be pickled.

        Raises:
          RuntimeError: another thread is in here.
        """
        state = {"settings": self.task.settings, "began": self._began, "actions": self._actions}
        now = {"random": self.random_state.get_state(), "next": self.task.chosen, "enabled": self._enabled}
        return copy.deepcopy({**state, **now})

    @in_turn
    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a state, to the last bit as where it was saved.

        Args:
          state: from `get_state` of an environment with the same settings, of this process or another.

        Raises:
          ValueError: it is of an environment of another kind or with other settings.
          RuntimeError: another thread is in here, or the environment is closed.
        """
        require_open(self._closed, "set_state")
        self._require_state(state)
        if state["began"] is None:
            self._began, self._actions, self._reset_next_step = None, [], True
        else:
            random, options, self._enabled = state["began"]
            self.random_state.set_state(random)
            self.task.choose(**options)
            self.reset()
            for action in state["actions"]:
                self.step(action)
        self._enabled = state["enabled"]
        self.random_state.set_state(state["random"])
        self.task.choose(**state["next"])

    def _require_state(self, state: dict[str, Any]) -> None:
        """Refuse what a return to a state would stumble over on its way."""
        require_state(type(self).__name__, state, {"settings": self.task.settings}, self.STATE)
        try:
            random, options, _ = state["began"] or (state["random"], {}, [])
            for numbers in (random, state["random"]):
                copy.deepcopy(self.random_state).set_state(numbers)
            self.task.require_episode(options, state["actions"])
            self.task.require_episode(state["next"], [])
        except (LookupError, TypeError, ValueError) as error:
            raise ValueError(
                f"set_state: state that no step leads to ({error}); expected one from get_state"
            ) from error

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.get_state(),)


def _restored(state: dict[str, Any]) -> ArmPerturbDmEnv:
    env = ArmPerturbDmEnv(state["settings"], None)
    env.set_state(state)
    return env


def compose(settings: Mapping[str, Any], random_state: int | np.random.RandomState | None) -> ArmPerturbDmEnv:
    """The environment of a task; arguments and errors as in `load_dm_env`."""
    return ArmPerturbDmEnv(task_settings(dict(settings)), random_state)
