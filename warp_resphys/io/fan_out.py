"""Independent tasks in worker processes of this machine, or of a Ray or Dask cluster, through joblib.

A worker works on one thread. Progress goes through one small file per task in a folder that all workers see, so that
the backends need to carry nothing but tasks and results. Where a worker is lost, all tasks are handed out again: a
task is to go on from what it has written, and to return at once where it was finished.
"""

import json
import logging
import os
import signal
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import torch
import warp as wp
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from .errors import InputError, ResphysError
from .memory import WorkersMemory, forget_peak_memory, peak_memory_gib
from .progress import be_quiet

log = logging.getLogger(__name__)

Advance = Callable[..., None]
_Status = tuple[int, dict[str, object]]  # units that a task has counted, and the named values that it gave last

_ATTEMPTS = 3
_IDLE_SECONDS = 60.0  # after which a worker of this machine ends
_PROGRESS_SECONDS = 0.1  # between two writes, and two reads, of the progress
_PARENT_SECONDS = 0.02  # between a worker's looks at whether the process that started it is still there
_ANSWER_SECONDS = 10.0  # in which a cluster has to answer
_LOST = {  # names of the errors that say that a worker is gone
    *("BrokenProcessPool", "KilledWorker", "CommClosedError", "RayActorError"),
    *("WorkerCrashedError", "NodeDiedError", "OwnerDiedError", "ObjectLostError"),
}


class WorkerError(ResphysError, RuntimeError):
    """A task that a worker process could not do."""


class WorkerFaultError(RuntimeError):
    """A fault of the program in a worker process, with its traceback."""


