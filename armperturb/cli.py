"""The command line: one subcommand per dataclass, each also a Python function."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import joblib
import numpy as np
import tyro
import xarray as xr
from tqdm import tqdm

from armperturb.analysis.fit.export import write_identification
from armperturb.analysis.fit.identify import Identifications, identify_conditions
from armperturb.convert import export_recording, import_recording
from armperturb.convert.exporter import require_ending
from armperturb.convert.faults import Repair
from armperturb.environment import Environment
from armperturb.envs.render.gl import require_simulator
from armperturb.perturbations import load_perturbation
from armperturb.recording import load_recording, save_recording
from armperturb.subject import RELAX, TASKS, Subject
from armperturb.validation import require_number


@dataclass(frozen=True, kw_only=True)
class Study:
    """Run the study: draw people, perturb them, identify them, and report."""

    out: Path
    """Folder for recordings, tables, figures and report.html; a study that was stopped there goes on."""
    subjects: int = 10
    """Number of synthetic people."""
    seed: int = 0
    """Of everything random."""
    protocol: Path | None = None
    """TOML file of what everyone goes through, instead of the thesis's protocol."""
    ideal: bool = False
    """People and instruments without noise."""
    forces: Literal["practice", "published"] | None = None
    """Where the forces come from, instead of what the protocol says: each person's practice session, or the protocol's
    own, the same for everyone."""
    muscles: Literal["nonlinear", "linear"] = "nonlinear"
    """People around a calibrated average person, whose muscles yield, or linear ones, so that estimates can be judged
    by true values."""
    workers: int | None = None
    """Number of processes; by default about one per core. No effect on the files, nor have the next two."""
    dask: str | None = None
    """Address of a Dask scheduler whose workers simulate, e.g. tcp://127.0.0.1:8786; needs armperturb[dask]."""
    block: int = 96
    """Number of trials that a worker simulates side by side; bounds its memory."""
    nonlinear: tuple[Literal["RT", "PT"], ...] = ()
    """Tasks in which everybody's muscle law is identified, which takes minutes per person; see `report`."""
    record_only: bool = False
    """Stop when the recordings are there: no identification, no report."""


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Perturb one synthetic person and write the recording."""

    subject: Path
    """TOML file of the person."""
    perturbation: Path
    """CSV file with the columns time_s,d_x_N,d_y_N."""
    out: Path
    """Recording to write (netCDF4)."""
    ideal: bool = False
    """Record the truth: no instrument effects, no noise."""
    rope: Literal["ideal", "pendulum"] = "ideal"
    """Whether the rope that carries the arm pulls it back like a pendulum."""
    rate: float = 200.0
    """Sampling rate of the recording [Hz]."""
    seed: int = 0
    """Of the instruments' noise."""


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Turn a laboratory's files into a recording, or a recording into files for other programs."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """CSV, MATLAB or C3D files with a JSON sidecar that says what they hold, or recordings (netCDF4); their trials are
    put together."""
    out: Path
    """Recording to write (.nc), or text (.csv) or MATLAB (.mat) with a sidecar beside it."""
    sidecar: Path | None = None
    """Sidecar of all files, see docs/recordings.md; by default FILE.json beside each."""
    repair: tuple[Repair, ...] = ()
    """Faults to repair instead of refusing them: gaps and drops of up to 0.1 s, an uneven clock, unequal lengths;
    trials leaves out those with other faults."""
    rate: float | None = None
    """Sampling rate of the recording [Hz]; by default that of the files."""


@dataclass(frozen=True, kw_only=True)
class Identify:
    """Estimate the admittance from a recording and fit an arm model to it."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings of one person to read: netCDF4, or CSV, MATLAB or C3D with a sidecar (see convert); the trials of a
    condition are identified together."""
    model: Literal["1", "2", "3", "4", "5", "6", "3a", "3b", "nonlinear"]
    """Model structure: 1 intrinsic and grip; 2 with velocity, 3 with velocity and position feedback; 4, 5 and 6 with
    force, acceleration or both besides; 3a and 3b total mass and reflexes, with grip, delay and cut-off fixed, 3b
    without negative gains; nonlinear a muscle law, from all trials of one or both tasks together."""
    out: Path
    """Folder for admittance.csv, parameters.csv and fit.json; of a nonlinear model, for parameters.csv,
    correlations.csv, predictions.csv, fit.json and pulses.svg, and for what lets a search that was stopped go on."""
    law: Literal["full", "short-range", "linear", "choose"] | None = None
    """Of the nonlinear model: the full muscle law (the default), short-range stiffness that yields alone, none, or what
    trials show that were left out of the fits (choose)."""
    pulses: str | None = None
    """Directions of the pulses that the nonlinear model is fitted to [deg], e.g. 20,200; the others are predicted."""
    estimator: Literal["thesis", "frequency", "record"] = "record"
    """Greatest likelihood over whole records or over mean periods (frequency), or the thesis's trial by trial."""
    share: str | None = None
    """Parameters that are the same in all conditions, e.g. mass,grip,k_s; of greatest likelihood only."""
    subject: str | None = None
    """Which subject, if the recording holds several."""
    condition: str | None = None
    """Which condition alone; by default all that have a multisine."""
    window_start: float = 8.0
    """Start of the window of whole periods [s]: the transient must have died away by then."""
    period: float | None = None
    """Period of the perturbation [s]; by default it is found."""
    lines_per_average: int = 4
    """Adjacent excited lines that are averaged in admittance.csv and by the thesis's estimator; 1 keeps every line and
    needs several trials."""


