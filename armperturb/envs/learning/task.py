"""The task of an agent that acts as a person's nervous system: settings, and the trials drawn from them."""

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from armperturb.analysis.arm.state_space import require_stable
from armperturb.cohort import Person, average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import ENGINES, TIMESTEP, Environment
from armperturb.envs.lab.trial import Trial, require_integrable
from armperturb.perturbations import Multisine, MultisineThenPulse, Perturbation, Pulse, Sampled, check_bandwidth
from armperturb.perturbations.multisine import PERIOD
from armperturb.subject import POSITION, RELAX, TASKS, Subject, at_level
from armperturb.validation import require_number, require_one_of, require_ranges, require_type

PERTURBATIONS = ("none", "multisine", "pulse", "multisine-pulse")
"""What may push the handle."""

PEOPLE = ("average", "published")
"""People by name: the calibrated average person, whose muscles yield, and the thesis's linear mean arms."""

CO_CONTRACTION = ("groups", "common", "off")
"""Whether an agent sets the level of each muscle group, one for all, or none."""

REWARDS = ("bounded", "cost")
"""Rewards of a decision: from 0 to 1, the better the higher, or minus a cost without bounds."""

SENSES = ("normalised", "physical")
"""Whether an observation is divided by `sense_scales`."""

OUT_OF_BOUNDS = ("clip", "refuse")
"""What is done with actions out of their bounds; those that are not finite are refused in any case."""

OPTIONS = ("perturbation", "rms", "peak", "directions_deg", "onset_window", "randomise", "noise", "trial")
"""What may be chosen anew at each reset; all but the trial as in `TaskSettings`."""

OF_KIND = {"rms": "multisine", "peak": "pulse", "directions_deg": "pulse", "onset_window": "pulse"}
"""Option to the part of the perturbation that it is of."""

REALISATIONS = 8
"""Multisines of lowered crest factor among which trials choose; each begins anywhere in its period."""

NOT_BY_LEVEL = tuple(f"{gain}_{joint}" for gain in ("ka", "kf") for joint in ("s", "se", "e"))
"""Gains of a subject that levels do not set: a person relaxed would keep them."""

LARGEST = 1e6
"""Of forces: what is larger is a slip, and numerics would suffer."""