@dataclass(frozen=True)
class Workers:
    """The processes that share the work.

    Attributes:
        count: number of tasks at once.
        backend: ``local`` processes, or those of a ``ray`` or ``dask`` cluster.
        address: of the cluster; where left out, one is started on this machine for as long as the work takes.
    """

    count: int = 1
    backend: str = "local"
    address: str | None = None

    @property
    def alone(self) -> bool:
        """Whether this process does all of the work itself."""
        return self.count == 1 and self.backend == "local"

    def at_most(self, count: int) -> "Workers":
        """The same workers, but at most so many, and at least one."""
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
        function: of a task and of `advance`; defined at the top of a module, as it is sent to the workers.
        tasks: started in this order.
        workers: in other processes even if there is only one.
        advance: called in a thread of this process with the number of units that workers have counted since the last
            call (negative after a worker was lost), and the named values that the function gave last.
        folder: that every worker can write to.
        memory: counts the memory of the workers.

    Raises:
        InputError: a backend that is not installed, or a cluster that does not answer.
        WorkerError: a task raised a ResphysError, whose sentence it has, or workers were lost again and again.
        WorkerFaultError: a task failed in another way.
    """
    if not tasks:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    for attempt in range(1, _ATTEMPTS + 1):
        known: dict[str, _Status] = {}
        try:
            with (
                TemporaryDirectory(prefix=".progress_", dir=folder, ignore_cleanup_errors=True) as place,
                _BACKENDS[workers.backend](workers),
                _followed(Path(place), known, advance),
            ):
                calls = [delayed(_work)(function, task, Path(place, str(at))) for at, task in enumerate(tasks)]
                # One job alone would be done in this process.
                outcomes = Parallel(n_jobs=max(workers.count, 2), pre_dispatch=workers.count, batch_size=1)(calls)
            break
        except Exception as error:
            if not _LOST & {kind.__name__ for kind in type(error).__mro__}:
                raise
            if attempt == _ATTEMPTS:
                raise WorkerError(
                    f"worker processes were ended from outside {attempt} times in a row, perhaps for want of memory "
                    f"({type(error).__name__}): run the same command again, with fewer processes."
                ) from error
            workers = workers.at_most(workers.count // 2) if workers.backend == "local" else workers
            log.warning("a worker process was lost: its work is done again, %d at once", workers.count)
            advance(-sum(total for total, _ in known.values()))
    if memory is not None:
        peaks: dict[tuple[str, int], float] = {}
        for _, worker, peak in outcomes:
            peaks[worker] = max(peak, peaks.get(worker, 0.0))
        memory.count(peaks.values())
    return [result for result, _, _ in outcomes]


def _work(function: Callable[[Any, Advance], Any], task: Any, progress: Path) -> tuple[Any, tuple[str, int], float]:
    """Does a task in a worker process; returns the result, machine and process, and the peak of its memory [GiB]."""
    be_quiet()
    wp.config.log_level = wp.LOG_WARNING  # Every worker would greet otherwise.
    torch.set_num_threads(1)
    forget_peak_memory()
    worker = (socket.gethostname(), os.getpid())
    if not progress.parent.is_dir():
        raise WorkerError(
            f"the worker on {worker[0]} does not see {progress.parent.parent}: choose a run folder that all workers "
            "share."
        )
    try:
        with threadpool_limits(1), _ProgressFile(progress) as advance:
            return function(task, advance), worker, peak_memory_gib()
    except ResphysError as error:
        raise WorkerError(str(error)) from None
    except Exception:
        raise WorkerFaultError(f"a worker process failed:\n{traceback.format_exc()}") from None


class _ProgressFile:
    """Writes how far a task is: what it has counted, and the named values that it gave last.

    Where the folder is gone, the work was given up or handed out again: the write fails, which ends the task.
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
def _followed(folder: Path, known: dict[str, _Status], advance: Advance) -> Iterator[None]:
    """Hands on what the progress files of tasks say; `known` has what was handed on, by name of the file."""
    ended = threading.Event()

    def look() -> None:
        for path in folder.iterdir():
            with suppress(ValueError):  # A file that is just being written.
                total, shown = json.loads(path.read_text(encoding="utf-8"))
                before = known.get(path.name, (0, {}))
                if (total, shown) != before:
                    known[path.name] = total, shown
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
def _local(workers: Workers) -> Iterator[None]:
    ends = {"initializer": _end_with, "initargs": (os.getpid(),)}
    with parallel_config("loky", idle_worker_timeout=_IDLE_SECONDS, **ends):
        with _interrupts_blocked():  # Workers that are started here leave Ctrl-C to this process.
            Parallel(n_jobs=max(workers.count, 2))(delayed(int)() for _ in range(2))
        yield


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with(parent: int) -> None:
    """Ends this process once the one that started it has ended, whatever it does or waits for then."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def _dask(workers: Workers) -> Iterator[None]:
    """Dask itself hands out lost work again, up to three times."""
    try:
        from distributed import Client
    except ModuleNotFoundError:
        raise InputError(_missing("dask")) from None
    own = {"n_workers": workers.count, "threads_per_worker": 1, "dashboard_address": None}
    try:
        with _interrupts_blocked():
            client = Client(**own) if workers.address is None else Client(workers.address, timeout=_ANSWER_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(_unreachable(workers)) from error
    with client, parallel_config("dask"):
        if any(threads != 1 for threads in client.nthreads().values()):
            raise InputError("a worker of the dask cluster has several threads: start each with --nthreads 1.")
        yield


@contextmanager
def _ray(workers: Workers) -> Iterator[None]:
    try:
        import ray
        from ray.util.joblib import register_ray
    except ModuleNotFoundError:
        raise InputError(_missing("ray")) from None
    own = not ray.is_initialized()
    if own:
        local: dict[str, Any] = {"num_cpus": workers.count, "include_dashboard": False}
        where = local if workers.address is None else {"address": workers.address}
        try:
            if workers.address not in (None, "auto"):  # Ray would try for minutes.
                host, _, port = str(workers.address).removeprefix("ray://").rpartition(":")
                socket.create_connection((host, int(port)), _ANSWER_SECONDS).close()
            with _interrupts_blocked():
                ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(_unreachable(workers)) from error
    register_ray()
    try:
        with parallel_config("ray", ray_remote_args={"num_cpus": 1}):
            yield
    finally:
        if own:
            ray.shutdown()


_BACKENDS: Final = {"local": _local, "ray": _ray, "dask": _dask}
BACKENDS: Final = tuple(_BACKENDS)


def _missing(backend: str) -> str:
    return f"parallel.backend is {backend}, which is not installed: run pip install 'warp-resphys[cluster]'."


def _unreachable(workers: Workers) -> str:
    return (
        f"no {workers.backend} cluster answers at parallel.address={workers.address}: start it, correct the address, "
        "or leave it out for one on this machine."
    )
