"""A simulator in threads and processes: every call returns what it returns alone.

Copies give the same motion.
"""

import copy
import io
import multiprocessing
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import (
    Body,
    Contact,
    Corotated,
    HalfSpace,
    Inputs,
    Simulator,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.energies.convex_material import ConvexMaterial

MESH = box_hexahedra((0.1, 0.02, 0.02), (6, 2, 2))
CLOSE = {"rtol": 1e-6, "atol": 1e-12}  # arrays elsewhere in memory may be added up in another order
TIP = select_vertices(MESH, x=0.1)
FLOOR = Contact({"floor": HalfSpace(position=(0.0, 0.0, -0.002))}, distance=0.001, friction=0.3)


def simulator(*energies):
    return Simulator(
        clamped(MESH, energies=energies), Corotated(100e3, 0.45, stiffness_damping=2e-3)
    )


def loss(sim, number, modulus):
    """The height of the tip after some steps and in an equilibrium, under a load of its own."""
    load = torch.zeros(1, len(MESH.vertices), 3, dtype=torch.float64)
    load[0, TIP, 2] = -1e-4 * number
    values = {"youngs_modulus": modulus}
    state = sim.static_equilibrium(Inputs(0.1 * load), values)
    return sim.rollout(state, 4, Inputs(load), values).q[-1, 0, TIP, 2].mean()


def results(sim, number):
    modulus = torch.tensor([100e3], dtype=torch.float64, requires_grad=True)
    height = loss(sim, number, modulus)
    height.backward()
    return height.item(), modulus.grad.item()


@pytest.mark.parametrize(("count", "energies"), [(2, (FLOOR,)), (4, ())])
def test_threads_have_the_results_of_one(count, energies):
    """Forward and backward, as each has its own buffers, starts and factors."""
    sim = simulator(*energies)
    alone = [results(sim, number) for number in range(8)]
    assert len(set(alone)) == 8
    with ThreadPoolExecutor(count) as pool:
        np.testing.assert_allclose(
            list(pool.map(lambda number: results(sim, number), range(8))), alone, **CLOSE
        )
    assert 1 < len({thread for thread, *_ in sim._equations.workspaces}) <= count + 1


def test_a_gradient_in_another_thread_does_not_disturb_a_step():
    """A backward pass needs the buffers of the forward pass, whose thread goes on."""
    sim = simulator()
    moduli = [torch.tensor([100e3], dtype=torch.float64, requires_grad=True) for _ in range(8)]
    alone = [results(sim, number) for number in range(8)]
    with ThreadPoolExecutor(1) as pool:
        heights, waiting = [], []
        for number, modulus in enumerate(moduli):
            heights.append(loss(sim, number, modulus))
            waiting.append(pool.submit(heights[-1].backward))
        for future in waiting:
            future.result()
    for height, modulus, expected in zip(heights, moduli, alone, strict=True):
        np.testing.assert_allclose((height.item(), modulus.grad.item()), expected, **CLOSE)


FIRST_USE = """
import numpy as np
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from core.dynamics.test_threads import CLOSE, FLOOR, results, simulator
together = Barrier(4)
def first(number):
    together.wait()
    return results(shared if number % 2 else simulator(FLOOR), 3)
shared = simulator(FLOOR)
with ThreadPoolExecutor(4) as pool:
    np.testing.assert_allclose([*pool.map(first, range(4))], [results(shared, 3)] * 4, **CLOSE)
"""


@pytest.mark.slow
def test_the_first_use_may_be_in_several_threads(pytestconfig):
    """Warp loads modules and captures graphs for the whole process:
    of one simulator and of several.
    """
    folder = pytestconfig.rootpath / "tests"
    command = [sys.executable, "-c", FIRST_USE]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux")
@pytest.mark.parametrize("divisions", [(6, 2, 2), (24, 12, 12)])
def test_a_forked_process_uses_the_simulator(divisions, monkeypatch):
    """With threads for the shards of a batch, and those of torch for a large body,
    neither of which it inherits.
    """
    monkeypatch.setenv("WARP_RESPHYS_THREADS", "2")
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    mesh = box_hexahedra((0.1, 0.02, 0.02), divisions)
    sim = Simulator(clamped(mesh), Corotated(100e3, 0.45))
    batch = 4 if len(mesh.vertices) < 1000 else 1

    def motion():
        return sim.step(sim.rest_state(batch)).q

    here = motion()
    (end, other), context = multiprocessing.Pipe(duplex=False), multiprocessing.get_context("fork")
    child = context.Process(target=lambda: other.send(motion().numpy()))
    try:
        child.start()
        assert end.poll(60)
        torch.testing.assert_close(torch.as_tensor(end.recv()), here, rtol=0.0, atol=1e-12)
    finally:
        child.kill()
        torch.set_num_threads(before)


def saved(thing):
    file = io.BytesIO()
    torch.save(thing, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


WAYS = {
    "pickle": lambda x: pickle.loads(pickle.dumps(x)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "save": saved,
}


@pytest.mark.parametrize("way", WAYS)
def test_copies_of_laws(way):
    """Their kernels, which are made for their terms, belong to a process."""
    law = ConvexMaterial(c10=30e3, bulk_1=1e6, ogden={3: 2e3})
    body = Body(box_hexahedra(divisions=(2, 1, 1)), fixed=[0, 1, 2, 3])
    expected = Simulator(body, law).static_equilibrium().q
    copied = Simulator(body, WAYS[way](law)).static_equilibrium().q
    torch.testing.assert_close(copied, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("way", WAYS)
def test_copies_of_bodies_states_and_motions(way):
    sim = simulator(FLOOR)
    motion = sim.rollout(sim.static_equilibrium(), 3)
    body, final, copied = (WAYS[way](thing) for thing in (sim.body, motion.final, motion))
    assert torch.equal(copied.q, motion.q)
    assert list(final.memory) == list(motion.final.memory)
    again = Simulator(body, sim.material)
    torch.testing.assert_close(again.step(final).q, sim.step(motion.final).q, rtol=0.0, atol=1e-12)
