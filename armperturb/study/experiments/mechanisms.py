"""What each mechanism of a person's muscle law does to the admittance and to the responses to pulses.

The person is simulated without noise under the published forces, with the whole law, with linear muscle, and with one
mechanism switched off at a time. All arms of a condition get the same multisines, and so do all conditions but for
their force: what differs between two of them is their doing. A multisine is ended by a pulse to either side, so that
the movement at the onset, which one pulse takes further and the other back, hardly counts in the mean.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.measures.kinematics import true_rotations
from armperturb.analysis.measures.pulse import WINDOWS, pulse_peaks
from armperturb.analysis.response.spectra import estimate_spectra, line_spectra
from armperturb.arrays import Array
from armperturb.cohort import Person
from armperturb.controllers.arm_control import stretched
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.trial import Trial
from armperturb.files import packaged_table
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations.multisine import PERIOD
from armperturb.study.protocol import PULSE_LEAD, THESIS, Protocol, with_published_forces
from armperturb.study.published import tables as published
from armperturb.study.results.quantities import Cell, published_cells
from armperturb.subject import Subject

Row = dict[str, Any]

WHOLE, LINEAR, ONE_LEVEL = "whole law", "linear muscle", "same co-contraction in all conditions"

MECHANISMS: dict[str, dict[str, float]] = packaged_table(__package__, "mechanisms.toml")
"""What an arm without one mechanism is called, to the fields of its law that are changed, and their values."""

AMPLITUDES = {"RT": ("RT2.5", "RT7.5", "RT22.5"), "PT": ("PT2.5", "PT7.5", "PT22.5")}
"""Task to its conditions with a multisine, the smallest movement first."""

PULSES = {"RT0": 1.0, "RT22.5": 1.0, "PT7.5": 2.0}
"""Condition to the level of the pulse whose response is shown."""

CONDITIONS = ("RT0", *(condition for conditions in AMPLITUDES.values() for condition in conditions))
"""All that are simulated."""

NEEDED = ("RT0", "RT2.5", "RT22.5", "PT2.5", "PT7.5", "PT22.5")
"""Conditions that are simulated for all arms."""

CALM = 8.0
"""Time after a pulse that comes alone, in which an arm has to come to rest [s]."""

AT_REST = 0.02
"""Largest movement in the last second of that time over the largest displacement, for an arm at rest [-]."""

LOW = 2
"""Number of the lowest frequencies over which the low-frequency admittance is averaged (thesis 3.1)."""

LOOP_FREQUENCY = 0.5
"""Frequency of the cyclic stretch of muscle elements [Hz]."""

LOOP_CYCLES = 12
"""Number of cycles, after which the loops repeat; the last is shown."""

LOOP_SAMPLES = 200
"""Samples per cycle."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """One arm in one condition.

    Attributes:
      subject: the arm, at its level of co-contraction.
      time: after the onset of a pulse [s], (time,); none without a pulse.
      distance: of the handle from its start, mean over trials [m], (time,).
      peak: largest distance, mean over trials [m]; NaN without a pulse.
      pulse_admittance: peak over the largest hand reaction force, mean over trials [m/N]; NaN without a pulse.
      frequency: [Hz], (frequency,); none without a multisine.
      gain: of the admittance [m/N], (frequency, output, input).
      stretch: RMS stretch of the muscle elements under the multisine [rad], (element,).
    """

    subject: Subject
    time: Array = field(default_factory=lambda: np.empty(0))
    distance: Array = field(default_factory=lambda: np.empty(0))
    peak: float = math.nan
    pulse_admittance: float = math.nan
    frequency: Array = field(default_factory=lambda: np.empty(0))
    gain: Array = field(default_factory=lambda: np.empty((0, 2, 2)))
    stretch: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def low_gain(self) -> Array:
        """Gain of the diagonal at the lowest frequencies [m/N], (frequency, axis)."""
        return np.diagonal(self.gain[:LOW], axis1=1, axis2=2)


@dataclass(frozen=True, kw_only=True, eq=False)
class Yielding:
    """A person with and without the mechanisms of the law.

    Attributes:
      person: with the whole law.
      variants: names of the arms, the whole law first.
      responses: of each variant in each condition, by their names; without those that are unstable.
      unstable: variant and condition to the reason why there is no response.
    """

    person: Person
    variants: tuple[str, ...]
    responses: Mapping[tuple[str, str], Response]
    unstable: Mapping[tuple[str, str], str]

    def rise(self, variant: str, above: str, below: str) -> float:
        """Low-frequency gain in one condition over that in another [-]; NaN if a response is missing.

        Mean over the lowest two frequencies and the diagonal, as in `headlines`.
        """
        return self._ratio(lambda response: response.low_gain, variant, above, below)

    def pulse_rise(self, variant: str) -> float:
        """Pulse admittance in RT22.5 over that in RT0 [-]; NaN if a response is missing."""
        return self._ratio(lambda response: response.pulse_admittance, variant, "RT22.5", "RT0")

    def _ratio(self, quantity: Callable[[Response], Any], variant: str, above: str, below: str) -> float:
        pair = [self.responses[variant, name] for name in (above, below) if (variant, name) in self.responses]
        return float(np.mean(quantity(pair[0]) / quantity(pair[1]))) if len(pair) == 2 else math.nan

    def rows(self) -> list[Row]:
        """A row per variant, and the published means of people; NaN where an arm is unstable or nothing published."""
        rows = [
            {
                "arm": variant,
                **{
                    f"peak_{condition}_m": response.peak
                    if (response := self.responses.get((variant, condition)))
                    else math.nan
                    for condition in PULSES
                },
                "RT_rise": self.rise(variant, "RT22.5", "RT2.5"),
                "PT_fall": self.rise(variant, "PT2.5", "PT22.5"),
                "pulse_admittance_RT22.5_over_RT0": self.pulse_rise(variant),
                "unstable_in": " ".join(condition for name, condition in self.unstable if name == variant),
            }
            for variant in self.variants
        ]
        people: Row = {"arm": "people, published mean"}
        for condition, level in PULSES.items():
            cell = Cell("2.1", condition, f"peak_displacement_{'min' if level == 1.0 else 'max'}")
            people[f"peak_{condition}_m"] = published_cells()[cell].mean
        for name, task in (("RT_rise", "rt"), ("PT_fall", "pt")):
            people[name] = float(published.headline_text(f"admittance_amplitude_factor_{task}"))
        return [*rows, {**people, "pulse_admittance_RT22.5_over_RT0": math.nan, "unstable_in": ""}]


def has_law(person: Person) -> bool:
    """Whether the person's muscles yield, in any task."""
    return any(subject.muscle is not None for subject in person.subjects.values())