Choices = float | tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class TaskSettings:
    """A task, what its agent may do and senses, and what it is rewarded for.

    Attributes:
      task: "PT" or "RT": whose own muscles, reflexes and noise the person has.
      person: "average", "published", or a `Person` with both tasks.
      perturbation: "none", "multisine", "pulse", or "multisine-pulse", where the pulse ends the multisine.
      rms: force of a multisine per axis [N]; of several, each trial draws one.
      peak: force of a pulse [N]; likewise.
      directions_deg: of a pulse, from the x axis [deg]; likewise.
      onset_window: earliest and latest onset of a pulse [s]; None is from a tenth to the half of the duration.
      randomise: whether trials draw realisation, force, direction and onset; if not, each takes the first of all.
      noise: whether the person is noisy and differs from trial to trial, as in the study.
      duration: of a trial [s]; it is truncated then.
      control_rate: decisions per second [Hz].
      timestep: of the simulation [s].
      engine: "mujoco", or "compiled": the same arm by compiled equations of motion, some ten times faster; dm_control
        always has MuJoCo.
      environment: what the hand holds.
      co_contraction: "groups", "common" or "off", see `CO_CONTRACTION`.
      reflexes: whether the agent sets reflex gains.
      torque: whether the agent adds torque at the joints.
      out_of_bounds: what is done with an action out of its bounds: "clip" or "refuse".
      highest_level: of co-contraction and reflex gains that an action of 1 stands for [-]: 0 is the person relaxed, 1
        the person's position task; beyond, torques are in proportion.
      highest_torque: that an action of 1 stands for [Nm].
      activation_time: with which muscles follow a new level of co-contraction [s]; 0 is at once. The default is the
        delay at low frequencies of the reflexes' activation filter, 2 zeta / omega.
      proprioceptive_delay: after which joints and hand are felt [s].
      visual_delay: after which the handle is seen [s].
      visual_gain: displacement seen over displacement [-]; 0 is darkness.
      senses: "normalised" or "physical".
      sense_scales: what is 1 in a normalised observation: stretch [rad], velocity [rad/s], force [N] and displacement
        seen [m].
      reward: "bounded" or "cost", see `Participants.judge`.
      displacement_weight: [1/m^2]; a displacement of 1 over its root halves the accuracy.
      co_contraction_weight: on the mean square level of the muscle groups [-].
      reflex_weight: on the mean square reflex level [-].
      torque_weight: on the mean square torque over `highest_torque` [-].

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is out of its range, or values do not fit together.
    """

    task: str = "PT"
    person: str | Person = "average"
    perturbation: str = "multisine"
    rms: Choices = 5.4
    peak: Choices = (53.9, 107.8)
    directions_deg: Choices = (20.0, 200.0)
    onset_window: tuple[float, float] | None = None
    randomise: bool = True
    noise: bool = True
    duration: float = 10.0
    control_rate: float = 50.0
    timestep: float = TIMESTEP
    engine: str = "mujoco"
    environment: Environment = field(default_factory=Environment)
    co_contraction: str = "groups"
    reflexes: bool = True
    torque: bool = True
    out_of_bounds: str = "clip"
    highest_level: float = 1.0
    highest_torque: float = 10.0
    activation_time: float = 0.064
    proprioceptive_delay: float = 0.030
    visual_delay: float = 0.150
    visual_gain: float = 1.0
    senses: str = "normalised"
    sense_scales: tuple[float, ...] = (0.02, 0.2, 5.0, 0.005)
    reward: str = "bounded"
    displacement_weight: float = 1e4
    co_contraction_weight: float = 0.15
    reflex_weight: float = 0.05
    torque_weight: float = 0.15

    def __post_init__(self) -> None:
        owner = "TaskSettings"
        for name in ("rms", "peak", "directions_deg", "onset_window", "sense_scales"):
            if isinstance(getattr(self, name), list):  # the caller's, who may change it
                object.__setattr__(self, name, tuple(getattr(self, name)))
        require_one_of(owner, "task", self.task, TASKS)
        require_one_of(owner, "perturbation", self.perturbation, PERTURBATIONS)
        require_one_of(owner, "engine", self.engine, ENGINES)
        require_one_of(owner, "co_contraction", self.co_contraction, CO_CONTRACTION)
        require_one_of(owner, "out_of_bounds", self.out_of_bounds, OUT_OF_BOUNDS)
        require_one_of(owner, "senses", self.senses, SENSES)
        require_one_of(owner, "reward", self.reward, REWARDS)
        if not isinstance(self.sense_scales, tuple) or len(self.sense_scales) != 4:
            raise TypeError(f"{owner}: sense_scales = {self.sense_scales!r}; expected four numbers")
        for value in self.sense_scales:
            require_number(owner, "sense_scales", value, above=0.0, at_most=LARGEST)
        if isinstance(self.person, Person):
            missing = [task for task in TASKS if task not in self.person.subjects]
            if missing:
                raise ValueError(f"{owner}: person {self.person.name!r} has no task {missing[0]}; expected both tasks")
        else:
            expected = f"a Person, which has a Subject for each task, or one of {', '.join(PEOPLE)}"
            require_type(f"{owner}: person", self.person, str, expected)
            require_one_of(owner, "person", self.person, PEOPLE)
        for name in ("randomise", "noise", "reflexes", "torque"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{owner}: {name} = {getattr(self, name)!r}; expected True or False")
        if not isinstance(self.environment, Environment):
            raise TypeError(f"{owner}: environment = {self.environment!r}; expected Environment")
        for name in ("rms", "peak"):
            for value in _choices(name, getattr(self, name)):
                require_number(owner, name, value, above=0.0, at_most=LARGEST)
        for value in _choices("directions_deg", self.directions_deg):
            require_number(owner, "directions_deg", value)
        require_ranges(owner, self)
        steps = f"steps of {self.timestep:g} s in a decision"
        _require_whole("control_rate", self.control_rate, "Hz", 1.0 / (self.control_rate * self.timestep), steps)
        _require_whole("duration", self.duration, "s", self.duration * self.control_rate, "decisions")
        if "pulse" in self.perturbation:
            require_number(owner, "duration with a pulse", self.duration, above=Pulse.width)
        window = self.onsets
        if not isinstance(window, tuple) or len(window) != 2:
            raise TypeError(f"{owner}: onset_window = {window!r}; expected the earliest and the latest onset [s]")
        for value in window:
            require_number(owner, "onset_window", value, at_least=0.0)
        if window[0] > window[1]:
            raise ValueError(f"{owner}: onset_window = {window!r}; expected the earliest onset first")
        if "pulse" in self.perturbation:
            latest = self.duration - Pulse.width
            require_number(owner, "latest onset of onset_window", window[1], at_most=latest)
        if self.perturbation == "multisine-pulse":
            require_number(owner, "earliest onset of onset_window", window[0], above=0.0)
        if self.task == "PT" and self.sets_levels:
            # Otherwise the agent could not reach the person's own level.
            require_number(owner, "highest_level", self.highest_level, at_least=1.0)
        for subject in self.people:
            self._require_sound(subject)

    def _require_sound(self, subject: Subject) -> None:
        subject.require_simulable()
        require_stable(subject, self.environment)
        require_integrable(subject, self.environment, None, self.timestep)
        fixed: dict[str, Any] = {name: getattr(subject, name) for name in NOT_BY_LEVEL}
        if subject.muscle is not None:
            fixed["spindle_threshold_slope"] = subject.muscle.spindle_threshold_slope
        for name, value in fixed.items() if self.sets_levels else ():
            if np.any(value):
                raise ValueError(
                    f"TaskSettings: subject {subject.name!r} has {name} = {value}; expected 0 where the agent sets "
                    "levels, which do not reach acceleration and force feedback or thresholds of spindles "
                    "(co_contraction = 'off' and reflexes = False set none)"
                )
        if self.sets_levels and subject.task == "PT":
            try:
                require_integrable(at_level(subject, self.highest_level), self.environment, None, self.timestep)
            except ValueError as error:
                raise ValueError(f"TaskSettings: highest_level = {self.highest_level!r}: {error}") from None
        if self.co_contraction != "groups":
            return
        for quantity in ("k", "b"):
            least = min(subject.muscle_groups(quantity))
            if least < 0.0:
                raise ValueError(
                    f"TaskSettings: co_contraction = 'groups'; expected 'common' or 'off', as a muscle group of "
                    f"subject {subject.name!r} has {quantity} = {least:.4g}, which would give energy by itself"
                )

    @property
    def onsets(self) -> tuple[float, float]:
        """Earliest and latest onset of a pulse [s]."""
        if self.onset_window is not None:
            return self.onset_window
        # Too short a trial has no pulse, which is refused elsewhere.
        latest = max(min(0.5 * self.duration, self.duration - Pulse.width), 0.0)
        return min(0.1 * self.duration, latest), latest

    @property
    def people(self) -> tuple[Subject, Subject]:
        """The person relaxed and in the position task: what levels of 0 and 1 stand for."""
        if self.person == "published":
            return RELAX, POSITION
        person = average_person() if isinstance(self.person, str) else self.person
        return person.subjects["RT"], person.subjects["PT"]

    @property
    def subject(self) -> Subject:
        """The person in this task."""
        return self.people[1 if self.task == "PT" else 0]

    @property
    def sets_levels(self) -> bool:
        """Whether the agent sets any level."""
        return self.co_contraction != "off" or self.reflexes

    @property
    def worst(self) -> float:
        """What a decision costs at the far corner of the workspace with all effort: no other inside costs more [-]."""
        efforts = self.co_contraction_weight + self.reflex_weight
        corner = 2.0 * self.environment.workspace**2
        return self.displacement_weight * corner + efforts * max(self.highest_level, 1.0) ** 2 + self.torque_weight

    @property
    def steps_per_decision(self) -> int:
        """Simulation steps between decisions."""
        return round(1.0 / (self.control_rate * self.timestep))

    def drawing(self, options: Mapping[str, Any] | None = None) -> Callable[[np.random.Generator], Trial]:
        """How trials are drawn; what has to be refused is refused here, before anything is drawn.

        Args:
          options: what differs from the settings, see `OPTIONS`, as `reset(options=...)` has it; a `trial` is taken as
            it is.

        Returns:
          A function of what the trial is drawn from.

        Raises:
          TypeError: an option has the wrong type.
          ValueError: an option is unknown or out of its range, or the trial's subject is unstable, of the other task,
            too fast for the step, or has longer delays than the task's person.
        """
        if options is None:
            return self._draw
        if not isinstance(options, Mapping):
            raise TypeError(f"reset: options = {options!r}; expected a dict of some of {', '.join(OPTIONS)}")
        for key in options:
            if key not in OPTIONS:
                raise ValueError(f"reset: unknown option {key!r}; expected some of {', '.join(OPTIONS)}")
        if "trial" not in options:
            settings = replace(self, **options) if options else self
            for key in options:
                if OF_KIND.get(key, "") not in settings.perturbation:
                    raise ValueError(
                        f"reset: {key} = {options[key]!r} with perturbation = {settings.perturbation!r}, which has no "
                        f"{OF_KIND[key]}; expected the option perturbation with one, or no {key}"
                    )
            return settings._draw
        if len(options) > 1:
            raise ValueError(f"reset: options = {', '.join(options)}; expected nothing else beside a trial")
        trial = self.checked(options["trial"], "reset")
        return lambda _: trial

    def _draw(self, rng: np.random.Generator) -> Trial:
        number = int(rng.integers(REALISATIONS)) if self.randomise else 0
        start = float(rng.uniform(0.0, PERIOD)) if self.randomise else 0.0
        onset = float(rng.uniform(*self.onsets)) if self.randomise else self.onsets[0]

        def choose(choices: Choices) -> float:
            values = _choices("choices", choices)
            return float(values[int(rng.integers(len(values)))] if self.randomise else values[0])

        perturbation = _perturbation(
            self, number, start, onset, choose(self.rms), choose(self.peak), choose(self.directions_deg)
        )
        seed, noise = int(rng.integers(2**63)), HUMAN_NOISE[self.task] if self.noise else None
        return Trial(subject=self.subject, perturbation=perturbation, condition=self.task, seed=seed, noise=noise)

    def checked(self, trial: object, owner: str) -> Trial:
        """The trial, as it fits to the task.

        Args:
          trial: a given one.
          owner: what was called with it, for messages.

        Raises:
          TypeError: it is no `Trial`.
          ValueError: it does not fit to the task, as `drawing` says.
        """
        if not isinstance(trial, Trial):
            raise TypeError(f"{owner}: trial = {trial!r}; expected Trial")
        if trial.subject.task != self.task:
            raise ValueError(f"{owner}: trial has the task {trial.subject.task}; expected {self.task}")
        self._require_sound(trial.subject)
        longest = max(max(subject.Td_s, subject.Td_e) for subject in self.people)
        for name in ("Td_s", "Td_e"):
            require_number(owner, f"{name} of the trial's subject", getattr(trial.subject, name), at_most=longest)
        check_bandwidth(trial.perturbation, 1.0 / self.timestep)
        require_number(owner, "duration of the trial", trial.perturbation.duration, at_least=1.0 / self.control_rate)
        return trial


def task_settings(settings: dict[str, Any]) -> TaskSettings:
    """Settings by name.

    Raises:
      TypeError: a name is unknown; otherwise as `TaskSettings`.
    """
    known = TaskSettings.__dataclass_fields__
    for name in settings:
        if name not in known:
            raise TypeError(f"unknown setting {name!r}; expected some of {', '.join(known)}")
    return TaskSettings(**settings)


def _perturbation(
    settings: TaskSettings, number: int, start: float, onset: float, rms: float, peak: float, direction: float
) -> Perturbation:
    kind, duration = settings.perturbation, settings.duration
    pulse = Pulse(peak=peak, direction_deg=direction, onset=onset, duration=duration) if "pulse" in kind else None
    if "multisine" not in kind:
        return pulse or Sampled(force=np.zeros((2, 2)), rate=2.0 / duration)
    unit = _realisation(number)
    turned = unit.phases + 2.0 * math.pi * np.mod(unit.frequencies * start, 1.0)
    multisine = replace(unit, rms=rms, phases=turned, duration=duration if pulse is None else onset)
    return multisine if pulse is None else MultisineThenPulse(multisine=multisine, pulse=pulse)


@functools.lru_cache(maxsize=REALISATIONS)
def _realisation(number: int) -> Multisine:
    """A multisine of 1 N; lowering its peaks takes 0.15 s, hence kept."""
    return Multisine.draw(seed=number, rms=1.0)


def _choices(name: str, choices: object) -> tuple[Any, ...]:
    """The numbers to choose from, of one or several."""
    values = choices if isinstance(choices, tuple) else (choices,)
    if not values:
        raise ValueError(f"TaskSettings: {name} = {choices!r}; expected at least one number")
    return tuple(values)


def _require_whole(name: str, value: float, unit: str, number: float, what: str) -> None:
    if number < 0.5 or abs(number - round(number)) > 1e-6:
        raise ValueError(f"TaskSettings: {name} = {value:g} {unit}; expected a whole number of {what}, not {number:g}")
