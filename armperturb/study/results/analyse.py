"""Analyses the recordings in a study folder; results that were kept there by an earlier call are used again."""

import itertools
import os
import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np

from armperturb.analysis.trials import trials_by_condition
from armperturb.archive import digest
from armperturb.cohort import Person
from armperturb.environment import Environment
from armperturb.files import checksum
from armperturb.progress import Progress
from armperturb.study.protocol import Protocol
from armperturb.study.recording.folder import ANALYSIS, RECORDINGS, find_recordings, require_own_results
from armperturb.study.recording.manifest import Manifest, current_versions, read_manifest
from armperturb.study.recording.record import record_study, worker_count
from armperturb.study.recording.settings import BLOCK, StudySettings
from armperturb.study.results.appendix_fits import Appendices, Key, SecondStep, fit_second_step, joined, means_of
from armperturb.study.results.cache import CachedResult, Unit, computed, kept_or_computed, reusable
from armperturb.study.results.cases import Case, arms_of, warn_of_short_multisines
from armperturb.study.results.emg import PersonEmg, person_emg
from armperturb.study.results.laboratory import as_measured, recorded_protocol
from armperturb.study.results.mean_admittance import main_conditions
from armperturb.study.results.nonlinear_fits import NonlinearFit, fit_nonlinear
from armperturb.study.results.person import PersonResults, analyse_person
from armperturb.study.results.recordings import load_trials
from armperturb.study.results.settings import AnalysisSettings
from armperturb.study.results.study_result import StudyResult
from armperturb.subject import TASKS
from armperturb.validation import require_type
from armperturb.workers import Workers, require_workers, workers_for

STEPS = 10
"""Steps that a person's first results count as, which take as much longer than what follows from everybody's."""

Result = TypeVar("Result")


def run_study(
    settings: StudySettings,
    out: str | Path,
    *,
    workers: int | None = 1,
    dask: str | None = None,
    block: int = BLOCK,
    nonlinear: Collection[str] = (),
    analysis: AnalysisSettings | None = None,
    show_progress: bool = True,
) -> StudyResult:
    """Record a study as `record_study` does, and analyse it.

    Args:
      settings: what determines the study.
      out: the study folder, see `armperturb.study.recording.folder`.
      workers: number of processes, also for the analysis; None for about one per core.
      dask: address of a Dask scheduler whose workers simulate.
      block: number of trials that a worker simulates side by side.
      nonlinear: tasks ("RT", "PT") in which everybody is identified nonlinearly, see `analyse_study`.
      analysis: which fits are made; all of the thesis's if None.
      show_progress: whether to draw progress bars on the terminal.

    Raises:
      Exception: as `record_study`.
    """
    require_type("study: settings", settings, StudySettings, "StudySettings")
    warn_of_short_multisines(settings.load_protocol())
    record_study(settings, out, workers=workers, dask=dask, block=block, show_progress=show_progress)
    return analyse_study(out, workers=workers, nonlinear=nonlinear, settings=analysis, show_progress=show_progress)


def analyse_study(
    root: str | Path,
    *,
    workers: int | None = None,
    nonlinear: Collection[str] = (),
    settings: AnalysisSettings | None = None,
    show_progress: bool = True,
) -> StudyResult:
    """Analyse the recordings in a study folder; results of an earlier call are used again, see `results.cache`.

    A folder that is incomplete, or was made by another version, is analysed as far as it goes. Without a manifest,
    conditions with names of the thesis are taken to be the thesis's, with the pulses that were recorded; all others are
    what their trials show, and nothing is known of the people.

    Args:
      root: the folder.
      workers: number of processes; None for about one per core. No effect on the result but for rounding.
      nonlinear: tasks ("RT", "PT") in which everybody is identified nonlinearly, which takes minutes per person. In
        the other tasks, fits of earlier calls are used as long as they are valid; those that are not are named in
        `StudyResult.missing`, and their files stay as they are.
      settings: which fits are made; all of the thesis's if None.
      show_progress: whether to draw progress bars on the terminal.

    Raises:
      TypeError: workers is no number.
      ValueError: workers is below 1, a folder of results is a link, no recording is whole, one is refused or not of one
        person, or without a manifest none is of the thesis's conditions.
      RuntimeError: workers die again and again.
      OSError: the folder holds no recording, or a file cannot be read.
    """
    require_workers("analysis", workers)
    root = Path(root)
    require_own_results(root)
    study, missing = _Study.find(root, settings or AnalysisSettings())
    with workers_for(worker_count(workers, len(study.paths)), None, [__name__]) as pool:
        with Progress("analysis", total=(STEPS + 2) * len(study.paths), unit="steps", show=show_progress) as bar:
            people = study.people(pool, bar)
            alone = study.result(people)
            appendices, second, emg = study.together(people, _main_cases(alone), pool, bar)
        fits, stale = _nonlinear(study.nonlinear_units(people), nonlinear, pool, show_progress)
    if study.made:
        missing += [line for person in people.values() for line in person.missing]
    missing += study.unused_fits(fits, stale)
    remarks = [line for person in people.values() for line in (*person.measures.left_out, *person.fits.left_out)]
    remarks += [line for step in second for line in step.left_out]
    remarks += [
        f"{fit.name} was not identified nonlinearly in {fit.label}: {fit.failed}" for fit in fits.values() if fit.failed
    ]
    return replace(
        alone,
        appendices=appendices,
        emg=emg,
        nonlinear=tuple(fits.values()),
        missing=tuple(missing),
        remarks=tuple(dict.fromkeys(remarks)),
    )