def variants(person: Person) -> dict[str, Person]:
    """The person, the person with linear muscle, and with each mechanism switched off that the person has, by name.

    Raises:
      ValueError: the person has no muscle law.
    """
    if not has_law(person):
        raise ValueError(f"person {person.name!r} has linear muscles; expected a muscle law")
    arms = {WHOLE: person, LINEAR: _with_laws(person, lambda _: None)}
    for name, off in MECHANISMS.items():
        changed = _with_laws(person, partial(replace, **off))
        if changed.subjects != person.subjects:
            arms[name] = changed
    if len(set(person.levels.values()) | {1.0}) > 1:
        arms[ONE_LEVEL] = replace(person, levels={})
    return arms


def _with_laws(person: Person, change: Callable[[MuscleLaw], MuscleLaw | None]) -> Person:
    subjects = {
        task: subject if subject.muscle is None else replace(subject, muscle=change(subject.muscle))
        for task, subject in person.subjects.items()
    }
    return replace(person, subjects=subjects)


def why_people_yield(
    person: Person,
    environment: Environment | None = None,
    *,
    seed: int = 0,
    n_multisines: int = 2,
    engine: str = "compiled",
    **options: Any,
) -> Yielding:
    """Perturb a person with and without each mechanism, side by side.

    Args:
      person: who has a muscle law, in both tasks.
      environment: what the hand holds; the thesis's manipulator if not given.
      seed: of the multisines.
      n_multisines: realisations behind each admittance.
      engine: see `run_experiment`.
      **options: further ones of `run_experiment`.

    Raises:
      ValueError: the person has no muscle law.
    """
    environment = environment or Environment()
    arms = variants(person)
    subjects = {
        (name, condition): THESIS.condition(condition).subject_of(arm)
        for name, arm in arms.items()
        for condition in CONDITIONS
        if condition in NEEDED or name in (WHOLE, LINEAR)
    }
    wrong = {
        subject: "is unstable for small or for large movements"
        for subject in subjects.values()
        if largest_real_pole(subject, environment) >= 0.0
    }

    def recorded(protocol: Protocol, pairs: Iterable[tuple[str, Subject]]) -> Iterator[tuple[str, Subject, xr.Dataset]]:
        trials = {pair: _trials(protocol, *pair, seed) for pair in pairs}
        if not trials:
            return
        everything = [trial for own_trials in trials.values() for trial in own_trials]
        recording = run_experiment(everything, environment, engine=engine, **options)
        first = 0
        for (condition, subject), own_trials in trials.items():
            yield condition, subject, recording.isel(trial=slice(first, first + len(own_trials)))
            first += len(own_trials)

    # Equal arms are simulated once: most mechanisms change the arm of one task, or of a few conditions.
    results: dict[tuple[str, Subject], Response | str] = {}
    steady: dict[Subject, str] = {}
    for (_, condition), subject in sorted(subjects.items(), key=lambda item: item[0][1] != "RT0"):
        if subject not in wrong:
            steady.setdefault(subject, condition)
    for condition, subject, recording in recorded(_alone(), ((name, subject) for subject, name in steady.items())):
        reason = _left_workspace(recording) or _oscillation(recording)
        if reason:
            wrong[subject] = reason
        results[condition, subject] = reason or _response(recording, subject)
    moved = {(name, subject): None for (_, name), subject in subjects.items() if name != "RT0" and subject not in wrong}
    for condition, subject, recording in recorded(_continuous(n_multisines), moved):
        results[condition, subject] = _left_workspace(recording) or _response(recording, subject)

    answers = {key: wrong.get(subject) or results[key[1], subject] for key, subject in subjects.items()}
    responses = {key: answer for key, answer in answers.items() if isinstance(answer, Response)}
    unstable = {key: answer for key, answer in answers.items() if isinstance(answer, str)}
    return Yielding(person=person, variants=tuple(arms), responses=responses, unstable=unstable)


