"""This process: imports without garbage collector, whose searches take a quarter
of their time, and end by SIGTERM.
"""

import gc
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collector_paused() -> Iterator[None]:
    """Spares the garbage collector the objects of modules that are imported meanwhile."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@contextmanager
def ends_as_after_ctrl_c() -> Iterator[None]:
    """Lets SIGTERM, by which clusters and containers end a process,
    act as Ctrl-C, unless the program handles it.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
