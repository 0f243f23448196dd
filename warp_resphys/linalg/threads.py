"""Thread counts: one thread for small linear algebra, several for the shards of a batch."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from threading import Lock, local
from typing import TypeVar

import torch
from threadpoolctl import LibController, ThreadpoolController

from ..io.errors import InputError

S = TypeVar("S")
T = TypeVar("T")

_WORTH_SHARING = 9_000  # unknowns of a body from which torch uses several threads
_LEAST_ENVIRONMENTS = 2  # environments per shard


@contextmanager
def threads_for(unknowns: int, shards: int = 1) -> Iterator[None]:
    """Limits BLAS to one thread, and torch too for small bodies (`unknowns`) or for a batch split into shards.

    Threads that spin-wait for microseconds of work cost milliseconds when the cores are busy, and a banded factor gains
    nothing from a second thread.
    """
    before = torch.get_num_threads()
    limit_torch = before > 1 and not (unknowns >= _WORTH_SHARING and shards == 1)
    _LIMIT.begin()
    if limit_torch:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if limit_torch:
            torch.set_num_threads(before)
        _LIMIT.end()


class _BlasLimit:
    """Limit of BLAS to one thread, which all threads of the process share: the last user takes it away."""

    def __init__(self) -> None:
        self._lock, self._users, self._limited = Lock(), 0, list[tuple[LibController, int]]()

    def begin(self) -> None:
        with self._lock:
            if not self._users:
                # Direct calls to the libraries: threadpoolctl's own queries take too long for a time step.
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


def shards_of(batch: int, device: torch.device, least: int = _LEAST_ENVIRONMENTS) -> list[slice]:
    """Returns the slices of a batch for one thread each, or none if a single thread does it all.

    On a CPU a kernel runs on the thread that launches it and releases the GIL. The number of threads is torch's, or
    ``WARP_RESPHYS_THREADS``; within `in_threads` it is one.

    Args:
        batch: number of environments.
        device: their device.
        least: smallest number of environments in a slice.

    Raises:
        InputError: the environment variable is not a whole number.
    """
    threads = os.environ.get("WARP_RESPHYS_THREADS", str(torch.get_num_threads()))
    if not threads.isdecimal():
        raise InputError(f"WARP_RESPHYS_THREADS is {threads!r}: it must be a whole number of threads.")
    count = min(int(threads), batch // least)
    if device.type != "cpu" or count < 2 or _is_shared():
        return []
    ends = [round(batch * k / count) for k in range(count + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


_SHARING = local()  # of each thread: whether it works on one of several shards


def _is_shared() -> bool:
    return getattr(_SHARING, "now", False)


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
    """Returns the results of a function for all shards; the calling thread works on the last one.

    Exceptions are raised after all threads have finished. Within the function, further shards are not shared again.
    """
    if len(shards) == 1 or _is_shared():
        return [work(shard) for shard in shards]
    grad_enabled = torch.is_grad_enabled()  # a thread-local setting

    def work_on(shard: S) -> T:
        _SHARING.now = True
        try:
            with torch.set_grad_enabled(grad_enabled):
                return work(shard)
        finally:
            _SHARING.now = False

    others = [_pool(len(shards) - 1).submit(work_on, shard) for shard in shards[:-1]]
    try:
        last = work_on(shards[-1])
    finally:
        wait(others)
    return [*(other.result() for other in others), last]
