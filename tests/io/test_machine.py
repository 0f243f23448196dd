"""What a result says about the machine and the code that made it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from warp_resphys.io.machine import commit, hardware

REPOSITORY = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen on this system")
def test_cores_are_those_that_the_process_may_use():
    core = min(os.sched_getaffinity(0))
    program = "from warp_resphys.io import machine; print(machine.available_cores(), machine.hardware()['cores used'])"
    command = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, [{core}]); {program}"]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert out == f"1 1 of {os.cpu_count()}\n"
    assert hardware()["processor"]


def test_the_commit_is_that_of_the_repository():
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if head.returncode:
        assert commit() is None
    else:
        assert head.stdout.startswith(str(commit()).partition(" ")[0])
