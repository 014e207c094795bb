"""What is run: conditions, pulses and trials of an experiment, as data (thesis 2.5, table 2.1)."""

import functools
import math
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from importlib import resources
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from armperturb.cohort import Person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Strap
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine, MultisineThenPulse, Perturbation, Pulse, draw_onset
from armperturb.perturbations.perturbation import LARGEST_RMS_DISPLACEMENT
from armperturb.seeds import random_stream, trial_seed
from armperturb.subject import TASKS, Subject, at_level
from armperturb.validation import require_number

FORCES = ("practice", "published")
"""Where the forces come from: each person's practice session, or the protocol's own, the same for everyone."""

PULSE_UNIT = "pulse_unit"
"""Key of the peak force of pulse level 1 [N] in a mapping of forces, beside the conditions' names."""

PULSE_WIDTH = 0.08
"""Duration of a pulse [s] (thesis 2.4)."""

MOST_CO_CONTRACTION = 10.0
"""Highest level of co-contraction [-]: anything more is a slip in a file."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A row of table 2.1: a task under a multisine, pulses, or both.

    Attributes:
      name: what it is called in recordings and tables; not empty.
      task: "PT" (position task) or "RT" (relax task).
      rms_displacement: intended RMS displacement under the multisine, per axis [m], 0 to 0.1; 0 for no multisine.
      published_force: RMS force of the multisine per axis [N], >= 0, for those who do not practise.
      pulse_levels: peak forces of the pulses, in pulse units, > 0 [-]; each is applied in every direction.
      repetitions: of each pulse level and direction; of the multisine if there are no pulses.
      co_contraction: level of everyone's muscles and reflexes, as a multiple of their own in this condition (see
        `Person.levels` and `subject.at_level`) [-], above 0 to 10; 1 in RT, as relaxed people do not adapt.
      reached: how many times as far as intended people move the handle in the experiment [-], 0.1 to 10: between the
        practice session and the experiment, people change.
      reached_spread: SD over people of the logarithm of that [-], 0 to 1.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is not finite or out of its range, or there is neither a multisine nor a pulse.
    """

    name: str
    task: str
    rms_displacement: float = 0.0
    published_force: float = 0.0
    pulse_levels: tuple[float, ...] = ()
    repetitions: int = 1
    co_contraction: float = 1.0
    reached: float = 1.0
    reached_spread: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise TypeError(f"name = {self.name!r}; expected a text that is not empty")
        owner = f"condition {self.name!r}"
        if self.name == PULSE_UNIT:
            raise ValueError(f"{owner}: name = {self.name!r}; expected another, this one means the unit of the pulses")
        if self.task not in TASKS:
            raise ValueError(f"{owner}: task = {self.task!r}; expected one of {', '.join(TASKS)}")
        require_number(owner, "rms_displacement", self.rms_displacement, at_least=0.0, at_most=LARGEST_RMS_DISPLACEMENT)
        require_number(owner, "published_force", self.published_force, at_least=0.0)
        require_number(owner, "repetitions", self.repetitions, at_least=1)
        if not isinstance(self.repetitions, Integral):
            raise TypeError(f"{owner}: repetitions = {self.repetitions!r}; expected a whole number")
        require_number(owner, "co_contraction", self.co_contraction, above=0.0, at_most=MOST_CO_CONTRACTION)
        require_number(owner, "reached", self.reached, at_least=0.1, at_most=10.0)
        require_number(owner, "reached_spread", self.reached_spread, at_least=0.0, at_most=1.0)
        if self.task == "RT" and self.co_contraction != 1.0:
            raise ValueError(
                f"{owner}: co_contraction = {self.co_contraction!r}; expected 1 in RT, as relaxed people do not adapt"
            )
        levels = _numbers(owner, "pulse_levels", self.pulse_levels)
        for level in levels:
            require_number(owner, "pulse_levels", level, above=0.0)
        _require_different(owner, "pulse_levels", levels)
        object.__setattr__(self, "pulse_levels", levels)
        if not levels and not self.has_multisine:
            raise ValueError(
                f"{owner}: rms_displacement = 0 and pulse_levels = []; expected a multisine, a pulse or both"
            )
        if self.published_force > 0.0 and not self.has_multisine:
            raise ValueError(
                f"{owner}: published_force = {self.published_force!r}; expected 0, as rms_displacement = 0"
            )

    @property
    def has_multisine(self) -> bool:
        """Whether the handle is perturbed all the time, not by a pulse alone."""
        return self.rms_displacement > 0.0

    def subject_of(self, person: Person) -> Subject:
        """The person in this condition's task, at its level of co-contraction.

        Raises:
          KeyError: the person lacks the task.
        """
        return at_level(person.subjects[self.task], self.co_contraction * person.levels.get(self.name, 1.0))


