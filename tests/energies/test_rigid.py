"""Rigid parts have the mass and the inertia tensor of their cells, and weigh what they should."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Rigid
from warp_resphys.energies.rigid import rigid_energies
from warp_resphys.mesh.mesh import Mesh, box_hexahedra, box_tetrahedra
from warp_resphys.stepping.constants import Mass

SIZE, DENSITY = np.array([0.03, 0.02, 0.05]), 800.0


@pytest.mark.parametrize("make", [box_hexahedra, box_tetrahedra])
def test_mass_and_inertia_of_a_box(make):
    mesh = make(tuple(SIZE), (2, 2, 3))
    mesh = Mesh(mesh.vertices - SIZE / 2, mesh.cells, {"box": np.arange(len(mesh.cells))})
    body = Body(mesh, rigid={"box": Rigid(DENSITY)})
    rigidity, inertia = rigid_energies(body, "box", body.rigid["box"])
    mass = DENSITY * SIZE.prod()
    assert DENSITY * float(rigidity.own_points.shape_volume.sum()) == pytest.approx(mass, rel=1e-12)
    corners, weights = mesh.vertices[inertia.own_points.nodes[0]], inertia.own_points.gradients[0, :, :, 0]

    def energy(velocity, spin):
        """Kinetic energy of the part when its control vertices move as a rigid body."""
        moving = weights @ (velocity + np.cross(spin, corners))
        return 0.5 * inertia.density * np.square(moving).sum()

    principal = mass / 12.0 * (np.square(SIZE).sum() - SIZE**2)
    for velocity, spin in np.random.default_rng(0).normal(size=(4, 2, 3)):
        expected = 0.5 * mass * velocity @ velocity + 0.5 * (principal * spin**2).sum()
        assert energy(velocity, spin) == pytest.approx(expected, rel=1e-10)
    assert energy(np.zeros(3), np.array([0.0, 0.0, 2.0])) == pytest.approx(2.0 * principal[2], rel=1e-10)


def test_masses_that_share_a_vertex_add_up_and_their_damping_is_the_mean_by_mass():
    one = Mass(torch.tensor([[1.0, 2.0, 0.0]]), torch.tensor([[1.0, 2.0, 5.0]]), torch.tensor([[0.5]]))
    other = Mass(torch.tensor([[3.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), torch.zeros(1, 3), torch.tensor([[2.5]]))
    total = Mass.sum([one, other])
    assert total.inertia.tolist() == [[4.0, 2.0, 0.0], [2.0, 2.0, 0.0]]
    assert total.weight.tolist() == [[1.0, 2.0, 5.0]]
    assert total.damping.tolist() == [[2.0, 0.5, 0.0], [1.5, 0.5, 0.0]]