class _NonlinearUnit(NamedTuple):
    """A recording to be identified nonlinearly in a task."""

    cached: CachedResult[NonlinearFit]
    recording: Path
    task: str
    cases: tuple[Case, ...]
    fitted_deg: tuple[float, ...] = ()
    start: Mapping[str, float] | None = None

    @property
    def checkpoint(self) -> Path:
        """Where a search is kept that is under way."""
        return self.cached.path.with_name(self.cached.path.name.replace(".json.gz", ".checkpoint.gz"))

    def with_pulses(self, first: NonlinearFit) -> list[Self]:
        """The same with pulses of all directions but one, starting from the fit without pulses."""
        units = []
        for others in first.others_deg:
            name = "-".join([self.recording.stem, "nonlinear", self.task, *(f"{deg:g}" for deg in others)])
            cached = replace(
                self.cached,
                path=self.cached.path.with_name(f"{name}.json.gz"),
                settings={**self.cached.settings, "fitted_deg": list(others)},
            )
            units.append(self._replace(cached=cached, fitted_deg=others, start=first.start))
        return units

    def run(self) -> NonlinearFit:
        recording = load_trials(self.recording, ["joint_angle"])
        # As results, a search is not kept in a folder that cannot be written to.
        checkpoint = self.checkpoint if os.access(self.checkpoint.parent, os.W_OK) else None
        return fit_nonlinear(recording, self.task, self.cases, self.fitted_deg, self.start, checkpoint)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Study:
    """A study folder: its recordings, and how they were made.

    Attributes:
      root: the folder.
      settings: which fits are made.
      paths: whole recordings, in the order of their names, to their checksums.
      made: how they were made; None if nobody says.
      protocol: what everyone went through.
      environment: what the hands held.
      cohort: the people who were simulated; empty if nobody knows.
      recorded: condition to the number of its trials; empty if `made` says how many there are to be.
    """

    root: Path
    settings: AnalysisSettings
    paths: Mapping[Path, str]
    made: Manifest | None
    protocol: Protocol
    environment: Environment
    cohort: tuple[Person, ...]
    recorded: Mapping[str, int]

    @classmethod
    def find(cls, root: Path, settings: AnalysisSettings) -> tuple[Self, list[str]]:
        """The study in a folder, and what the folder lacks or has otherwise, one line each."""
        paths, missing = find_recordings(root)
        made = _manifest(root, missing)
        environment = Environment()
        cohort = made.draw_people(environment) if made else ()
        if cohort is None:
            missing.append("this version draws other people than those who were recorded: their truth is unknown")
            cohort = ()
        if made and len(paths) < made.subjects:
            absent = sorted({person.name for person in cohort} - {path.stem for path in paths})
            named = f" ({', '.join(absent)})" if absent else ""
            lacking = made.subjects - len(paths)
            line = f"the study is incomplete: {lacking} of {made.subjects} people have no whole recording"
            missing.append(line + named)
        protocol, recorded = (made.protocol, {}) if made else recorded_protocol(root, paths, missing)
        study = cls(
            root=root,
            settings=settings,
            paths={path: checksum(path) for path in paths},
            made=made,
            protocol=protocol,
            environment=environment,
            cohort=cohort,
            recorded=recorded,
        )
        return study, missing

    def people(self, pool: Workers | None, bar: Progress) -> dict[Path, PersonResults]:
        """Each recording to what it tells, people in the order of their names.

        Raises:
          ValueError: a recording is refused, or two are of one person, who would count twice.
        """
        units = [
            Unit(
                cached=self._cached(path, "person", PersonResults, protocol=self.protocol.to_dict()),
                run=partial(_analyse, path, self.protocol, self.settings),
            )
            for path in self.paths
        ]
        results = zip(self.paths, kept_or_computed(units, pool, bar, steps=STEPS), strict=True)
        people = dict(sorted(results, key=lambda item: item[1].measures.name))
        for (path, person), (other, another) in itertools.combinations(people.items(), 2):
            name = person.measures.name
            if name == another.measures.name:
                raise ValueError(f"{path} and {other.name} are of subject {name!r}; expected one recording per person")
            if person.measures.cells and person.measures.cells == another.measures.cells:
                raise ValueError(f"{path} and {other.name} hold the same trials; expected one recording per person")
        return people

    def together(
        self, people: Mapping[Path, PersonResults], cases: Sequence[Case], pool: Workers | None, bar: Progress
    ) -> tuple[Appendices, list[SecondStep], tuple[PersonEmg, ...]]:
        """What needs everybody's results: fits of appendices C to E, their second steps, and EMG.

        Step 2 of appendix C starts from everybody's step 1, and figures show the EMG of the first of these cases with
        any.
        """
        first, starts = (
            joined(getattr(person.fits, name) for person in people.values()) for name in ("first", "starts")
        )
        means = means_of(first)
        short = {condition.name for condition in self.protocol.too_short()} - {condition for condition, _ in first}
        units = []
        for path in self.paths:
            cached = self._cached(path, "step-2", SecondStep)
            everybody = replace(cached, recordings={path.name: sha256 for path, sha256 in self.paths.items()})
            units.append(Unit(cached=everybody, run=partial(_second_step, path, means, short)))
        results = kept_or_computed([*units, *self._emg_units(people, cases[:1])], pool, bar)
        second, emg = results[: len(units)], results[len(units) :]
        with_emg = [case for case in cases if any(person.levels for person in emg if person.name == case.name)]
        if with_emg and with_emg[0] is not cases[0]:
            emg = kept_or_computed(self._emg_units(people, with_emg[:1]), pool, bar)
        appendices = Appendices(first=first, second=joined(step.estimates for step in second), starts=starts)
        return appendices, second, tuple(emg) if any(person.levels for person in emg) else ()

    def result(self, people: Mapping[Path, PersonResults]) -> StudyResult:
        """The study with what each recording tells by itself."""
        cases = tuple(self.with_truth(case) for person in people.values() for case in person.cases)
        protocol = self.protocol
        if self.made is None:
            protocol, cases = as_measured(protocol, cases)
        return StudyResult(
            made=self.made,
            protocol=protocol,
            environment=self.environment if self.made else _measured(people.values()),
            recorded=self.recorded,
            cohort=self.cohort,
            cases=cases,
            recordings={person.measures.name: path for path, person in people.items()},
            people=tuple(person.measures for person in people.values()),
        )

    def _emg_units(self, people: Mapping[Path, PersonResults], shown: Sequence[Case]) -> list[Unit[PersonEmg]]:
        """Everybody's EMG; and, in these cases, what figures show of it."""
        units = []
        contractions = [condition.name for condition in self.protocol.conditions if condition.contraction]
        for path, person in people.items():
            name = person.measures.name
            condition = next((case.condition for case in shown if case.name == name), None)
            arms = arms_of(person.cases, self.protocol.conditions)
            settings = {"contractions": contractions, "arms": digest(arms)}
            cached = CachedResult(
                path=self._file(path, "-emg"),
                kind="emg",
                result=PersonEmg,
                recordings={path.name: self.paths[path]},
                settings={**settings, **({"shown": condition.name} if condition else {})},
            )
            units.append(Unit(cached=cached, run=partial(person_emg, name, path, condition, contractions, arms)))
        return units

    def nonlinear_units(self, people: Mapping[Path, PersonResults]) -> list[_NonlinearUnit]:
        """Every person in either task, without pulses."""
        units = []
        for task in TASKS[::-1]:
            for path, person in people.items():
                identified = [case for case in person.cases if case.condition.task == task and case.identification]
                starts = {case.condition.name: case.model for case in identified}
                cached = CachedResult(
                    path=self._file(path, f"-nonlinear-{task}"),
                    kind="nonlinear",
                    result=NonlinearFit,
                    recordings={path.name: self.paths[path]},
                    settings={"task": task, "fitted_deg": [], "starts_from": starts},
                )
                units.append(_NonlinearUnit(cached, path, task, person.cases))
        return units

    def unused_fits(self, fits: Mapping[Path, NonlinearFit], stale: Mapping[Path, str]) -> list[str]:
        """One line for each nonlinear fit in the folder that is not used, with how to make it anew."""
        lines = []
        for path in sorted({*(self.root / ANALYSIS).glob("*-nonlinear-*.json.gz")} - fits.keys()):
            name, _, rest = path.name.removesuffix(".json.gz").partition("-nonlinear-")
            said = f"the nonlinear fit {ANALYSIS}/{path.name} is not used: "
            if name in {recording.stem for recording in self.paths}:
                command = f"armperturb report {shlex.quote(str(self.root))} --nonlinear {rest.partition('-')[0]}"
                reason = stale.get(path, "it follows from a fit that is not used")
                lines.append(f"{said}{reason}; to make it anew: {command}")
            else:
                lines.append(f"{said}{name} has no whole recording; expected it in the folder, or the fit removed")
        return lines

    def with_truth(self, case: Case) -> Case:
        """A case with the path of its recording and, where it is known and has a fixed shoulder, who was simulated."""
        cohort = () if self.protocol.strap else self.cohort
        truth = next((case.condition.subject_of(person) for person in cohort if person.name == case.name), None)
        return replace(case, recording=self.root / case.recording, truth=truth)

    def _cached(self, path: Path, kind: str, result: type[Result], **settings: Any) -> CachedResult[Result]:
        return CachedResult(
            path=self._file(path, "" if kind == "person" else f"-{kind}"),
            kind=kind,
            result=result,
            recordings={path.name: self.paths[path]},
            settings={**asdict(self.settings), **settings},
        )

    def _file(self, recording: Path, suffix: str) -> Path:
        return self.root / ANALYSIS / f"{recording.stem}{suffix}.json.gz"