def _alone() -> Protocol:
    """Every condition without its multisine, and long enough to see whether an arm comes to rest."""
    still: dict[str, Any] = {"rms_displacement": 0.0, "published_force": 0.0, "repetitions": 1}
    levels = {name: PULSES.get(name, 1.0) for name in CONDITIONS}
    conditions = [replace(THESIS.condition(name), **still, pulse_levels=(level,)) for name, level in levels.items()]
    return with_published_forces(conditions, PULSE_LEAD, PULSE_LEAD + CALM)


def _continuous(n_multisines: int) -> Protocol:
    """The conditions with a multisine; with pulses at its end where they are shown."""
    levels = {name: (PULSES[name],) if name in PULSES else () for name in CONDITIONS}
    conditions = [
        replace(THESIS.condition(name), pulse_levels=levels[name], repetitions=n_multisines)
        for name in CONDITIONS
        if THESIS.condition(name).has_multisine
    ]
    onset = WINDOW_START + PERIOD
    return with_published_forces(conditions, onset, onset + max(WINDOWS.values()) + 0.1)


def _trials(protocol: Protocol, condition: str, subject: Subject, seed: int) -> list[Trial]:
    """The trials of one condition, whose multisines are those of all conditions, and of both directions."""
    alone = replace(protocol, conditions=(protocol.condition(condition),))
    drawn = alone.draw_multisines(seed, range(alone.conditions[0].repetitions))
    multisines = {number: drawn[planned.repetition] for number, planned in enumerate(alone.planned_trials()) if drawn}
    person = Person(name=subject.name, height=1.0, mass=1.0, subjects={subject.task: subject})
    return alone.trials(person, alone.given_forces(), seed, 0, noisy=False, multisines=multisines)


