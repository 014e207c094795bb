"""Runs the experiments of a study: draws people, lets them practise, perturbs them, records.

Everything that a subject's file holds follows from the settings and the subject's number alone, so a study may be
stopped, killed and started again, and be shared out over processes and machines, without any effect on the files.
"""

import hashlib
import itertools
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from armperturb.analysis.arm.state_space import largest_real_pole
from armperturb.cohort import Person
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.files import write_whole
from armperturb.joined_recordings import stack_trials
from armperturb.perturbations import Multisine
from armperturb.progress import Progress
from armperturb.recording_files import encode_recording
from armperturb.study.protocol import Protocol
from armperturb.study.recording.folder import StudyFolder, cannot_write, open_study
from armperturb.study.recording.manifest import Manifest
from armperturb.study.recording.practice import practise
from armperturb.study.recording.settings import BLOCK, StudySettings
from armperturb.validation import require_number, require_type
from armperturb.workers import LOG, Workers, completed, cpu_count, require_workers, signals_held_back, workers_for

PROGRESS_INTERVAL = 0.2
"""Time between two reports of a worker's progress [s]."""

MOST_NAMED = 5
"""How many of the people who are unstable an error names."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Unit:
    """Some people's whole experiment, to be done in one go; all that a worker needs to know."""

    number: int
    people: tuple[tuple[int, Person], ...]
    protocol: Protocol
    multisines: dict[int, Multisine]
    settings: StudySettings
    block: int
    n_threads: int
    staging: Path | None  # where to leave the files; None to send them back
    progress: Path | None  # file of the simulated seconds, those of this unit being the double at place `number`

    @property
    def seconds(self) -> float:
        """Simulated time of all trials [s]."""
        return len(self.people) * len(self.protocol.planned_trials()) * self.protocol.trial_duration


class _Finished(NamedTuple):
    """A subject's file that a worker has written."""

    name: str
    content: Path | bytes
    sha256: str


def record_study(
    settings: StudySettings,
    out: str | Path,
    *,
    workers: int | None = 1,
    dask: str | None = None,
    block: int = BLOCK,
    show_progress: bool = True,
) -> list[Path]:
    """Draw the cohort, let it practise, simulate every trial and write one recording per subject.

    A study that was stopped or killed goes on where it was: subjects whose file is there and whole are not done again.
    Neither `workers` nor `dask` nor `block` has any effect on what the files hold.

    Args:
      settings: what determines the study.
      out: the study folder, see `armperturb.study.recording.folder`.
      workers: number of processes; 1 for this one alone with as many threads as there are cores, None for about
        one per core.
      dask: address of a Dask scheduler whose workers do the work instead; they send the files back.
      block: number of trials that a worker simulates side by side; its memory grows with it, or with the trials
        of a person if they are more.
      show_progress: whether to draw a progress bar on the terminal.

    Returns:
      The path of each subject's recording, subjects in order.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, a condition makes somebody unstable, or the folder was made with other
        settings.
      RuntimeError: another run is at work in the folder, workers die again and again, or Dask is not installed.
      OSError: a file cannot be read or written, or no Dask scheduler answers.
    """
    require_type("study: settings", settings, StudySettings, "StudySettings")
    require_number("study", "block", block, at_least=1)
    require_workers("study", workers)
    protocol = settings.load_protocol()
    people = settings.draw_people(Environment())
    _require_stable(people, protocol)
    names = [person.name for person in people]
    with open_study(Path(out), Manifest.of(people, protocol, settings).to_dict()) as folder:
        done, damaged = folder.check(names)
        for path in damaged:
            LOG.warning("%s does not match its checksum: set aside, and its subject is done again", path)
        missing = [(number, person) for number, person in enumerate(people) if person.name not in set(done)]
        if missing:
            n_trials = len(protocol.planned_trials())
            with (
                workers_for(worker_count(workers, len(missing)), dask, [__name__]) as pool,
                _Bar(len(people) * n_trials, len(done) * n_trials, protocol.trial_duration, show_progress) as bar,
            ):
                units = _units(missing, settings, protocol, folder, pool, block)
                with closing(_work(units, pool, bar)) as finished:
                    for file in finished:
                        content = file.content
                        staged = content if isinstance(content, Path) else _stage(content, folder.staging, file.name)
                        folder.keep(file.name, staged, file.sha256)
        return [folder.recording(name) for name in names]


