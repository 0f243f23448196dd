"""Named Warp modules, which are compiled only if used, and the streams of kernel launches."""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import torch
import warp as wp

_SETTINGS = Lock()  # Warp's settings are global to the process.


def named_module(part: str) -> wp.Module:
    """Returns the Warp module of kernels that are generated per law or per type, without Warp's own adjoints."""
    module = wp.get_module(f"{__package__}.{part}")
    wp.set_module_options({"enable_backward": False}, module)
    return module


@contextmanager
def shareable() -> Iterator[None]:
    """Loads Warp modules so that several CPU threads may launch their kernels concurrently.

    By default every launch registers its tile memory, which these kernels do not use, in a variable shared by all
    threads.
    """
    with _SETTINGS:
        before = wp.config.enable_tiles_in_stack_memory
        wp.config.enable_tiles_in_stack_memory = False
        try:
            yield
        finally:
            wp.config.enable_tiles_in_stack_memory = before


def launch_stream(device: torch.device) -> Any:
    """Returns torch's current stream for launches by Warp, None on a CPU."""
    if device.type == "cpu":
        return None
    handle = torch.cuda.current_stream(device).cuda_stream
    own = wp.get_device(str(device)).stream
    # Torch may use Warp's own stream; a second wp.Stream on its handle would destroy it when collected.
    return own if handle == own.cuda_stream else _stream(str(device), handle)


@functools.cache
def _stream(device: str, handle: int) -> Any:
    """Cached: Warp unregisters a stream with its object, and torch reuses a few streams."""
    return wp.Stream(device, cuda_stream=handle)
