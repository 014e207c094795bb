"""A study that was recorded, and all that the analysis makes of it.

| file | |
|---|---|
| `analysis/NAME.json.gz` | what a person's recording tells, so that nothing has to be computed twice |
| `analysis/NAME-step-2.json.gz` | step 2 of appendix C, which depends on everybody |
| `analysis/NAME-nonlinear-TASK.json.gz` | a nonlinear fit, if one was asked for; `-20`: pulses at 20° fitted too |
| `analysis/NAME-nonlinear-TASK.npz` | how far it has come, while it is under way |

They are made anew when the recording, the protocol or this package has changed, and mean nothing beside the recordings.
"""

import hashlib
import json
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

from tqdm import tqdm

from armperturb.analysis.trials import trials_by_condition
from armperturb.archive import code_digest, keep, read_archive
from armperturb.cohort import Person
from armperturb.environment import Environment
from armperturb.recording import load_recording
from armperturb.study.protocol import THESIS, Condition, Protocol
from armperturb.study.recording.folder import RECORDINGS, digest, find_recordings
from armperturb.study.recording.manifest import Manifest, current_versions, read_manifest
from armperturb.study.recording.record import BLOCK, StudySettings, record_study, worker_count
from armperturb.study.results.appendix_fits import (
    Appendices,
    Fits,
    Key,
    SecondStep,
    fit_person,
    fit_second_step,
    joined,
    means_of,
)
from armperturb.study.results.cases import Case, identify_person
from armperturb.study.results.nonlinear_fits import NonlinearFit, fit_nonlinear
from armperturb.study.results.trial_measures import PersonMeasures, measure_person
from armperturb.subject import TASKS
from armperturb.validation import require_number
from armperturb.workers import Workers, completed, workers_for

ANALYSIS = "analysis"

Unit = TypeVar("Unit")
Result = TypeVar("Result")


