"""Trials of one person in one condition: checked once, cut once, the manipulator identified once.

Every estimator takes `ConditionTrials`, or a recording that `prepare` turns into them. What several estimators need is
computed when it is first asked for, and kept with the trials (`per_trials`): manipulator and instrument noise, the
period, spectra. A trial is used up to its pulse; `cuts` says where that is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import limit_samples, of_condition, one_condition, onset_samples
from armperturb.analysis.force_balance import EDGE, Balance, Skew
from armperturb.analysis.numerics.periodicity import are_independent, samples_of_period
from armperturb.analysis.smoother import NoiseLevels
from armperturb.analysis.start import constant_force, first_push, start_at_rest
from armperturb.arrays import Array, Indices
from armperturb.copied_trials import Lines, each_once, joined_lines, without_copies
from armperturb.environment import Environment
from armperturb.recording import ARM_LABELS, EXPECTED, TRIAL_COORDINATES, check_recording
from armperturb.subject import POSITION, RELAX, TASKS, Subject
from armperturb.validation import as_list, require_number, require_one_of

AT_ONCE = 0.5
"""Time within which what perturbs a trial from its start begins [s]."""

NEGLIGIBLE = 1e-9
"""Disturbances below this count as zero [N]."""

OTHERS = "in Python, recording.isel(trial=[...]) takes the other trials"
"""How a trial is left out, for messages."""


class TrialRecord(NamedTuple):
    """One trial from the start of the analysis to its pulse.

    Attributes:
      perturbation: d [N], (time, axis).
      response: f [N] and x [m] beside one another, (time, 4).
      rate: of the samples [Hz].
    """

    perturbation: Array
    response: Array
    rate: float


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ConditionTrials:
    """Trials of one person in one condition.

    Attributes:
      recording: the checked trials.
      numbers: which trials these are, of those that were prepared, (trial,).
      whole: the trials that these were taken from, whose manipulator and displacement they share; None for none.
      given: manipulator and instrument noise; None to identify them from these trials.
      given_covariance: of the errors of the given manipulator, see `manipulator.manipulator_covariance`; None for none.
      last: number of samples that fits over whole records may use; None for all.
      copies: condition to a line on each trial that repeats another and is left out.
    """

    recording: xr.Dataset
    numbers: Indices
    whole: Self | None = None
    given: tuple[Environment, NoiseLevels] | None = None
    given_covariance: Array | None = None
    last: int | None = None
    copies: Lines = field(default_factory=dict)
    results: dict[object, Any] = field(default_factory=dict, init=False)

    @classmethod
    def prepare(cls, recording: xr.Dataset, *, is_checked: bool = False) -> Self:
        """Check the trials of one person in one condition, and leave out copies.

        Args:
          recording: the trials.
          is_checked: whether `check_recording` has already accepted it, as it does all that `load_recording` reads.

        Raises:
          ValueError: as `check_recording`.
        """
        if not is_checked:
            check_recording(recording)
        return cls(**without_copies(recording)._asdict())

    def __repr__(self) -> str:
        return f"<{self.name} in {self.label}: {self.n_trials} x {self.n_samples / self.rate:g} s>"

    @cached_property
    def label(self) -> str:
        """The condition."""
        return str(self.recording["condition"].values[0])

    @cached_property
    def are_independent(self) -> bool:
        """Whether every trial has a perturbation of its own, no other's one scaled, turned round or at another time."""
        used = [d[: max(end, 1)][: self.last] for d, end in zip(self.perturbation, self.onset, strict=True)]
        return are_independent([part - part.mean(axis=0) for part in used])

    @cached_property
    def body(self) -> Subject:
        """Task, segment lengths and posture, in a subject whose muscles do not matter.

        Raises:
          ValueError: trials differ in subject, condition or posture, segment lengths or posture are not known, or the
            task is unknown.
        """
        values = one_condition([self.recording])
        for name in ARM_LABELS:
            if np.isnan(self.recording[name].values).any():
                meaning = TRIAL_COORDINATES[name][1]
                raise ValueError(
                    f"recording: {name} is unknown in {self.label}; expected the {meaning}, which a model of the arm "
                    f"needs (labels.{name} of the sidecar; of all: {', '.join(ARM_LABELS)}; joints of a Laboratory)"
                )
        require_one_of("recording", "task", values["task"], TASKS)
        preset = POSITION if values["task"] == POSITION.task else RELAX
        return replace(preset, name=self.name, **{name: values[name] for name in ARM_LABELS})

    @property
    def name(self) -> str:
        """Of the person."""
        return str(self.recording["subject"].values[0])

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""
        return float(self.recording.attrs["rate"])

    @property
    def n_trials(self) -> int:
        """How many trials."""
        return int(self.recording.sizes["trial"])

    @property
    def n_samples(self) -> int:
        """Samples of each trial."""
        return int(self.recording.sizes["time"])

    @cached_property
    def perturbation(self) -> Array:
        """d [N], (trial, time, axis)."""
        return np.asarray(self.recording["perturbation"].values, dtype=float)

    @cached_property
    def force(self) -> Array:
        """Reaction force f of the handle on the hand [N], (trial, time, axis)."""
        return np.asarray(self.recording["force"].values, dtype=float)

    @cached_property
    def recorded_displacement(self) -> Array:
        """Displacement of the handle as the encoders have it [m], (trial, time, axis)."""
        return np.asarray(self.recording["displacement"].values, dtype=float)

    @property
    def signals(self) -> tuple[Array, Array, Array]:
        """d, f and the displacement as they were recorded, (trial, time, axis) each."""
        return self.perturbation, self.force, self.recorded_displacement

    @cached_property
    def drive(self) -> Array:
        """d without a constant force, and with zero for what is negligible [N]: simulating denormal numbers is slow."""
        d = self.perturbation - (0.0 if self.from_rest else constant_force(self.perturbation[:, : self.first_onset]))
        return np.where(np.abs(d) < NEGLIGIBLE, 0.0, d)

    @cached_property
    def onset(self) -> Indices:
        """First sample of each trial's pulse, or the number of samples of a trial without one, (trial,)."""
        return onset_samples(self.recording)

    @cached_property
    def limit(self) -> Array:
        """When each trial met the workspace limit [samples], (trial,); infinite if it did not."""
        return limit_samples(self.recording)

    @cached_property
    def begin(self) -> float:
        """Time from which on something perturbs every trial before its pulse [s]; 0 if it does so nearly at once."""
        first = first_push([d[:end] for d, end in zip(self.perturbation, self.onset, strict=True)]) / self.rate
        return first if first > AT_ONCE else 0.0

    @property
    def direction_deg(self) -> Array:
        """Direction of each trial's pulse [deg], (trial,); NaN without a pulse."""
        return np.asarray(self.recording["pulse_direction"].values, dtype=float)

    @property
    def first_onset(self) -> int:
        """First sample of the earliest pulse, or the number of samples."""
        return int(self.onset.min(initial=self.n_samples))

    @cached_property
    def end(self) -> int:
        """Number of samples that fits over whole records may use.

        At the workspace limit the handle is blocked. The last `EDGE` s are those in which filters of a recorder end.
        """
        limit = min(float(self.limit.min(initial=np.inf)), self.n_samples)
        last = self.n_samples if self.last is None else self.last
        return min(self.n_samples - round(EDGE * self.rate), round(limit), last)

    @property
    def balance(self) -> Balance:
        """Force balance of the manipulator. Raises ValueError where the trials are too short."""
        return Balance.stored(self.results, self.signals, self.rate)

    @cached_property
    def instruments(self) -> tuple[Environment, NoiseLevels]:
        """The manipulator, and the noise of the instruments. Raises ValueError as `balance` and `Balance.fit`."""
        if self.given is not None:
            return self.given
        return self.balance.fit() if self.whole is None else self.whole.instruments

    @property
    def environment(self) -> Environment:
        """What the hand held: mass, damping and stiffness of the manipulator."""
        return self.instruments[0]

    @property
    def noise(self) -> NoiseLevels:
        """White noise of the instruments."""
        return self.instruments[1]

    @cached_property
    def from_rest(self) -> bool:
        """Whether every trial starts at rest, the handle at zero and under no constant force."""
        return start_at_rest(*self.signals, self.rate)

    @cached_property
    def skew(self) -> Skew:
        """Delay of force after displacement, as these trials show it."""
        return self.balance.skew(*self.instruments)

    @cached_property
    def displacement(self) -> Array:
        """Displacement of the handle from encoders and strain gauge together [m], (trial, time, axis)."""
        if self.whole is not None:
            return self.whole.displacement[self.numbers]
        return self.balance.displacement(*self.instruments)

    @cached_property
    def multisine(self) -> Self:
        """Signals before the first pulse, of the trials that stay inside the workspace until then.

        A pulse may well take the handle to the limit: that does not harm the multisine before it. The manipulator is
        identified from these signals alone.
        """
        end = self.first_onset
        inside = np.flatnonzero(~(self.limit < end))
        part = self.recording.isel(trial=inside, time=slice(0, end))
        part = part.assign_coords(limit_time=("trial", np.full(len(inside), np.nan)))
        return type(self)(recording=part, numbers=self.numbers[inside])

    def take(self, trials: Iterable[int]) -> Self:
        """Some of the trials; manipulator and displacement stay those of all."""
        index = np.asarray(list(trials), dtype=np.intp)
        numbers = index if self.whole is None else self.numbers[index]
        return replace(self, recording=self.recording.isel(trial=index), numbers=numbers, whole=self.whole or self)

    def before(self, sample: int) -> Self:
        """The same trials, of which fits over whole records use only what is before a sample."""
        numbers = np.arange(self.n_trials) if self.whole is None else self.numbers
        return replace(self, last=min(self.end, sample), numbers=numbers, whole=self.whole or self)

    def require_inside(self) -> None:
        """Refuse trials that met the workspace limit.

        Raises:
          ValueError: one did.
        """
        hit = np.flatnonzero(np.isfinite(self.limit))
        if len(hit):
            raise ValueError(
                f"trial {hit[0]} reached the workspace limit at {self.limit[hit[0]] / self.rate:.3f} s; expected "
                f"trials that stay inside ({OTHERS})"
            )

    def is_perturbed(self, window_start: float) -> bool:
        """Whether something that changes perturbs every trial between a time [s] and its pulse."""
        first = round(window_start * self.rate)
        parts = [d[first:end] for d, end in zip(self.perturbation, self.onset, strict=True)]
        return all(len(part) and np.ptp(part, axis=0).any() for part in parts)

    def records(self, window_start: float) -> list[TrialRecord]:
        """Trials from a time on to each one's pulse, or to its end.

        Args:
          window_start: that time [s].

        Raises:
          ValueError: a trial met the workspace limit, nothing is left of it, or its perturbation or force is constant.
        """
        require_number("records", "window_start", window_start, at_least=0.0)
        self.require_inside()
        first = round(window_start * self.rate)
        records = []
        for trial, end in enumerate(self.onset.tolist()):
            if end - first < 2:
                raise ValueError(
                    f"trial {trial} ends at {end / self.rate:g} s; expected more than {window_start:g} s (an earlier "
                    f"--window-start; {OTHERS})"
                )
            d, f, x = (values[trial, first:end] for values in self.signals)
            for name, values in (("perturbation", d), ("force", f)):
                if not np.ptp(values, axis=0).any():
                    raise ValueError(
                        f"{name} of trial {trial} is constant from {window_start:g} s on; expected a perturbed trial "
                        f"(an earlier --window-start; {OTHERS})"
                    )
            records.append(TrialRecord(d, np.concatenate([f, x], axis=1), self.rate))
        return records

    def window(self, window_start: float, period: float) -> slice:
        """Samples of the whole periods between a time and the first pulse, or the end.

        Args:
          window_start: that time [s].
          period: of the perturbation [s].

        Raises:
          ValueError: there is no whole period, or a period is not a whole number of samples.
        """
        require_number("window", "window_start", window_start, at_least=0.0)
        n_period, first = samples_of_period(period, self.rate), round(window_start * self.rate)
        n_periods = (self.first_onset - first) // n_period
        if n_periods < 1:
            raise ValueError(
                f"the recording holds {self.first_onset / self.rate:g} s before the pulse or its end; expected a whole "
                f"period of {period:g} s from {window_start:g} s on (an earlier --window-start)"
            )
        return slice(first, first + n_periods * n_period)