def _require_stable(people: Sequence[Person], protocol: Protocol) -> None:
    """Refuse conditions in which somebody is unstable, before anybody practises.

    People are drawn stable at their own levels with a shoulder that is held: others have to be looked at.

    Raises:
      ValueError: there is such a condition.
    """
    strap = protocol.strap
    for condition in protocol.conditions:
        if condition.co_contraction == 1.0 and strap is None:
            continue
        poles = {p.name: largest_real_pole(condition.subject_of(p), Environment(), strap) for p in people}
        unstable = [name for name, pole in poles.items() if not pole < 0.0]
        if unstable:
            more = ", ..." if len(unstable) > MOST_NAMED else ""
            remedies = ["a level nearer to 1"] * (condition.co_contraction != 1.0) + ["another strap"] * bool(strap)
            raise ValueError(
                f"condition {condition.name!r}: co_contraction = {condition.co_contraction:g} makes {len(unstable)} of "
                f"{len(people)} people unstable on the manipulator{' and the strap' if strap else ''} "
                f"({', '.join(unstable[:MOST_NAMED])}{more}); "
                f"expected {' or '.join([*remedies, 'other people (--seed, --muscles)'])}"
            )


def worker_count(workers: int | None, n_subjects: int) -> int:
    """Number of processes, None standing for about one per core: no more than there is work for."""
    if workers is None:
        cores = cpu_count()
        # One process in four more than cores costs little, and is worth it if then none is idle in the last round.
        workers = next((count for count in range(cores, cores + cores // 4 + 1) if n_subjects % count == 0), cores)
    return min(workers, n_subjects)


def _units(
    missing: Sequence[tuple[int, Person]],
    settings: StudySettings,
    protocol: Protocol,
    folder: StudyFolder,
    pool: Workers | None,
    block: int,
) -> list[_Unit]:
    """Share the people out."""
    n_groups = math.ceil(len(missing) / max(1, block // len(protocol.planned_trials())))
    if pool is not None:
        # Balance the load: at least two batches per worker, equal counts, so that no worker idles at the end.
        count = pool.at_once() // 2
        n_groups = min(max(2, math.ceil(n_groups / count)) * count, len(missing))
    size, n_larger = divmod(len(missing), n_groups)
    starts = [size * number + min(number, n_larger) for number in range(n_groups + 1)]
    groups = [tuple(missing[first:last]) for first, last in itertools.pairwise(starts)]
    multisines = draw_multisines(protocol, settings.seed, pool)
    progress = None
    if pool is not None and not pool.remote:
        progress = folder.staging / "progress"
        progress.write_bytes(bytes(8 * len(groups)))
    return [
        _Unit(
            number=number,
            people=group,
            protocol=protocol,
            multisines=multisines,
            settings=settings,
            block=block,
            n_threads=0 if pool is None else pool.threads(number, len(groups)),
            staging=None if pool is not None and pool.remote else folder.staging.resolve(),
            progress=progress,
        )
        for number, group in enumerate(groups)
    ]


def draw_multisines(protocol: Protocol, seed: int, pool: Workers | None) -> dict[int, Multisine]:
    """`Protocol.draw_multisines`, shared out: some seconds' work that everybody's trials wait for."""
    if pool is None:
        return protocol.draw_multisines(seed)
    numbers = [[number] for number, trial in enumerate(protocol.planned_trials()) if trial.condition.has_multisine]
    drawn = completed(partial(protocol.draw_multisines, seed), numbers, pool)
    return {number: multisine for some in drawn for number, multisine in some.items()}


def _work(units: Sequence[_Unit], pool: Workers | None, bar: "_Bar") -> Generator[_Finished]:
    """Do the units and give each subject's file as it comes."""
    if pool is None:
        for unit in units:
            yield from _do(unit, bar.add)
        return
    seconds = np.array([unit.seconds for unit in units])
    finished = np.zeros(len(units), bool)
    progress_file = units[0].progress

    def poll() -> None:
        running = np.zeros(len(units)) if progress_file is None else np.fromfile(progress_file)
        bar.reach(float(np.where(finished, seconds, running).sum()))

    with closing(completed(_do_numbered, units, pool, poll)) as results:
        for number, files in results:
            finished[number] = True
            poll()
            yield from files


def _do_numbered(unit: _Unit) -> tuple[int, list[_Finished]]:
    """What a worker process does."""
    if unit.progress is None:
        return unit.number, _do(unit, None)
    with unit.progress.open("r+b", buffering=0) as progress_file:
        done, next_time = 0.0, 0.0

        def report_progress(seconds: float) -> None:
            nonlocal done, next_time
            done += seconds
            if (now := time.monotonic()) >= next_time:
                progress_file.seek(8 * unit.number)
                progress_file.write(np.float64(done).tobytes())
                next_time = now + PROGRESS_INTERVAL

        return unit.number, _do(unit, report_progress)


def _do(unit: _Unit, progress: Callable[[float], object] | None) -> list[_Finished]:
    """Let the people of a unit practise, perturb them, and write their files."""
    of_people = practised_trials(unit.people, unit.protocol, unit.settings, unit.multisines, unit.n_threads)
    recording = _simulate([trial for trials in of_people for trial in trials], unit, progress)
    n_trials = len(of_people[0])
    return [
        _write(recording.isel(trial=slice(place * n_trials, (place + 1) * n_trials)), person.name, unit.staging)
        for place, (_, person) in enumerate(unit.people)
    ]


def practised_trials(
    people: Sequence[tuple[int, Person]],
    protocol: Protocol,
    settings: StudySettings,
    multisines: Mapping[int, Multisine],
    n_threads: int,
) -> list[list[Trial]]:
    """Each person's trials, with the forces of the practice session.

    Args:
      people: with their numbers in the cohort.
      protocol: of the settings.
      settings: of the study.
      multisines: from `draw_multisines`.
      n_threads: of the simulation; 0 takes all cores.
    """
    everyone = [person for _, person in people]
    forces = practise(everyone, protocol, settings.seed, n_threads=n_threads, timestep=settings.timestep)
    return [
        protocol.trials(person, force, settings.seed, number, noisy=not settings.ideal, multisines=multisines)
        for (number, person), force in zip(people, forces, strict=True)
    ]


def _simulate(trials: Sequence[Trial], unit: _Unit, progress: Callable[[float], object] | None) -> xr.Dataset:
    """The recording of all trials, at most `block` of them side by side."""
    pieces = [
        run_experiment(
            trials[first : first + unit.block],
            timestep=unit.settings.timestep,
            engine=unit.settings.engine,
            strap=unit.protocol.strap,
            instruments=None if unit.settings.ideal else Instruments(),
            n_threads=unit.n_threads,
            progress=progress,
        )
        for first in range(0, len(trials), unit.block)
    ]
    return pieces[0] if len(pieces) == 1 else stack_trials(pieces)


def _write(recording: xr.Dataset, name: str, staging: Path | None) -> _Finished:
    """A subject's file: on disk for `StudyFolder.keep` to take over, or to be sent back."""
    with signals_held_back():  # in the middle of a file, HDF5 makes other errors of it
        content = encode_recording(recording)
    sha256 = hashlib.sha256(content).hexdigest()
    return _Finished(name=name, content=content if staging is None else _stage(content, staging, name), sha256=sha256)


def _stage(content: bytes, staging: Path, name: str) -> Path:
    path = staging / f"{name}.nc"
    try:
        write_whole(path, content)
    except OSError as error:
        raise cannot_write(path, error) from None
    return path


class _Bar(Progress):
    """A bar that shows trials done, speed as a multiple of real time, and time left.

    Args:
      n_trials: of the whole study.
      n_before: of them, done by earlier runs.
      duration: of a trial [s].
      show: whether to draw it if there is a terminal.
    """

    def __init__(self, n_trials: int, n_before: int, duration: float, show: bool) -> None:
        self._n_trials, self._n_before, self._duration = n_trials, n_before, duration
        self._seconds, self._begin = 0.0, time.monotonic()
        # Without smoothing, the time left is based on the mean speed.
        options: dict[str, Any] = {"smoothing": 0, "miniters": 0, "mininterval": PROGRESS_INTERVAL}
        options["bar_format"] = "{l_bar}{bar}| {remaining} left{postfix}"
        super().__init__("recording", total=n_trials, initial=n_before, unit="trials", show=show, **options)

    def add(self, seconds: float) -> None:
        """So many simulated seconds more have been done."""
        self.reach(self._seconds + seconds)

    def reach(self, seconds: float) -> None:
        """So many simulated seconds have been done in this run."""
        self._seconds = seconds
        # Not a rounding error more than all, which tqdm would complain about.
        n_done = min(self._n_before + seconds / self._duration, self._n_trials)
        speed = seconds / (time.monotonic() - self._begin)
        self.set_postfix_str(f"{int(n_done + 1e-6)}/{self._n_trials} trials, {speed:.0f} x real time", refresh=False)
        self.update(n_done - self.n)
