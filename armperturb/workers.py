"""Worker processes: on this machine, or of a Dask cluster.

Work is divided into units, each of which a pure function computes. A unit whose worker has died is therefore computed
again, and the assignment of units to workers has no effect on any file.
"""

import gc
import importlib
import logging
import os
import signal
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import NamedTuple, TypeVar

from loky import ProcessPoolExecutor
from loky import cpu_count as cpu_count
from loky.backend import resource_tracker as pool_tracker

from armperturb.extras import naming_the_extra
from armperturb.memory import keep_memory
from armperturb.validation import require_number

Unit = TypeVar("Unit")
Result = TypeVar("Result")

LOG = logging.getLogger(__name__)

ENDINGS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask this process to end."""

MOST_WORKERS = 1000
"""Processes on one machine; each takes some 200 MB."""

HELPER_DIED = "resource_tracker: process died"
"""How the warning begins that a pool's helper was killed: it is started anew, which concerns nobody."""

LEAST_ADDRESSES = 10**9
"""Address space with which a worker starts [byte]."""

MAX_DEATHS = 3
"""How often in succession workers may die before a unit is finished: beyond that, the unit itself is at fault."""

KEPT_MEMORY = {"LOKY_MAX_MEMORY_LEAK_SIZE": str(2**30)}
"""How much a process may keep after a unit [byte]; one that keeps more is started anew. With loky's own 300 MB it would
be after the first units, which load libraries and fill caches, and loading all that again takes seconds."""

DASK_TIMEOUT = 10.0
"""How long a Dask scheduler may take to answer [s]."""

TICK = 0.2
"""Time between two looks at the progress [s]."""