@dataclass(frozen=True, kw_only=True)
class Response:
    """Estimate a frequency response without a model of the arm, its uncertainty, and how nonlinear the arm is."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings of one person in one condition: netCDF4, or CSV, MATLAB or C3D with a sidecar (see convert); their
    lengths may differ."""
    out: Path
    """Folder for response.csv and response.svg; with multisines in two trials or more also distortion.csv and .svg."""
    method: Literal["multisine", "noise", "welch", "multitaper", "spectral", "arx", "subspace"] = "multisine"
    """How: for multisines of any lines and period, multisine, or spectral as in the thesis; for any disturbance with
    power at all frequencies, noise, welch or multitaper; for either, the models arx and subspace."""
    what: Literal["arm", "environment", "total"] = "arm"
    """Of what: the arm (from force to displacement), the manipulator, or both (from perturbation to displacement)."""
    subject: str | None = None
    """Which subject, if the recordings hold several."""
    condition: str | None = None
    """Which condition, if they hold several."""
    window_start: float | None = None
    """Start of what is used [s]; by default 2 of multisine, 8 of spectral, and else 0."""
    period: float | None = None
    """Period of a multisine [s]; by default it is found."""


@dataclass(frozen=True, kw_only=True)
class Validate:
    """Judge the estimators on synthetic trials whose truth is known: bias, error over Cramer-Rao bound, coverage."""

    out: Path
    """Folder for tables/validation.csv, tables/validation_summary.csv, figures/validation.svg and settings.json."""
    task: Literal["PT", "RT"] = "PT"
    """Whose mean arm is perturbed, as in PT7.5 or RT7.5."""
    subject: Path | None = None
    """TOML file of the person who is perturbed instead."""
    model: Literal["1", "2", "3", "4", "5", "6", "3a", "3b"] = "3b"
    """Model structure that is fitted; what it fixes is fixed at the truth."""
    groups: int = 40
    """How often it all is repeated."""
    trials: int = 8
    """Number of trials that are identified together."""
    estimators: tuple[Literal["thesis", "frequency", "record"], ...] = ("thesis", "frequency", "record")
    """Which are judged."""
    noise: float = 1.0
    """Factor on the person's noise; 0 leaves that of the instruments."""
    force: float | None = None
    """RMS force per axis [N]; by default the published one of the task."""
    wrong: Literal["nothing", "delay", "force-feedback", "grip"] = "nothing"
    """What is wrong on purpose: the delay 10 ms too long, the person's force feedback left out, the grip too soft."""
    multibody: bool = False
    """Perturb MuJoCo's arm, which moves in a circle, and not the linear one, for which the structure is exact."""
    seed: int = 0
    """Of everything random."""
    workers: int | None = None
    """Number of processes; by default one per core. No effect on the files."""


