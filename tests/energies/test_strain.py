"""Green strain at the points of a solid, of which the last results serve again."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Corotated, Simulator, box_hexahedra
from warp_resphys.energies.viscosity import GreenStrain, StrainTerm

MESH = box_hexahedra((0.1, 0.02, 0.02), (3, 1, 1))


@pytest.fixture
def term():
    simulator = Simulator(Body(MESH), Corotated(1e5, 0.45, stiffness_damping=0.01))
    (solid,) = (t for t in simulator.workspace(1).potential.energies if isinstance(t, StrainTerm))
    return solid


def stretched(factor):
    return torch.as_tensor(MESH.vertices * np.array([factor, 1.0, 1.0]))[None]


def strained(factor):
    return 0.5 * (factor**2 - 1.0)


def test_a_stretched_bar_has_its_strain_however_often_it_is_asked_for(term):
    one, two = stretched(1.1), stretched(1.2)
    for q, factor in ((one, 1.1), (two, 1.2), (one, 1.1), (stretched(1.3), 1.3), (two, 1.2), (one, 1.1)):
        strain = GreenStrain.apply(term, q)
        np.testing.assert_allclose(strain[..., 0, 0], strained(factor), rtol=1e-12)
        assert float(strain[..., 1:, :].abs().max()) < 1e-12


@pytest.mark.parametrize(
    "change",
    [lambda q: q.mul_(2.0), lambda q: q.numpy().__imul__(2.0), lambda q: q.data.mul_(2.0)],
    ids=["in place", "numpy", "data"],
)
@pytest.mark.parametrize("inference", [False, True])
def test_positions_that_changed_have_another_strain(term, change, inference):
    with torch.inference_mode(inference):
        q = stretched(1.1)
        GreenStrain.apply(term, q)
        change(q)
        np.testing.assert_allclose(GreenStrain.apply(term, q)[..., 0, 0], strained(2.2), rtol=1e-12)


def test_strains_of_inference_mode_do_not_reach_gradients(term):
    q = stretched(1.1)
    with torch.inference_mode():
        GreenStrain.apply(term, q)
    (gradient,) = torch.autograd.grad(GreenStrain.apply(term, q.requires_grad_()).square().sum(), q)
    assert float(gradient.abs().max()) > 0.0
