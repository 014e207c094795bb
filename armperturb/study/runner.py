"""Runs the study: draws people, perturbs them, records, identifies."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from tqdm import tqdm

from armperturb.analysis.identify import Identification, identify
from armperturb.cohort import draw
from armperturb.environment import Environment
from armperturb.envs.experiment import run_experiment
from armperturb.envs.instruments import Instruments
from armperturb.recording import load_recording, save_recording
from armperturb.study.protocol import CONDITIONS, Condition, draw_multisines, trials_of
from armperturb.subject import Subject
from armperturb.validation import require_number

TRIALS_PER_BATCH = 96
"""About how many trials are simulated side by side; bounds the memory."""


@dataclass(frozen=True, kw_only=True)
class StudySettings:
    """What determines a study.

    Attributes:
      subjects: number of people.
      seed: of everything random.

    Raises:
      ValueError: a value is out of its range.
    """

    subjects: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        require_number("study", "subjects", self.subjects, at_least=1)
        require_number("study", "seed", self.seed, at_least=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One subject in one condition.

    Attributes:
      condition: what was run.
      truth: the subject that was simulated.
      recording: path of the subject's recording.
      identification: what the analysis made of it; None if every trial met the workspace limit.
      left_out: reasons why trials were left out, one each.
    """

    condition: Condition
    truth: Subject
    recording: Path
    identification: Identification | None
    left_out: tuple[str, ...]

    @property
    def identified(self) -> Identification:
        """The identification of a case that `StudyResult.of` gives, which has one."""
        assert self.identification is not None
        return self.identification

    def trials(self) -> xr.Dataset:
        """The recorded trials behind the identification."""
        return _inside(_of_condition(load_recording(self.recording), self.condition))


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyResult:
    """A finished study.

    Attributes:
      settings: what determined it.
      environment: what the hands held.
      cases: one per subject and condition, subjects in order.
    """

    settings: StudySettings
    environment: Environment
    cases: tuple[Case, ...]

    def of(self, condition: str) -> list[Case]:
        """The identified cases of one condition."""
        return [case for case in self.cases if case.condition.name == condition and case.identification is not None]


def run_study(settings: StudySettings, out: Path, *, show_progress: bool = True) -> StudyResult:
    """Draw the cohort, simulate and record every trial, and identify every subject in every condition.

    Args:
      settings: what determines the study.
      out: folder for `recordings/*.nc`, one file per subject.
      show_progress: whether to draw progress bars on the terminal.

    Raises:
      OSError: the folder cannot be written to.
    """
    folder = out / "recordings"
    folder.mkdir(parents=True, exist_ok=True)
    environment = Environment()
    people = _draw_people(settings, environment)
    cases = []
    with tqdm(total=len(people) * len(CONDITIONS), desc="identify", disable=not show_progress, position=1) as bar:
        for name, recording in _record(settings, people, environment, show_progress):
            path = folder / f"{name}.nc"
            save_recording(recording, path)
            for condition in CONDITIONS:
                cases.append(_identify(condition, people[name][condition.name], recording, path))
                bar.update()
    return StudyResult(settings=settings, environment=environment, cases=tuple(cases))


def _draw_people(settings: StudySettings, environment: Environment) -> dict[str, dict[str, Subject]]:
    """Name to condition to subject."""
    return {
        name: {
            condition.name: draw(
                condition.preset,
                np.random.default_rng([settings.seed, number, key]),
                name=name,
                environment=environment,
            )
            for key, condition in enumerate(CONDITIONS)
        }
        for number, name in enumerate(f"S{i + 1:02d}" for i in range(settings.subjects))
    }


def _record(
    settings: StudySettings,
    people: dict[str, dict[str, Subject]],
    environment: Environment,
    show_progress: bool,
) -> Iterator[tuple[str, xr.Dataset]]:
    """Each subject's recording, simulated several subjects at a time."""
    multisines = {condition.name: draw_multisines(condition, settings.seed) for condition in CONDITIONS}
    trials = {
        name: [
            trial
            for key, condition in enumerate(CONDITIONS)
            for trial in trials_of(
                condition,
                subjects[condition.name],
                multisines[condition.name],
                int(np.random.SeedSequence([settings.seed, number, key]).generate_state(1)[0]),
            )
        ]
        for number, (name, subjects) in enumerate(people.items())
    }
    total = sum(trial.perturbation.duration for of_subject in trials.values() for trial in of_subject)
    with tqdm(total=total, desc="simulate", unit="s", unit_scale=True, disable=not show_progress) as bar:
        for names in _blocks(trials):
            block = [trial for name in names for trial in trials[name]]
            recording = run_experiment(block, environment, instruments=Instruments(), progress=bar.update)
            first = 0
            for name in names:
                last = first + len(trials[name])
                yield name, recording.isel(trial=slice(first, last))
                first = last


def _blocks(trials: dict[str, list]) -> Iterator[Sequence[str]]:
    block: list[str] = []
    for name in trials:
        block.append(name)
        if sum(len(trials[n]) for n in block) >= TRIALS_PER_BATCH:
            yield block
            block = []
    if block:
        yield block


def _identify(condition: Condition, truth: Subject, recording: xr.Dataset, path: Path) -> Case:
    mine = _of_condition(recording, condition)
    limits = mine["limit_time"].values
    left_out = tuple(
        f"trial {trial} of {truth.name} in {condition.name} reached the workspace limit at {limits[trial]:.3f} s"
        for trial in np.flatnonzero(np.isfinite(limits))
    )
    inside = _inside(mine)
    identification = identify(inside, condition.model) if inside.sizes["trial"] else None
    return Case(condition=condition, truth=truth, recording=path, identification=identification, left_out=left_out)


def _of_condition(recording: xr.Dataset, condition: Condition) -> xr.Dataset:
    return recording.isel(trial=np.flatnonzero(recording["condition"].values == condition.name))


def _inside(recording: xr.Dataset) -> xr.Dataset:
    """Trials that stayed off the workspace limit."""
    return recording.isel(trial=np.flatnonzero(np.isnan(recording["limit_time"].values)))