Trials: TypeAlias = ConditionTrials | xr.Dataset
"""What an estimator takes: prepared trials, or their recording."""

SeveralTrials: TypeAlias = Trials | Sequence[Trials]
"""Trials of one person in one condition that may differ in length from recording to recording."""


def prepared(trials: Trials) -> ConditionTrials:
    """The trials, prepared if they are not yet."""
    return trials if isinstance(trials, ConditionTrials) else ConditionTrials.prepare(trials)


def prepared_recordings(recordings: SeveralTrials, *, one_rate: bool = True) -> list[ConditionTrials]:
    """One or several recordings, prepared if they are not yet; a trial of several of them counts once.

    Args:
      recordings: of one or several trials each.
      one_rate: whether all must have the same sampling rate.

    Raises:
      TypeError: it is something else.
      ValueError: there is none, one is refused, or rates differ.
    """
    trials = [prepared(each) for each in as_list("recordings", recordings, (ConditionTrials, xr.Dataset), EXPECTED)]
    rates = sorted({part.rate for part in trials})
    if one_rate and len(rates) > 1:
        raise ValueError(f"recordings: rate = {', '.join(f'{rate:g}' for rate in rates)} Hz; expected one rate")
    if len(trials) == 1:
        return trials
    inside, lines = each_once([part.recording for part in trials], [part.numbers for part in trials])
    if not lines:
        return trials
    copies = joined_lines([*(part.copies for part in trials), lines])
    return [replace(part.take(those), copies=copies) for part, those in zip(trials, inside, strict=True) if those]