class Cell(NamedTuple):
    """What one trial of a protocol is made of.

    Attributes:
      condition: which row of the table.
      repetition: from 0.
      level: of the pulse [-]; 0 for none.
      direction_deg: of the pulse, from the fronto-parallel axis [deg]; NaN for none.
    """

    condition: Condition
    repetition: int
    level: float
    direction_deg: float


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """All trials that every person goes through.

    Attributes:
      conditions: at least one, with different names.
      forces: "practice" (each person's, see `armperturb.study.recording.practice`) or "published" (those given here).
      pulse_directions_deg: directions of the pulses from the fronto-parallel axis, counter-clockwise [deg].
      pulse_unit: peak force of pulse level 1 [N], > 0; with practised forces only if `pulse_unit_condition` is empty.
      pulse_unit_condition: name of the condition whose practised RMS force sets the pulse unit; may be empty.
      pulse_unit_factor: pulse unit over that RMS force [-], > 0.
      multisine_duration: time from a trial's start to the pulse that ends the multisine [s]; without a pulse the
        multisine lasts until the end of the trial.
      trial_duration: duration of every trial [s].
      onset_window: earliest and latest onset of a pulse without a multisine [s].
      strap: what lets everyone's shoulder move; None holds it in place.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: a value is not finite or out of its range, or values do not fit together.
    """

    conditions: tuple[Condition, ...]
    forces: str = "practice"
    pulse_directions_deg: tuple[float, ...] = (20.0, 200.0)
    pulse_unit: float = 53.9
    pulse_unit_condition: str = ""
    pulse_unit_factor: float = 10.0
    multisine_duration: float = 32.0
    trial_duration: float = 36.0
    onset_window: tuple[float, float] = (5.0, 20.0)
    strap: Strap | None = None

    def __post_init__(self) -> None:
        owner = "protocol"
        object.__setattr__(self, "conditions", tuple(self.conditions))
        if not self.conditions:
            raise ValueError(f"{owner}: conditions = []; expected at least one")
        _require_different(owner, "conditions", [condition.name for condition in self.conditions])
        if self.forces not in FORCES:
            raise ValueError(f"{owner}: forces = {self.forces!r}; expected one of {', '.join(FORCES)}")
        if self.strap is not None and not isinstance(self.strap, Strap):
            raise TypeError(f"{owner}: strap = {self.strap!r}; expected Strap or None")
        for name in ("pulse_unit", "pulse_unit_factor", "trial_duration", "multisine_duration"):
            require_number(owner, name, getattr(self, name), above=0.0)
        self._check_pulses(owner)
        if self.forces == "published":
            for condition in self.conditions:
                if condition.has_multisine and not condition.published_force:
                    raise ValueError(
                        f"condition {condition.name!r}: published_force = {condition.published_force!r}; "
                        'expected a number above 0, as forces = "published"'
                    )

    def _check_pulses(self, owner: str) -> None:
        directions = _numbers(owner, "pulse_directions_deg", self.pulse_directions_deg)
        _require_different(owner, "pulse_directions_deg", directions)
        object.__setattr__(self, "pulse_directions_deg", directions)
        if not directions and any(condition.pulse_levels for condition in self.conditions):
            raise ValueError(f"{owner}: pulse_directions_deg = []; expected at least one, as there are pulses")

        latest = self.trial_duration - PULSE_WIDTH
        longest = f"at most {latest:g} s, for a pulse of {PULSE_WIDTH:g} s to end within trial_duration"
        for condition in self.conditions:
            if condition.has_multisine and condition.pulse_levels and self.multisine_duration > latest:
                raise ValueError(
                    f"{owner}: multisine_duration = {self.multisine_duration!r}; expected {longest} "
                    f"(condition {condition.name!r})"
                )
        window = _numbers(owner, "onset_window", self.onset_window)
        if len(window) != 2 or not 0.0 <= window[0] <= window[1]:
            raise ValueError(
                f"{owner}: onset_window = {list(window)!r}; expected the earliest and the latest onset [s], from 0 on"
            )
        object.__setattr__(self, "onset_window", window)
        for condition in self.conditions:
            if not condition.has_multisine and window[1] > latest:
                raise ValueError(
                    f"{owner}: onset_window = {list(window)!r}; expected {longest} (condition {condition.name!r})"
                )
        if not isinstance(self.pulse_unit_condition, str):
            raise TypeError(f"{owner}: pulse_unit_condition = {self.pulse_unit_condition!r}; expected a text")
        with_multisine = [condition.name for condition in self.conditions if condition.has_multisine]
        if self.pulse_unit_condition and self.pulse_unit_condition not in with_multisine:
            raise ValueError(
                f"{owner}: pulse_unit_condition = {self.pulse_unit_condition!r}; expected a condition with a multisine "
                f"({', '.join(with_multisine) or 'there is none'}), or nothing"
            )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], source: str = "protocol") -> Self:
        """A protocol from its fields by name, as in a TOML file; what is left out is as in `Protocol`.

        Args:
          values: field name to value; "conditions" is a list of such mappings, "strap" is one.
          source: where the values come from, for the message.

        Raises:
          TypeError: a value has the wrong type.
          ValueError: a key is unknown or missing, or a value is refused.
        """
        _check_keys(cls, source, values)
        tables = values["conditions"]
        if not isinstance(tables, Sequence) or not all(isinstance(table, Mapping) for table in tables):
            raise TypeError(f"{source}: conditions = {tables!r}; expected tables that begin with [[conditions]]")
        conditions = []
        for number, table in enumerate(tables, start=1):
            place = f"{source}, condition {number}"
            _check_keys(Condition, place, table)
            try:
                conditions.append(Condition(**table))
            except (TypeError, ValueError) as error:
                raise type(error)(f"{place}: {error}") from None
        given = {**values, "conditions": tuple(conditions)}
        if "strap" in values:
            if not isinstance(values["strap"], Mapping):
                raise TypeError(f"{source}: strap = {values['strap']!r}; expected a table that begins with [strap]")
            _check_keys(Strap, f"{source}, strap", values["strap"])
        try:
            if "strap" in values:
                given["strap"] = Strap(**values["strap"])
            return cls(**given)
        except (TypeError, ValueError) as error:
            raise type(error)(f"{source}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Field name to value, as `from_dict` reads it; numbers, texts, lists and tables only."""
        values = asdict(self)
        if self.strap is None:  # TOML has nothing for it
            del values["strap"]
        for table in (values, *values["conditions"]):
            table.update({key: list(value) for key, value in table.items() if isinstance(value, tuple)})
        return values

    def condition(self, name: str) -> Condition:
        """The condition of that name.

        Raises:
          KeyError: there is none.
        """
        for condition in self.conditions:
            if condition.name == name:
                return condition
        raise KeyError(f"no condition {name!r}; there are {', '.join(c.name for c in self.conditions)}")

    def cells(self) -> tuple[Cell, ...]:
        """What the trials of a person are made of, in the order of the table."""
        return tuple(
            Cell(condition, repetition, level, direction)
            for condition in self.conditions
            for repetition in range(condition.repetitions)
            for level in condition.pulse_levels or (0.0,)
            for direction in (self.pulse_directions_deg if condition.pulse_levels else (math.nan,))
        )

    def given_forces(self) -> dict[str, float]:
        """The protocol's own forces: condition name to RMS force per axis [N], and `PULSE_UNIT` to peak force [N]."""
        forces = {c.name: float(c.published_force) for c in self.conditions if c.has_multisine}
        return {**forces, PULSE_UNIT: float(self.pulse_unit)}

    def draw_multisines(self, seed: int, numbers: Collection[int] | None = None) -> dict[int, Multisine]:
        """Number of the cell to its multisine of 1 N RMS: a different realisation in each, the same for everyone.

        Lowering the peaks takes some 0.25 s per realisation; they are kept, so that later calls cost nothing.

        Args:
          seed: of the study.
          numbers: of the cells that are wanted, to share out the work; all if None.
        """
        return {
            number: _realisation(seed, number)
            for number, cell in enumerate(self.cells())
            if cell.condition.has_multisine and (numbers is None or number in numbers)
        }

    def trials(
        self,
        person: Person,
        forces: Mapping[str, float],
        seed: int,
        number: int,
        *,
        noisy: bool = True,
        multisines: Mapping[int, Multisine] | None = None,
    ) -> list[Trial]:
        """All trials of one person in random order.

        Multisines depend on the seed and the cell; order, onsets and everything that is noise also on the person.

        Args:
          person: who is perturbed.
          forces: condition name to RMS force per axis [N], and `PULSE_UNIT` to the peak force of level 1 [N].
          seed: of the study.
          number: of the person in the cohort, from 0.
          noisy: whether the person is as noisy as people are; if not, the trials are ideal.
          multisines: of `draw_multisines(seed)`, where a caller has them already.

        Returns:
          The trials in the order in which they are done, `Trial.order` counting from 0.

        Raises:
          KeyError: a force or a task of the person is missing.
        """
        cells = self.cells()
        multisines = self.draw_multisines(seed) if multisines is None else multisines
        order = _generator(seed, "order", number).permutation(len(cells)).tolist()
        return [
            Trial(
                subject=cell.condition.subject_of(person),
                perturbation=self._perturbation(
                    cell,
                    forces,
                    multisines.get(key),
                    draw_onset(_generator(seed, "onset", number, key), *self.onset_window),
                ),
                condition=cell.condition.name,
                repetition=cell.repetition,
                pulse_level=cell.level,
                order=place,
                seed=trial_seed(seed, "trial", number, key),
                noise=HUMAN_NOISE[cell.condition.task] if noisy else None,
            )
            for place, (key, cell) in enumerate((key, cells[key]) for key in order)
        ]

    def _perturbation(
        self, cell: Cell, forces: Mapping[str, float], unit: Multisine | None, onset: float
    ) -> Perturbation:
        """What is applied in a cell, from a multisine of 1 N and the onset of a pulse alone [s]."""
        if unit is not None:
            onset = self.multisine_duration if cell.level else self.trial_duration
            multisine = replace(unit, rms=forces[cell.condition.name], duration=onset)
            if not cell.level:
                return multisine
        pulse = Pulse(
            peak=cell.level * forces[PULSE_UNIT],
            direction_deg=cell.direction_deg,
            onset=onset,
            duration=self.trial_duration,
            width=PULSE_WIDTH,
        )
        return pulse if unit is None else MultisineThenPulse(multisine=multisine, pulse=pulse)


def load_protocol(path: str | Path) -> Protocol:
    """Read a protocol from a TOML file; docs/protocol.md describes it.

    Raises:
      TypeError: a value has the wrong type.
      ValueError: the file is no TOML, or a key or value is refused; the message names file, field, value and what was
        expected.
      OSError: the file cannot be read.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a TOML file ({error}); expected lines such as 'trial_duration = 36.0'") from None
    return Protocol.from_dict(values, source=str(path))


def _generator(seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    return np.random.default_rng(random_stream(seed, purpose, *numbers))


@functools.lru_cache(maxsize=4096)
def _realisation(seed: int, cell: int) -> Multisine:
    """The multisine of a cell with an RMS force of 1 N."""
    return Multisine.draw(seed=_generator(seed, "multisine", cell), rms=1.0)


def _check_keys(cls: type, source: str, values: Mapping[str, Any]) -> None:
    known = [field.name for field in fields(cls)]
    required = {Protocol: ("conditions",), Condition: ("name", "task")}.get(cls, ())
    for key in values:
        if key not in known:
            raise ValueError(f"{source}: unknown key {key!r}; expected keys are {', '.join(known)}")
    for key in required:
        if key not in values:
            raise ValueError(f"{source}: missing key {key!r}; expected keys are {', '.join(known)}")


def _numbers(owner: str, field: str, values: object) -> tuple[float, ...]:
    """The values as finite floats; a bare number is no list."""
    if not isinstance(values, list | tuple) or not all(
        isinstance(value, Real) and not isinstance(value, bool) for value in values
    ):
        raise TypeError(f"{owner}: {field} = {values!r}; expected a list of numbers")
    for value in values:
        require_number(owner, field, value)
    return tuple(float(value) for value in values)


def _require_different(owner: str, field: str, values: Sequence[object]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise ValueError(f"{owner}: {field} holds {value!r} twice; expected each once")


def _thesis() -> Protocol:
    with resources.as_file(resources.files("armperturb.study").joinpath("thesis.toml")) as path:
        return load_protocol(path)


THESIS = _thesis()
"""The experiment of the thesis: eight conditions, 32 trials (table 2.1); `thesis.toml` beside this file."""


def with_published_forces(conditions: Sequence[Condition], onset: float, duration: float) -> Protocol:
    """Conditions like the thesis's, with its mean forces and pulses instead of each person's own.

    Args:
      conditions: to be run.
      onset: of every pulse, where the multisine ends [s].
      duration: of every trial [s].

    Raises:
      ValueError: as `Protocol`.
    """
    return replace(
        THESIS,
        conditions=tuple(conditions),
        forces="published",
        pulse_unit_condition="",
        multisine_duration=onset,
        trial_duration=duration,
        onset_window=(onset, onset),
    )
