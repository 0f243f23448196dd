"""Solves as a GPU takes them, with decisions on the device and threads of cells, do what those of a CPU do."""

import pytest
import torch

from support.clamped import clamped
from warp_resphys import Corotated, Inputs, Simulator, SolverSettings, State, box_hexahedra, box_tetrahedra
from warp_resphys.dynamics.assembly import HessianAssembly
from warp_resphys.dynamics.minimiser import Minimiser
from warp_resphys.energies.launcher import Launcher
from warp_resphys.energies.potential import IncrementalPotential
from warp_resphys.io.errors import ConvergenceError
from warp_resphys.studies.gradient_check import pose

MESH = box_hexahedra((0.06, 0.02, 0.02), (4, 2, 2))
BODY = clamped(MESH)
MATERIAL = Corotated(1e5, 0.45, density=1000.0, stiffness_damping=1e-3)


def simulator(name, device, material=MATERIAL, **settings):
    chosen = SolverSettings(name=name, linear_solver="tiled", **({"relative_tolerance": 1e-9} | settings))
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
        s = simulator(name, device, relative_tolerance=tolerance, factors=factors, max_iterations=500)
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
        s = simulator("newton", device, factors="single", max_iterations=1, on_failure="count")
        state = s.step(compressed(s))
        return state.q, s.workspace(3).minimiser("dynamics", s.settings).hessian.clamped.tolist()

    (q, clamped), (expected, expected_clamped) = begun(), host(begun)
    assert clamped == expected_clamped == [False, True, False]
    torch.testing.assert_close(q, expected, rtol=0.0, atol=0.0)


def test_a_solve_is_one_launch(monkeypatch, device):
    s = simulator("quasi_newton", device, material=Corotated(1e5, 0.45, density=1000.0))
    start = bent(s)
    s.step(start)
    launches = []
    launch = IncrementalPotential.launch
    monkeypatch.setattr(
        IncrementalPotential, "launch", lambda self, *commands: launches.append(commands) or launch(self, *commands)
    )
    s.step(start)
    assert len(launches) == 1


def test_a_rollout_says_which_of_its_steps_failed_first(device):
    """Also on a GPU, where the host looks only after the last step."""
    s = simulator("quasi_newton", device, max_iterations=25)
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
