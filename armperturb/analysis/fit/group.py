"""Trials of one person in one condition together with the structure that is fitted to them, and their likelihoods."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self

import numpy as np
import xarray as xr

from armperturb.analysis.cuts import require_two_axes
from armperturb.analysis.defaults import WINDOW_START
from armperturb.analysis.fit.admittance_problem import Target, checked_problem, least_squares
from armperturb.analysis.fit.emg_laws import Law
from armperturb.analysis.fit.emg_likelihood import EmgLikelihood
from armperturb.analysis.fit.likelihood import (
    START_OF_MOVING,
    Likelihood,
    PeriodLikelihood,
    RecordLikelihood,
    Signals,
    whitened,
)
from armperturb.analysis.fit.linear_start import linear_start, linear_starts
from armperturb.analysis.fit.structures import Structure
from armperturb.analysis.fit.total_admittance import LONGEST_RUN
from armperturb.analysis.force_balance import EDGE
from armperturb.analysis.manipulator import copies_left_out, manipulator_covariance
from armperturb.analysis.measures.start_geometry import applied_perturbation
from armperturb.analysis.per_trials import per_trials
from armperturb.analysis.periods import check_period, common_period
from armperturb.analysis.response.condition_spectra import condition_spectra, periodic_lines
from armperturb.analysis.response.joint_records import excited_frequencies
from armperturb.analysis.response.record_window import RecordWindow, quick_length
from armperturb.analysis.response.spectra import SpectralEstimate
from armperturb.analysis.trials import (
    ConditionTrials,
    SeveralTrials,
    TrialRecord,
    prepared_recordings,
    trials_by_condition,
)
from armperturb.arrays import Array
from armperturb.environment import Environment
from armperturb.joined_recordings import join_recordings
from armperturb.subject import Subject

APART = 0.1
"""Share of the time before a pulse by which another trial's comes earlier if they are not taken together [-]."""

ANOTHER, CLEARLY = 0.15, 5.0
"""Share of its impedance by which a manipulator differs from another one, and standard errors by which it must [-]."""

FREQUENCIES = np.geomspace(0.3, 10.0, 12)
"""At which manipulators are compared [Hz]."""

SEGMENT = 120.0
"""Length of the segments of long records that structures are compared on [s]."""

Method = Literal["frequency", "record"]
"""Whether the mean period of each trial is used, or all of it from its start."""

NOT_PERIODIC = 0.01
"""RMS of what changes from period to period over that of the perturbation from which on it is not periodic [-]."""

WELL_KNOWN = 20.0
"""Up to this frequency all that the perturbation excites is used [Hz]: arms differ little from their models there."""

EVALUATIONS = 40
"""Of a structure, in a fit to the estimated admittance, which is but a start."""

STARTS = 3
"""Starts from which each structure is fitted to the estimated admittance, which differ in delay and cut-off."""

COHERENCE = (0.05, 0.9999)
"""Coherences beyond which an admittance counts as no less, or no more, well known [-]."""


@per_trials
def _white(trials: ConditionTrials) -> Array:
    """Whitened displacement, (trial, time, axis)."""
    return whitened(trials.displacement, trials.rate)


