"""Work in several processes: what comes back, what is lost and done again, and how it ends."""

import os
import signal
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from warp_resphys.dynamics.simulator import Simulator
from warp_resphys.energies.materials import make_material
from warp_resphys.fem.body import Body
from warp_resphys.io.errors import InputError
from warp_resphys.io.fan_out import WorkerError, WorkerFaultError, Workers, fan_out
from warp_resphys.mesh.mesh import box_hexahedra, select_vertices

CLUSTERS = {"ray": "ray", "dask": "distributed"}


def work(task, advance):
    if task == "bad input":
        raise InputError("this cannot be simulated: take another.")
    if task == "fault":
        raise ZeroDivisionError("nothing that a user can mend")
    if task == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    advance(task, rest=task % 2)
    time.sleep(0.3)
    return os.getpid(), torch.get_num_threads(), 10 * task


def done(tasks, workers, folder, function=work):
    counted = []

    def advance(count=1, **fields):
        counted.append((count, fields))

    with closing(fan_out(function, tasks, workers, advance, folder)) as results:
        return dict(results), counted


@pytest.fixture(params=["local", *CLUSTERS])
def workers(request, monkeypatch):
    if request.param in CLUSTERS:
        pytest.importorskip(CLUSTERS[request.param])
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # where they find these functions
    return Workers(2, request.param)


def test_each_task_is_done_once_in_other_processes_on_one_thread(workers, tmp_path):
    results, counted = done([1, 2, 3, 4, 5], workers, tmp_path)
    assert {number: result[2] for number, result in results.items()} == {0: 10, 1: 20, 2: 30, 3: 40, 4: 50}
    assert sorted((count, fields["rest"]) for count, fields in counted) == [(1, 1), (2, 0), (3, 1), (4, 0), (5, 1)]
    assert os.getpid() not in {result[0] for result in results.values()}
    assert len({result[0] for result in results.values()}) == 2
    assert {result[1] for result in results.values()} == {1}
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("task", "error", "message"),
    [
        ("bad input", WorkerError, "^this cannot be simulated: take another.$"),
        ("fault", WorkerFaultError, "ZeroDivisionError: nothing that a user can mend"),
    ],
)
def test_an_error_ends_all_of_them(task, error, message, workers, tmp_path):
    with pytest.raises(error, match=message):
        done([2, task, 4], workers, tmp_path)


def test_one_that_kills_its_worker_again_and_again_is_given_up(tmp_path):
    with pytest.raises(WorkerError, match="ended from outside 3 times in a row, perhaps for want of memory"):
        done([2, "killed"], Workers(2), tmp_path)


def dies_once(task, advance):
    """Counts to three, and dies in between if it has not died before."""
    folder, number = task
    for at in range(3):
        advance()
        if number == 1 and at == 1 and not (folder / "died").exists():
            (folder / "died").touch()
            time.sleep(0.5)  # until its progress was seen
            os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def test_what_a_killed_worker_had_is_done_again(workers, tmp_path):
    place = tmp_path / "progress"
    place.mkdir()
    results, counted = done([(tmp_path, number) for number in range(4)], workers, place, dies_once)
    assert (tmp_path / "died").exists()
    assert results == {0: 0, 1: 1, 2: 4, 3: 9}
    counts = [count for count, _ in counted]
    assert sum(counts) == 12
    assert min(counts) == -2


def test_nothing_to_do(tmp_path):
    assert done([], Workers(2), tmp_path) == ({}, [])


@pytest.mark.parametrize("backend", [*CLUSTERS])
def test_a_cluster_that_is_not_there(backend, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, CLUSTERS[backend], None)
    with pytest.raises(InputError, match=f"parallel.backend is {backend}, which is not installed: run pip install"):
        done([1], Workers(2, backend), tmp_path)


@pytest.mark.parametrize(("backend", "address"), [("ray", "127.0.0.1:9"), ("dask", "tcp://127.0.0.1:9")])
def test_an_address_that_nobody_answers_at(backend, address, tmp_path):
    pytest.importorskip(CLUSTERS[backend])
    with pytest.raises(InputError, match=f"no {backend} cluster answers at parallel.address={address}"):
        done([1], Workers(2, backend, address), tmp_path)


def ignores_interrupts(task, advance):
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def takes_memory(task, advance):
    return len(b"x" * int(task * 2**30))