def prepared_condition(recordings: SeveralTrials) -> list[ConditionTrials]:
    """As `prepared_recordings`. Raises ValueError also where trials are not of one person in one condition."""
    trials = prepared_recordings(recordings)
    one_condition(part.recording for part in trials)
    return trials


def records_of(trials: Sequence[ConditionTrials], window_start: float) -> list[TrialRecord]:
    """All trials from a time on, see `ConditionTrials.records`."""
    return [record for part in trials for record in part.records(window_start)]


def trials_by_condition(recording: xr.Dataset, *, is_checked: bool = False) -> dict[str, ConditionTrials]:
    """Condition to its trials, in the order of the recording.

    Args:
      recording: trials of one person.
      is_checked: as `ConditionTrials.prepare` has it.

    Raises:
      ValueError: the recording is refused, or holds several people.
    """
    if not is_checked:
        check_recording(recording)
    people = list(dict.fromkeys(recording["subject"].values.tolist()))
    if len(people) > 1:
        raise ValueError(f"recording: subject = {', '.join(map(str, people))}; expected one person")
    recording, _, copies = without_copies(recording)
    return {
        str(label): replace(ConditionTrials.prepare(of_condition(recording, label), is_checked=True), copies=copies)
        for label in dict.fromkeys(recording["condition"].values.tolist())
    }