@dataclass(frozen=True, kw_only=True)
class Design:
    """Plan an experiment: predicted standard errors, and the multisine that makes those of the goal least."""

    subject: Path
    """TOML file of who will be perturbed, as far as is known."""
    goal: str
    """Parameters that matter: reflex, intrinsic, grip, mass or all."""
    limits: str
    """RMS force per axis [N], RMS displacement per axis [m] and duration of a trial [s], e.g. 5.4,0.0075,32."""
    out: Path
    """Folder for tables/design.csv, tables/spectrum.csv, tables/signals.csv, figures/design.svg, perturbations/ (one
    CSV per trial, for simulate) and settings.json."""
    trials: int = 8
    """Number of trials that will be identified together."""
    model: Literal["1", "2", "3", "4", "5", "6", "3a", "3b"] | None = None
    """Model structure that will be fitted; what it fixes is known. By default 3b, or 1 for a person without
    reflexes."""
    peak: float | None = None
    """Largest force that there may ever be on an axis [N]; by default any."""
    spread: float = 0.2
    """Share of each axis's power that is spread evenly over the band, 0 to 1, so that structure and admittances can be
    judged from the same trials."""
    noise: Literal["held", "follows"] = "held"
    """Of the person: held at what it is under the thesis's multisine, also under less load; or following the load, as
    the noise of the synthetic people does."""
    perturbation: Path | None = None
    """CSV file (see simulate) of a perturbation of your own, whose standard errors are told beside; it need not keep
    the limits."""
    seed: int = 0
    """Of the phases."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Analyse the recordings of a study, whole or not, and write its report."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the study; its recordings stay as they are."""
    nonlinear: tuple[Literal["RT", "PT"], ...] = ()
    """Tasks in which everybody's muscle law is identified, and left-out pulses are predicted; takes minutes per person.
    What was found once is part of later reports too."""
    workers: int | None = None
    """Number of processes; by default about one per core. No effect on the files but for rounding."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """Compare a study with the published tables: shares of cells within 0.5, 1 and 2 SD, and the headline numbers."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the study, whole or not; its recordings stay as they are."""
    out: Path | None = None
    """Folder for score.csv, headlines.csv and score.txt; by default DIR/score."""
    workers: int | None = None
    """Number of processes; by default about one per core. No effect on the files but for rounding."""


@dataclass(frozen=True, kw_only=True)
class Video:
    """Replay a recorded trial as a video: the rig from above and from the side, forces as arrows, and a strip chart."""

    recording: Annotated[Path, tyro.conf.Positional]
    """Recording to read (netCDF4), also of a person, if it says how long the arm is."""
    out: Path
    """Video to write: MP4 (H.264), or GIF."""
    trial: int
    """Which trial of the recording, from 0."""
    view: str = "both"
    """top, oblique, or both side by side."""
    size: str = "640x480"
    """Width x height of each view [pixel], up to 1920x1440; the strip chart below adds half the height."""
    slow: float = 1.0
    """How many times slower than life, e.g. 10 for a pulse; below 1 it is faster."""
    start: float | None = None
    """Where in the trial to start [s]; by default at its start."""
    stop: float | None = None
    """Where in the trial to stop [s]; by default at its end, or where the handle met the limit of the workspace: from
    there on signals mean nothing, and are not shown. A pulse that is slowed down is shown from 0.2 s before its
    onset to 1 s after it, unless --start or --stop is given."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Open MuJoCo's interactive viewer, on a recorded trial or on a person whom the mouse can push; needs a display."""

    recording: Annotated[Path | None, tyro.conf.Positional] = None
    """Recording whose trial is replayed over and over; without one, a person at rest."""
    trial: int = 0
    """Which trial of the recording, from 0."""
    slow: float = 1.0
    """How many times slower than life."""
    subject: Path | None = None
    """TOML file of the person at rest, instead of the thesis's mean person of the relax task."""


