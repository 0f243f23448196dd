"""Cells that vector instructions take as a whole, against the same points one by one (`kernels.lanes`)."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from warp_resphys import Body, box_hexahedra, box_tetrahedra
from warp_resphys.energies.catalogue import MATERIALS
from warp_resphys.energies.placed import PlacedEnergy
from warp_resphys.energies.potential import IncrementalPotential, StepTerms
from warp_resphys.energies.solid import Solid, SolidTerm

SIZE = (0.1, 0.02, 0.02)
MESHES = {
    "8 nodes": box_hexahedra(SIZE, (5, 2, 1)),
    "20 nodes": box_hexahedra(SIZE, (3, 1, 1), nodes=20),
    "27 nodes": box_hexahedra(SIZE, (2, 1, 1), nodes=27),
    "tetrahedra": box_tetrahedra(SIZE, (3, 1, 1), order=2),
}
STRAINS = (0.0, 1e-6, 0.02, 0.2, 3.0)  # of the environments; the last one turns cells inside out


def positions(mesh):
    """The body moved, turned and deformed, by more and more from one environment to the next."""
    random, q = np.random.default_rng(0), mesh.vertices
    edge = np.ptp(mesh.vertices[mesh.cells[0]], axis=0).min()
    turned = [Rotation.random(random_state=n).apply(q) for n in range(len(STRAINS))]
    return np.stack(
        [x + strain * edge * random.uniform(-0.5, 0.5, q.shape) for x, strain in zip(turned, STRAINS, strict=True)]
    )


def evaluated(mesh, viscous):
    """A potential after an evaluation and a tangent, of which one environment has clamped eigenvalues."""
    body, batch = Body(mesh), len(STRAINS)
    solid = Solid(body.discretisation, MATERIALS["corotated"]())
    none = torch.zeros(0, dtype=torch.int64)
    p = IncrementalPotential(
        [PlacedEnergy(solid, solid.points(mesh))], body.coordinates, none, batch, torch.device("cpu")
    )
    random = torch.Generator().manual_seed(0)
    (term,) = p.energies
    carried = torch.as_tensor(term._carried / term._carried.max())
    offset = 0.1 * torch.randn(batch, term.n_points, 3, 3, generator=random, dtype=torch.float64)
    values = {
        "stiffness": carried * (1.0 + torch.rand(batch, term.n_points, 2, generator=random, dtype=torch.float64)),
        "viscosity": torch.tensor([[2.0, 0.5]] if viscous else [[0.0, 0.0]]).double().expand(batch, 2),
        "strain_offset": offset + offset.mT,
        "dilation_offset": 0.1 * torch.randn(batch, term.n_points, generator=random, dtype=torch.float64),
    }
    n = len(mesh.vertices)
    p.set_terms(StepTerms(p.zeros(n, 3), p.zeros(n), p.zeros(n, 3), values))
    p.positions.copy_(torch.as_tensor(positions(mesh)))
    p.evaluate()
    p.update_tangent(torch.arange(batch) == 1)
    return p


@pytest.mark.parametrize("viscous", [False, True])
@pytest.mark.parametrize("mesh", MESHES)
def test_cells_as_a_whole_equal_their_points(mesh, viscous, monkeypatch):
    whole = evaluated(MESHES[mesh], viscous)
    assert all(whole.energies[0].whole_cells(s, whole.own_values[0], whole._position_view) for s in whole.sets)
    monkeypatch.setattr(SolidTerm, "whole_cells", lambda *_: None)
    single = evaluated(MESHES[mesh], viscous)
    for points in whole.sets:
        own = points.source
        f = np.einsum("bcai,cqaj->bcqij", positions(MESHES[mesh])[:, own.nodes], own.gradients)
        growth = np.linalg.det(f).min((1, 2))
        assert growth[:-1].min() > 0.1
        assert growth[-1] < 0.0
    for one, other in zip(whole.residual, single.residual, strict=True):
        size = float(other.abs().max())
        torch.testing.assert_close(one, other, rtol=0.0, atol=1e-13 * (size + 1.0) / SIZE[1])
    torch.testing.assert_close(whole.energy, single.energy, rtol=1e-9, atol=1e-14)
    for one, other in zip(whole.tangents, single.tangents, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(whole._point_energy, single._point_energy, rtol=1e-9, atol=1e-14)
