"""A study gives the same files however it is run, stopped, killed and started again."""

import hashlib
import io
import logging
import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace
from multiprocessing import forkserver

import numpy as np
import psutil
import pytest

from armperturb.cli import main
from armperturb.recording_files import load_recording
from armperturb.study.recording import record as runner
from armperturb.study.recording.record import record_study
from armperturb.study.recording.settings import StudySettings
from armperturb.study.results.analyse import run_study
from tests.recorded import (
    N_SUBJECTS,
    N_TRIALS,
    PATIENCE,
    PROTOCOL,
    arguments,
    assert_checksums_fit,
    assert_same_content,
    count,
    files,
    killing,
    wait_for,
)

pytestmark = pytest.mark.slow(reason="records studies, in processes that are killed and interrupted")


@pytest.fixture(scope="module")
def forked():
    """What starts processes that need not load the package, as one that never worked has loaded it for them."""
    context = multiprocessing.get_context("forkserver")
    ours = [runner.__name__, run_study.__module__, "armperturb.commands.study"]
    context.set_forkserver_preload([*ours, "dask.array", "distributed", "h5netcdf", "pytest"])
    forkserver.ensure_running()
    return context


def test_files_hold_every_trial_in_order(undisturbed, tmp_path):
    assert len(undisturbed) == N_SUBJECTS + 1
    (tmp_path / "S02.nc").write_bytes(undisturbed["S02.nc"])
    recording = load_recording(tmp_path / "S02.nc")
    assert recording.sizes["trial"] == N_TRIALS
    assert set(recording["subject"].values) == {"S02"}
    assert sorted(recording["condition"].values) == ["PT2.5", "PT2.5", "RT0", "RT0"]
    assert recording["order"].values.tolist() == list(range(N_TRIALS))


def test_blocks_change_no_file(settings, undisturbed, tmp_path):
    record_study(replace(settings, subjects=2), tmp_path, show_progress=False, block=1)
    assert_same_content(tmp_path, {name: undisturbed[name] for name in ("S01.nc", "S02.nc", "SHA256SUMS")})


def test_blocks_change_no_file_of_people_whose_muscles_yield(settings, tmp_path):
    two = replace(settings, subjects=2, muscles="nonlinear")
    for block in (96, 3):
        record_study(two, tmp_path / str(block), block=block, show_progress=False)
    assert_same_content(tmp_path / "96", files(tmp_path / "3"))


def test_a_dask_cluster_gives_the_same_files_though_a_worker_is_killed(settings, undisturbed, forked, tmp_path):
    import dask
    from distributed import Client, LocalCluster

    with (
        dask.config.set({"distributed.worker.multiprocessing-method": forked.get_start_method()}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=logging.CRITICAL
        ) as cluster,
    ):
        with Client(cluster, set_as_default=False) as client:
            pids = list(client.run(os.getpid).values())
        thread, on_the_way = killing(tmp_path, lambda: psutil.Process(pids[0]))
        record_study(settings, tmp_path, dask=cluster.scheduler_address, show_progress=False)
        thread.join()
    assert on_the_way == [True]
    assert_same_content(tmp_path, undisturbed)


def study(out, arguments):
    """What the command does, in a process group that Ctrl-C reaches as in a terminal."""
    os.setsid()
    # Where the tests run in the background, Ctrl-C may be ignored; a study would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream, name in ((1, os.devnull), (2, errors_of(out))):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    sys.exit(main(arguments))


def errors_of(out):
    return out.with_name(f"{out.name}-errors")


def started(forked, out, protocol, *options):
    """A study in processes of its own, and its workers once a file is there."""
    before = count(out)
    run = forked.Process(target=study, args=(out, arguments(out, protocol, "--block", "4", *options)))
    run.start()
    wait_for(lambda: count(out) > before or not run.is_alive())
    return run, psutil.Process(run.pid).children(recursive=True)


def assert_ended(processes):
    _, alive = psutil.wait_procs(processes, timeout=10.0)
    assert not [process for process in alive if process.status() != "zombie"]


