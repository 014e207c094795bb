"""Whatever is shared out over processes is the same as without them, though some are killed."""

# In one file, as processes take longer to start than to do any of it.

import logging
import resource
import shutil

import psutil
import pytest

from armperturb.cli import main
from armperturb.study.experiments.cohort_cells import measure_cohort
from armperturb.study.recording import record as runner
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings
from armperturb.study.results.analyse import analyse_study
from armperturb.study.validation.validate import ValidateSettings, validate
from armperturb.workers import kept_workers
from tests.differences import differences
from tests.recorded import arguments, assert_same_content, cells_of_cohort, cohort, files, killing
from tests.studies import FEW_FITS, sketch

pytestmark = pytest.mark.slow(reason="records, analyses and draws in several processes")


@pytest.fixture(scope="module", autouse=True)
def kept_processes():
    """Worker processes are passed on from one test to the next, until something fails in one."""
    with kept_workers(runner.__name__):
        yield


def local_workers():
    children = psutil.Process().children()
    return [child for child in children if any("LokyProcess" in word for word in child.cmdline())]


def test_workers_change_no_file_though_one_is_killed(settings, undisturbed, tmp_path, caplog):
    thread, on_the_way = killing(tmp_path, lambda: local_workers()[0])
    with caplog.at_level(logging.WARNING):
        record_study(settings, tmp_path, workers=2, show_progress=False)
    thread.join()
    assert on_the_way == [True]
    assert "a worker process died" in caplog.text
    assert_same_content(tmp_path, undisturbed)


def test_processes_give_the_same_cells(once, tmp_path):
    alone = once("cohort", cells_of_cohort)
    assert measure_cohort(cohort(tmp_path), workers=2, show_progress=False).equals(alone)


def test_processes_give_the_same_validation():
    validation = ValidateSettings(task="RT", model="1", groups=2, trials=1, estimators=("frequency", "record"))
    one, two = (validate(validation, workers=count, show_progress=False) for count in (1, 2))
    assert one.to_frame().equals(two.to_frame())
    assert one.names == two.names == validation.structure().free


LONG_ENOUGH = """
forces = "published"
trial_duration = 28.7
multisine_duration = 28.5
pulse_directions_deg = [20.0]

[[conditions]]
name = "RT22.5"
task = "RT"
rms_displacement = 0.0225
published_force = 1.8
"""


def test_worker_processes_change_nothing_but_roundings(tmp_path):
    (tmp_path / "p.toml").write_text(LONG_ENOUGH)
    # A step at which this takes seconds; nothing here depends on it.
    settings = StudySettings(subjects=2, protocol=tmp_path / "p.toml", muscles="linear", timestep=5e-3)
    record_study(settings, tmp_path / "s", show_progress=False)
    here = analyse_study(tmp_path / "s", workers=1, settings=FEW_FITS, show_progress=False)
    shutil.rmtree(tmp_path / "s" / "analysis")  # else it would only be read again
    there = analyse_study(tmp_path / "s", workers=2, settings=FEW_FITS, show_progress=False)
    assert [case.name for case in there.of("RT22.5")] == ["S01", "S02"]
    assert len(here.people[0].trials) == 1  # appendix C, which takes long, starts from RT7.5, which is not there
    # With another number of threads, BLAS adds in another order.
    assert differences(here, there, rel=1e-10) == []


def test_workers_draw_the_same_bytes(study, tmp_path):
    figures = ("fit_PT", "trajectories_PT")
    pages = [sketch(study, tmp_path / str(workers), figures, workers) for workers in (1, 2)]
    assert pages[0] == pages[1]
    for name in figures:
        one, two = (tmp_path / folder / "figures" / f"{name}.svg" for folder in "12")
        assert one.read_bytes() == two.read_bytes()


def test_a_full_disk_is_one_line_and_spares_earlier_files(protocol, settings, undisturbed, copied, capfd):
    for name in ("S02.nc", "S04.nc"):
        (copied / "recordings" / name).unlink()
    before = files(copied)
    # A limit on the size of files stands for a full disk: the same call fails in the same place.
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit = (len(undisturbed["S02.nc"]) // 2, unlimited[1])
    try:
        for process in (psutil.Process(), *local_workers()):
            process.rlimit(psutil.RLIMIT_FSIZE, limit)
        status = main(arguments(copied, protocol, "--workers", "2"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert status == 1
    [line] = capfd.readouterr().err.splitlines()
    assert "cannot be written (File too large); what was finished before is kept" in line
    assert files(copied) == before
    record_study(settings, copied, show_progress=False)
    assert_same_content(copied, undisturbed)
