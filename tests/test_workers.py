"""Units of work outlive the workers that do them."""

import logging
import mmap
import os
import platform
import signal
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path

import psutil
import pytest
from loky import ProcessPoolExecutor

from armperturb import workers
from armperturb.extras import MissingExtraError
from armperturb.workers import DaskCluster, LocalProcesses, completed, kept_workers, workers_for

ROOT = Path(__file__).parents[1]


def square(number):
    return number**2


def die_once(unit):
    """The first call for a marker ends its process as SIGKILL does; all others do their work."""
    number, marker = unit
    try:
        os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return number
    os.kill(os.getpid(), 9)


def die(_):
    os._exit(1)


def fail(number):
    raise ValueError(f"unit {number} is wrong")


def warn(number):
    warnings.warn(f"unit {number}\nis strange", RuntimeWarning, stacklevel=1)


def wait_long(_):
    time.sleep(60.0)


def leave_a_line(file):
    with file.open("a") as lines:
        lines.write("done\n")


@pytest.mark.slow(reason="processes of its own")
def test_what_is_done_ahead_is_done_once_and_may_fail(tmp_path):
    ahead = [partial(leave_a_line, tmp_path / "first"), partial(fail, 1), partial(leave_a_line, tmp_path / "second")]
    with kept_workers(ahead=ahead):
        for _ in range(2):
            with workers_for(2, None) as pool:
                assert sorted(completed(square, range(8), pool)) == [n**2 for n in range(8)]
        files, latest = [tmp_path / name for name in ("first", "second")], time.monotonic() + 60.0
        while not all(map(Path.exists, files)):  # one process may still load what the other has worked with
            assert time.monotonic() < latest
            time.sleep(0.01)
    assert [file.read_text() for file in files] == ["done\n", "done\n"]


@pytest.mark.slow(reason="starts processes")
def test_all_units_are_done_once_and_what_one_raises_comes_through():
    ticks = []
    with workers_for(2, None) as pool:
        for first in (0, 20):  # the processes stay for more
            found = list(completed(square, range(first, first + 20), pool, lambda: ticks.append(0)))
            assert sorted(found) == [n**2 for n in range(first, first + 20)]
        with pytest.raises(ValueError, match="unit 0 is wrong"):
            list(completed(fail, range(1), pool))
    assert ticks


def process_of(_):
    return os.getpid()


def has_loaded(module):
    return module in sys.modules


@pytest.mark.slow(reason="processes of its own")
def test_processes_start_and_load_before_there_is_work():
    with workers_for(2, None, ["armperturb.person_files"]) as pool:
        before = set(psutil.Process().children())
        pool.start()
        started = {process.pid for process in set(psutil.Process().children()) - before}
        pool.start()
        assert set(completed(process_of, range(4), pool)) <= started
        assert all(completed(has_loaded, ["armperturb.person_files"] * 4, pool))


@pytest.mark.slow(reason="starts processes three times")
def test_kept_workers_are_the_same_until_something_fails():
    def processes(count):
        with workers_for(count, None) as pool:
            return set(completed(process_of, range(8), pool))

    with kept_workers():
        first = processes(2)
        assert processes(2) & first
        with pytest.raises(ValueError, match="unit 3 is wrong"), workers_for(2, None) as pool:
            list(completed(fail, [3], pool))
        second = processes(2)
        assert not second & first
        assert not processes(3) & second
    assert not any(psutil.pid_exists(pid) for pid in first | second)


