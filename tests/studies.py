"""The recordings and studies of conftest.py, and what other studies in tests are made with."""

import itertools
from dataclasses import replace
from pathlib import Path

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
from armperturb.study.recording.folder import ANALYSIS
from armperturb.study.recording.settings import StudySettings
from armperturb.study.report import films
from armperturb.study.report.figures import rig as rig_figures
from armperturb.study.report.report import write_report
from armperturb.study.results.analyse import run_study
from armperturb.study.results.settings import AnalysisSettings
from armperturb.subject import POSITION, RELAX


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


def ideal():
    return run_experiment([*perturbed(RELAX, 0.3, 4), *perturbed(POSITION, 0.3, 4)])


def noisy_relax():
    trials = perturbed(RELAX, 0.9, 6, noise=HUMAN_NOISE["RT"])
    recording = run_experiment(trials, instruments=Instruments(emg=None))
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


FEW_FITS = AnalysisSettings(structures=("1",), starts_of=None)
"""One structure of appendix C, nothing of D and E."""


def coarse_study(settings, folder, analysis=FEW_FITS):
    """A study whose recordings take a second, and its analysis."""
    return run_study(
        replace(settings, engine="compiled", timestep=5e-3), folder, analysis=analysis, show_progress=False
    )


def short_study(protocol, folder):
    return coarse_study(StudySettings(subjects=2, seed=3, protocol=protocol, muscles="linear"), folder)


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


def thesis_study(folder):
    (folder / "protocol.toml").write_text(THESIS_LIKE)
    settings = StudySettings(subjects=3, seed=3, protocol=folder / "protocol.toml", muscles="linear")
    return coarse_study(settings, folder, replace(FEW_FITS, starts_of="PT7.5"))


def plain_picture(model, qpos=None, camera="top", *, width, height):
    """Stands for a picture of the rig, which takes seconds and a GL library."""
    return np.full((*np.shape(qpos)[:-1], height, width, 3), 200, dtype=np.uint8)


def plain_film(replay, out, clip):
    """Stands for a film of the rig, likewise."""
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    mediapy.write_video(out, np.full((2, 120, 160, 3), 200, dtype=np.uint8), fps=10, qp=30)


def plain_report(study, folder):
    """The folder of a report whose pictures and films of the rig are plain."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig_figures, "render", plain_picture)
        patch.setattr(films, "write_video", plain_film)
        write_report(study, folder, show_progress=False)
    return folder


PASSED_ON: dict[frozenset[Path], dict[str, bytes]] = {}
"""Folders of recordings to files of results about them, see `sketch`."""


def sketch(study, out, figures=(), workers=1):
    """The text of a report without figures but these, and without further simulations.

    Results that do not depend on figures are passed on from one report to the next about the same recordings.
    """
    folders = {path.parent for path in study.recordings.values()}
    passed_on = PASSED_ON.setdefault(frozenset(folders), {})
    (out / ANALYSIS).mkdir(parents=True, exist_ok=True)
    for name, content in passed_on.items():
        (out / ANALYSIS / name).write_bytes(content)
    path = write_report(study, out, figures=figures, simulate=False, workers=workers, show_progress=False)
    for kept in itertools.chain(*((out / ANALYSIS).glob(of_kind) for of_kind in ("*-emg.json.gz", "played-*"))):
        passed_on[kept.name] = kept.read_bytes()
    return path.read_text(encoding="utf-8")


def explained():
    average = average_person()
    law = MuscleLaw(short_range_stiffness=10.0, elastic_limit_deg=0.7)
    subjects = {
        "PT": replace(average.subjects["PT"], muscle=None),
        "RT": replace(average.subjects["RT"], muscle=law),
    }
    return why_people_yield(replace(average, subjects=subjects, levels={}), timestep=5e-3)