def _manifest(root: Path, missing: list[str]) -> Manifest | None:
    try:
        made = read_manifest(root)
    except ValueError as error:
        missing.append(f"{error}")
        return None
    if made is not None:
        now = current_versions()
        others = [
            f"{name} {made.versions.get(name, '?')}, now {version}"
            for name, version in now.items()
            if made.versions.get(name) != version
        ]
        if others:
            missing.append(f"the recordings were made with other versions: {'; '.join(others)}")
    return made


def _main_cases(study: StudyResult) -> list[Case]:
    """Those of the main condition of the position task, people in order."""
    main = main_conditions(study)
    return study.of(main["PT"].name) if "PT" in main else []


def _measured(people: Iterable[PersonResults]) -> Environment:
    """The manipulator as the recordings show it, mean over people and conditions."""
    shown = [case.identification.environment for person in people for case in person.cases if case.identification]
    if not shown:
        return Environment()
    values = {
        field.name: float(np.mean([getattr(each, field.name) for each in shown])) for field in fields(Environment)
    }
    return Environment(**values)


def _analyse(path: Path, protocol: Protocol, settings: AnalysisSettings) -> PersonResults:
    recording = load_trials(path, ["joint_angle"])
    try:
        return analyse_person(recording, Path(RECORDINGS, path.name), protocol, settings)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _second_step(path: Path, means: Mapping[Key, Mapping[str, float]], unidentified: Collection[str]) -> SecondStep:
    return fit_second_step(trials_by_condition(load_trials(path, []), is_checked=True), means, unidentified)