class PersonResults(NamedTuple):
    """What one person's recording tells.

    Attributes:
      cases: the person in each condition that has a multisine.
      measures: what the thesis reports of a person.
      fits: of appendices C to E, but for step 2 of C.
      missing: what the protocol has and the recording lacks, one line each.
    """

    cases: tuple[Case, ...]
    measures: PersonMeasures
    fits: Fits
    missing: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyResult:
    """An analysed study.

    Attributes:
      made: how its recordings were made; None if nobody says, as of a laboratory's.
      protocol: what everyone went through, or was to.
      environment: what the hands held.
      cohort: the people who were simulated; empty if nobody knows.
      cases: one per person who was recorded and condition that has a multisine, people in order.
      recordings: everyone who was recorded, in order, to the path of the recording.
      people: what the thesis reports of each person.
      appendices: fits of appendices C to E.
      nonlinear: nonlinear fits, those that failed too; empty if nobody asked for any.
      missing: what the folder lacks, or how it was made otherwise; one line each.
      remarks: why parts of what is there were left out, likewise.
    """

    made: Manifest | None
    protocol: Protocol
    environment: Environment
    cohort: tuple[Person, ...]
    cases: tuple[Case, ...]
    recordings: Mapping[str, Path] = field(default_factory=dict)
    people: tuple[PersonMeasures, ...] = ()
    appendices: Appendices = field(default_factory=Appendices)
    nonlinear: tuple[NonlinearFit, ...] = ()
    missing: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def n_people(self) -> int:
        """How many people were to be recorded; who was, if nobody says."""
        return self.made.subjects if self.made else len(self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Everyone who was recorded."""
        return tuple(dict.fromkeys([*(person.name for person in self.people), *(case.name for case in self.cases)]))

    @property
    def has_truth(self) -> bool:
        """Whether the people are known and linear, so that what is fitted to them has true values."""
        truths = [case.truth for case in self.cases]
        return bool(truths) and all(truth is not None and truth.muscle is None for truth in truths)

    @property
    def seed(self) -> int:
        """Of everything random that is drawn for the report."""
        return self.made.seed if self.made else 0

    @property
    def is_ideal(self) -> bool:
        """Whether people and instruments are free of noise."""
        return self.made is not None and self.made.ideal

    @cached_property
    def conditions(self) -> tuple[Condition, ...]:
        """Conditions in which somebody was identified, in the protocol's order."""
        return tuple(condition for condition in self.protocol.conditions if self.of(condition.name))

    def n_trials(self, condition: str) -> int:
        """Trials of everyone in a condition."""
        return self.n_people * sum(cell.condition.name == condition for cell in self.protocol.cells())

    def of(self, condition: str) -> list[Case]:
        """The identified cases of one condition."""
        return [case for case in self.cases if case.condition.name == condition and case.identification is not None]


def run_study(
    settings: StudySettings,
    out: Path,
    *,
    workers: int | None = 1,
    dask: str | None = None,
    block: int = BLOCK,
    nonlinear: Collection[str] = (),
    show_progress: bool = True,
) -> StudyResult:
    """Record a study as `record_study` does, and analyse it.

    Args:
      settings: what determines the study.
      out: the study folder, see `armperturb.study.recording.folder`.
      workers: number of processes, also for the analysis; None for about one per core.
      dask: address of a Dask scheduler whose workers simulate.
      block: number of trials that a worker simulates side by side.
      nonlinear: as `analyse_study` has it.
      show_progress: whether to draw progress bars on the terminal.

    Raises:
      Exception: as `record_study`.
    """
    record_study(settings, out, workers=workers, dask=dask, block=block, show_progress=show_progress)
    return analyse_study(out, workers=workers, nonlinear=nonlinear, show_progress=show_progress)


def analyse_study(
    root: Path, *, workers: int | None = None, nonlinear: Collection[str] = (), show_progress: bool = True
) -> StudyResult:
    """Analyse the recordings in a study folder; what an earlier call has found there is used again.

    A folder that is incomplete, or was made by another version, is analysed as far as it goes. Without a manifest, the
    protocol is taken to be the thesis's, and nothing is known of the people.

    Args:
      root: the folder.
      workers: number of processes; None for about one per core. No effect on the result but for rounding.
      nonlinear: tasks ("RT", "PT") in which everybody is identified nonlinearly, which takes minutes per person; what
        an earlier call has found of the others is there all the same.
      show_progress: whether to draw progress bars on the terminal.

    Raises:
      TypeError: workers is no number.
      ValueError: workers is below 1, no recording is whole, or one is refused or not of one person.
      RuntimeError: workers die again and again.
      OSError: the folder holds no recording, or a file cannot be read.
    """
    if workers is not None:
        require_number("analysis", "workers", workers, at_least=1)
    paths, missing = find_recordings(root)
    made = _manifest(root, missing)
    protocol, environment = made.protocol if made else THESIS, Environment()
    cohort = _cohort(made, environment, missing)
    truths = {person.name: person for person in cohort}
    if made and len(paths) < made.subjects:
        absent = sorted(truths.keys() - {path.stem for path in paths})
        named = f" ({', '.join(absent)})" if absent else ""
        lacking = made.subjects - len(paths)
        missing.append(f"the study is incomplete: {lacking} of {made.subjects} people have no whole recording{named}")
    keys = {path: _key(digest(path), protocol) for path in paths}
    with (
        workers_for(worker_count(workers, len(paths)), None) as crew,
        tqdm(total=2 * len(paths), desc="analyse", unit="step", disable=None if show_progress else True) as bar,
    ):
        units = [_Unit(path, protocol, keys[path], _file(root, path)) for path in paths]
        results = zip(_each(_analyse, PersonResults, units, crew, bar), paths, strict=True)
        recorded = sorted(results, key=lambda one: one[0].measures.name)
        found = [one for one, _ in recorded]
        _require_different(found)
        first, starts = (joined(getattr(one.fits, name) for one in found) for name in ("first", "starts"))
        means = means_of(first)
        # Step 2 follows from everybody's step 1.
        second_key = hashlib.sha256("".join(sorted(keys.values())).encode()).hexdigest()
        later = [_LaterUnit(path, means, second_key, _file(root, path, "-step-2")) for path in paths]
        second = _each(_analyse_later, SecondStep, later, crew, bar)
        bar.close()
        to_fit = [
            _NonlinearUnit(path, task, one.cases, keys[path], _file(root, path, f"-nonlinear-{task}"))
            for task in TASKS[::-1]
            for one, path in recorded
        ]
        fitted = _nonlinear(to_fit, nonlinear, crew, show_progress)
    remarks: list[str] = []
    for one in found:
        missing += one.missing
        remarks += [*one.measures.left_out, *one.fits.left_out]
    remarks += [line for one in second for line in one.left_out]
    remarks += [
        f"{one.name} was not identified nonlinearly in {one.told}: {one.failed}" for one in fitted if one.failed
    ]
    return StudyResult(
        made=made,
        protocol=protocol,
        environment=environment,
        cohort=cohort,
        cases=tuple(
            replace(
                case,
                recording=root / case.recording,
                truth=case.condition.subject_of(truths[case.name]) if case.name in truths else None,
            )
            for one in found
            for case in one.cases
        ),
        recordings={one.measures.name: path for one, path in recorded},
        people=tuple(one.measures for one in found),
        appendices=Appendices(first=first, second=joined(one.estimates for one in second), starts=starts),
        nonlinear=tuple(fitted),
        missing=tuple(missing),
        remarks=tuple(remarks),
    )


def _require_different(found: Sequence[PersonResults]) -> None:
    """Refuse one person in two files, who would count twice.

    Raises:
      ValueError: there is one.
    """
    names = [one.measures.name for one in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{names.count(name)} recordings are of subject {name!r}; expected one per person")


def _manifest(root: Path, missing: list[str]) -> Manifest | None:
    try:
        made = read_manifest(root)
    except ValueError as error:
        missing.append(f"how the recordings were made is not known, so the thesis's protocol is assumed: {error}")
        return None
    if made is not None:
        now = current_versions()
        others = [f"{name} {made.versions.get(name, '?')}, now {now[name]}" for name in now]
        others = [text for name, text in zip(now, others, strict=True) if made.versions.get(name) != now[name]]
        if others:
            missing.append(f"the recordings were made with other versions: {'; '.join(others)}")
    return made


def _cohort(made: Manifest | None, environment: Environment, missing: list[str]) -> tuple[Person, ...]:
    """Those who were simulated, where that is known."""
    people = made.draw_people(environment) if made else ()
    if people is None:
        missing.append("this version draws other people than those who were recorded: their truth is unknown")
    return people or ()


class _Unit(NamedTuple):
    """A recording to be analysed, and where the result is kept."""

    path: Path
    protocol: Protocol
    key: str
    kept: Path


class _LaterUnit(NamedTuple):
    """A recording for step 2 of appendix C."""

    path: Path
    means: Mapping[Key, Mapping[str, float]]
    key: str
    kept: Path


class _NonlinearUnit(NamedTuple):
    """A recording to be identified nonlinearly in a task, and where the result is kept."""

    path: Path
    task: str
    cases: tuple[Case, ...]
    key: str
    kept: Path
    fitted_deg: tuple[float, ...] = ()
    start: Mapping[str, float] | None = None

    @property
    def checkpoint(self) -> Path:
        """Where a search is kept that is under way."""
        return self.kept.with_name(self.kept.name.removesuffix(".json.gz") + ".npz")

    def with_pulses(self, first: NonlinearFit) -> list[Self]:
        """The same with pulses of all directions but one, from what was found without pulses."""
        more = []
        for others in first.others_deg:
            name = "-".join([self.path.stem, "nonlinear", self.task, *(f"{deg:g}" for deg in others)])
            kept = self.kept.with_name(f"{name}.json.gz")
            more.append(self._replace(kept=kept, fitted_deg=others, start=first.start))
        return more


def _nonlinear(
    units: Sequence[_NonlinearUnit], tasks: Collection[str], crew: Workers | None, show_progress: bool
) -> list[NonlinearFit]:
    """The fits without pulses, then those with some; only what was kept of tasks that nobody asked for."""

    def is_wanted(unit: _NonlinearUnit) -> bool:
        return unit.task in tasks or read_archive(unit.kept, unit.key, NonlinearFit) is not None

    def fitted(wanted: Sequence[_NonlinearUnit]) -> list[NonlinearFit]:
        found = _each(_fit_nonlinear, NonlinearFit, wanted, crew, bar)
        for unit in wanted:
            unit.checkpoint.unlink(missing_ok=True)
        return found

    units = list(filter(is_wanted, units))
    if not units:
        return []
    with tqdm(total=len(units), desc="nonlinear", unit="fit", disable=None if show_progress else True) as bar:
        first = fitted(units)
        pairs = zip(units, first, strict=True)
        more = [one for unit, fit in pairs for one in unit.with_pulses(fit) if is_wanted(one)]
        bar.reset(len(units) + len(more))
        bar.update(len(units))
        return first + fitted(more)


def _fit_nonlinear(unit: _NonlinearUnit) -> NonlinearFit:
    recording = load_recording(unit.path, ["joint_angle"])
    # As results, a search is not kept in a folder that cannot be written to.
    checkpoint = unit.checkpoint if os.access(unit.checkpoint.parent, os.W_OK) else None
    return fit_nonlinear(recording, unit.task, unit.cases, unit.fitted_deg, unit.start, checkpoint)


def _analyse(unit: _Unit) -> PersonResults:
    recording = load_recording(unit.path, ["joint_angle"])
    try:
        conditions = trials_by_condition(recording, is_checked=True)
        cases = identify_person(conditions, Path(RECORDINGS, unit.path.name), unit.protocol)
        return PersonResults(
            cases=cases,
            measures=measure_person(recording, conditions, cases),
            fits=fit_person(conditions),
            missing=tuple(_missing(recording, unit.protocol)),
        )
    except ValueError as error:
        raise ValueError(f"{unit.path}: {error}") from None


def _analyse_later(unit: _LaterUnit) -> SecondStep:
    return fit_second_step(trials_by_condition(load_recording(unit.path, []), is_checked=True), unit.means)


def _missing(recording: Any, protocol: Protocol) -> list[str]:
    """What a person's recording lacks, and what it has besides."""
    name = str(recording["subject"].values[0])
    there = recording["condition"].values.tolist()
    wanted = [cell.condition.name for cell in protocol.cells()]
    lines = [
        f"{name} has {there.count(condition)} of {wanted.count(condition)} trials in {condition}"
        for condition in dict.fromkeys(wanted)
        if there.count(condition) < wanted.count(condition)
    ]
    other = [condition for condition in dict.fromkeys(there) if condition not in wanted]
    return lines + [f"{name} was recorded in {condition}, which the protocol lacks" for condition in other]


def _each(
    function: Callable[[Any], Result],
    kind: type[Result],
    units: Sequence[_Unit | _LaterUnit | _NonlinearUnit],
    crew: Workers | None,
    bar: tqdm,
) -> list[Result]:
    """The result of each unit, in their order: kept from an earlier call, or computed and kept."""
    results: dict[int, Result] = {}
    for number, unit in enumerate(units):
        kept = read_archive(unit.kept, unit.key, kind)
        if kept is not None:
            results[number] = kept
            bar.update()
    missing = [(number, function, unit) for number, unit in enumerate(units) if number not in results]
    done = map(_numbered, missing) if crew is None else completed(_numbered, missing, crew, bar.refresh)
    for number, result in done:
        results[number] = result
        keep(units[number].kept, units[number].key, result)
        bar.update()
    return [results[number] for number in range(len(units))]


def _numbered(work: tuple[int, Callable[[Any], Result], Any]) -> tuple[int, Result]:
    number, function, unit = work
    return number, function(unit)


def _file(root: Path, recording: Path, suffix: str = "") -> Path:
    return root / ANALYSIS / f"{recording.stem}{suffix}.json.gz"


def _key(sha256: str, protocol: Protocol) -> str:
    """What a result depends on: recording, protocol, this package and its libraries."""
    text = json.dumps([sha256, protocol.to_dict(), code_digest(), current_versions()])
    return hashlib.sha256(text.encode()).hexdigest()