@dataclass(frozen=True, kw_only=True)
class Calibrate:
    """Find the average person around whom cohorts are drawn, from the published tables 2.1, F.2, F.3 and F.4."""

    out: Path
    """TOML file to write; the package's own is armperturb/average_person.toml."""
    laws: tuple[Literal["linear", "short-range", "full"], ...] = ("full",)
    """Muscle laws to calibrate; the person that is written is that of the full law, the others are for comparison."""
    seed: int = 0
    """Of the multisines."""
    iterations: int = 20
    """At most as many steps of the search."""


def study(settings: Study) -> Path:
    """Run a study, or go on with one, and return the path of its report, or of the folder if there is none.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, or the folder was made with other settings.
      RuntimeError: another run is at work in the folder, or workers die again and again.
      OSError: a file cannot be read or written, or no Dask scheduler answers.
    """
    # Here, so that the other commands start without the drawing library.
    from armperturb.study.recording.record import StudySettings, record_study

    what = StudySettings(
        subjects=settings.subjects,
        seed=settings.seed,
        protocol=settings.protocol,
        ideal=settings.ideal,
        forces=settings.forces,
        muscles=settings.muscles,
    )
    if settings.record_only:
        record_study(what, settings.out, workers=settings.workers, dask=settings.dask, block=settings.block)
        return settings.out
    from armperturb.study.report.report import write_report
    from armperturb.study.results.study_result import run_study

    result = run_study(
        what,
        settings.out,
        workers=settings.workers,
        dask=settings.dask,
        block=settings.block,
        nonlinear=settings.nonlinear,
    )
    return write_report(result, settings.out, workers=settings.workers)