def _nonlinear(
    units: Sequence[_NonlinearUnit], tasks: Collection[str], pool: Workers | None, show_progress: bool
) -> tuple[dict[Path, NonlinearFit], dict[Path, str]]:
    """Fits without pulses, then those with some.

    Args:
      units: those without pulses.
      tasks: in which fits that are missing or stale are made; of the others, only kept ones that are valid are used.
      pool: who computes.
      show_progress: whether to draw a progress bar.

    Returns:
      File to fit, and file to why it is stale.
    """
    fits, stale = dict[Path, NonlinearFit](), dict[Path, str]()

    def add(units: Sequence[_NonlinearUnit], stage: str) -> None:
        available, reasons = reusable([unit.cached for unit in units])
        stale.update(reasons)
        new = [unit for unit in units if unit.cached.path not in available and unit.task in tasks]
        if new:
            with Progress(stage, total=len(new), unit="fits", show=show_progress) as bar:
                for number, fit in computed(new, pool, bar):
                    new[number].checkpoint.unlink(missing_ok=True)
                    available[new[number].cached.path] = fit
        fits.update({unit.cached.path: available[unit.cached.path] for unit in units if unit.cached.path in available})

    add(units, "nonlinear fits")
    more = [unit.with_pulses(fits[unit.cached.path]) for unit in units if unit.cached.path in fits]
    add(list(itertools.chain.from_iterable(more)), "nonlinear fits with pulses")
    return fits, stale
