"""Independent pieces of work over worker processes, of this machine or of a cluster, through joblib.

A worker works on one thread, and leaves Ctrl-C to the process that handed out the work. What it says of its progress
goes through files, so that workers need no more of a cluster than the folder that they write their results to. Work
whose worker was lost is handed out again: it is to go on from what it has written, or to do the same once more.
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
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Final, NamedTuple

import torch
import warp as wp
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits

from .errors import InputError, ResphysError
from .memory import WorkersMemory, forget_peak_memory, peak_memory_gib
from .progress import be_quiet

log = logging.getLogger(__name__)

Advance = Callable[..., None]
Call = tuple[Any, ...]  # arguments of `_work`
Run = Callable[[Sequence[Call], int], Generator["_Outcome", None, None]]  # does calls, so many at once

_LOSSES = 3  # one after the other without a result in between, after which work is given up
_IDLE_SECONDS = 60.0  # after which a worker of this machine ends
_LOOK_SECONDS = 0.1  # between looks at the progress
_PARENT_SECONDS = 0.02  # between a worker's looks at whether the process that started it is still there
_ANSWER_SECONDS = 10.0  # that a cluster has to answer in
_LOST = {  # errors, by name, that say that a worker is gone
    *("BrokenProcessPool", "TerminatedWorkerError", "KilledWorker", "CommClosedError"),
    *("WorkerCrashedError", "NodeDiedError", "OwnerDiedError", "ObjectLostError"),
}
_BEGINS = "begins"  # line of a journal


class WorkerError(ResphysError, RuntimeError):
    """A worker process that could not do its piece of work."""


class WorkerFaultError(RuntimeError):
    """A fault of the program in a worker process, with its traceback."""


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    Attributes:
        count: pieces at once.
        backend: ``local`` processes, or those of a ``ray`` or ``dask`` cluster.
        address: of the cluster; where left out, one is started on this machine for as long as the work takes.
    """

    count: int = 1
    backend: str = "local"
    address: str | None = None

    @property
    def alone(self) -> bool:
        """Whether this process does it all."""
        return self.count == 1 and self.backend == "local"

    def at_most(self, count: int) -> "Workers":
        """No more than so many, one at least."""
        return replace(self, count=max(min(self.count, count), 1))


ALONE = Workers()


class _Outcome(NamedTuple):
    number: int  # of the task
    kind: str  # done, error or fault
    content: Any
    worker: tuple[str, int]  # machine and process
    peak_gib: float