class LocalProcesses:
    """Fresh Python processes on this machine, through loky; they end with this one, however it ends.

    Args:
      count: of processes.
      modules: that they load before they work.
      ahead: functions that are called first, each in one of the processes, for what they leave on disk; should one
        fail, whoever needs that hears of it.
    """

    remote = False
    """Whether they may lack this machine's file system."""

    def __init__(self, count: int, modules: Sequence[str] = (), ahead: Sequence[Callable[[], object]] = ()) -> None:
        self.count = count
        self._modules, self._ahead = tuple(modules), tuple(ahead)
        self._executor: ProcessPoolExecutor | None = None

    def start(self) -> None:
        """Start the processes, if there are none: they load what they need while this one does something else."""
        with signals_held_back():
            executor = self._pool()
            # A task that does nothing would start them as well, but what a process takes up after its first task
            # counts as a leak, for which it is started anew.
            if hasattr(executor, "_ensure_executor_running"):  # loky's own method
                executor._ensure_executor_running()

    def submit(self, function: Callable[[Unit], Result], unit: Unit) -> "Future[Result]":
        """Submit a unit, to processes that are started if there are none."""
        with signals_held_back():
            return self._pool().submit(function, unit)

    def _pool(self) -> ProcessPoolExecutor:
        """What runs the processes; signals are to be held back."""
        if self._executor is None:
            # Libraries with a pool of their own (BLAS) must not take every core in every process.
            names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
            threads = str(self.threads(0, self.count))
            # A process that keeps much memory is restarted, which concerns nobody.
            warnings.filterwarnings("ignore", "A worker was restarted", UserWarning)
            warnings.filterwarnings("ignore", HELPER_DIED, UserWarning)
            pool_tracker.ensure_running()
            self._executor = ProcessPoolExecutor(
                self.count,
                initializer=_begin,
                initargs=(os.getpid(), self._modules),
                env={**dict.fromkeys(names, threads), **KEPT_MEMORY},
            )
            for first in self._ahead:
                self._executor.submit(first)
            self._ahead = ()
        return self._executor

    def at_once(self) -> int:
        """Two for each process, so that none waits for work."""
        return 2 * self.count

    def threads(self, number: int, n_units: int) -> int:
        """The cores divided among the processes; in the last round among those that still have a unit."""
        last_round = n_units % self.count
        together = last_round if number >= n_units - last_round else self.count
        return max(1, cpu_count() // together)

    def stop(self) -> None:
        """Kill the processes."""
        with signals_held_back():
            executor, self._executor = self._executor, None
            if executor is not None:
                executor.shutdown(wait=True, kill_workers=True)
                for thread in threading.enumerate():
                    # Cut off by the end of this process, it would leave a lock that the pool's helper complains about.
                    if thread.name == "QueueFeederThread":
                        thread.join(timeout=0.5)

    close = stop


class DaskCluster:
    """The workers of a Dask cluster; the extra `dask` brings the library.

    Args:
      address: of the scheduler, e.g. "tcp://127.0.0.1:8786".

    Raises:
      MissingExtraError: the library is not installed.
      OSError: no scheduler answers at the address.
    """

    remote = True

    def __init__(self, address: str) -> None:
        with naming_the_extra("--dask"):
            from distributed import Client
        try:
            self._client = Client(address, timeout=DASK_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise OSError(f"no Dask scheduler answers at {address} ({error}); expected host:port of one") from None
        self._executor: Executor | None = None

    def submit(self, function: Callable[[Unit], Result], unit: Unit) -> "Future[Result]":
        """Submit a unit."""
        if self._executor is None:
            if not self._client.ncores():
                LOG.warning("the Dask cluster has no workers yet: waiting for some")
            self._executor = self._client.get_executor(pure=False)
        return self._executor.submit(_on_its_own, function, unit)

    def at_once(self) -> int:
        """Two for each thread that the cluster has now: it may grow or shrink on the way."""
        return 2 * max(1, sum(self._client.ncores().values()))

    def threads(self, number: int, n_units: int) -> int:
        """One: Dask itself runs a unit on every thread of a worker."""
        return 1

    def stop(self) -> None:
        """Give up what still runs there."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=False)

    def close(self) -> None:
        """Give up what still runs there, and end the connection."""
        self.stop()
        self._client.close(timeout=1)


Workers = LocalProcesses | DaskCluster
"""Processes that compute units of work."""


def require_workers(owner: str, count: int | None) -> None:
    """Refuse a number of processes that this machine cannot have; None, which stands for about one per core, is good.

    It is asked before any work, which may need fewer.

    Args:
      owner: what they work for, for the message.
      count: of local processes.

    Raises:
      TypeError: it is not a whole number.
      ValueError: it is below 1 or above `MOST_WORKERS`.
    """
    require_number(owner, "workers", count, at_least=1, at_most=MOST_WORKERS, whole=True, optional=True)


class _Kept(NamedTuple):
    """Processes that are kept, none or one kind, and what they do first."""

    processes: list[LocalProcesses]
    modules: tuple[str, ...]
    ahead: tuple[Callable[[], object], ...]


_KEPT: ContextVar[_Kept | None] = ContextVar("kept workers", default=None)


@contextmanager
def kept_workers(*modules: str, ahead: Sequence[Callable[[], object]] = ()) -> Iterator[None]:
    """Within it, who asks for as many local processes as who asked before gets the same.

    Args:
      modules: what any of their work needs. They load it first: what a process takes up later counts as a leak, for
        which it is started anew.
      ahead: see `LocalProcesses`.
    """
    kept_ones = _Kept([], modules, tuple(ahead))
    token = _KEPT.set(kept_ones)
    try:
        yield
    finally:
        _KEPT.reset(token)
        for workers in kept_ones.processes:
            workers.close()


def _local_processes(count: int, modules: Sequence[str]) -> LocalProcesses:
    kept_ones = _KEPT.get()
    if kept_ones is None:
        return LocalProcesses(count, modules)
    processes = kept_ones.processes
    if [workers.count for workers in processes] != [count]:
        for workers in processes:
            workers.close()
        processes[:] = [LocalProcesses(count, kept_ones.modules, kept_ones.ahead)]
    return processes[0]


def _is_kept(workers: Workers) -> bool:
    kept_ones = _KEPT.get()
    return kept_ones is not None and workers in kept_ones.processes


@contextmanager
def workers_for(count: int, dask: str | None, modules: Sequence[str] = ()) -> Iterator[Workers | None]:
    """The workers to compute with; None stands for this process itself.

    Args:
      count: of local processes.
      dask: address of a Dask scheduler, which takes the place of local processes.
      modules: what local processes load when they start, unless they are kept ones (`kept_workers`).

    Raises:
      MemoryError: a process may take too little memory to become one.
      MissingExtraError: Dask is not installed.
      OSError: no scheduler answers.
    """
    if count != 1 and dask is None:
        _require_addresses()
    workers = DaskCluster(dask) if dask is not None else _local_processes(count, modules) if count != 1 else None
    is_done = False
    try:
        yield workers
        is_done = True
    finally:
        # What is left undone must not go on behind the back of those who clean up.
        if workers is not None and not (is_done and _is_kept(workers)):
            workers.close()


def _require_addresses() -> None:
    """Refuse a limit within which worker processes die while they start."""
    if find_spec("resource") is None:
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESSES:
        raise MemoryError(
            f"workers: memory of a process is limited to {limit} bytes (ulimit -v); expected at least "
            f"{LEAST_ADDRESSES} for worker processes (--workers 1 starts none)"
        )


def completed(
    function: Callable[[Unit], Result],
    units: Sequence[Unit],
    workers: Workers,
    tick: Callable[[], object] = lambda: None,
) -> Generator[Result]:
    """Compute units of work and yield the results as they are finished, in any order.

    Args:
      function: computes a unit; must give the same result whenever and wherever it is called.
      units: arguments of the function.
      workers: processes that compute.
      tick: called several times a second while waiting.

    Raises:
      RuntimeError: workers died repeatedly.
      Exception: what the function raised; units that still run are given up.
    """
    waiting = deque(units)
    deaths = 0
    while waiting:
        running: dict[Future, Unit] = {}
        ended_well = False
        try:
            while waiting or running:
                at_once = workers.at_once()
                while waiting and len(running) < at_once:
                    future = workers.submit(function, waiting[0])
                    running[future] = waiting.popleft()
                done, _ = wait(running, timeout=TICK, return_when=FIRST_COMPLETED)
                tick()
                for future in done:
                    result = future.result()
                    del running[future]
                    deaths = 0
                    yield result
            ended_well = True
        except BrokenProcessPool as error:
            deaths += 1
            if deaths > MAX_DEATHS:
                raise RuntimeError(
                    f"worker processes died {deaths} times in succession ({error}); expected enough memory for them (a "
                    "smaller --block or fewer --workers)"
                ) from None
            waiting.extendleft(reversed(running.values()))
            why = " ".join(str(error).split())
            LOG.warning("a worker process died; %d unfinished units are computed again (%s)", len(running), why)
        except CancelledError:
            raise RuntimeError("the workers gave up a unit; expected the cluster to stay until the end") from None
        finally:
            if not ended_well:
                workers.stop()


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Delay Ctrl-C and requests to end until the end of the block, and keep them from processes that start in it.

    A terminal sends them to all processes, but this one stops the others; and a pool that is interrupted while its
    processes start loses track of them.
    """
    received: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    # Processes inherit the blocked signals; here, another thread (BLAS) may still receive them.
    before = {each: signal.signal(each, lambda number, _: received.append(number)) for each in ENDINGS if in_main}
    can_block = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS) if can_block else ()
    # Otherwise the pool would start this helper itself, and unblock signals, as it does here.
    resource_tracker.ensure_running()
    if can_block:
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDINGS)
    try:
        yield
    finally:
        if can_block:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for each, handler in before.items():
            signal.signal(each, handler)
        if received:
            signal.raise_signal(received[0])