def report(settings: Report) -> Path:
    """Analyse a study folder as far as it goes, and return the path of the report.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, or a file is no recording of one person.
      RuntimeError: workers die again and again.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without the drawing library.
    from armperturb.study.report.report import write_report
    from armperturb.study.results.study_result import analyse_study

    result = analyse_study(settings.folder, workers=settings.workers, nonlinear=settings.nonlinear)
    return write_report(result, settings.folder, workers=settings.workers)


def simulate(settings: Simulate) -> xr.Dataset:
    """Simulate one trial, write its recording and return it.

    Raises:
      ValueError: subject or perturbation is refused, or the handle reached the workspace limit.
      OSError: a file cannot be read or written.
    """
    # Here, so that `identify` does without the simulator.
    from armperturb.envs.lab.experiment import run_experiment
    from armperturb.envs.lab.instruments import Instruments
    from armperturb.envs.lab.trial import Trial

    person, perturbation = Subject.load(settings.subject), load_perturbation(settings.perturbation)
    if not settings.out.parent.is_dir():
        raise FileNotFoundError(f"{settings.out}: folder {settings.out.parent} does not exist; expected one that does")
    environment = Environment()
    try:
        recording = run_experiment(
            [Trial(subject=person, perturbation=perturbation, seed=settings.seed)],
            environment,
            rate=settings.rate,
            rope=settings.rope,
            instruments=None if settings.ideal else Instruments(),
        )
    except (ValueError, RuntimeError) as error:
        raise type(error)(f"{settings.subject} with {settings.perturbation}: {error}") from None
    limit = float(recording["limit_time"].values[0])
    if np.isfinite(limit):
        raise ValueError(
            f"{settings.perturbation}: displacement reached the workspace limit at {limit:.3f} s; expected it to stay "
            f"within {environment.workspace:g} m of the start (a weaker perturbation or a stiffer subject)"
        )
    save_recording(recording, settings.out)
    return recording


def convert(settings: Convert) -> tuple[tuple[str, ...], list[Path]]:
    """Read recordings and write them in another format; return what is to be known, and the paths written.

    Raises:
      TypeError: a field of a sidecar has the wrong type.
      ValueError: a file is refused, or has a fault that is not to be repaired.
      RuntimeError: C3D is to be read without ezc3d.
      OSError: a file cannot be read or written.
    """
    require_ending(settings.out)  # before long recordings are read
    if not settings.out.parent.is_dir():
        raise FileNotFoundError(f"{settings.out}: folder {settings.out.parent} does not exist; expected one that does")
    found = import_recording(settings.files, sidecar=settings.sidecar, repair=settings.repair, rate=settings.rate)
    paths = export_recording(found.recording, settings.out)
    return found.notes, paths


def identify(settings: Identify) -> Identifications:
    """Identify the arm from recordings, write the results and return them by condition.

    Raises:
      TypeError: a field of a sidecar has the wrong type.
      ValueError: a recording is refused or cannot be identified.
      RuntimeError: C3D is to be read without ezc3d.
      OSError: a file cannot be read or written.
    """
    named = ", ".join(map(str, settings.recordings))
    for name in ("law", "pulses"):
        if getattr(settings, name) is not None:
            raise ValueError(
                f"identify: {name} = {getattr(settings, name)!r}; expected none but of the nonlinear model"
            )
    recording = _wanted_trials(settings)
    tasks = list(dict.fromkeys(recording["task"].values.tolist()))
    if len(tasks) > 1:
        raise ValueError(f"{named}: trials of the tasks {' and '.join(tasks)}; expected one (choose a --condition)")
    try:
        result = identify_conditions(
            recording,
            settings.model,
            estimator=settings.estimator,
            share=() if settings.share is None else tuple(settings.share.split(",")),
            window_start=settings.window_start,
            period=settings.period,
            lines_per_average=settings.lines_per_average,
        )
    except ValueError as error:
        raise ValueError(f"{named}: {error}") from None
    write_identification(result, settings.out)
    return result


def response(settings: Response) -> list[str]:
    """Estimate a frequency response, write it, and return what is to be said of it, a line each.

    Raises:
      TypeError: a field of a sidecar has the wrong type.
      ValueError: a recording is refused, or does not suit the method.
      RuntimeError: C3D is to be read without ezc3d.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without the drawing library.
    from armperturb.analysis.defaults import SETTLED
    from armperturb.analysis.response.best_linear import best_linear
    from armperturb.analysis.response.estimate import response as estimate
    from armperturb.analysis.trials import common_period, prepared_recordings
    from armperturb.commands.response import distortion_text, write_response

    periodic = settings.method in ("multisine", "spectral")
    if settings.period is not None and not periodic:
        raise ValueError(f"response: period = {settings.period:g}; expected none with the method {settings.method}")
    recordings = [import_recording([path]).recording for path in settings.recordings]
    named = ", ".join(map(str, settings.recordings))
    for name in ("subject", "condition"):
        wanted = getattr(settings, name)
        held = list(dict.fromkeys(label for one in recordings for label in one[name].values.tolist()))
        if wanted is None and len(held) > 1:
            raise ValueError(f"{named}: {name}s {', '.join(held)}; expected one (choose a --{name})")
        if wanted is not None and wanted not in held:
            raise ValueError(f"{named}: no {name} {wanted!r}; expected one of {', '.join(held)}")
        chosen = held[0] if wanted is None else wanted
        recordings = [one.isel(trial=np.flatnonzero(one[name].values == chosen)) for one in recordings]
        recordings = [one for one in recordings if one.sizes["trial"]]
    condition = str(recordings[0]["condition"].values[0])
    options: dict[str, Any] = {} if settings.window_start is None else {"window_start": settings.window_start}
    said, distortion = [], None
    try:
        trials = prepared_recordings(recordings)
        if settings.method == "multisine":
            start = SETTLED if settings.window_start is None else settings.window_start
            found_or_given = common_period(trials, start) if settings.period is None else settings.period
            options |= {"period": found_or_given}
            said.append(f"period: {options['period']:g} s")
        elif settings.period is not None:
            options |= {"period": settings.period}
        found = estimate(trials, settings.method, what=settings.what, **options)
    except ValueError as error:
        raise ValueError(f"{named}: {error}") from None
    if found.environment is not None:
        held_by = found.environment
        said.append(
            f"force balance of the manipulator used: {held_by.m_env:.4g} kg, {held_by.b_env:.3g} Ns/m, "
            f"{held_by.k_env:.4g} N/m"
        )
    if found.covariance is None:
        said.append(f"no uncertainty: {settings.method} needs more trials for one")
    if settings.method == "multisine" and settings.what == "arm":
        try:
            distortion = best_linear(trials, **options)
            said.append(distortion_text(distortion))
        except ValueError as error:
            said.append(f"nonlinear distortion: not told ({error})")
    write_response(found, distortion, settings.out, condition)
    return said