@dataclass(frozen=True, kw_only=True, eq=False)
class Group:
    """Trials of one person in one condition, and the structure that is fitted to them.

    Attributes:
      parts: the trials, those of one length together.
      structure: what is free.
      spectra: admittances and coherence.
      top: highest frequency that counts in `records` [Hz].
      period: likelihood of the mean periods; None of a perturbation that is not periodic, or not for long enough.
      made: what is computed when it is first asked for, also by groups that differ in structure or EMG alone.
      emg: likelihood of the EMG of the first part; None if it is not used.
    """

    parts: tuple[ConditionTrials, ...]
    structure: Structure
    spectra: SpectralEstimate
    top: float
    period: Likelihood | None
    made: dict[str, tuple[RecordLikelihood, ...]] = field(default_factory=dict)
    emg: EmgLikelihood | None = None

    @classmethod
    def prepare(
        cls,
        trials: SeveralTrials,
        structure: Structure,
        *,
        window_start: float = WINDOW_START,
        period: float | None = None,
    ) -> Self:
        """Prepare trials. Of trials with pulses, what is before these is used.

        The perturbation may be of any kind. Records start at rest or amid the movement, see `likelihood`.

        Args:
          trials: of one person in one condition, or their recordings, which may differ in length.
          structure: what is to be estimated.
          window_start: start of the window of whole periods, after the transient has died away [s].
          period: of the disturbance [s]; None to find it, if there is one.

        Raises:
          ValueError: a recording is refused, gives no spectra, or is of several people, tasks or postures.
        """
        parts = tuple(prepared_recordings(trials))
        for part in parts:
            check_period(part, window_start, period)
        spectra = condition_spectra(parts, window_start=window_start, period=period)
        lines = periodic_lines(parts, window_start, period)
        top = highest_frequency(parts, float((spectra if lines is None else lines).frequency[-1]))
        return cls(
            parts=parts,
            structure=structure,
            spectra=spectra,
            top=top,
            period=None if lines is None else _period_likelihood(parts[0], window_start, period, top),
        )

    @cached_property
    def of_records(self) -> tuple[ConditionTrials, ...]:
        """The trials of each likelihood of whole records: of parts whose pulses come at various times, several each.

        EMG takes the trials of a part together.
        """
        return self.parts if self.emg else tuple(few for part in self.parts for few in pulsed_alike(part))

    @property
    def records(self) -> tuple[RecordLikelihood, ...]:
        """Likelihood of the whole records, each up to the earliest pulse of its trials."""
        if "records" not in self.made:
            self.made["records"] = tuple(record_likelihood(part, self.top) for part in self.of_records)
        return self.made["records"]

    @property
    def segments(self) -> tuple[RecordLikelihood, ...]:
        """The same, of which long records are cut into segments that count as trials of their own.

        They share the frequencies at which a model is evaluated, which makes an hour thirty times as cheap.
        """
        if "segments" not in self.made:
            counts = [_n_segments(part, self.top) for part in self.of_records]
            self.made["segments"] = (
                self.records
                if max(counts) < 2
                else tuple(
                    record_likelihood(part, self.top, count)
                    for part, count in zip(self.of_records, counts, strict=True)
                )
            )
        return self.made["segments"]

    def with_structure(self, structure: Structure) -> Self:
        """The same trials, to be fitted by another structure."""
        return replace(self, structure=structure)

    def with_emg(self, emg: EmgLikelihood) -> Self:
        """The same trials, of which EMG tells as well; one part only."""
        made = self.made if len(self.of_records) == len(self.parts) else {}
        return replace(self, emg=emg, made=made)

    def under(self, law: Law | None) -> Self:
        """The same trials, whose EMG, if there is any, follows a law."""
        return self if law is None or self.emg is None else replace(self, emg=self.emg.under(law))

    @cached_property
    def initial(self) -> Array:
        """Free parameters from which a search may start, (parameter,)."""
        start = linear_start(self.spectra.frequency, self.spectra.arm, self.body, self.structure)
        return start if self.period is not None else self.fit_of_spectra(start)[0]

    def fit_of_spectra(self, start: Array) -> tuple[Array, float]:
        """Free parameters nearest to the estimated admittance, (parameter,), and how far from it [-].

        The distance is the sum of squares of the admittance's relative errors over their variances, as far as the
        coherence tells these.

        Args:
          start: where the search starts, (parameter,).
        """
        spectra = self.spectra
        target = Target(
            frequency=spectra.frequency, admittance=spectra.arm, body=self.body, environment=self.environment
        )
        coherence = np.clip(spectra.coherence, *COHERENCE)
        weight = np.sqrt(coherence / (1.0 - coherence) * spectra.n_averages[:, None])
        problem = replace(
            checked_problem(target, self.structure, "exact"),
            weight=np.broadcast_to(weight[:, :, None], spectra.arm.shape),
        )
        solution = least_squares(problem, start, with_penalty=False, most=EVALUATIONS)
        return solution.x, float(2.0 * solution.cost)

    def best_fit_of_spectra(self) -> tuple[Array, float]:
        """The nearest of what `fit_of_spectra` makes of several starts."""
        starts = linear_starts(self.spectra.frequency, self.spectra.arm, self.body, self.structure)
        nearest = sorted(starts, key=lambda start: start[1])[:STARTS]
        return min((self.fit_of_spectra(start) for start, _ in nearest), key=lambda end: end[1])

    @property
    def label(self) -> str:
        """The condition."""
        return self.parts[0].label

    @property
    def body(self) -> Subject:
        """Task, segment lengths and posture."""
        return self.parts[0].body

    @property
    def environment(self) -> Environment:
        """What the hand held, of the first part."""
        return self.parts[0].environment


