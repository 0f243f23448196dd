"""Start and end of worker processes.

They import this module before any large library, so that it imports none itself.
"""

import gc
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

_PARENT_SECONDS = 0.02  # interval at which a worker checks that its parent process lives


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Blocks Ctrl-C in processes that start meanwhile."""
    if not hasattr(signal, "pthread_sigmask"):  # On Windows, Ctrl-C reaches the workers as well.
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin_worker(parent: int) -> None:
    """Begins a worker process: it ends with its parent, and collects no garbage until `end_imports`."""
    gc.disable()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def end_imports() -> None:
    """Collects garbage again, but not in the modules that this process has imported."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