def interrupted(run, workers, out):
    """Seconds that a study takes to stop at a Ctrl-C."""
    start = time.monotonic()
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does: to all processes
    run.join(timeout=PATIENCE)
    took = time.monotonic() - start
    errors = errors_of(out).read_text()
    assert run.exitcode == 130, errors
    assert errors == "armperturb: interrupted; the same command continues from here\n"
    assert_ended(workers)
    return took


def stopped_soon(forked, tmp_path, protocol, *options, meanwhile=lambda *_: None):
    """The folder of a study that was interrupted and stopped soon."""
    for attempt in range(3):
        out = tmp_path / str(attempt)
        run, workers = started(forked, out, protocol, *options)
        meanwhile(run, out)
        took = interrupted(run, workers, out)
        if took < 2.0:  # where other tests hold the processors, it waits for them, too
            break
    assert took < 2.0
    kept = files(out)
    assert len(kept) > 1
    assert all(
        hashlib.sha256(kept[name]).hexdigest() in kept["SHA256SUMS"].decode() for name in kept if name.endswith(".nc")
    )
    return out


def test_ctrl_c_stops_soon_and_keeps_what_is_finished_and_a_second_run_is_refused_before(
    forked, protocol, settings, undisturbed, tmp_path, capsys
):
    def second_run(run, out):
        os.kill(run.pid, signal.SIGSTOP)  # lest it ends meanwhile
        status = main(arguments(out, protocol))
        os.kill(run.pid, signal.SIGCONT)
        assert status == 1
        assert capsys.readouterr().err.startswith(
            f"armperturb: error: {out}: another run is at work in this folder (process {run.pid}"
        )

    out = stopped_soon(forked, tmp_path, protocol, "--workers", "1", meanwhile=second_run)
    record_study(settings, out, show_progress=False)
    assert_same_content(out, undisturbed)


def test_interrupted_and_killed_with_its_workers_and_started_again_it_ends_the_same(
    forked, protocol, undisturbed, tmp_path, capfd
):
    out = stopped_soon(forked, tmp_path, protocol, "--workers", "2")
    # At any other time: ten times in `benchmarks.study_kills`. What a killed run's helpers say is not the next one's.
    run, workers = started(forked, out, protocol, "--workers", "2")
    time.sleep(np.random.default_rng(2).uniform(0.0, 0.2))
    run.kill()
    run.join()
    assert_ended(workers)
    capfd.readouterr()
    assert main(arguments(out, protocol, "--workers", "1")) == 0
    assert capfd.readouterr().err == ""
    assert_same_content(out, undisturbed)
    assert sorted(path.name for path in out.iterdir()) == [".lock", "manifest.json", "recordings"]


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b[:5000] + b"?" + b[5001:]])
def test_a_damaged_file_is_named_set_aside_and_redone(settings, undisturbed, copied, caplog, damage):
    path = copied / "recordings" / "S03.nc"
    path.write_bytes(damage(undisturbed["S03.nc"]))
    with caplog.at_level(logging.WARNING):
        record_study(settings, copied, show_progress=False)
    assert f"{path}.corrupt does not match its checksum" in caplog.text
    aside = copied / "recordings" / "S03.nc.corrupt"
    assert aside.read_bytes() == damage(undisturbed["S03.nc"])
    aside.unlink()
    assert_same_content(copied, undisturbed)


def test_finished_subjects_are_not_done_again(settings, copied, monkeypatch):
    monkeypatch.setattr(runner, "run_experiment", None)
    found = record_study(settings, copied, workers=2, show_progress=False)
    assert found == [copied / "recordings" / f"S0{number}.nc" for number in range(1, N_SUBJECTS + 1)]


def test_other_settings_are_refused(settings, copied):
    with pytest.raises(ValueError, match=r"ideal is false there and true now; protocol.forces is \"published\" there"):
        record_study(replace(settings, ideal=True, forces="practice"), copied)