def _left_workspace(recording: xr.Dataset) -> str:
    """When the handle left the workspace; empty if it did not."""
    limit = recording["limit_time"].values
    return f"leaves the workspace at {np.nanmin(limit):.1f} s" if np.isfinite(limit).any() else ""


def _oscillation(recording: xr.Dataset) -> str:
    """Empty if the arm comes to rest after a pulse: it moves little, or half as much as 3 s before."""
    rate = float(recording.attrs["rate"])
    handle, second = recording["displacement"].values, round(rate)
    before, after = (
        np.ptp(part, axis=1).max(axis=-1) for part in (handle[:, -4 * second : -3 * second], handle[:, -second:])
    )
    peak = np.linalg.norm(handle, axis=-1).max(axis=-1)
    oscillates = (after > AT_REST * peak) & (after > 0.5 * before)
    return f"self-sustained oscillation: still moves {CALM:g} s after a pulse" if oscillates.any() else ""


def _response(recording: xr.Dataset, subject: Subject) -> Response:
    """What one arm's trials in one condition show."""
    rate = float(recording.attrs["rate"])
    response = Response(subject=subject)
    pulse_onset = float(recording["pulse_onset"].values[0])
    if math.isfinite(pulse_onset):
        onset = round(pulse_onset * rate)
        shown = slice(onset, onset + round(WINDOWS[subject.task] * rate) + 1)
        distance = np.linalg.norm(recording["displacement"].values[:, shown], axis=-1)
        peak, force = (float(values.mean()) for values in pulse_peaks(recording))
        time = np.arange(distance.shape[1]) / rate
        response = replace(
            response, time=time, distance=distance.mean(axis=0), peak=peak, pulse_admittance=peak / force
        )
    if pulse_onset < WINDOW_START:
        return response
    spectra = estimate_spectra(line_spectra(recording, window_start=WINDOW_START))
    window = slice(round(WINDOW_START * rate), round((WINDOW_START + PERIOD) * rate))
    shoulder, elbow = true_rotations(recording)[:, window].reshape(-1, 2).T
    stretch = np.sqrt(np.mean(np.stack([shoulder, shoulder + elbow, elbow], axis=1) ** 2, axis=0))
    return replace(response, frequency=spectra.frequency, gain=np.abs(spectra.arm), stretch=stretch)


def intrinsic_loop(
    subject: Subject, amplitude: Sequence[float] | Array, *, frequency: float = LOOP_FREQUENCY
) -> tuple[Array, Array]:
    """Intrinsic torque of the muscle elements while each is stretched to and fro: spring, damper and muscle law.

    Args:
      subject: whose muscles.
      amplitude: of the sinusoidal stretch [rad], (element,).
      frequency: of the sinusoid [Hz].

    Returns:
      Stretch [rad] and the torque with which the elements oppose it [Nm], (time, element) both: one cycle, closed,
      after `LOOP_CYCLES` of them, as muscle remembers how it was moved.
    """
    timestep = 1.0 / (frequency * LOOP_SAMPLES)
    phase = 2.0 * np.pi * np.arange(LOOP_CYCLES * LOOP_SAMPLES + 1)[:, None] / LOOP_SAMPLES
    stretch = np.asarray(amplitude, dtype=float) * np.sin(phase)
    velocity = np.asarray(amplitude, dtype=float) * (2.0 * np.pi * frequency) * np.cos(phase)
    torque, _ = stretched([subject], stretch[:, None], velocity[:, None], timestep)
    law = torque[:, 0]
    linear = np.array(subject.muscle_groups("k")) * stretch + np.array(subject.muscle_groups("b")) * velocity
    last = slice(-LOOP_SAMPLES - 1, None)
    return stretch[last], (linear + law)[last]
