"""Work in several processes: what comes back, and how it ends."""

import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
import torch

from warp_resphys.io.errors import InputError
from warp_resphys.io.processes import WorkerError, in_processes


def work(task, advance):
    if task == "bad input":
        raise InputError("this cannot be simulated: take another.")
    if task == "fault":
        raise ZeroDivisionError("nothing that a user can mend")
    if task == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    advance(task, rest=task % 2)
    return os.getpid(), torch.get_num_threads(), 10 * task


def done(tasks, processes):
    counted = []
    with closing(in_processes(work, tasks, processes, lambda count, rest: counted.append((count, rest)))) as results:
        return dict(results), counted


def test_each_task_is_done_once_in_other_processes_on_one_thread():
    results, counted = done([1, 2, 3, 4, 5], 2)
    assert {number: result[2] for number, result in results.items()} == {0: 10, 1: 20, 2: 30, 3: 40, 4: 50}
    assert sorted(counted) == [(1, 1), (2, 0), (3, 1), (4, 0), (5, 1)]
    assert os.getpid() not in {result[0] for result in results.values()}
    assert len({result[0] for result in results.values()}) == 2
    assert {result[1] for result in results.values()} == {1}


@pytest.mark.parametrize(
    ("task", "error", "message"),
    [
        ("bad input", WorkerError, "^this cannot be simulated: take another.$"),
        ("fault", RuntimeError, "ZeroDivisionError: nothing that a user can mend"),
        ("killed", WorkerError, "a worker process was ended from outside .exit code -9., perhaps for want of memory"),
    ],
)
def test_an_error_ends_all_of_them(task, error, message):
    with pytest.raises(error, match=message) as caught:
        done([2, task, 4], 2)
    assert isinstance(caught.value, WorkerError) == (error is WorkerError)


def test_nothing_to_do():
    assert done([], 2) == ({}, [])


def ignores_interrupts(task, advance):
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def takes_memory(task, advance):
    return len(b"x" * int(task * 2**30))


def test_no_worker_sees_an_interrupt():
    program = "from test_processes import *\n"
    program += "print(sorted(in_processes(ignores_interrupts, [0, 1, 2], 3, print)))"
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    assert found.stdout.splitlines()[-1] == "[(0, True), (1, True), (2, True)]"


def test_a_worker_tells_its_own_memory_not_that_of_its_parent():
    program = "from warp_resphys.io.memory import *\n"
    program += "from test_processes import *\n"
    program += "held = b'x' * 3 * 2**30; del held\n"
    program += "memory = WorkersMemory(); list(in_processes(takes_memory, [0.1, 0.5, 0.2], 1, print, memory))\n"
    program += "print(peak_memory_gib(), memory.gib)"
    found = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    own, workers = map(float, found.stdout.splitlines()[-1].split())
    assert own > 3.0
    assert 0.5 < workers < 2.0
