"""Independent pieces of work in several processes.

Processes are spawned: a fork would copy the threads' locks of torch and Warp in whatever state they are. Each works on
one thread. Ctrl-C is the parent's to handle; a worker ends with its parent, however that ends, as its pipe is closed.
"""

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Generator, Sequence
from itertools import islice
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

import torch
import warp as wp
from threadpoolctl import threadpool_limits

from .errors import ResphysError
from .memory import WorkersMemory, peak_memory_gib
from .progress import be_quiet

Advance = Callable[..., None]


class WorkerError(ResphysError, RuntimeError):
    """A worker process that could not do its piece of work."""


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(
    function: Callable[[Any, Advance], Any],
    tasks: Sequence[Any],
    processes: int,
    advance: Advance,
    memory: WorkersMemory | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """Yields a task's number and result as each finishes; close the iterator to end the workers.

    Args:
        function: of a task and of `advance`; defined at the top of a module, as what it takes and returns is sent.
        tasks: started in this order.
        processes: at most so many at once.
        advance: called here, with the arguments that a worker called its own with.
        memory: that counts what the workers take.

    Raises:
        WorkerError: a task raised a ResphysError, whose sentence it has, or a worker was ended from outside.
        RuntimeError: a task failed in another way.
    """
    crew: dict[Connection, BaseProcess] = {}
    busy: dict[Connection, int] = {}
    peaks: dict[Connection, float] = {}
    waiting = iter(range(len(tasks)))
    try:
        for number in islice(waiting, processes):
            worker = _start(function, crew)
            worker.send(tasks[number])
            busy[worker] = number
        while busy:
            for connection in wait([*busy]):
                assert isinstance(connection, Connection)
                kind, content = _receive(connection, crew[connection])
                if kind == "advance":
                    advance(content[0], **content[1])
                    continue
                result, peaks[connection] = content
                number = busy.pop(connection)
                if (following := next(waiting, None)) is not None:
                    connection.send(tasks[following])
                    busy[connection] = following
                yield number, result
    finally:
        if memory is not None:
            memory.count(peaks.values())
        for worker, process in crew.items():
            worker.close()
            process.terminate()
            process.join()


def _start(function: Callable[[Any, Advance], Any], crew: dict[Connection, BaseProcess]) -> Connection:
    """Adds a worker, which never sees Ctrl-C, to the crew; this process sees it afterwards."""
    context = multiprocessing.get_context("spawn")
    resource_tracker.ensure_running()  # Else it is started with the first process, and unblocks them before that.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(function, theirs), daemon=True)
        process.start()
        crew[ours] = process
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    theirs.close()
    return ours


def _receive(connection: Connection, process: BaseProcess) -> tuple[str, Any]:
    try:
        kind, content = connection.recv()
    except (EOFError, ConnectionError) as error:
        process.join()
        raise WorkerError(
            f"a worker process was ended from outside (exit code {process.exitcode}), perhaps for want of memory: "
            "run the same command again, with fewer processes."
        ) from error
    if kind == "error":
        raise WorkerError(content)
    if kind == "fault":
        raise RuntimeError(f"a worker process failed:\n{content}")
    return kind, content


def _work(function: Callable[[Any, Advance], Any], connection: Connection) -> None:
    """Does one task after the other until the parent closes the pipe."""

    def advance(count: int = 1, **fields: object) -> None:
        connection.send(("advance", (count, fields)))

    be_quiet()
    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_WARNING  # As in the parent: every worker would greet otherwise.
    with threadpool_limits(1):
        try:
            while True:
                connection.send(_outcome(function, connection.recv(), advance))
        except (EOFError, ConnectionError):
            return


def _outcome(function: Callable[[Any, Advance], Any], task: Any, advance: Advance) -> tuple[str, Any]:
    try:
        return "done", (function(task, advance), peak_memory_gib())
    except ConnectionError:
        raise
    except ResphysError as error:
        return "error", str(error)
    except Exception:
        return "fault", traceback.format_exc()