def fan_out(
    function: Callable[[Any, Advance], Any],
    tasks: Sequence[Any],
    workers: Workers,
    advance: Advance,
    folder: Path,
    memory: WorkersMemory | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """Yields a task's number and result as each finishes; close the iterator to end the workers.

    Args:
        function: of a task and of `advance`; defined at the top of a module, as what it takes and returns is sent.
        tasks: started in this order.
        workers: who do them, in other processes even if there is only one.
        advance: called here, with the arguments that a worker called its own with; what lost work had counted is
            counted back.
        folder: that every worker can write to.
        memory: that counts what the workers take.

    Raises:
        InputError: a backend that is not installed, or a cluster that does not answer.
        WorkerError: a task raised a ResphysError, whose sentence it has, or workers were lost again and again.
        WorkerFaultError: a task failed in another way.
    """
    left = dict(enumerate(tasks))
    if not left:
        return
    peaks: dict[tuple[str, int], float] = {}
    count, losses, attempt = workers.count, 0, 0
    folder.mkdir(parents=True, exist_ok=True)
    with (
        TemporaryDirectory(prefix=".progress_", dir=folder, ignore_cleanup_errors=True) as place,
        _Followed(Path(place), len(tasks), advance),
        _BACKENDS[workers.backend](workers) as run,
    ):
        try:
            while left:
                over = Path(place, f"over_{attempt}")
                calls = [(function, number, task, Path(place, str(number)), over) for number, task in left.items()]
                try:
                    with closing(run(calls, count)) as outcomes:
                        for outcome in outcomes:
                            peaks[outcome.worker] = max(outcome.peak_gib, peaks.get(outcome.worker, 0.0))
                            _raise_for(outcome)
                            del left[outcome.number]
                            losses = 0
                            yield outcome.number, outcome.content
                except Exception as error:
                    if not _LOST & {each.__name__ for each in type(error).__mro__}:
                        raise
                    over.touch()
                    losses, attempt = losses + 1, attempt + 1
                    if losses == _LOSSES:
                        raise WorkerError(
                            f"worker processes were ended from outside {losses} times in a row, perhaps for want of "
                            f"memory ({_first_line(error)}): run the same command again, with fewer processes."
                        ) from error
                    if memory is not None:
                        memory.count(peaks.values())
                    peaks.clear()
                    count = max(count // 2, 1) if workers.backend == "local" else count
                    log.warning("a worker process was lost: its work is done again, %d at once", count)
        finally:
            if memory is not None:
                memory.count(peaks.values())


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:160]


def _raise_for(outcome: _Outcome) -> None:
    if outcome.kind == "error":
        raise WorkerError(outcome.content)
    if outcome.kind == "fault":
        raise WorkerFaultError(f"a worker process failed:\n{outcome.content}")


def _work(function: Callable[[Any, Advance], Any], number: int, task: Any, journal: Path, over: Path) -> _Outcome:
    """Does a task in a worker process, until what handed it out says that it is over, or has removed the folder."""
    be_quiet()
    wp.config.log_level = wp.LOG_WARNING  # Every worker would greet otherwise.
    if threading.current_thread() is threading.main_thread():
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    torch.set_num_threads(1)
    forget_peak_memory()
    worker = (socket.gethostname(), os.getpid())
    if not journal.parent.is_dir():
        place = journal.parent.parent
        said = f"the worker on {worker[0]} does not see {place}: choose a run folder that all workers share."
        return _Outcome(number, "error", said, worker, peak_memory_gib())
    with threadpool_limits(1), journal.open("a", encoding="utf-8", buffering=1) as written:

        def advance(count: int = 1, **fields: object) -> None:
            if over.exists() or not over.parent.exists():
                raise WorkerError("the work was given up, or handed out again.")
            written.write(json.dumps([count, fields], default=str) + "\n")

        written.write(f"\n{_BEGINS}\n")  # after what a worker may have begun to write when it was lost
        try:
            return _Outcome(number, "done", function(task, advance), worker, peak_memory_gib())
        except ResphysError as error:
            return _Outcome(number, "error", str(error), worker, peak_memory_gib())
        except Exception:
            return _Outcome(number, "fault", traceback.format_exc(), worker, peak_memory_gib())


class _Followed:
    """Hands on what the journals of tasks say, as they grow."""

    def __init__(self, folder: Path, tasks: int, advance: Advance) -> None:
        self._journals = [folder / str(number) for number in range(tasks)]
        self._advance = advance
        self._read, self._counted = [0] * tasks, [0] * tasks  # bytes; what was handed on
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="progress", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._look()

    def _follow(self) -> None:
        while not self._ended.wait(_LOOK_SECONDS):
            self._look()

    def _look(self) -> None:
        for number, path in enumerate(self._journals):
            with suppress(FileNotFoundError), path.open("rb") as journal:
                journal.seek(self._read[number])
                lines, end, _ = journal.read().rpartition(b"\n")
                self._read[number] += len(lines) + len(end)
                for line in lines.splitlines():
                    self._hand_on(number, line.decode())

    def _hand_on(self, number: int, line: str) -> None:
        if line == _BEGINS:
            count, fields = -self._counted[number], {}
        else:
            try:
                count, fields = json.loads(line)
            except ValueError:  # of a worker that was lost
                return
        self._counted[number] += count
        if count or fields:
            self._advance(count, **fields)


@contextmanager
def _local(workers: Workers) -> Iterator[Run]:
    ends = {"initializer": _end_with, "initargs": (os.getpid(),)}
    with parallel_config("loky", inner_max_num_threads=1, idle_worker_timeout=_IDLE_SECONDS, **ends):
        yield _by_joblib


def _end_with(parent: int) -> None:
    """Ends this process once the one that started it has ended, whatever it does or waits for then."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def _by_joblib(calls: Sequence[Call], count: int) -> Generator[_Outcome, None, None]:
    # One job alone would be done in this process.
    parallel = Parallel(n_jobs=max(count, 2), pre_dispatch=count, batch_size=1, return_as="generator_unordered")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # as the workers are started
    try:
        outcomes = parallel(delayed(_work)(*call) for call in calls)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*have been cancelled|.*results from work already performed")
        yield from outcomes


@contextmanager
def _dask(workers: Workers) -> Iterator[Run]:
    """Lost work is handed out again by Dask itself."""
    try:
        from distributed import Client
    except ModuleNotFoundError:
        raise InputError(_missing("dask")) from None
    own = {"n_workers": workers.count, "threads_per_worker": 1, "dashboard_address": None}
    try:
        client = Client(**own) if workers.address is None else Client(workers.address, timeout=_ANSWER_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(_unreachable(workers)) from error
    if any(threads != 1 for threads in client.nthreads().values()):
        client.close()
        raise InputError("a worker of the dask cluster has several threads: start each with --nthreads 1.")
    with client, parallel_config("dask"):
        yield _by_joblib


@contextmanager
def _ray(workers: Workers) -> Iterator[Run]:
    """Lost work is handed out again by Ray itself; through its own calls, as its joblib backend holds results back."""
    try:
        import ray
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
            ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(_unreachable(workers)) from error
    remote = ray.remote(num_cpus=1, max_retries=_LOSSES)(_work)

    def run(calls: Sequence[Call], count: int) -> Generator[_Outcome, None, None]:
        waiting = iter(calls)
        pending = [remote.remote(*call) for call in islice(waiting, count)]
        try:
            while pending:
                (ready,), pending = ray.wait(pending)
                pending += [remote.remote(*call) for call in islice(waiting, 1)]
                yield ray.get(ready)
        finally:
            for each in pending:
                ray.cancel(each, force=True)

    try:
        yield run
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
