"""On a GPU, threads work on the nodes of a cell and on their pairs: the same sums, made here on a CPU too."""

import pytest
import torch

from support.clamped import clamped
from warp_resphys.dynamics.assembly import HessianAssembly
from warp_resphys.dynamics.simulator import Simulator
from warp_resphys.energies.launcher import Launcher
from warp_resphys.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.stepping.state import State

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