def _wanted_trials(settings: Identify) -> xr.Dataset:
    recording = import_recording(settings.recordings).recording
    for name in ("subject", "condition"):
        wanted = getattr(settings, name)
        if wanted is not None:
            found = recording[name].values
            if wanted not in found:
                named, held = ", ".join(map(str, settings.recordings)), ", ".join(dict.fromkeys(found.tolist()))
                raise ValueError(f"{named}: no {name} {wanted!r}; expected one of {held}")
            recording = recording.isel(trial=np.flatnonzero(found == wanted))
    return recording


def identify_nonlinear(settings: Identify) -> list[str]:
    """Fit a muscle law, write results and figure, and return what is to be said of it.

    Raises:
      TypeError: a field of a sidecar has the wrong type.
      ValueError: a setting is of linear models, or a recording is refused or cannot be identified.
      RuntimeError: C3D is to be read without ezc3d.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without compiler and drawing library.
    from armperturb.analysis.nonlinear.identify import identify_nonlinear as search
    from armperturb.analysis.nonlinear.identify import told, write_nonlinear
    from armperturb.plots.style import new_figure, save_svg

    for name in ("estimator", "share", "lines_per_average"):
        default = Identify.__dataclass_fields__[name].default
        if getattr(settings, name) != default:
            raise ValueError(
                f"identify: {name} = {getattr(settings, name)!r}; expected {default!r} with the nonlinear model"
            )
    try:
        directions = [float(value) for value in settings.pulses.split(",")] if settings.pulses else []
    except ValueError:
        raise ValueError(
            f"identify: pulses = {settings.pulses!r}; expected directions with commas between, e.g. 20,200"
        ) from None
    recording = _wanted_trials(settings)
    if settings.out.exists() and not settings.out.is_dir():
        raise ValueError(f"{settings.out} is a file; expected a folder, or a new name for one")
    is_new = not settings.out.exists()
    settings.out.mkdir(parents=True, exist_ok=True)  # now, as checkpoints go there
    try:
        found = search(
            recording,
            settings.law or "full",
            pulse_directions_deg=directions,
            window_start=settings.window_start,
            period=settings.period,
            folder=settings.out,
            progress=lambda line: print(line, file=sys.stderr, flush=True),
            threads=joblib.cpu_count(),
        )
    except ValueError as error:
        if is_new and not any(settings.out.iterdir()):
            settings.out.rmdir()
        raise ValueError(f"{', '.join(map(str, settings.recordings))}: {error}") from None
    if found.pulses["nonlinear"]:
        figure = new_figure(1.0)
        found.plot(figure)
        save_svg(figure, settings.out / "pulses.svg")
    write_nonlinear(found, settings.out)
    return told(found)


def validate(settings: Validate) -> str:
    """Judge the estimators, write tables and figure, and return a summary to print.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, subject and model do not go together, or the arm is unstable.
      RuntimeError: workers die again and again.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without the drawing library.
    from armperturb.study.validation.report import summary_text, write_validation
    from armperturb.study.validation.validate import ValidateSettings
    from armperturb.study.validation.validate import validate as judge

    what = {name: value for name, value in vars(settings).items() if name not in ("out", "workers")}
    result = judge(ValidateSettings(**what), workers=settings.workers)
    write_validation(result, settings.out)
    return summary_text(result)


