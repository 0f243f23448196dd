"""Warp modules, of which a run compiles those it launches from, and the streams that kernels run on."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import torch
import warp as wp

_SETTINGS = Lock()  # Warp has them for the whole process.


def named_module(part: str) -> wp.Module:
    """Returns the Warp module of a part that is made more than once, by law or by type; nothing is differentiated."""
    module = wp.get_module(f"{__package__}.{part}")
    wp.set_module_options({"enable_backward": False}, module)
    return module


@contextmanager
def shareable() -> Iterator[None]:
    """Warp modules that are loaded meanwhile may be launched by several threads at once, on a CPU.

    Otherwise every launch would register the place of its tiles, which these kernels do not use, in a variable that
    all threads share.
    """
    with _SETTINGS:
        before = wp.config.enable_tiles_in_stack_memory
        wp.config.enable_tiles_in_stack_memory = False
        try:
            yield
        finally:
            wp.config.enable_tiles_in_stack_memory = before


def launch_stream(device: torch.device) -> Any:
    """Torch's current stream, for launches by Warp; None on a CPU."""
    if device.type == "cpu":
        return None
    handle = torch.cuda.current_stream(device).cuda_stream
    own = wp.get_device(str(device)).stream
    # Torch may work on Warp's own stream, which a second object for it would take from Warp when it goes.
    return own if handle == own.cuda_stream else _stream(str(device), handle)


@functools.cache
def _stream(device: str, handle: int) -> Any:
    """Kept, as Warp forgets a stream of torch's with its object, and torch uses few of them again and again."""
    return wp.Stream(device, cuda_stream=handle)
