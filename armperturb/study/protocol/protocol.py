"""All trials of an experiment, as data that a file can hold (thesis 2.5, table 2.1)."""

import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import NoneType
from typing import Any, Self, TypeVar

import numpy as np

from armperturb.analysis.defaults import WINDOW_START
from armperturb.cohort import Person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.environment import Strap
from armperturb.envs.lab.trial import Trial
from armperturb.files import read_toml
from armperturb.foreign import LARGEST
from armperturb.perturbations import Multisine, MultisineThenPulse, Perturbation, Pulse, Rest, draw_onset
from armperturb.perturbations.multisine import PERIOD
from armperturb.seeds import random_stream, trial_seed
from armperturb.study.protocol.condition import PULSE_UNIT, Condition, PlannedTrial, numbers, require_different
from armperturb.validation import as_list_of, require_keys, require_one_of, require_ranges, require_type

Made = TypeVar("Made")

FORCES = ("practice", "published")
"""Where the forces come from: each person's practice session, or the protocol's own, the same for everyone."""

PULSE_WIDTH = 0.08
"""Duration of a pulse [s] (thesis 2.4)."""

BYTES_PER_SECOND = 8 * (200 * 10 + 2000 * 8)
"""That a trial takes in memory, of handle, joints and shoulder at 200 Hz and EMG at 2 kHz [byte/s]."""

NEEDED = WINDOW_START + PERIOD
"""How long a multisine has to last for anybody to be identified [s]."""