@contextmanager
def _silent_helpers() -> Iterator[None]:
    """Processes that start in it print nothing: a pool's helper prints tracebacks about a worker that was killed."""
    try:
        error_stream = os.dup(2)
    except OSError:
        yield
        return
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(error_stream, 2)
        os.close(error_stream)


# The pool itself starts its helper anew where that was killed, and the new one complains of all that it does not know.
if hasattr(pool_tracker, "spawnv_passfds"):  # loky's own function
    pool_tracker.spawnv_passfds = _silent_helpers()(pool_tracker.spawnv_passfds)


def _on_its_own(function: Callable[[Unit], Result], unit: Unit) -> Result:
    """Compute a unit on a Dask worker as if there were no cluster."""
    import dask

    keep_memory()
    # xarray would ask the cluster for a lock on every file that it writes, even on one in memory, which fails.
    with dask.config.set(scheduler="synchronous"):
        return function(unit)


def _begin(parent: int, modules: Sequence[str]) -> None:
    """Load what the work needs; and make this process end soon after its parent, even if that was killed.

    A warning is one line, as those of commands are, without a place in the code.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    keep_memory()
    warnings.formatwarning = lambda message, *_: f"armperturb: warning: {' '.join(str(message).split())}\n"
    warnings.filterwarnings("ignore", HELPER_DIED, UserWarning)
    # Modules are no garbage: looking for it among them takes a sixth of the time that they take to load.
    gc.disable()
    for module in modules:
        importlib.import_module(module)
    gc.freeze()
    gc.enable()
