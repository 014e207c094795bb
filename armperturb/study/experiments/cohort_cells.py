"""Published cells of large cohorts, each person simulated, measured and forgotten: no recording is kept."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from armperturb.arrays import Array
from armperturb.cohort import draw_person
from armperturb.environment import Environment
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.perturbations import Multisine
from armperturb.perturbations.multisine import PERIOD
from armperturb.progress import Progress
from armperturb.study.protocol import Protocol
from armperturb.study.recording.record import draw_multisines, practised_trials, worker_count
from armperturb.study.recording.settings import StudySettings
from armperturb.study.results.quantities import Cell, measured_cells, published_cells
from armperturb.validation import require_type
from armperturb.workers import completed, require_workers, workers_for

BATCH = 8
"""Most people who practise side by side; limits a worker's memory, no effect on the result."""


def cells_of_trials(
    trials: Sequence[Sequence[Trial]], environment: Environment, **options: Any
) -> list[dict[Cell, float]]:
    """Published cells that each person's trials fill, all simulated side by side, SI.

    Args:
      trials: of each person.
      environment: what the hand holds.
      **options: of `run_experiment`.
    """
    recording = run_experiment([trial for of_person in trials for trial in of_person], environment, **options)
    ends = np.cumsum([len(of_person) for of_person in trials]).tolist()
    return [
        measured_cells(recording.isel(trial=slice(*span)), period=PERIOD)
        for span in zip([0, *ends], ends, strict=False)
    ]


def measure_cohort(
    settings: StudySettings, *, workers: int | None = None, dask: str | None = None, show_progress: bool = True
) -> pd.DataFrame:
    """Published cells of everybody in a study of these settings, to the last bit, without its recordings.

    People are drawn, practise, and are simulated and measured in batches, so that memory does not grow with their
    number but for the result. Neither `workers` nor `dask` has any effect on it.

    Args:
      settings: what determines the study; with `engine = "compiled"` it takes a third of the time.
      workers: number of processes; 1 for this one alone with as many threads as there are cores, None for about one
        per core.
      dask: address of a Dask scheduler whose workers do the work instead.
      show_progress: whether to draw a progress bar on the terminal.

    Returns:
      A row per person; a column (table, condition, quantity) per cell of `study.results.quantities`, SI; NaN where a
      person fills none.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range.
      RuntimeError: a displacement was not reached in practice, workers die again and again, or Dask is not installed.
      OSError: the protocol's file cannot be read, or no Dask scheduler answers.
    """
    require_type("cohort: settings", settings, StudySettings, "StudySettings")
    require_workers("cohort", workers)
    protocol, n_people = settings.load_protocol(), settings.subjects
    measured: dict[int, tuple[str, Array]] = {}
    with (
        workers_for(worker_count(workers, n_people), dask) as pool,
        Progress("cohort", total=n_people, unit="people", show=show_progress) as bar,
    ):
        multisines = draw_multisines(protocol, settings.seed, pool)
        measure = partial(_measure, settings, protocol, multisines, 0 if pool is None else 1)
        size = min(BATCH, -(-n_people // (1 if pool is None else pool.at_once())))
        batches = [range(first, min(first + size, n_people)) for first in range(0, n_people, size)]
        for some in map(measure, batches) if pool is None else completed(measure, batches, pool, bar.refresh):
            measured |= some
            bar.update(len(some))
    names, cells = zip(*(measured[number] for number in range(n_people)), strict=True)
    columns = pd.MultiIndex.from_tuples(published_cells(), names=Cell._fields)
    return pd.DataFrame(np.stack(cells), names, columns)


def _measure(
    settings: StudySettings, protocol: Protocol, multisines: Mapping[int, Multisine], n_threads: int, numbers: range
) -> dict[int, tuple[str, Array]]:
    """Name and cells of each of these people, in the order of `published_cells`; arrays, as there may be many."""
    environment = Environment()
    people = [(n, draw_person(settings.seed, n, environment, muscles=settings.muscles)) for n in numbers]
    of_people = practised_trials(people, protocol, settings, multisines, n_threads)
    options: dict[str, Any] = {"timestep": settings.timestep, "engine": settings.engine, "strap": protocol.strap}
    if not settings.ideal:
        options["instruments"] = Instruments(marker_noise=None, emg=None)  # each has noise of its own
    measured = {}
    for (number, person), trials in zip(people, of_people, strict=True):
        (cells,) = cells_of_trials([trials], environment, n_threads=n_threads, **options)
        measured[number] = person.name, np.array([cells.get(cell, math.nan) for cell in published_cells()])
    return measured
