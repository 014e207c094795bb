"""Recordings and studies that several tests read; whichever test process needs one first makes it for all."""

import fcntl
import gc
import os
import pickle
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from armperturb.cohort import average_person
from armperturb.controllers.remnant import HUMAN_NOISE
from armperturb.envs.lab.experiment import run_experiment
from armperturb.envs.lab.instruments import Instruments
from armperturb.envs.lab.trial import Trial
from armperturb.muscle_law import MuscleLaw
from armperturb.perturbations import Multisine, MultisineThenPulse
from armperturb.study.experiments.mechanisms import why_people_yield
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.report import write_report
from armperturb.study.results.analyse import run_study
from armperturb.study.results.settings import AnalysisSettings
from armperturb.subject import POSITION, RELAX

SLOW_FIXTURES = {
    **dict.fromkeys(("study", "thesis_study", "thesis_report", "ideal"), "simulates and analyses a small study"),
    "fitted_folder": "analyses a folder several times",
    "explained": "simulates a person with and without each mechanism of the muscle law",
    "forces": "simulates practice sessions",
    "linear": "simulates a candidate of the calibration",
    "moved": "simulates a moving shoulder",
}
"""Fixtures that take seconds, and why: tests that use them are marked as slow."""


def pytest_collection_modifyitems(items):
    slow_tests = Counter()
    for item in items:
        for fixture in SLOW_FIXTURES.keys() & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow(reason=SLOW_FIXTURES[fixture]))
        slow_tests[item.path] += item.get_closest_marker("slow") is not None
    items.sort(key=lambda item: -slow_tests[item.path])  # so that no process ends long after the others


def pytest_collection_finish():
    gc.freeze()  # what was imported for all tests need not be searched for garbage in each


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """A function `once(name, make)`: what `make(folder)` gives, made in one test process and read by the others.

    All get the same folder, of that name, and must leave what is in it as it is.
    """
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent  # a session's processes have a folder each, in one of their own

    def get(name, make):
        value = root / f"{name}.pickle"
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # a process that ends lets go of it
            if not value.exists():
                (root / name).mkdir(exist_ok=True)
                made = pickle.dumps(make(root / name))
                value.with_suffix(".part").write_bytes(made)
                value.with_suffix(".part").rename(value)
        return pickle.loads(value.read_bytes())

    return get


def perturbed(subject, rms, n_trials, noise=None):
    return [
        Trial(
            subject=subject,
            perturbation=MultisineThenPulse.join(
                Multisine.draw(seed=seed, rms=rms, crested=False), peak=30.0, direction_deg=20.0, tail=1.0
            ),
            condition=f"{subject.task}7.5",
            repetition=seed,
            pulse_level=1.0,
            seed=seed,
            noise=noise,
        )
        for seed in range(n_trials)
    ]


@pytest.fixture(scope="session")
def ideal_recording(once):
    """Four ideal trials of the relaxed preset and four of the one that keeps position, whose arm hardly turns."""
    return once("ideal", lambda _: run_experiment([*perturbed(RELAX, 0.3, 4), *perturbed(POSITION, 0.3, 4)]))


@pytest.fixture(scope="session")
def relax_recording(ideal_recording):
    """Four ideal trials of the relaxed preset."""
    return ideal_recording.isel(trial=slice(4))


@pytest.fixture(scope="session")
def position_recording(ideal_recording):
    """Four ideal trials of the preset that keeps position."""
    return ideal_recording.isel(trial=slice(4, None))


@pytest.fixture(scope="session")
def noisy_relax_recording(once):
    """Six noisy trials of the relaxed preset, in two conditions that differ in name alone."""
    recording = once(
        "noisy relax",
        lambda _: run_experiment(perturbed(RELAX, 0.9, 6, noise=HUMAN_NOISE["RT"]), instruments=Instruments(emg=None)),
    )
    labels = ["RT7.5"] * 3 + ["RT22.5"] * 3
    return recording.assign_coords(condition=("trial", labels), repetition=("trial", [0, 1, 2] * 2))


