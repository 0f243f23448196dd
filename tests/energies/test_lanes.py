"""Cells that vector instructions take as a whole, against the same points one by one (`kernels.lanes`)."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from warp_resphys import Body, box_hexahedra, box_tetrahedra
from warp_resphys.energies.base import PlacedEnergy
from warp_resphys.energies.catalogue import MATERIALS
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


def potential_of(mesh, batch, **options):
    body, none = Body(mesh, **options), torch.zeros(0, dtype=torch.int64)
    solid = Solid(body.discretisation, MATERIALS["corotated"]())
    placed = [PlacedEnergy(solid, solid.points(mesh))]
    return IncrementalPotential(placed, body.coordinates, none, batch, torch.device("cpu"))


def whole_cells(p):
    """Whether each set of points is taken cell by cell."""
    return [p.energies[0].lane_cells(s) is not None for s in p.sets]


def evaluated(mesh, viscosity, q):
    """A potential after an evaluation and a tangent, of which the second environment has clamped eigenvalues."""
    batch = len(q)
    p = potential_of(mesh, batch)
    random = torch.Generator().manual_seed(0)
    (term,) = p.energies
    carried = torch.as_tensor(term._carried / term._carried.max())
    offset = 0.1 * torch.randn(batch, term.n_points, 3, 3, generator=random, dtype=torch.float64)
    values = {
        "stiffness": carried * (1.0 + torch.rand(batch, term.n_points, 2, generator=random, dtype=torch.float64)),
        "viscosity": torch.tensor([viscosity]).double().expand(batch, 2),
        "strain_offset": viscosity[0] * (offset + offset.mT),
        "dilation_offset": 0.1 * torch.randn(batch, term.n_points, generator=random, dtype=torch.float64),
    }
    n = len(mesh.vertices)
    p.set_terms(StepTerms(p.zeros(n, 3), p.zeros(n), p.zeros(n, 3), [values]))
    p.positions.copy_(torch.as_tensor(q))
    p.evaluate()
    p.update_tangent(torch.arange(batch) == 1)
    return p


def gradients_of(p, q):
    """Deformation gradients (B, C, Q, 3, 3) of all points."""
    (points,) = (s.source for s in p.sets)
    return np.einsum("bcai,cqaj->bcqij", q[:, points.nodes], points.gradients)


def check_equal(whole, mesh, viscosity, q, monkeypatch):
    """Compares a potential with one whose points are taken one by one."""
    monkeypatch.setattr(SolidTerm, "lane_cells", lambda *_: None)
    single = evaluated(mesh, viscosity, q)
    for one, other in zip(whole.residual, single.residual, strict=True):
        size = float(other.abs().max())
        torch.testing.assert_close(one, other, rtol=0.0, atol=1e-13 * (size + 1.0) / SIZE[1])
    torch.testing.assert_close(whole.energy, single.energy, rtol=1e-9, atol=1e-14)
    torch.testing.assert_close(whole._point_energy, single._point_energy, rtol=1e-9, atol=1e-14)
    for one, other in zip(whole.tangents, single.tangents, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("viscosity", [(0.0, 0.0), (2.0, 0.5)], ids=str)
@pytest.mark.parametrize("mesh", MESHES)
def test_cells_as_a_whole_equal_their_points(mesh, viscosity, monkeypatch):
    q = positions(MESHES[mesh])
    whole = evaluated(MESHES[mesh], viscosity, q)
    assert all(whole_cells(whole))
    growth = np.linalg.det(gradients_of(whole, q)).min((1, 2))
    assert growth[:-1].min() > 0.1
    assert growth[-1] < 0.0
    check_equal(whole, MESHES[mesh], viscosity, q, monkeypatch)


@pytest.mark.parametrize("flattest", [0.19, 0.21])
def test_a_flat_point_leaves_the_others_of_its_cell_as_they_are(flattest, monkeypatch):
    """One corner of a cell of 27 nodes is pushed in until the flattest point has a given J: some groups are taken."""
    mesh = box_hexahedra(SIZE, (1, 1, 1), nodes=27)
    p, way = potential_of(mesh, 1), np.zeros_like(mesh.vertices)
    way[7] = -mesh.vertices[7]  # the corner opposite to the origin

    def growth(share):
        return np.linalg.det(gradients_of(p, (mesh.vertices + share * way)[None]))[0, 0, :27]

    shares = np.linspace(0.0, 0.5, 2001)
    share = shares[np.argmax([growth(s).min() < flattest for s in shares])]
    assert growth(share).min() == pytest.approx(flattest, abs=0.01)
    groups = [growth(share)[k : k + 8].min() for k in range(0, 27, 8)]
    assert max(groups) > 0.5
    q = np.repeat((mesh.vertices + share * way)[None], 2, 0)
    check_equal(evaluated(mesh, (2.0, 0.5), q), mesh, (2.0, 0.5), q, monkeypatch)


def test_an_environment_that_is_done_keeps_its_sums_and_its_tangent():
    q = positions(MESHES["8 nodes"])[1:3]
    p = evaluated(MESHES["8 nodes"], (2.0, 0.5), q)
    before = [getattr(p, name).clone() for name in ("energy", "energy_size", "residual_norm")]
    tangent = p.tangents[0].clone()
    p.active[1] = 0
    p.positions.mul_(1.1)
    p.evaluate()
    p.update_tangent(active=torch.tensor([True, False]))
    for name, own in zip(("energy", "energy_size", "residual_norm"), before, strict=True):
        assert float(getattr(p, name)[0]) != float(own[0])
        assert float(getattr(p, name)[1]) == float(own[1])
    assert bool(p.tangents[0][0].ne(tangent[0]).any())
    torch.testing.assert_close(p.tangents[0][1], tangent[1], rtol=0.0, atol=0.0)


def test_cells_whose_points_have_both_terms_or_none_to_share_are_not_taken():
    assert not any(whole_cells(potential_of(MESHES["8 nodes"], 1, volume_integration="full")))
    assert not any(whole_cells(potential_of(box_tetrahedra(SIZE, (3, 1, 1)), 1)))