def require_one_person(groups: Sequence[Group]) -> None:
    """Refuse groups of several people or postures, or two of one condition.

    Raises:
      ValueError: there are such.
    """
    labels = [group.label for group in groups]
    for label in ("name", "l_h", "l_f", "theta_s_deg", "theta_e_deg"):
        values = {getattr(group.body, label) for group in groups}
        if len(values) > 1:
            raise ValueError(
                f"the conditions {', '.join(labels)} differ in {label} ({', '.join(map(str, sorted(values)))}); "
                "expected one person in one posture"
            )
    for label in labels:
        if labels.count(label) > 1:
            raise ValueError(f"the condition {label!r} comes twice; expected each once (its trials in one group)")


def parts_by_condition(
    recordings: xr.Dataset | Sequence[xr.Dataset] | Mapping[str, Sequence[ConditionTrials]],
) -> dict[str, tuple[ConditionTrials, ...]]:
    """Condition to its trials on two axes, those of one length and manipulator together, in the order of recordings.

    Args:
      recordings: trials of one person, of any lengths; or these by condition already.

    Raises:
      TypeError: recordings are something else.
      ValueError: there is none, trials are of one axis or not of the condition that is their key, or as
        `trials_by_condition`, of all recordings together.
    """
    if isinstance(recordings, Mapping) and not isinstance(recordings, xr.Dataset):
        conditions = {label: tuple(prepared_recordings(parts)) for label, parts in recordings.items()}
        _require_one_name([part for parts in conditions.values() for part in parts])
    else:
        conditions = _by_label(recordings)
    for label, part in ((label, part) for label, parts in conditions.items() for part in parts):
        require_two_axes(part.recording)
        if part.label != label:
            raise ValueError(
                f"identify: trials of {label!r} are of condition {part.label!r}; expected that as their key"
            )
    return conditions


def _by_label(recordings: xr.Dataset | Sequence[xr.Dataset]) -> dict[str, tuple[ConditionTrials, ...]]:
    several = prepared_recordings(recordings, one_rate=False)
    _require_one_name(several)
    parts: dict[str, dict[tuple[float, int], list[ConditionTrials]]] = {}
    for each in several:
        for label, trials in trials_by_condition(each.recording, is_checked=True).items():
            clock = trials.rate, trials.n_samples
            parts.setdefault(label, {}).setdefault(clock, []).append(replace(trials, copies=each.copies))
    return {
        label: tuple(_together(same) for of_clock in by_clock.values() for same in _by_manipulator(of_clock))
        for label, by_clock in parts.items()
    }


def _require_one_name(several: Sequence[ConditionTrials]) -> None:
    people = list(dict.fromkeys(str(name) for each in several for name in each.recording["subject"].values))
    if len(people) > 1:
        raise ValueError(f"recording: subject = {', '.join(people)}; expected one person")


def _by_manipulator(parts: Sequence[ConditionTrials]) -> list[list[ConditionTrials]]:
    """Parts of one condition, those together whose manipulators do not clearly differ."""
    together: list[list[ConditionTrials]] = []
    for part in parts:
        same = next((those for those in together if not _differ(those[0], part)), None)
        if same is None:
            together.append([part])
        else:
            same.append(part)
    return together


def _together(parts: Sequence[ConditionTrials]) -> ConditionTrials:
    if len(parts) == 1:
        return parts[0]
    joined = ConditionTrials.prepare(join_recordings([part.recording for part in parts]).recording)
    return replace(joined, copies={parts[0].label: copies_left_out(parts)})


def pulsed_alike(part: ConditionTrials) -> list[ConditionTrials]:
    """Trials whose pulses come at about the same time together, as of each group what is before its first is used."""
    together: list[list[int]] = []
    for trial in np.argsort(-part.onset, kind="stable").tolist():
        if together and part.onset[trial] >= (1.0 - APART) * part.onset[together[-1][0]]:
            together[-1].append(trial)
        else:
            together.append([trial])
    return [part] if len(together) == 1 else [part.take(sorted(trials)) for trials in together]


def remark_on_manipulators(parts: Sequence[ConditionTrials]) -> list[str]:
    """A line on the manipulators of a condition that was recorded with several of them."""
    if not any(_differ(parts[0], part) for part in parts[1:]):
        return []
    each = (part.environment for part in parts)
    named = "; ".join(f"{held.m_env:.3g} kg, {held.b_env:.3g} Ns/m, {held.k_env:.4g} N/m" for held in each)
    return [f"recorded with several manipulators, each taken as it is ({named})"]


