"""Runs independent tasks in worker processes of this machine, or of a Dask cluster, with joblib.

Workers are single-threaded. When a worker is lost, unfinished tasks are submitted again.
"""

import logging
import os
import signal
import socket
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from .errors import InputError, ResphysError, ResphysWarning, needs_extra
from .kernel_cache import start_quietly
from .process import ends_as_after_ctrl_c
from .progress import be_quiet

log = logging.getLogger(__name__)

_ATTEMPTS = 3
_IDLE_SECONDS = 60.0  # after which an idle local worker ends
_ANSWER_SECONDS = 10.0  # timeout of the connection to a cluster
_PARENT_SECONDS = 0.02  # interval at which a worker checks that its parent process lives
# Errors that mean that a worker is lost.
_LOST = {"BrokenProcessPool", "KilledWorker", "CommClosedError"}


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
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    workers: Workers,
    folder: Path,
    finished: Callable[[int], None] = lambda number: None,
) -> list[Any]:
    """Calls a function for every task in worker processes.

    Returns the results in the order of the tasks.

    Args:
        function: of a task; a module-level function, as it is pickled for the workers.
        tasks: started in this order.
        workers: always other processes, even a single one.
        folder: which all workers must share.
        finished: called with the number of each task, once, when it is done.

    Raises:
        InputError: Dask is not installed, or the cluster does not answer.
        WorkerError: a task raised a ResphysError, whose message is kept, or workers were lost
            repeatedly.
        WorkerFaultError: a task raised another error.
    """
    results: dict[int, Any] = {}
    for attempt in range(1, _ATTEMPTS + 1):
        left = [(number, task) for number, task in enumerate(tasks) if number not in results]
        if not left:
            break
        try:
            with (
                ends_as_after_ctrl_c(),
                _local(workers) if workers.address is None else _dask(workers.address),
            ):
                # With n_jobs=1, joblib would work in this process.
                parallel = Parallel(
                    n_jobs=max(workers.count, 2),
                    pre_dispatch=workers.count,
                    batch_size=1,
                    return_as="generator_unordered",
                )
                for number, result in parallel(
                    delayed(_work)(function, *numbered, folder) for numbered in left
                ):
                    results[number] = result
                    finished(number)
        except Exception as error:
            if not _LOST & {kind.__name__ for kind in type(error).__mro__}:
                raise
            if attempt == _ATTEMPTS:
                raise WorkerError(
                    f"worker processes were killed {attempt} times in a row, perhaps because "
                    f"memory ran out ({type(error).__name__}): "
                    "run the same command again, with fewer processes."
                ) from error
            workers = workers.at_most(workers.count // 2) if workers.address is None else workers
            log.warning(
                "a worker process was lost: its work is repeated, %d tasks at once", workers.count
            )
    return [results[number] for number in range(len(tasks))]


def _work(function: Callable[[Any], Any], number: int, task: Any, folder: Path) -> tuple[int, Any]:
    """Runs a task in a worker process; returns its number and its result."""
    be_quiet()
    _begin_work()
    if not folder.is_dir():
        raise WorkerError(
            f"the worker on {socket.gethostname()} cannot access {folder}: choose a run folder "
            "that all workers share."
        )
    try:
        with threadpool_limits(1):
            return number, function(task)
    except ResphysError as error:
        raise WorkerError(str(error)) from None
    except Exception:
        raise WorkerFaultError(f"a worker process failed:\n{traceback.format_exc()}") from None


def _begin_work() -> None:
    """Prepares a worker process: one thread of torch,
    and no warnings that the parent process has shown.
    """
    warnings.simplefilter("ignore", ResphysWarning)
    torch.set_num_threads(1)
    os.environ["WARP_RESPHYS_THREADS"] = "1"
    start_quietly()


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
    with (
        warnings.catch_warnings(),
        parallel_config("loky", idle_worker_timeout=_IDLE_SECONDS, **ends),
    ):
        # loky replaces a worker that ended because it was idle or its memory had grown, and warns
        # of that.
        warnings.filterwarnings(
            "ignore", "A worker stopped while some jobs were given to the executor"
        )
        with interrupts_blocked():
            # loky ends a worker whose memory grows by 300 MB after its first call, which hence has
            # all imports.
            Parallel(n_jobs=max(workers.count, 2))(
                delayed(_begin_work)() for _ in range(workers.count)
            )
        yield


@contextmanager
def _dask(address: str) -> Iterator[None]:
    """Connects to a Dask cluster, which resubmits lost work itself, up to three times."""
    with needs_extra("cluster", f"parallel.address={address} needs"):
        from distributed import Client
    try:
        client = Client(address, timeout=_ANSWER_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no Dask cluster answers at parallel.address={address}: start it, correct the "
            "address, or omit it to use processes of this machine."
        ) from error
    with client, parallel_config("dask"):
        if any(threads != 1 for threads in client.nthreads().values()):
            raise InputError(
                "a worker of the Dask cluster has several threads: start each with --nthreads 1."
            )
        yield