PULSE_LEAD = 0.5
"""Time before a pulse that comes alone, in experiments beside a study [s]."""


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
        conditions = as_list_of(
            f"{owner}: conditions", f"{owner}: a condition", self.conditions, Condition, "Conditions", or_none=True
        )
        if not conditions:
            raise ValueError(f"{owner}: conditions = []; expected at least one")
        object.__setattr__(self, "conditions", tuple(conditions))
        require_different(owner, "conditions", [condition.name for condition in self.conditions])
        require_one_of(owner, "forces", self.forces, FORCES)
        require_type(f"{owner}: strap", self.strap, (Strap, NoneType), "Strap or None")
        require_ranges(owner, self)
        self._check_pulses(owner)
        self._check_size(owner)
        if self.forces == "published":
            self.given_forces()

    def _check_size(self, owner: str) -> None:
        """Refuse more than one file of a person can hold, before any trial is planned."""
        n_pulses = [len(condition.pulse_levels) * len(self.pulse_directions_deg) for condition in self.conditions]
        n_trials = sum(each.repetitions * max(n, 1) for each, n in zip(self.conditions, n_pulses, strict=True))
        size = BYTES_PER_SECOND * n_trials * self.trial_duration
        if size > LARGEST:
            raise ValueError(
                f"{owner}: {n_trials} trials of {self.trial_duration:g} s take {size / 2**30:.3g} GiB per person; "
                f"expected at most {LARGEST / 2**30:g} GiB (fewer repetitions, or shorter trials)"
            )

    def _check_pulses(self, owner: str) -> None:
        directions = numbers(owner, "pulse_directions_deg", self.pulse_directions_deg)
        require_different(owner, "pulse_directions_deg", directions)
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
        window = numbers(owner, "onset_window", self.onset_window)
        if len(window) != 2 or not 0.0 <= window[0] <= window[1]:
            raise ValueError(
                f"{owner}: onset_window = {list(window)!r}; expected the earliest and the latest onset [s], from 0 on"
            )
        object.__setattr__(self, "onset_window", window)
        for condition in self.conditions:
            if condition.pulse_levels and not condition.has_multisine and window[1] > latest:
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
        require_keys(source, values, [field.name for field in fields(cls)], ("conditions",))
        tables = values["conditions"]
        if not isinstance(tables, Sequence) or not all(isinstance(table, Mapping) for table in tables):
            raise TypeError(f"{source}: conditions = {tables!r}; expected tables that begin with [[conditions]]")
        given = {
            **values,
            "conditions": tuple(
                _made(Condition, f"{source}, condition {number}", table, ("name", "task"))
                for number, table in enumerate(tables, start=1)
            ),
        }
        if "strap" in values:
            if not isinstance(values["strap"], Mapping):
                raise TypeError(f"{source}: strap = {values['strap']!r}; expected a table that begins with [strap]")
            given["strap"] = _made(Strap, f"{source}, strap", values["strap"])
        return _made(cls, source, given)

    def to_dict(self) -> dict[str, Any]:
        """Field name to value, as `from_dict` reads it; numbers, texts, lists and tables only."""
        values = asdict(self)
        if self.strap is None:  # TOML has nothing for it
            del values["strap"]
        for condition in values["conditions"]:
            if condition["contraction"] is None:
                del condition["contraction"]
        for table in (values, *values["conditions"]):
            table.update({key: list(value) for key, value in table.items() if isinstance(value, tuple)})
        return values

    def condition(self, name: str) -> Condition:
        """The condition of that name.

        Raises:
          KeyError: there is none.
        """
        conditions = {condition.name: condition for condition in self.conditions}
        if name not in conditions:
            raise KeyError(f"no condition {name!r}; there are {', '.join(conditions)}")
        return conditions[name]

    def multisine_lasts(self, condition: Condition) -> float:
        """How long the multisine of a condition lasts: to its pulse, or to the end of the trial [s]."""
        return self.multisine_duration if condition.pulse_levels else self.trial_duration

    def too_short(self) -> tuple[Condition, ...]:
        """Conditions whose multisine is too short for anybody to be identified."""
        return tuple(
            condition
            for condition in self.conditions
            if condition.has_multisine and self.multisine_lasts(condition) < NEEDED
        )

    def planned_trials(self) -> tuple[PlannedTrial, ...]:
        """The trials of a person, in the order of the table."""
        return tuple(
            PlannedTrial(condition, repetition, level, direction)
            for condition in self.conditions
            for repetition in range(condition.repetitions)
            for level in condition.pulse_levels or (0.0,)
            for direction in (self.pulse_directions_deg if condition.pulse_levels else (math.nan,))
        )

    def given_forces(self) -> dict[str, float]:
        """The published forces: condition name to RMS force per axis [N], and `PULSE_UNIT` to peak force [N].

        Raises:
          ValueError: a condition with a multisine has no published force.
        """
        forces = {c.name: float(c.published_force) for c in self.conditions if c.has_multisine}
        for name, force in forces.items():
            if not force:
                raise ValueError(
                    f"condition {name!r}: published_force = {force!r}; expected a number above 0, as forces are "
                    '"published"'
                )
        return {**forces, PULSE_UNIT: float(self.pulse_unit)}

    def draw_multisines(self, seed: int, only: Collection[int] | None = None) -> dict[int, Multisine]:
        """Number of each planned trial with a multisine to that multisine, of 1 N RMS, which is the same for everyone.

        Lowering the peaks takes some 0.15 s per multisine; they are cached, so that later calls cost nothing.

        Args:
          seed: of the study.
          only: numbers of the trials that are wanted, to share out the work; all if None.
        """
        return {
            number: _realisation(seed, number)
            for number, planned in enumerate(self.planned_trials())
            if planned.condition.has_multisine and (only is None or number in only)
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

        Multisines depend on the seed and the planned trial; order, onsets and all noise depend on the person as well.

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
        planned = self.planned_trials()
        multisines = self.draw_multisines(seed) if multisines is None else multisines
        order = _generator(seed, "order", number).permutation(len(planned)).tolist()
        trials = []
        for place, key in enumerate(order):
            condition, repetition, level, _ = planned[key]
            onset = draw_onset(_generator(seed, "onset", number, key), *self.onset_window)
            trials.append(
                Trial(
                    subject=condition.subject_of(person),
                    perturbation=self._perturbation(planned[key], forces, multisines.get(key), onset),
                    condition=condition.name,
                    repetition=repetition,
                    pulse_level=level,
                    order=place,
                    seed=trial_seed(seed, "trial", number, key),
                    noise=HUMAN_NOISE[condition.task] if noisy else None,
                    contraction=condition.contraction,
                )
            )
        return trials

    def _perturbation(
        self, planned: PlannedTrial, forces: Mapping[str, float], unit: Multisine | None, onset: float
    ) -> Perturbation:
        """What is applied in a trial, from a multisine of 1 N and the onset of a pulse without a multisine [s]."""
        if planned.condition.contraction is not None:
            return Rest(duration=self.trial_duration)
        if unit is not None:
            onset = self.multisine_duration if planned.level else self.trial_duration
            multisine = replace(unit, rms=forces[planned.condition.name], duration=onset)
            if not planned.level:
                return multisine
        pulse = Pulse(
            peak=planned.level * forces[PULSE_UNIT],
            direction_deg=planned.direction_deg,
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
    return Protocol.from_dict(read_toml(path, "trial_duration = 36.0"), source=str(path))


def _generator(seed: int, purpose: str, *numbers: int) -> np.random.Generator:
    return np.random.default_rng(random_stream(seed, purpose, *numbers))


@functools.lru_cache(maxsize=4096)
def _realisation(seed: int, number: int) -> Multisine:
    """The multisine of a planned trial with an RMS force of 1 N."""
    return Multisine.draw(seed=_generator(seed, "multisine", number), rms=1.0)


def _made(cls: type[Made], source: str, values: Mapping[str, Any], required: Sequence[str] = ()) -> Made:
    require_keys(source, values, [field.name for field in fields(cls)], required)  # type: ignore[arg-type]
    try:
        return cls(**values)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{source}: {error}") from None


THESIS = load_protocol(Path(__file__).with_name("thesis.toml"))
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
