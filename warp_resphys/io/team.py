"""Processes that torchrun has started: the first one works, and all of them train networks together.

Each knows its place from the environment. Without torchrun there is one process, and nothing here does anything.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, TypeVar

from .errors import InputError

if TYPE_CHECKING:  # Not all who name stages need it.
    import torch

T = TypeVar("T")

_PATIENCE = timedelta(days=7)  # that the others have while the first one works


def place() -> tuple[int, int]:
    """This process's number, and how many there are."""
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def is_first() -> bool:
    """Whether this is the process that works and writes."""
    return place()[0] == 0


@contextmanager
def joined(device: torch.device) -> Iterator[None]:
    """Brings the processes together; all but the first fall silent. On GPUs, each takes one of its own machine.

    Raises:
        InputError: a GPU that is named, or a machine with fewer GPUs than processes.
    """
    if place()[1] == 1:
        yield
        return
    import torch
    import torch.distributed as dist

    from .progress import be_quiet

    if device.index is not None:
        raise InputError(f"device is {device}, but torchrun gives each process a GPU of its own: choose device=cuda.")
    if device.type == "cuda":
        local, count = (int(os.environ.get(name, "0")) for name in ("LOCAL_RANK", "LOCAL_WORLD_SIZE"))
        if count > torch.cuda.device_count():
            raise InputError(
                f"torchrun has started {count} processes here for {torch.cuda.device_count()} GPUs: start one for each."
            )
        torch.cuda.set_device(local)
    if not is_first():
        be_quiet()
        logging.disable(logging.WARNING)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_PATIENCE)
    yield
    dist.barrier()  # Threads of one that leaves while another is still at it may end both processes.
    dist.destroy_process_group()  # After an error the process is to end, not to wait for the others.


def agreed(value: T) -> T:
    """What the first process says; the others wait for it."""
    if place()[1] == 1:
        return value
    import torch.distributed as dist

    said = [value]
    dist.broadcast_object_list(said)
    return said[0]


def add_up(tensors: Iterable[torch.Tensor]) -> None:
    """Replaces each process's tensors by their sums over all: the same numbers everywhere."""
    if place()[1] == 1:
        return
    import torch
    import torch.distributed as dist

    parts = list(tensors)
    whole = torch.cat([each.reshape(-1) for each in parts])
    dist.all_reduce(whole)
    for each, values in zip(parts, whole.split([each.numel() for each in parts]), strict=True):
        each.copy_(values.view_as(each))
