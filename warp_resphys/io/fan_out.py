"""Runs independent tasks in worker processes of this machine, or of a Dask cluster, with joblib.

Workers are single-threaded. Progress is reported through a small file for each task in a shared folder, so that joblib
transfers only tasks and results. When a worker is lost, all tasks are submitted again: a task must return at
once if its file is finished.
"""

import json
import logging
import os
import signal
import socket
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import warp as wp
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from .errors import InputError, ResphysError, ResphysWarning
from .memory import WorkersMemory, forget_peak_memory, peak_memory_gib
from .progress import be_quiet

log = logging.getLogger(__name__)

Advance = Callable[..., None]
_Status = tuple[int, dict[str, object]]  # units that a task has counted, and its latest named values

_ATTEMPTS = 3
_IDLE_SECONDS = 60.0  # after which an idle local worker ends
_PROGRESS_SECONDS = 0.1  # interval of writing and of reading the progress
_ANSWER_SECONDS = 10.0  # timeout of the connection to a cluster
_PARENT_SECONDS = 0.02  # interval at which a worker checks that its parent process lives
_LOST = {"BrokenProcessPool", "KilledWorker", "CommClosedError"}  # errors that mean that a worker is lost


class WorkerError(ResphysError, RuntimeError):
    """A task that failed in a worker process for a reason that the user can fix."""


class WorkerFaultError(RuntimeError):
    """An unexpected error in a worker process, with its traceback."""


@dataclass(frozen=True)
class Workers:
    """The processes that share the work.

    Attributes:
        count: number of tasks at once.
        address: of a Dask cluster; processes of this machine if omitted.
    """

    count: int = 1
    address: str | None = None

    @property
    def alone(self) -> bool:
        """Whether this process does all of the work itself."""
        return self.count == 1 and self.address is None

    def at_most(self, count: int) -> "Workers":
        """Returns the same workers, limited to a number of tasks at once."""
        return replace(self, count=max(min(self.count, count), 1))


ALONE = Workers()


def fan_out(
    function: Callable[[Any, Advance], Any],
    tasks: Sequence[Any],
    workers: Workers,
    advance: Advance,
    folder: Path,
    memory: WorkersMemory | None = None,
) -> list[Any]:
    """Calls a function for every task in worker processes; returns the results in the order of the tasks.

    Args:
        function: of a task and of `advance`; a module-level function, as it is pickled for the workers.
        tasks: started in this order.
        workers: always other processes, even a single one.
        advance: called in a thread of this process with the number of units that workers have counted since the last
            call (negative after a worker was lost), and the latest named values of a task.
        folder: writable by all workers.
        memory: counts the memory of the workers.

    Raises:
        InputError: Dask is not installed, or the cluster does not answer.
        WorkerError: a task raised a ResphysError, whose message is kept, or workers were lost repeatedly.
        WorkerFaultError: a task raised another error.
    """
    if not tasks:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    for attempt in range(1, _ATTEMPTS + 1):
        reported: dict[str, _Status] = {}
        try:
            with (
                TemporaryDirectory(prefix=".progress_", dir=folder, ignore_cleanup_errors=True) as place,
                _local(workers) if workers.address is None else _dask(workers.address),
                _followed(Path(place), reported, advance),
            ):
                calls = [delayed(_work)(function, task, Path(place, str(at))) for at, task in enumerate(tasks)]
                # With n_jobs=1, joblib would work in this process.
                outcomes = Parallel(n_jobs=max(workers.count, 2), pre_dispatch=workers.count, batch_size=1)(calls)
            break
        except Exception as error:
            if not _LOST & {kind.__name__ for kind in type(error).__mro__}:
                raise
            if attempt == _ATTEMPTS:
                raise WorkerError(
                    f"worker processes were killed {attempt} times in a row, perhaps because memory ran out "
                    f"({type(error).__name__}): run the same command again, with fewer processes."
                ) from error
            workers = workers.at_most(workers.count // 2) if workers.address is None else workers
            log.warning("a worker process was lost: its work is repeated, %d tasks at once", workers.count)
            advance(-sum(total for total, _ in reported.values()))
    if memory is not None:
        peaks: dict[tuple[str, int], float] = {}
        for _, worker, peak in outcomes:
            peaks[worker] = max(peak, peaks.get(worker, 0.0))
        memory.count(peaks.values())
    return [result for result, _, _ in outcomes]


def _work(function: Callable[[Any, Advance], Any], task: Any, progress: Path) -> tuple[Any, tuple[str, int], float]:
    """Runs a task in a worker process; returns its result, host and process, and peak memory [GiB]."""
    be_quiet()
    _begin_work()
    forget_peak_memory()
    worker = (socket.gethostname(), os.getpid())
    if not progress.parent.is_dir():
        raise WorkerError(
            f"the worker on {worker[0]} cannot access {progress.parent.parent}: choose a run folder that all workers "
            "share."
        )
    try:
        with threadpool_limits(1), _ProgressFile(progress) as advance:
            return function(task, advance), worker, peak_memory_gib()
    except ResphysError as error:
        raise WorkerError(str(error)) from None
    except Exception:
        raise WorkerFaultError(f"a worker process failed:\n{traceback.format_exc()}") from None


def _begin_work() -> None:
    """Prepares a worker process: one thread of torch, and no warnings that the parent process has shown."""
    warnings.simplefilter("ignore", ResphysWarning)
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING
    shown = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)  # Its library writes them itself.
        wp.init()
    finally:
        os.dup2(shown, 2)
        os.close(shown)


