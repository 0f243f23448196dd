"""Tasks in several processes: results, lost workers, errors and interruption.

Workers import this module. Tasks that need torch or a simulator import it, as it takes most of the
start of a worker.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from warp_resphys.io.errors import InputError
from warp_resphys.io.fan_out import WorkerError, WorkerFaultError, Workers, fan_out


def wait_until(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def work(task):
    """Waits until a second worker has started."""
    import torch

    folder, number = task
    (folder / f"worker_{os.getpid()}").touch()
    wait_until(lambda: len([*folder.glob("worker_*")]) > 1)
    return os.getpid(), torch.get_num_threads(), 10 * number


def done(function, tasks, workers, folder):
    """Runs tasks; returns the results and the numbers of the finished tasks."""
    numbers = []
    return fan_out(function, tasks, workers, folder, numbers.append), numbers


@pytest.fixture(params=["local", pytest.param("dask", marks=pytest.mark.slow)])
def workers(request, monkeypatch):
    if request.param == "local":
        yield Workers(2)
        return
    distributed = pytest.importorskip("distributed")
    # Where workers find these functions.
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        yield Workers(2, cluster.scheduler_address)


def test_results_come_in_order_from_other_processes_on_one_thread_in_a_shared_folder(
    workers, tmp_path
):
    results, numbers = done(work, [(tmp_path, number) for number in range(1, 6)], workers, tmp_path)
    assert [result for _, _, result in results] == [10, 20, 30, 40, 50]
    assert sorted(numbers) == [0, 1, 2, 3, 4]
    assert len({process for process, _, _ in results} - {os.getpid()}) == 2
    assert {threads for _, threads, _ in results} == {1}
    with pytest.raises(WorkerError, match="choose a run folder that all workers share"):
        done(fails, [""], workers, tmp_path / "elsewhere")


def fails(task):
    if task == "bad input":
        raise InputError("this is refused.")
    if task == "fault":
        raise ZeroDivisionError("a fault of the program")
    if task == "killed":
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("task", "error", "message"),
    [
        pytest.param("bad input", WorkerError, "^this is refused.$", marks=pytest.mark.slow),
        pytest.param("fault", WorkerFaultError, "ZeroDivisionError", marks=pytest.mark.slow),
    ],
)
def test_an_error_ends_the_work(task, error, message, workers, tmp_path):
    with pytest.raises(error, match=message):
        done(fails, ["", task, ""], workers, tmp_path)


@pytest.mark.slow
def test_a_task_that_always_kills_its_worker_is_an_error(tmp_path):
    with pytest.raises(WorkerError, match="3 times in a row"):
        done(fails, ["", "killed"], Workers(2), tmp_path)


def dies_once(task):
    folder, number = task
    if number == 1 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


@pytest.mark.slow
def test_the_task_of_a_killed_worker_is_repeated(workers, tmp_path):
    results, numbers = done(
        dies_once, [(tmp_path, number) for number in range(4)], workers, tmp_path
    )
    assert results == [0, 1, 4, 9]
    assert (tmp_path / "died").exists()
    assert sorted(numbers) == [0, 1, 2, 3]


def test_nothing_to_do(tmp_path):
    assert done(work, [], Workers(2), tmp_path) == ([], [])


def test_dask_that_is_not_installed(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        InputError,
        match=r"parallel\.address=tcp://head:8786 needs a package.*'warp-resphys\[cluster\]'",
    ):
        done(work, [1], Workers(2, "tcp://head:8786"), tmp_path)


def test_an_address_that_nobody_answers_at(tmp_path):
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match=r"parallel\.address=tcp://127\.0\.0\.1:9"):
        done(work, [1], Workers(2, "tcp://127.0.0.1:9"), tmp_path)


def interrupts_itself(task):
    os.kill(os.getpid(), signal.SIGINT)
    return "continues"


@pytest.mark.slow
def test_workers_leave_ctrl_c_to_their_parent(tmp_path):
    assert done(interrupts_itself, [0, 1, 2], Workers(2), tmp_path)[0] == ["continues"] * 3


HELD = []


def keeps_memory(number):
    """Holds 200 MB until loky looks at the memory, once a second."""
    HELD[:] = [b"x" * 200_000_000]
    time.sleep(1.1)
    return os.getpid()


@pytest.mark.slow
def test_workers_with_all_imports_go_on(tmp_path):
    """loky ends workers whose memory grows by 300 MB after their first call."""
    assert len({*done(keeps_memory, range(6), Workers(2), tmp_path)[0]}) <= 2


def works_or_waits(task):
    folder, waits = task
    (folder / f"process_{os.getpid()}").touch()
    wait_until(lambda: len([*folder.glob("process_*")]) > 1)
    while not waits:
        pass
    time.sleep(300.0)


def lives(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_parent(tmp_path, sent):
    """Even if it is killed: otherwise they would write to the files of a run that resumes."""
    program = "from test_fan_out import *\nfolder = Path(sys.argv[1])\n"
    program += "fan_out(works_or_waits, [(folder, False), (folder, True)], Workers(2), folder)"
    command = [sys.executable, "-c", program, str(tmp_path)]
    parent = subprocess.Popen(command, cwd=Path(__file__).parent, stderr=subprocess.PIPE)
    wait_until(lambda: len([*tmp_path.glob("process_*")]) == 2)
    workers = [int(path.name.removeprefix("process_")) for path in tmp_path.glob("process_*")]
    parent.send_signal(sent)
    assert "leaked" not in parent.communicate()[1].decode() or sent == signal.SIGKILL
    wait_until(lambda: not any(map(lives, workers)))


@pytest.mark.slow
def test_workers_repeat_no_warning_of_warp():
    code = (
        "import os; from warp_resphys.io.fan_out import _begin_work; "
        "_begin_work(); os.write(2, b'own message')"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (ended.stdout, ended.stderr) == ("", "own message")
