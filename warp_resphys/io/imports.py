"""Imports without Python's garbage collector, whose searches of their objects take a quarter of their time."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def uncollected() -> Iterator[None]:
    """Spares the garbage collector the objects of modules that are imported meanwhile."""
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        if not gc.get_freeze_count():
            gc.freeze()
            gc.unfreeze()  # All objects are old now, which only a full collection searches.
        gc.enable()