class _ProgressFile:
    """Writes the progress of a task: the units that it has counted, and its latest named values.

    If the folder is gone, the work was cancelled or submitted again: the write fails, which ends the task.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._total, self._next = path, 0, 0.0
        self._shown: dict[str, object] = {}

    def __enter__(self) -> Advance:
        return self._advance

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._write()

    def _advance(self, count: int = 1, **shown: object) -> None:
        self._total += count
        self._shown = shown or self._shown
        if shown or time.monotonic() >= self._next:
            self._write()

    def _write(self) -> None:
        self._path.write_text(json.dumps([self._total, self._shown], default=str), encoding="utf-8")
        self._next = time.monotonic() + _PROGRESS_SECONDS


@contextmanager
def _followed(folder: Path, reported: dict[str, _Status], advance: Advance) -> Iterator[None]:
    """Reports the progress files of tasks to `advance`; `reported` has the last status by file name."""
    ended = threading.Event()

    def look() -> None:
        for path in folder.iterdir():
            with suppress(ValueError):  # a file that is being written
                total, shown = json.loads(path.read_text(encoding="utf-8"))
                before = reported.get(path.name, (0, {}))
                if (total, shown) != before:
                    reported[path.name] = total, shown
                    advance(total - before[0], **shown)

    def follow() -> None:
        while not ended.wait(_PROGRESS_SECONDS):
            look()

    thread = threading.Thread(target=follow, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    look()


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Blocks Ctrl-C in processes that start meanwhile, which leave it to this one."""
    if not hasattr(signal, "pthread_sigmask"):  # On Windows, Ctrl-C reaches the workers as well.
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with(parent: int) -> None:
    """Lets this worker end with its parent process."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def _local(workers: Workers) -> Iterator[None]:
    ends = {"initializer": _end_with, "initargs": (os.getpid(),)}
    with warnings.catch_warnings(), parallel_config("loky", idle_worker_timeout=_IDLE_SECONDS, **ends):
        # loky replaces a worker that ended because it was idle or its memory had grown, and warns of that.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given to the executor")
        with interrupts_blocked():
            # loky ends a worker whose memory grows by 300 MB after its first call, which hence has all imports.
            Parallel(n_jobs=max(workers.count, 2))(delayed(_begin_work)() for _ in range(workers.count))
        yield


@contextmanager
def _dask(address: str) -> Iterator[None]:
    """Connects to a Dask cluster, which resubmits lost work itself, up to three times."""
    try:
        from distributed import Client
    except ModuleNotFoundError:
        raise InputError(
            f"parallel.address is {address}, but Dask is not installed: run pip install 'warp-resphys[cluster]'."
        ) from None
    try:
        client = Client(address, timeout=_ANSWER_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask cluster answers at parallel.address={address}: start it, correct the address, or omit it to use "
            "processes of this machine."
        ) from error
    with client, parallel_config("dask"):
        if any(threads != 1 for threads in client.nthreads().values()):
            raise InputError("a worker of the Dask cluster has several threads: start each with --nthreads 1.")
        yield