def design(settings: Design) -> str:
    """Plan an experiment, write the results and return a summary to print.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, or no multisine tells about some of the model's parameters.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without the drawing library.
    from armperturb.study.planning.plan import DesignSettings
    from armperturb.study.planning.plan import design as plan
    from armperturb.study.planning.report import design_text, write_design

    try:
        force, displacement, duration = map(float, settings.limits.split(","))
    except ValueError:
        raise ValueError(
            f"design: limits = {settings.limits!r}; expected three numbers with commas between: RMS force [N], RMS "
            "displacement [m], duration [s]"
        ) from None
    apart = ("subject", "limits", "out", "perturbation")
    what = {name: value for name, value in vars(settings).items() if name not in apart}
    result = plan(
        DesignSettings(
            subject=Subject.load(settings.subject),
            limits=(force, displacement, duration),
            proposed=None if settings.perturbation is None else load_perturbation(settings.perturbation),
            **what,
        )
    )
    write_design(result, settings.out)
    return design_text(result)


def score(settings: Score) -> str:
    """Compare a study with the published tables, write the results and return them to print.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, or a file is no recording of one person.
      RuntimeError: workers die again and again.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without what a study needs.
    from armperturb.study.comparison.score import score as compare
    from armperturb.study.comparison.score import score_text, write_score
    from armperturb.study.results.study_result import analyse_study

    result = compare(analyse_study(settings.folder, workers=settings.workers))
    write_score(result, settings.out or settings.folder / "score")
    return score_text(result)


