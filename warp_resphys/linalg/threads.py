"""Numbers of threads: one for small linear algebra, several for the shards of a batch."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import TypeVar

import torch
from threadpoolctl import LibController, ThreadpoolController

from ..io.errors import InputError

S = TypeVar("S")
T = TypeVar("T")

_WORTH_SHARING = 9_000  # unknowns of a body
_LEAST_ENVIRONMENTS = 2  # of a shard


@contextmanager
def threads_for(unknowns: int, shards: int = 1) -> Iterator[None]:
    """BLAS on one thread; torch too, where bodies of so many unknowns are not worth sharing, or shards have one each.

    Threads that spin for one another's share of a microsecond's work take milliseconds when the cores are busy, and a
    banded factor gains nothing from a second one.
    """
    before = torch.get_num_threads()
    one = before > 1 and not (unknowns >= _WORTH_SHARING and shards == 1)
    # By the libraries themselves: a step is too short to ask all that threadpoolctl asks.
    several = [(library, count) for library in _blas() if (count := library.get_num_threads()) != 1]
    for library, _ in several:
        library.set_num_threads(1)
    if one:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if one:
            torch.set_num_threads(before)
        for library, count in several:
            library.set_num_threads(count)


@cache
def _blas() -> list[LibController]:
    found: list[LibController] = ThreadpoolController().select(user_api="blas").lib_controllers
    return found


def shards_of(batch: int, device: torch.device) -> list[slice]:
    """Rows of a batch that a thread each works on, or nothing if one thread has them all.

    On a CPU a kernel runs on the thread that launches it, and releases Python's lock meanwhile. As many threads are
    used as torch may use; ``WARP_RESPHYS_THREADS`` is another number.

    Raises:
        InputError: that is none.
    """
    wanted = os.environ.get("WARP_RESPHYS_THREADS", str(torch.get_num_threads()))
    if not wanted.isdecimal():
        raise InputError(f"WARP_RESPHYS_THREADS is {wanted!r}: it must be a whole number of threads.")
    count = min(int(wanted), batch // _LEAST_ENVIRONMENTS)
    if device.type != "cpu" or count < 2:
        return []
    ends = [round(batch * k / count) for k in range(count + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


@cache
def _crew(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "warp-resphys", lambda: torch.set_num_threads(1))


def in_threads(work: Callable[[S], T], shards: Sequence[S]) -> list[T]:
    """The results of a function for each shard, the last of which the calling thread works on.

    What one of them raises is raised when all have ended.
    """
    if len(shards) == 1:
        return [work(shards[0])]
    graded = torch.is_grad_enabled()  # Each thread has that setting for itself.

    def work_on(shard: S) -> T:
        with torch.set_grad_enabled(graded):
            return work(shard)

    others = [_crew(len(shards) - 1).submit(work_on, shard) for shard in shards[:-1]]
    try:
        own = work(shards[-1])
    finally:
        wait(others)
    return [*(other.result() for other in others), own]