SHORT = """
forces = "published"
trial_duration = 29.0
multisine_duration = 28.6
onset_window = [1.0, 2.0]
pulse_directions_deg = [20.0]

[[conditions]]
name = "PT0"
task = "PT"
pulse_levels = [1]

[[conditions]]
name = "PT7.5"
task = "PT"
rms_displacement = 0.0075
published_force = 5.4
pulse_levels = [1, 2]

[[conditions]]
name = "PT2.5"
task = "PT"
rms_displacement = 0.0025
published_force = 1.2

[[conditions]]
name = "RT7.5"
task = "RT"
rms_displacement = 0.0075
published_force = 0.9
pulse_levels = [1]
repetitions = 2

[[conditions]]
name = "RT22.5"
task = "RT"
rms_displacement = 0.0225
published_force = 1.8
"""


@pytest.fixture(scope="session")
def short_protocol(tmp_path_factory):
    """A protocol file: two amplitudes of each task, pulses with, without and instead of a multisine, seven trials."""
    path = tmp_path_factory.mktemp("protocol") / "short.toml"
    path.write_text(SHORT)
    return path


FEW_FITS = AnalysisSettings(structures=("1",), starts_of=None)
"""One structure of appendix C, nothing of D and E."""


def coarse_study(settings, folder, analysis=FEW_FITS):
    """A study whose recordings take a second, and its analysis."""
    return run_study(replace(settings, engine="compiled"), folder, analysis=analysis, show_progress=False)


@pytest.fixture(scope="session")
def study(short_protocol, once):
    """Two noisy people with linear muscles who went through the short protocol."""
    settings = StudySettings(subjects=2, seed=3, protocol=short_protocol, muscles="linear")
    return once("study", lambda folder: coarse_study(settings, folder))


THESIS_LIKE = """
forces = "published"
trial_duration = 30.0
multisine_duration = 28.6
onset_window = [1.0, 1.2]
pulse_directions_deg = [20.0]
""" + "".join(
    f"""
[[conditions]]
name = "{name}"
task = "{name[:2]}"
pulse_levels = {levels}
"""
    + (f"rms_displacement = {1e-3 * float(name[2:])}\npublished_force = {force}\n" if force else "")
    for name, levels, force in (
        ("PT0", [1, 2], 0.0),
        ("PT2.5", [2], 1.2),
        ("PT7.5", [1, 2], 5.4),
        ("PT22.5", [2], 16.6),
        ("RT0", [1], 0.0),
        ("RT2.5", [1], 0.4),
        ("RT7.5", [1], 0.9),
        ("RT22.5", [1], 1.8),
    )
)


@pytest.fixture(scope="session")
def thesis_study(once):
    """Three noisy people with linear muscles in all conditions of the thesis, each pulse once, to one side."""

    def make(folder):
        (folder / "protocol.toml").write_text(THESIS_LIKE)
        settings = StudySettings(subjects=3, seed=3, protocol=folder / "protocol.toml", muscles="linear")
        return coarse_study(settings, folder, replace(FEW_FITS, starts_of="PT7.5"))

    return once("thesis study", make)


def plain_picture(model, qpos=None, camera="top", *, width, height):
    """Stands for a picture of the rig, which takes seconds and a GL library."""
    return np.full((*np.shape(qpos)[:-1], height, width, 3), 200, dtype=np.uint8)


@pytest.fixture(scope="session")
def thesis_report(thesis_study, once):
    """The folder of the report on that study; pictures of the rig are plain."""

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rig_figures, "render", plain_picture)
            write_report(thesis_study, folder, show_progress=False)
        return folder

    return once("thesis report", make)


def sketch(study, out, figures=(), workers=1):
    """The text of a report without figures but these, and without further simulations."""
    path = write_report(study, out, figures=figures, simulate=False, workers=workers, show_progress=False)
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def explained(once):
    """Somebody with short-range stiffness in RT alone, and one level of co-contraction; with and without it."""
    average = average_person()
    law = MuscleLaw(short_range_stiffness=10.0, elastic_limit_deg=0.7)
    subjects = {
        "PT": replace(average.subjects["PT"], muscle=None),
        "RT": replace(average.subjects["RT"], muscle=law),
    }

    person = replace(average, subjects=subjects, levels={})
    return once("explained", lambda _: why_people_yield(person, timestep=5e-3))
