"""Imports without garbage collection, here and in worker processes."""

import gc
import subprocess
import sys

from warp_resphys.io.imports import uncollected


def test_nothing_is_collected_meanwhile_and_what_was_made_is_old():
    gc.unfreeze()  # what runs in this process have frozen
    with uncollected():
        assert not gc.isenabled()
        made = [[] for _ in range(10)]
    assert gc.isenabled()
    young = {id(x) for generation in (0, 1) for x in gc.get_objects(generation)}
    assert not young & {id(x) for x in made}
    gc.disable()
    try:
        with uncollected():
            pass
        assert not gc.isenabled()  # as the caller had it
    finally:
        gc.enable()


def test_a_worker_begins_without_large_libraries():
    program = """
import gc, sys
from warp_resphys.io.children import begin_worker, end_imports
assert not {"torch", "numpy", "warp", "joblib", "hydra"} & {*sys.modules}
begin_worker(__import__("os").getppid())
assert not gc.isenabled()
end_imports()
assert gc.isenabled() and gc.get_freeze_count()
"""
    subprocess.run([sys.executable, "-c", program], check=True)