def _differ(first: ConditionTrials, other: ConditionTrials) -> bool:
    """Whether the manipulators of two recordings differ by more than `ANOTHER`, and by more than their errors."""
    try:
        before, after = (
            np.array([held.m_env, held.b_env, held.k_env]) for held in (first.environment, other.environment)
        )
        covariance = manipulator_covariance(first) + manipulator_covariance(other)
    except ValueError:  # of too little movement, or refused later with the reason
        return False
    change = after - before
    omega = 2.0 * np.pi * FREQUENCIES
    of_parts = np.stack([omega**2, omega, np.ones_like(omega)])  # of mass, damping and stiffness
    share = np.hypot(change[2] - change[0] * omega**2, change[1] * omega) / (before @ of_parts)
    errors = np.sqrt(np.diag(covariance) + 1e-12)
    return bool(share.max() > ANOTHER and (np.abs(change) / errors).max() > CLEARLY)


def highest_frequency(parts: Sequence[ConditionTrials], estimated: float) -> float:
    """Highest frequency that counts in whole records [Hz].

    The likelihood weighs what is there by the noise, so that a perturbation which falls towards high frequencies tells
    of inertia and damping where too little of its power is left for the spectra.

    Args:
      parts: the trials.
      estimated: highest frequency of the spectra [Hz].
    """
    rate = parts[0].rate
    records = [TrialRecord(d, d, rate) for part in parts for d in applied_perturbation(part)[:, : part.first_onset]]
    excited = float(excited_frequencies(records).max(initial=0.0))
    return min(max(1.1 * estimated, min(excited, WELL_KNOWN)), 0.45 * rate)


def _signals(trials: ConditionTrials, window: slice) -> Signals:
    d, applied, white = (
        part[:, window] for part in (trials.perturbation, applied_perturbation(trials), _white(trials))
    )
    return Signals(d, applied, white, trials.body, trials.environment, trials.rate)


def record_likelihood(trials: ConditionTrials, top: float, n_segments: int = 1) -> RecordLikelihood:
    """Likelihood of whole records up to the first pulse, or of segments of them, at frequencies up to `top` [Hz]."""
    signals = _record_signals(trials)
    top = min(top, 0.45 * signals.rate)
    if n_segments == 1:
        return RecordLikelihood(signals, top, from_rest=trials.from_rest)
    # What is not judged of each, at its start, is the end of the one before.
    spoiled = round(START_OF_MOVING * signals.rate)
    n_judged = quick_length((signals.perturbation.shape[1] - spoiled) // n_segments)
    starts = n_judged * np.arange(n_segments)
    inside = starts[:, None] + np.arange(spoiled + n_judged)
    cut = {
        name: getattr(signals, name)[:, inside].reshape(-1, spoiled + n_judged, 2)
        for name in ("perturbation", "applied", "displacement")
    }
    return RecordLikelihood(signals._replace(**cut), top, from_rest=False)


def _n_segments(trials: ConditionTrials, top: float) -> int:
    """Into how many segments records are cut: into one of those that are not long."""
    duration = min(trials.first_onset, trials.n_samples) / trials.rate
    return max(1, int(duration / SEGMENT)) if duration * top > LONGEST_RUN else 1


def _record_signals(trials: ConditionTrials) -> Signals:
    """Whole records up to the first pulse, at about `MODEL_RATE` where they are sampled faster."""
    window = RecordWindow.of(trials)
    if window.factor == 1:
        return _signals(trials, slice(window.end))
    rate = trials.rate / window.factor
    d, applied, x = (
        window(values) for values in (trials.perturbation, applied_perturbation(trials), trials.displacement)
    )
    return Signals(d, applied, whitened(x, rate), trials.body, trials.environment, rate)


def _period_likelihood(
    trials: ConditionTrials, window_start: float, period: float | None, top: float
) -> Likelihood | None:
    """That of the mean periods; None of a perturbation that was another a period earlier."""
    rate = trials.rate
    n_period = round((common_period([trials], window_start) if period is None else period) * rate)
    first = round(window_start * rate)
    end = min(trials.first_onset, trials.n_samples - round(EDGE * rate))
    d = trials.perturbation
    n = min(n_period, first // 2)
    earlier, later = d[:, first - n : first], d[:, first - n + n_period : first + n_period]
    change = np.sqrt(np.mean((later - earlier) ** 2, axis=(1, 2))) if n else np.zeros(len(d))
    if (change > NOT_PERIODIC * np.sqrt(np.mean(d[:, first : first + n_period] ** 2, axis=(1, 2)))).any():
        return None
    last = first + n_period * max(1, (end - first) // n_period)
    return PeriodLikelihood(_signals(trials, slice(first, last)), n_period, top)
