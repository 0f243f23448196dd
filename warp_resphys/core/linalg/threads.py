"""Thread counts: one thread for small linear algebra, several for the shards of a batch."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from threading import Lock, local
from typing import TypeVar, cast

import torch
from threadpoolctl import LibController, ThreadpoolController

from ...io.errors import InputError

S = TypeVar("S")
T = TypeVar("T")

_WORTH_SHARING = 9_000  # unknowns of a body from which torch uses several threads
_LEAST_ENVIRONMENTS = 2  # of small bodies per shard
_IN_CACHE = 4_000  # unknowns of the environments of a shard


@contextmanager
def threads_for(unknowns: int, shards: int = 1) -> Iterator[None]:
    """Limits BLAS to one thread, and torch too for small bodies (`unknowns`)
    or for a batch split into shards.

    Threads that spin-wait for microseconds of work cost milliseconds when the cores are busy, and a
    banded factor gains nothing from a second thread.
    """
    before, outer = torch.get_num_threads(), getattr(_OF_THREAD, "unlimited", None)
    limit_torch = before > 1 and not (unknowns >= _WORTH_SHARING and shards == 1)
    _OF_THREAD.unlimited = outer or before
    _LIMIT.begin()
    if limit_torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if limit_torch:
            torch.set_num_threads(before)
        _OF_THREAD.unlimited = outer
        _LIMIT.end()


class _BlasLimit:
    """Limit of BLAS to one thread, which all threads of the process share:
    the last user takes it away.
    """

    def __init__(self) -> None:
        self._lock, self._users = Lock(), 0
        self._limited = list[tuple[LibController, int]]()

    def begin(self) -> None:
        with self._lock:
            if not self._users:
                # Direct calls to the libraries: threadpoolctl's own queries take too long for a
                # time step.
                counts = [(library, library.get_num_threads()) for library in _blas()]
                self._limited = [(library, count) for library, count in counts if count != 1]
                for library, _ in self._limited:
                    library.set_num_threads(1)
            self._users += 1

    def end(self) -> None:
        with self._lock:
            self._users -= 1
            for library, count in () if self._users else self._limited:
                library.set_num_threads(count)


_LIMIT = _BlasLimit()


@cache
def _blas() -> list[LibController]:
    libraries: list[LibController] = ThreadpoolController().select(user_api="blas").lib_controllers
    return libraries


def shards_of(batch: int, device: torch.device, unknowns: int = 1) -> list[slice]:
    """Returns the slices of a batch that are worked on one after another or by several threads.

    None for a single one.

    On a CPU a kernel runs on the thread that launches it and releases the GIL. There is a slice for
    each thread, or more for large environments, whose matrices then stay in a processor's cache
    from one kernel to the next.

    Args:
        batch: number of environments.
        device: their device.
        unknowns: of an environment.

    Raises:
        InputError: see `thread_count`.
    """
    most = max(1, _IN_CACHE // unknowns)  # environments of a slice
    least = min(most, _LEAST_ENVIRONMENTS)
    threads = 1 if is_shared() else thread_count()
    count = max(min(threads, batch // least), -(-batch // most))
    if device.type != "cpu" or count < 2:
        return []
    ends = [round(batch * k / count) for k in range(count + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


def thread_count() -> int:
    """Returns the number of threads that share a batch: torch's outside `threads_for`, or
    ``WARP_RESPHYS_THREADS``.

    Raises:
        InputError: the environment variable is not a whole number.
    """
    unlimited = getattr(_OF_THREAD, "unlimited", None) or torch.get_num_threads()
    threads = os.environ.get("WARP_RESPHYS_THREADS", str(unlimited))
    if not threads.isdecimal():
        raise InputError(
            f"WARP_RESPHYS_THREADS is {threads!r}: it must be a whole number of threads."
        )
    return max(1, int(threads))


# Of each thread: whether it is `sharing`, at work on one of several shards, and torch's `unlimited`
# number of threads.
_OF_THREAD = local()


def is_shared() -> bool:
    """Returns whether this thread works on one of several shards, which are not shared again."""
    return getattr(_OF_THREAD, "sharing", False)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "warp-resphys", lambda: torch.set_num_threads(1))


def _forked() -> None:
    """Lets a forked process, which has none of these threads and none of OpenMP's, do without."""
    _pool.cache_clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def in_threads(work: Callable[[S], T], shards: Sequence[S]) -> list[T]:
    """Returns the results of a function for all shards, of which every thread works on some.

    The calling thread is the last one. Exceptions are raised after all threads have finished.
    Within the function, further shards are not shared again.
    """
    threads = min(thread_count(), len(shards))
    if threads == 1 or is_shared():
        return [work(shard) for shard in shards]
    grad_enabled = torch.is_grad_enabled()  # a thread-local setting

    def work_on(mine: Sequence[S]) -> list[T]:
        _OF_THREAD.sharing = True
        try:
            with torch.set_grad_enabled(grad_enabled):
                return [work(shard) for shard in mine]
        finally:
            _OF_THREAD.sharing = False

    *first, last = (shards[number::threads] for number in range(threads))
    others = [_pool(threads - 1).submit(work_on, mine) for mine in first]
    results: list[T | None] = [None] * len(shards)
    try:
        results[threads - 1 :: threads] = work_on(last)
    finally:
        wait(others)
    for number, other in enumerate(others):
        results[number::threads] = other.result()
    return cast(list[T], results)
