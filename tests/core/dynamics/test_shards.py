"""A batch is what its environments are one by one, whatever threads share it,
and solves on a device those of a CPU.
"""

import time
from threading import get_ident

import pytest
import torch

from support.clamped import clamped
from warp_resphys import (
    Inputs,
    Simulator,
    SolverSettings,
    State,
    box_hexahedra,
    box_tetrahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.assembly import HessianAssembly
from warp_resphys.core.dynamics.gradient_check import pose
from warp_resphys.core.dynamics.minimiser import Minimiser
from warp_resphys.core.energies.launcher import Launcher
from warp_resphys.core.energies.materials import Corotated
from warp_resphys.core.energies.potential import IncrementalPotential
from warp_resphys.core.linalg.threads import in_threads, shards_of, thread_count, threads_for
from warp_resphys.io.errors import ConvergenceError

MESH = box_hexahedra((0.06, 0.02, 0.02), (4, 2, 2))
BODY = clamped(MESH)
SIZE, STEPS = 7, 6


def threads(monkeypatch, count):
    monkeypatch.setenv("WARP_RESPHYS_THREADS", str(count))


def simulator(**settings):
    material = Corotated(1e5, 0.45, density=1000.0, stiffness_damping=1e-3)
    return Simulator(
        BODY, material, solver=SolverSettings(**({"relative_tolerance": 1e-5} | settings))
    )


@pytest.fixture
def motion():
    """A start, forces and a modulus that differ from one environment to the next,
    none as hard as the other.
    """
    sim = simulator()
    generator = torch.Generator().manual_seed(0)
    start = pose(sim, "bent", SIZE)
    growth, rest = torch.linspace(0.0, 1.2, SIZE)[:, None, None], sim.rest_positions
    start = State(rest + growth * (start.q - rest), start.v)
    forces = (
        2.5e-3
        * growth
        * torch.randn(STEPS, *start.q.shape, generator=generator, dtype=torch.float64)
    )
    modulus = 1e5 * (1.0 + torch.rand(SIZE, 1, generator=generator, dtype=torch.float64))
    return start, forces, modulus


def rolled(motion, rows, **settings):
    start, forces, modulus = motion
    state = State(start.q[rows], start.v[rows])
    return simulator(**settings).rollout(
        state, STEPS, Inputs(forces[:, rows]), {"youngs_modulus": modulus[rows]}
    )


@pytest.mark.parametrize(
    ("name", "linear_solver"),
    [("newton", "sparse"), ("quasi_newton", "tiled"), ("quasi_newton", "banded")],
)
def test_an_environment_does_what_it_does_alone(motion, name, linear_solver):
    """Its directions, line searches and factors are its own: nothing depends on its neighbours."""
    settings = {"name": name, "linear_solver": linear_solver}
    together = rolled(motion, slice(None), **settings)
    counts = torch.stack([r.iterations for r in together.reports])
    made = torch.stack([r.factorisations for r in together.reports])
    assert len(set(counts.sum(0).tolist())) > 2
    assert len(set(made.sum(0).tolist())) > 2
    for i in range(SIZE):
        alone = rolled(motion, slice(i, i + 1), **settings)
        torch.testing.assert_close(alone.q[:, 0], together.q[:, i], rtol=0.0, atol=1e-13)
        assert counts[:, i].tolist() == [int(r.iterations) for r in alone.reports]
        assert made[:, i].tolist() == [int(r.factorisations) for r in alone.reports]


@pytest.mark.parametrize(("count", "linear_solver"), [(2, "banded"), (3, "tiled")])
def test_threads_change_nothing(motion, monkeypatch, count, linear_solver):
    results = []
    for number in (1, count):
        threads(monkeypatch, number)
        sim = simulator(linear_solver=linear_solver)
        assert len(sim.workspace(SIZE).shards) == (0 if number == 1 else count)
        start, forces, modulus = motion
        leaves = [
            t.clone().requires_grad_()
            for t in (start.q, start.v, forces, modulus, torch.tensor([1000.0]).double())
        ]
        q, v, f, e, density = leaves
        trajectory = sim.rollout(
            State(q, v), STEPS, Inputs(f), {"youngs_modulus": e, "density": density}
        )
        gradients = torch.autograd.grad(
            trajectory.q[-1].square().sum() + trajectory.v[-1].sum(), leaves
        )
        report = trajectory.reports[-1]
        results.append((trajectory.q, report.iterations, report.relative_residual, *gradients))
    shards = [own.potential for _, own in sim.workspace(SIZE).shards]
    assert not any(potential.positions.requires_grad for potential in shards)
    for one, several in zip(*results, strict=True):
        torch.testing.assert_close(several, one, rtol=1e-12, atol=1e-14)


def test_a_failure_in_a_thread_names_the_environment_of_the_batch(motion, monkeypatch):
    threads(monkeypatch, 3)
    start = motion[0]
    v = start.v.clone()
    v[5] += 1e3
    with pytest.raises(ConvergenceError, match=f"in environment 5 of {SIZE}") as caught:
        simulator(max_iterations=25).step(State(start.q, v))
    assert caught.value.positions.shape == start.q.shape
    assert caught.value.report.converged.tolist() == [i != 5 for i in range(SIZE)]


@pytest.mark.parametrize("failing", [0, 2])
def test_what_a_thread_raises_comes_when_all_have_ended(failing, monkeypatch):
    threads(monkeypatch, 3)
    ended = []

    def work(number):
        if number == failing:
            raise ValueError(f"from {number}")
        time.sleep(0.2)
        ended.append(number)

    with pytest.raises(ValueError, match=f"from {failing}"):
        in_threads(work, range(3))
    assert sorted(ended) == sorted({0, 1, 2} - {failing})


def test_results_are_in_the_order_of_the_shards(monkeypatch):
    threads(monkeypatch, 2)
    assert in_threads(lambda number: number, range(5)) == [*range(5)]


def test_shards_are_not_shared_again(monkeypatch):
    threads(monkeypatch, 4)
    inner = in_threads(
        lambda _: (shards_of(8, torch.device("cpu")), in_threads(lambda n: n, [1, 2])), range(3)
    )
    assert inner == [([], [1, 2])] * 3
    assert len(shards_of(8, torch.device("cpu"))) == 4


@pytest.fixture
def three_torch_threads(monkeypatch):
    monkeypatch.delenv("WARP_RESPHYS_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_torch_threads")
def test_a_batch_is_shared_by_as_many_threads_as_torch_has(motion, monkeypatch):
    """Although torch has a single one while they work."""
    used, solve = set(), Minimiser.solve
    monkeypatch.setattr(Minimiser, "solve", lambda *given: used.add(get_ident()) or solve(*given))
    rolled(motion, slice(None))
    assert len(used) > 1
    assert torch.get_num_threads() == thread_count() == 3
    with threads_for(1):
        assert torch.get_num_threads() == 1
        with threads_for(1, shards=2):
            # Also in steps within a reconstruction's.
            assert len(simulator().workspace(SIZE).shards) == 3
        assert thread_count() == 3
    torch.set_num_threads(2)
    assert thread_count() == 2


def test_a_simulator_first_used_within_a_shard_shares_later_batches(monkeypatch):
    threads(monkeypatch, 2)
    sim = simulator()
    assert in_threads(lambda _: len(sim.workspace(SIZE).shards), range(2)) == [0, 0]
    assert len(sim.workspace(SIZE).shards) == 2


@pytest.mark.parametrize(
    ("name", "limit"), [("quasi_newton", 1), ("newton", 2), ("projective_dynamics", 3)]
)
def test_no_environment_has_more_iterations_than_the_limit(name, limit):
    sim = simulator(name=name, max_iterations=limit, on_failure="count")
    rest = sim.rest_state(3)
    q, tip = rest.q.clone(), torch.as_tensor(select_vertices(MESH, x=0.06))
    q[1, tip, 0] -= 0.04
    q[2, tip] *= 1e6
    assert int(sim.step(State(q, rest.v)).report.iterations.max()) <= limit


def test_shards_cover_the_batch(monkeypatch):
    cpu = torch.device("cpu")
    threads(monkeypatch, 4)
    assert shards_of(3, cpu) == []
    assert shards_of(64, torch.device("cuda")) == []
    for batch in (4, 9, 64):
        rows = shards_of(batch, cpu)
        assert [i for part in rows for i in range(batch)[part]] == list(range(batch))
        assert len(rows) == min(4, batch // 2)
        large = shards_of(batch, cpu, 3_000)
        assert [i for part in large for i in range(batch)[part]] == list(range(batch))
        assert len(large) == batch


MATERIAL = Corotated(1e5, 0.45, density=1000.0, stiffness_damping=1e-3)


def on_device(name, device, material=MATERIAL, **settings):
    chosen = SolverSettings(
        name=name, linear_solver="tiled", **({"relative_tolerance": 1e-9} | settings)
    )
    return Simulator(BODY, material, solver=chosen, device=device)


def bent(s):
    return pose(s, "bent", 3)


def compressed(s):
    """To two fifths of its length in the second environment, where its Hessian is indefinite."""
    state = s.rest_state(3)
    state.q[1, :, 0] *= 0.4
    return state


def far(s):
    """Ten metres from the origin rounding leaves more than 1e-13 of the residual."""
    state = pose(s, "bent", 3)
    return State(state.q + 10.0, state.v)


@pytest.fixture
def host(monkeypatch):
    """Runs a function with the host in the loop."""

    def run(function):
        with monkeypatch.context() as patch:
            patch.setattr(Minimiser, "_runs_on_device", False)
            return function()

    return run


@pytest.mark.parametrize(
    ("name", "start", "tolerance", "factors"),
    [
        ("quasi_newton", bent, 1e-9, "single"),
        ("quasi_newton", far, 1e-13, "double"),
        ("newton", compressed, 1e-9, "double"),
        ("newton", bent, 1e-9, "single"),
    ],
)
def test_the_loop_on_the_device_is_that_of_the_host(name, start, tolerance, factors, host, device):
    def rolled():
        s = on_device(
            name, device, relative_tolerance=tolerance, factors=factors, max_iterations=500
        )
        trajectory = s.rollout(start(s), 8)
        return trajectory.final, trajectory.reports

    trajectory, reports = rolled()
    expected, expected_reports = host(rolled)
    torch.testing.assert_close(trajectory.q, expected.q, rtol=0.0, atol=0.0)
    for one, other in zip(reports, expected_reports, strict=True):
        assert one.iterations.tolist() == other.iterations.tolist()
        assert one.factorisations.tolist() == other.factorisations.tolist()
        assert bool(one.converged.all())


def test_an_indefinite_hessian_is_clamped_where_it_is(host, device):
    def begun():
        s = on_device("newton", device, factors="single", max_iterations=1, on_failure="count")
        state = s.step(compressed(s))
        return state.q, s.workspace(3).minimiser("dynamics", s.settings).hessian.clamped.tolist()

    (q, clamped), (expected, expected_clamped) = begun(), host(begun)
    assert clamped == expected_clamped == [False, True, False]
    torch.testing.assert_close(q, expected, rtol=0.0, atol=0.0)


def test_a_solve_is_one_launch(monkeypatch, device):
    s = on_device("quasi_newton", device, material=Corotated(1e5, 0.45, density=1000.0))
    start = bent(s)
    s.step(start)
    launches = []
    launch = IncrementalPotential.launch
    monkeypatch.setattr(
        IncrementalPotential,
        "launch",
        lambda self, *commands: launches.append(commands) or launch(self, *commands),
    )
    s.step(start)
    assert len(launches) == 1


def test_a_rollout_says_which_of_its_steps_failed_first(device):
    """Also on a GPU, where the host looks only after the last step."""
    s = on_device("quasi_newton", device, max_iterations=25)
    start = bent(s)
    expected = s.rollout(start, 3).q
    force = torch.zeros(4, *start.q.shape, device=start.q.device, dtype=start.q.dtype)
    force[1, 2] = force[3, 0] = 1e5
    with pytest.raises(ConvergenceError, match="environment 2 of 3") as caught:
        s.rollout(start, 4, Inputs(external_force=force))
    assert list(caught.value.report.converged) == [True, True, False]
    torch.testing.assert_close(s.rollout(start, 3).q, expected, rtol=0.0, atol=1e-9)


MESHES = {
    "hexahedra": box_hexahedra((0.1, 0.03, 0.03), (4, 2, 2)),
    "10-node tetrahedra": box_tetrahedra((0.1, 0.03, 0.03), (3, 1, 1), order=2),
}


def evaluated(mesh):
    """Residual, Hessian and its product at a bent pose, and where two steps lead from there."""
    simulator = Simulator(clamped(mesh))
    state = simulator.rest_state(2)
    q = state.q.clone()
    q[..., 2] += torch.tensor([3.0, -1.0])[:, None] * q[..., 0].square()
    workspace = simulator.workspace(2)
    potential = workspace.potential
    end = simulator.rollout(State(q, state.v), 2)
    potential.positions.copy_(q)
    potential.evaluate()
    potential.update_tangent()
    linear = workspace.linear_solver("dense", torch.float64)
    values = HessianAssembly(potential, linear, workspace.pattern)().clone()
    return potential.residual.clone(), values, potential.stiffness_product(q), end.q


@pytest.mark.parametrize("name", MESHES)
def test_they_find_what_threads_of_vertices_find(name, monkeypatch):
    expected = evaluated(MESHES[name])
    monkeypatch.setattr(Launcher, "by_cells", True)
    results = evaluated(MESHES[name])
    for one, other in zip(results, expected, strict=True):
        assert float(other.abs().max()) > 0.0
        torch.testing.assert_close(one, other, rtol=0.0, atol=1e-12 * float(other.abs().max()))
