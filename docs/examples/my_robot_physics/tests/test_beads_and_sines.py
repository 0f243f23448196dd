"""Beads move with the body, and the network has the derivatives of its formula."""

import pytest
import torch
from my_robot_physics.beads import Beads
from my_robot_physics.sines import Sines

from warp_resphys import box_hexahedra
from warp_resphys.io.errors import InputError

MESH = box_hexahedra((0.06, 0.02, 0.02), (6, 2, 2))


def test_beads_move_as_the_silicone_around_them():
    places = torch.tensor([[0.013, 0.004, 0.017], [0.05, 0.01, 0.01]], dtype=torch.float64)
    beads = Beads.bind(MESH, places.numpy(), ["a", "b"])
    strain = torch.tensor([[1.2, 0.1, 0.0], [0.0, 0.9, 0.0], [0.3, 0.0, 1.0]], dtype=torch.float64)
    moved = beads(torch.from_numpy(MESH.vertices)[None] @ strain.mT)
    torch.testing.assert_close(moved[0], places @ strain.mT, rtol=0.0, atol=1e-12)


def test_beads_cast_elsewhere_move_as_the_silicone_there():
    places = torch.tensor([[0.013, 0.004, 0.017]], dtype=torch.float64)
    offset = torch.tensor([[1e-3, -2e-3, 5e-4]], dtype=torch.float64)
    strain = torch.tensor([[1.2, 0.1, 0.0], [0.0, 0.9, 0.0], [0.3, 0.0, 1.0]], dtype=torch.float64)
    beads = Beads.bind(MESH, places.numpy(), ["a"]).moved(offset)
    moved = beads(torch.from_numpy(MESH.vertices)[None] @ strain.mT)
    torch.testing.assert_close(moved[0], (places + offset) @ strain.mT, rtol=0.0, atol=1e-12)


def test_a_bead_outside_is_refused():
    with pytest.raises(InputError, match="a is 10 mm outside of the body"):
        Beads.bind(MESH, torch.tensor([[0.07, 0.01, 0.01]]).double().numpy(), ["a"])


def test_gradients_of_the_network_equal_differences():
    network = Sines(3, 2, width=5, frequency=2.0).double()
    x = torch.randn(
        4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True
    )
    assert torch.autograd.gradcheck(network, (x,))