def video(settings: Video) -> None:
    """Write the video of a trial.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, or the recording is refused.
      RuntimeError: this machine cannot draw.
      OSError: a file cannot be read or written.
    """
    # Here, so that the other commands start without the drawing library.
    from armperturb.envs.render.replay import SIGNALS, Replay
    from armperturb.envs.render.video import Clip, require_ending, write_video

    require_ending(settings.out)
    width, times, height = settings.size.partition("x")
    if not (times and width.isdecimal() and height.isdecimal()):
        raise ValueError(f"video: size = {settings.size!r}; expected width x height in pixels, e.g. 640x480")
    clip = Clip(
        view=settings.view,
        width=int(width),
        height=int(height),
        slow=settings.slow,
        start=settings.start,
        stop=settings.stop,
    )
    recording = load_recording(settings.recording, optional=SIGNALS)
    replay = Replay.of_trial(recording, settings.trial, str(settings.recording))
    with tqdm(desc="video", unit="frame", disable=None) as bar:

        def tell(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        write_video(replay, settings.out, clip, progress=tell)


def view(settings: View) -> None:
    """Open the viewer, and return when its window is closed.

    Raises:
      ValueError: a setting is out of its range, or a file is refused.
      RuntimeError: no window can be opened.
      OSError: a file cannot be read.
    """
    # Here, so that the other commands start without what a window needs.
    from armperturb.envs.render.replay import SIGNALS, Replay
    from armperturb.envs.render.viewer import require_display, watch_rig, watch_trial

    require_display()  # before a long recording is read
    require_number("view", "slow", settings.slow, above=0.0)
    if settings.recording is None:
        watch_rig(RELAX if settings.subject is None else Subject.load(settings.subject))
        return
    if settings.subject is not None:
        raise ValueError(f"view: subject = {str(settings.subject)!r}; expected none beside a recording")
    recording = load_recording(settings.recording, optional=SIGNALS)
    watch_trial(Replay.of_trial(recording, settings.trial, str(settings.recording)), slow=settings.slow)


def calibrate(settings: Calibrate) -> str:
    """Calibrate, write the average person, and return a summary to print.

    Raises:
      TypeError: a setting has the wrong type.
      ValueError: a setting is out of its range, or the full law is left out.
      RuntimeError: a search ended with a person who leaves the workspace.
      OSError: the file cannot be written.
    """
    # Here, so that the other commands start without what a study needs.
    from armperturb.study.experiments.calibration import calibrate as search
    from armperturb.study.experiments.calibration import save_calibrations, summary

    if "full" not in settings.laws:
        raise ValueError(f"laws = {settings.laws!r}; expected 'full' among them, as its person is written")
    if not settings.out.parent.is_dir():
        raise FileNotFoundError(f"{settings.out}: folder {settings.out.parent} does not exist; expected one that does")
    found = []
    for law in dict.fromkeys(settings.laws):
        for task in TASKS:

            def tell(line: str, name: str = f"{law}, {task}") -> None:
                print(f"{name}: {line}", file=sys.stderr, flush=True)

            found.append(search(task, law, seed=settings.seed, max_iterations=settings.iterations, progress=tell))
    save_calibrations(settings.out, found)
    return "\n".join(
        f"{row['law']}, {row['task']}, {row['n']} cells {row['cells']}: {row['within_0.5_sd']:.0%} within 0.5, "
        f"{row['within_1_sd']:.0%} within 1, {row['within_2_sd']:.0%} within 2 SD; RMS {row['rms_deviation']:.2f} SD"
        for row in summary(found)
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run it.

    Args:
      arguments: as typed after `armperturb`; by default those of this process.

    Returns:
      The exit status: 0, 1 for an input that is refused (one line on stderr says why), 130 for Ctrl-C.
    """
    command = tyro.cli(
        Study
        | Report
        | Score
        | Simulate
        | Convert
        | Identify
        | Response
        | Validate
        | Design
        | Calibrate
        | Video
        | View,
        prog="armperturb",
        description="Human-arm perturbation experiments on synthetic people in MuJoCo, and their analysis.",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    try:
        if not isinstance(command, Convert | Identify | Response):
            require_simulator()
        if isinstance(command, Study):
            print(f"{'recordings' if command.record_only else 'report'}: {study(command)}")
        elif isinstance(command, Report):
            print(f"report: {report(command)}")
        elif isinstance(command, Simulate):
            simulate(command)
            print(f"recording: {command.out}")
        elif isinstance(command, Convert):
            notes, paths = convert(command)
            for note in notes:
                print(note)
            print(f"recording: {', '.join(map(str, paths))}")
        elif isinstance(command, Response):
            for line in response(command):
                print(line)
            print(f"results: {command.out}")
        elif isinstance(command, Score):
            print(score(command))
            print(f"results: {command.out or command.folder / 'score'}")
        elif isinstance(command, Validate):
            print(validate(command))
            print(f"results: {command.out}")
        elif isinstance(command, Design):
            print(design(command))
            print(f"results: {command.out}")
        elif isinstance(command, Video):
            video(command)
            print(f"video: {command.out}")
        elif isinstance(command, View):
            view(command)
        elif isinstance(command, Calibrate):
            print(calibrate(command))
            print(f"average person: {command.out}")
        elif command.model == "nonlinear":
            for line in identify_nonlinear(command):
                print(line)
            print(f"results: {command.out}")
        else:
            for condition, result in identify(command).items():
                fit, vaf = result.fit, result.vaf
                print(f"{condition}: {fit.message}; VAF x {vaf[0]:.1f} %, y {vaf[1]:.1f} %")
                for remark in fit.remarks:
                    print(f"{condition}: {remark}")
            print(f"results: {command.out}")
    except (ValueError, TypeError, OSError, RuntimeError, ArithmeticError, MemoryError) as error:
        message = " ".join(str(error).split())
        print(f"armperturb: error: {message}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        can = isinstance(command, Study | Report) or (isinstance(command, Identify) and command.model == "nonlinear")
        goes_on = "; the same command goes on from here" if can else ""
        print(f"armperturb: stopped{goes_on}", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
