"""Conditions of an experiment (thesis 2.5, table 2.1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import NamedTuple

from armperturb.cohort import Person
from armperturb.perturbations.perturbation import LARGEST_RMS_DISPLACEMENT
from armperturb.subject import TASKS, Subject, at_level
from armperturb.validation import require_name, require_number, require_one_of, require_ranges, require_whole

PULSE_UNIT = "pulse_unit"
"""Key of the peak force of pulse level 1 [N] in a mapping of forces, beside the conditions' names."""


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
      contraction: share of full activation to which all muscles contract for some seconds [-], 0 to 1, in trials
        without perturbation, to which EMG refers: 1 is a maximal contraction, 0 is rest. None for perturbed trials.

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
    contraction: float | None = None

    def __post_init__(self) -> None:
        require_name("condition", "name", self.name)
        owner = f"condition {self.name!r}"
        if self.name == PULSE_UNIT:
            raise ValueError(f"{owner}: name = {self.name!r}; expected another, this one means the unit of the pulses")
        require_one_of(owner, "task", self.task, TASKS)
        require_number(owner, "rms_displacement", self.rms_displacement, at_least=0.0, at_most=LARGEST_RMS_DISPLACEMENT)
        require_whole(owner, "repetitions", self.repetitions, at_least=1)
        require_ranges(owner, self)
        if self.task == "RT" and self.co_contraction != 1.0:
            raise ValueError(
                f"{owner}: co_contraction = {self.co_contraction!r}; expected 1 in RT, as relaxed people do not adapt"
            )
        levels = numbers(owner, "pulse_levels", self.pulse_levels)
        for level in levels:
            require_number(owner, "pulse_levels", level, above=0.0)
        require_different(owner, "pulse_levels", levels)
        object.__setattr__(self, "pulse_levels", levels)
        require_number(owner, "contraction", self.contraction, at_least=0.0, at_most=1.0, optional=True)
        if self.contraction is not None:
            if levels or self.has_multisine:
                raise ValueError(
                    f"{owner}: contraction = {self.contraction!r} with a perturbation; expected rms_displacement = 0 "
                    "and pulse_levels = []"
                )
        elif not levels and not self.has_multisine:
            raise ValueError(
                f"{owner}: rms_displacement = 0 and pulse_levels = []; expected a multisine, a pulse or both, "
                "or a contraction"
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


class PlannedTrial(NamedTuple):
    """A trial that every person goes through.

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


def numbers(owner: str, field: str, values: object) -> tuple[float, ...]:
    """The values as finite floats; a bare number is no list."""
    if not isinstance(values, list | tuple) or not all(
        isinstance(value, Real) and not isinstance(value, bool) for value in values
    ):
        raise TypeError(f"{owner}: {field} = {values!r}; expected a list of numbers")
    for value in values:
        require_number(owner, field, value)
    return tuple(float(value) for value in values)


def require_different(owner: str, field: str, values: Sequence[object]) -> None:
    """Refuse a value that is there twice.

    Raises:
      ValueError: there is one.
    """
    for value in values:
        if values.count(value) > 1:
            raise ValueError(f"{owner}: {field} holds {value!r} twice; expected each once")
