"""Keeps small linear algebra on one thread."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_WORTH_SHARING = 200_000  # unknowns of a batch


@contextmanager
def threads_for(unknowns: int) -> Iterator[None]:
    """Torch on one thread while vectors of this size are worked on, if that is too small to share.

    Threads that spin for one another's share of a microsecond's work take milliseconds when the cores are busy.
    """
    before = torch.get_num_threads()
    if before == 1 or unknowns >= _WORTH_SHARING:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