@pytest.mark.slow(reason="processes that are killed")
def test_units_of_a_killed_worker_are_done_again_and_none_doubled(tmp_path, caplog):
    units = [(n, str(tmp_path / str(n // 4))) for n in range(8)]
    with caplog.at_level(logging.WARNING), workers_for(2, None) as pool:
        found = list(completed(die_once, units, pool))
    assert sorted(found) == list(range(8))
    assert "a worker process died" in caplog.text


@pytest.mark.slow(reason="processes of its own")
def test_workers_that_always_die_end_it(monkeypatch):
    monkeypatch.setattr(workers, "MAX_DEATHS", 1)
    with pytest.raises(RuntimeError, match="worker processes died 2 times in succession"):
        list(completed(die, range(3), LocalProcesses(1)))


def helper():
    """The process that cleans up after a pool."""
    running = [each for each in psutil.Process().children() if each.status() != psutil.STATUS_ZOMBIE]
    (process,) = [each for each in running if "loky.backend.resource_tracker" in str(each.cmdline())]
    return process


@pytest.mark.slow(reason="processes of its own")
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="a process's files are in /proc on Linux alone")
def test_the_pools_helper_prints_nothing_about_killed_workers_nor_when_it_is_started_anew():
    error = os.readlink("/proc/self/fd/2")
    with workers_for(2, None) as pool:
        for _ in range(2):
            assert list(completed(square, [3], pool)) == [9]
            assert os.readlink(f"/proc/{helper().pid}/fd/2") == os.devnull
            helper().kill()
            pool.stop()
    assert os.readlink("/proc/self/fd/2") == error


def note_that_the_helper_died(_):
    warnings.warn("resource_tracker: process died unexpectedly, relaunching", stacklevel=1)


@pytest.mark.slow(reason="processes of its own")
def test_a_warning_of_a_worker_is_one_line_and_a_helper_that_was_killed_is_none(capfd):
    with workers_for(2, None) as pool:
        list(completed(note_that_the_helper_died, range(2), pool))
        list(completed(warn, [3], pool))
    assert capfd.readouterr().err == "armperturb: warning: unit 3 is strange\n"


@pytest.mark.slow(reason="starts processes")
def test_closing_stops_at_once():
    pool = LocalProcesses(2)
    results = completed(wait_long, range(4), pool, lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert time.monotonic() - start < 10.0  # the start of the processes included, on a busy machine


def ctrl_c_is_blocked(_):
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.slow(reason="a process of its own")
def test_ctrl_c_does_not_reach_the_processes():
    # In a process of its own: what the pool leaves running in this one would hide how the first one starts.
    code = (
        "from tests.test_workers import *\n"
        "pool = LocalProcesses(2)\n"
        "print(set(completed(ctrl_c_is_blocked, range(6), pool)), flush=True)\n"
        "pool.stop()\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout == "{True}\n"


@pytest.fixture
def ctrl_c_is_heard():
    """What a shell starts in the background ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_waits_until_the_processes_have_started(monkeypatch, ctrl_c_is_heard):
    def start(self):
        signal.raise_signal(signal.SIGINT)
        begin(self)
        started.append(len(self._processes))

    started, begin = [], ProcessPoolExecutor._adjust_process_count
    monkeypatch.setattr(ProcessPoolExecutor, "_adjust_process_count", start)
    pool = LocalProcesses(2)
    with pytest.raises(KeyboardInterrupt):
        pool.submit(square, 1)
    assert started == [2]
    processes = [psutil.Process(pid) for pid in pool._executor._processes]
    pool.stop()
    assert psutil.wait_procs(processes, timeout=10.0)[1] == []


def test_cores_are_shared_out(monkeypatch):
    monkeypatch.setattr(workers, "cpu_count", lambda: 8)
    pool = LocalProcesses(4)
    assert [pool.threads(number, 10) for number in range(10)] == [2] * 8 + [4] * 2
    assert [pool.threads(number, 2) for number in range(2)] == [4] * 2
    assert LocalProcesses(16).threads(0, 16) == 1


def test_one_worker_is_this_process():
    with workers_for(1, None) as pool:
        assert pool is None


def test_dask_is_told_to_be_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"--dask needs distributed, .* `pip install 'armperturb\[dask\]'`"):
        DaskCluster("tcp://127.0.0.1:1")


@pytest.mark.slow(reason="waits for an answer")
def test_a_wrong_dask_address_is_told(monkeypatch):
    monkeypatch.setattr(workers, "DASK_TIMEOUT", 0.5)
    with pytest.raises(OSError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "):
        DaskCluster("tcp://127.0.0.1:1")
    with pytest.raises(OSError, match="no Dask scheduler answers at nonsense://x"):
        DaskCluster("nonsense://x")


@pytest.mark.slow(reason="starts a Dask cluster")
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep what they like")
def test_workers_of_a_dask_cluster_keep_the_memory_of_arrays():
    from distributed import LocalCluster

    def pages_fetched(count):
        import resource

        import numpy as np

        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(count):
            np.ones(2**18)
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    options = {"dashboard_address": ":0", "silence_logs": logging.CRITICAL}
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, **options) as cluster,
        workers_for(2, cluster.scheduler_address) as pool,
    ):
        pool.submit(pages_fetched, 1).result()
        fetched = pool.submit(pages_fetched, 100).result()
    assert fetched < 10 * 2**21 / mmap.PAGESIZE  # of ten arrays out of a hundred


def test_too_little_memory_for_workers_is_refused_before_they_start(monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda what: (600_000 * 1024, resource.RLIM_INFINITY))
    with pytest.raises(MemoryError, match="expected at least 1000000000 for worker processes"), workers_for(2, None):
        pass
    with workers_for(1, None) as pool:
        assert pool is None
