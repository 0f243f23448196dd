"""Named Warp modules, which are compiled only if used,
the streams of launches, and Warp in several threads.

Warp's settings, modules and captures are global to the process: while a thread makes kernels,
records a launch or captures a graph, no other one may launch.
"""

import functools
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any, Final, TypeVar

import torch
import warp as wp

T = TypeVar("T")

_WARP = RLock()


def generated(make: Callable[..., T]) -> Callable[..., T]:
    """Decorates a function that makes kernels: every result is made once, by one thread."""
    cached = functools.cache(make)

    @functools.wraps(make)
    def locked(*arguments: Any) -> T:
        with _WARP:
            return cached(*arguments)

    return locked


def named_module(part: str) -> wp.Module:
    """Returns the Warp module of kernels that are generated per law or per type,
    without Warp's own adjoints.
    """
    module = wp.get_module(f"{__package__}.{part}")
    wp.set_module_options({"enable_backward": False}, module)
    return module


@contextmanager
def shareable() -> Iterator[None]:
    """Lets one thread at a time load Warp modules, such
    that several CPU threads may launch their kernels concurrently.

    By default every launch registers its tile memory, which these kernels do not use, in a variable
    shared by all threads.
    """
    with _WARP:
        before = wp.config.enable_tiles_in_stack_memory
        wp.config.enable_tiles_in_stack_memory = False
        try:
            yield
        finally:
            wp.config.enable_tiles_in_stack_memory = before


def compile_together(kernels: Iterable[Any], device: torch.device, block: int) -> None:
    """Compiles the modules of kernels side by side, where each would wait for its first launch.

    Args:
        kernels: kernels of modules that are complete.
        device: of their launches.
        block: threads per block of their launches.
    """
    _compile_together(tuple({kernel.module: None for kernel in kernels}), str(device), block)


@functools.cache
def _compile_together(modules: tuple[Any, ...], device: str, block: int) -> None:
    with shareable():
        wp.force_load(device, list(modules), block_dim=block)


class RecordedLaunch:
    """A recorded launch of Warp, which waits while another thread captures.

    Locks would cost several percent of a step: threads enter themselves in a list, in one
    instruction of Python.
    """

    _running: Final = list[None]()  # an entry for every launch
    _captured = False  # whether a thread captures, or waits for launches to end

    def __init__(self, command: Any) -> None:
        self._command = command

    def launch(self, stream: Any = None) -> None:
        """Launches the kernel."""
        running = RecordedLaunch._running
        running.append(None)
        if RecordedLaunch._captured:
            running.pop()
            with _WARP:  # locked by the thread that captures, which may launch
                running.append(None)
        try:
            self._command.launch(stream)
        finally:
            running.pop()

    @classmethod
    def forked(cls) -> None:
        """Lets a forked process begin, which has one thread."""
        cls._running.clear()
        _WARP.release()

    @classmethod
    @contextmanager
    def captured(cls, device: torch.device) -> Iterator[Any]:
        """Captures the launches of this thread, when those of others have ended."""
        with _WARP:
            cls._captured = True
            try:
                while cls._running:
                    time.sleep(1e-5)
                with wp.ScopedCapture(device=str(device)) as capture:
                    yield capture
            finally:
                cls._captured = False


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_WARP.acquire, after_in_parent=_WARP.release, after_in_child=RecordedLaunch.forked
    )


def launch_stream(device: torch.device) -> Any:
    """Returns torch's current stream for launches by Warp, None on a CPU."""
    if device.type == "cpu":
        return None
    handle = torch.cuda.current_stream(device).cuda_stream
    of_warp = wp.get_device(str(device)).stream
    # Torch may use Warp's stream; a second wp.Stream on its handle would destroy it when collected.
    return of_warp if handle == of_warp.cuda_stream else _stream(str(device), handle)


@functools.cache
def _stream(device: str, handle: int) -> Any:
    """Returns a stream.

    Cached, as Warp unregisters a stream with its object, and torch reuses a few.
    """
    return wp.Stream(device, cuda_stream=handle)