def told(program, folder):
    """What a program prints that has imported all of this."""
    lines = "from pathlib import Path\nfrom test_fan_out import *\n" + program
    run = subprocess.run(
        [sys.executable, "-c", lines, str(folder)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    )
    return run.stdout.splitlines()[-1]


def test_no_worker_sees_an_interrupt(tmp_path):
    found = told(
        "print(sorted(fan_out(ignores_interrupts, [0, 1, 2], Workers(3), print, Path(sys.argv[1]))))", tmp_path
    )
    assert found == "[(0, True), (1, True), (2, True)]"


def test_a_worker_tells_its_own_memory_not_that_of_its_parent_or_of_work_before(tmp_path):
    program = "from warp_resphys.io.memory import *\n"
    program += "held = b'x' * 3 * 2**30; del held\n"
    program += "def gib(*tasks):\n"
    program += "    memory = WorkersMemory()\n"
    program += "    list(fan_out(takes_memory, tasks, Workers(1), print, Path(sys.argv[1]), memory))\n"
    program += "    return memory.gib\n"
    program += "print(peak_memory_gib(), gib(1.0, 0.1), gib(0.1))"
    own, workers, later = map(float, told(program, tmp_path).split())
    assert own > 3.0
    assert 1.0 < workers < 2.5
    assert later < 1.0


def test_workers_end_with_their_parent(tmp_path):
    """Even if that is killed: nobody else may write to the files of who comes after."""
    program = "from test_fan_out import *\nfrom pathlib import Path\n"
    program += "list(fan_out(works_on, [Path(sys.argv[1])] * 2, Workers(2), print, Path(sys.argv[1])))"
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], cwd=Path(__file__).parent)
    deadline = time.monotonic() + 60.0
    while len([*tmp_path.glob("alive_*")]) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    parent.kill()
    parent.wait()
    time.sleep(1.0)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("alive_*")}
    time.sleep(1.0)
    assert len(before) == 2
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.glob("alive_*")}


def test_workers_that_wait_or_tell_nothing_end_with_their_parent(tmp_path):
    program = "from test_fan_out import *\nfrom pathlib import Path\n"
    program += "list(fan_out(ponders, [(Path(sys.argv[1]), each) for each in (0.0, 300.0)], Workers(2), print, "
    program += "Path(sys.argv[1])))"
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], cwd=Path(__file__).parent)
    deadline = time.monotonic() + 60.0
    while len([*tmp_path.glob("ponders_*")]) < 2 and time.monotonic() < deadline:
        time.sleep(0.1)
    workers = [int(path.name.removeprefix("ponders_")) for path in tmp_path.glob("ponders_*")]
    assert len(workers) == 2
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20.0
    while any(map(lives, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(lives, workers))


def lives(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def ponders(task, advance):
    folder, seconds = task
    (folder / f"ponders_{os.getpid()}").touch()
    while len([*folder.glob("ponders_*")]) < 2:  # One for each.
        time.sleep(0.01)
    time.sleep(seconds)


def works_on(folder, advance):
    for _ in range(1000):
        (folder / f"alive_{os.getpid()}").write_text(str(time.time_ns()))
        advance()
        time.sleep(0.1)


def falls(steps, advance):
    """Where a beam is after so many steps, which a worker computes."""
    mesh = box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2))
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0))
    simulator = Simulator(body, make_material("corotated", youngs_modulus=2e5, poissons_ratio=0.45, density=1e3), 0.01)
    advance()
    return simulator.rollout(simulator.rest_state(), steps).q[-1].numpy()


@contextmanager
def cluster_of_two_nodes(backend):
    """The address of a cluster that was there before the work."""
    if backend == "ray":
        cluster = pytest.importorskip("ray.cluster_utils").Cluster()
        try:
            for _ in range(2):
                cluster.add_node(num_cpus=1)
            yield cluster.address
        finally:
            cluster.shutdown()
        return
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


@pytest.mark.parametrize("backend", [*CLUSTERS])
def test_a_cluster_finds_what_one_process_finds(backend, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    with cluster_of_two_nodes(backend) as address:
        found, counted = done([1, 2, 3, 4], Workers(2, backend, address), tmp_path, falls)
    assert sum(count for count, _ in counted) == 4
    for number, q in found.items():
        np.testing.assert_allclose(q, falls(1 + number, lambda: None), rtol=0, atol=1e-12)