def test_another_protocol_in_the_same_file_is_refused(settings, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(PROTOCOL)
    mine = replace(settings, subjects=1, protocol=path)
    record_study(mine, tmp_path / "s", show_progress=False)
    path.write_text(PROTOCOL.replace("onset_window = [0.3, 0.8]", "onset_window = [0.3, 0.9]"))
    with pytest.raises(ValueError, match=r"protocol.onset_window\[1\] is 0.8 there and 0.9 now"):
        record_study(mine, tmp_path / "s", show_progress=False)


def test_other_muscles_are_other_files_and_refused(settings, undisturbed, tmp_path):
    nonlinear = replace(settings, subjects=1, muscles="nonlinear")
    (path,) = record_study(nonlinear, tmp_path / "s", show_progress=False)
    (tmp_path / "linear.nc").write_bytes(undisturbed["S01.nc"])
    mine, other = (load_recording(file) for file in (path, tmp_path / "linear.nc"))
    assert mine["perturbation"].equals(other["perturbation"])
    assert not np.allclose(mine["displacement"], other["displacement"], rtol=0.1)
    with pytest.raises(ValueError, match=r'muscles is "nonlinear" there and "linear" now'):
        record_study(replace(nonlinear, muscles="linear"), tmp_path / "s", show_progress=False)


def test_progress_shows_trials_speed_and_time_left(settings, tmp_path, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(runner, "PROGRESS_INTERVAL", 0.0)
    record_study(replace(settings, subjects=2), tmp_path, block=4)
    shown = terminal.getvalue()
    assert f"{2 * N_TRIALS}/{2 * N_TRIALS} trials, " in shown
    assert " x real time" in shown
    assert "00:0" in shown
    assert " left" in shown
    assert len(shown.split("\r")) > 10


def test_by_default_the_last_round_is_full_if_it_can_be(monkeypatch):
    monkeypatch.setattr(runner, "cpu_count", lambda: 4)
    assert [runner.worker_count(None, n) for n in (1, 3, 4, 9, 10, 12, 1000)] == [1, 3, 4, 4, 5, 4, 4]
    assert runner.worker_count(8, 3) == 3


def test_bad_numbers_are_refused(settings, tmp_path):
    for options, message in (
        ({"workers": 0}, "workers = 0; expected a finite number at least 1 and at most 1000"),
        ({"block": 0}, "block = 0; expected a finite number at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            record_study(settings, tmp_path / "s", **options)
    with pytest.raises(ValueError, match="forces = 'none'; expected one of practice, published"):
        StudySettings(forces="none")
    with pytest.raises(ValueError, match="study: muscles = 'soft'; expected one of nonlinear, linear"):
        StudySettings(muscles="soft")
    assert not (tmp_path / "s").exists()


def test_a_protocol_with_a_strap_records_shoulders_that_move(settings, tmp_path):
    longer = PROTOCOL.replace("trial_duration = 1.0", "trial_duration = 2.0").replace("0.9", "1.5")
    path, farthest = tmp_path / "p.toml", {}
    for name, table in (("fixed", ""), ("strapped", "[strap]\nstiffness = 4000.0\n")):
        path.write_text(f"{longer}\n{table}")
        one = replace(settings, subjects=1, protocol=path, muscles="nonlinear")
        (file,) = record_study(one, tmp_path / name, show_progress=False)
        farthest[name] = np.abs(load_recording(file)["shoulder_marker"].values).max(axis=(1, 2))
    assert farthest["fixed"].max() < 5e-3
    assert farthest["strapped"].max() > 6e-3
    with pytest.raises(ValueError, match=r"protocol\.strap"):
        record_study(one, tmp_path / "fixed", show_progress=False)


def test_a_short_multisine_is_left_out_with_its_reason(settings, copied):
    result = run_study(settings, copied, show_progress=False)
    assert [case.condition.name for case in result.cases] == ["PT2.5"] * N_SUBJECTS
    assert result.of("PT2.5") == []
    assert "S01 in PT2.5 was not identified: the multisine lasts 0.9 s" in result.cases[0].left_out[0]


def test_digest_file_is_that_of_the_files(undisturbed):
    assert_checksums_fit(undisturbed)
