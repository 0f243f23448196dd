"""Static deflections: convergence with refinement, the documented sags,
and linear elasticity for small strains.
"""

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import (
    Body,
    Corotated,
    Simulator,
    StableNeoHookean,
    box_hexahedra,
    box_tetrahedra,
    select_vertices,
)
from warp_resphys.core.energies.catalogue import MATERIALS
from warp_resphys.core.fem.coordinates import SymmetryPlane
from warp_resphys.core.stepping.inputs import Inputs

BEAM = (0.1, 0.03, 0.03)
SILICONE = {"youngs_modulus": 264e3, "density": 1070.0}


def tip_sag(mesh, material, gravity=9.80709, **body):
    """Mean vertical displacement of the tip face under its own weight [m]."""
    settings = {"gravity": (0, 0, -gravity), "solver": "newton", "relative_tolerance": 1e-8}
    simulator = Simulator(clamped(mesh, **body), material, **settings)
    moved = simulator.static_equilibrium().q[0] - simulator.rest_positions
    return float(moved[mesh.vertices[:, 0] == mesh.vertices[:, 0].max(), 2].mean())


@pytest.mark.parametrize(
    ("integration", "sag_mm", "tolerance_mm"), [("centre", -6.42, 0.03), ("full", -3.07, 0.03)]
)
def test_sag_of_the_beam(integration, sag_mm, tolerance_mm):
    sag = tip_sag(
        box_hexahedra(), Corotated(poissons_ratio=0.499, **SILICONE), volume_integration=integration
    )
    assert 1e3 * sag == pytest.approx(sag_mm, abs=tolerance_mm)


def test_a_slender_beam_sags_as_euler_and_bernoulli_say():
    """A tip's sag of rho g A L^4 / (8 E I) under the beam's weight."""
    length, width, modulus, density, g = 0.2, 0.01, 1e7, 1000.0, 9.80709
    mesh = box_hexahedra((length, width, width), (20, 1, 1), nodes=27)
    expected = density * g * width**2 * length**4 / (8.0 * modulus * width**4 / 12.0)
    assert tip_sag(mesh, Corotated(modulus, 0.0, density=density), g) == pytest.approx(
        -expected, rel=0.01
    )


def linear_sags(mesh, sizes, poissons_ratio):
    """Sags under a load so small that the problem is linear [m]."""
    material = StableNeoHookean(264e3, poissons_ratio, density=1070.0)
    return np.array([tip_sag(mesh(n), material, gravity=1e-4) for n in sizes])


def quadratic_tetrahedra(n):
    return box_tetrahedra(BEAM, (2 * n, n, n), order=2)


@pytest.mark.parametrize("nodes", [20, 27])
def test_quadratic_hexahedra_converge_a_rate_faster(nodes):
    """Their sags change by an eighth or less from one refinement to the next,
    towards those of 10-node tetrahedra.
    """
    sags = linear_sags(lambda n: box_hexahedra(BEAM, (2 * n, n, n), nodes=nodes), (1, 2, 4), 0.0)
    first, second = np.abs(np.diff(sags))
    assert second < first / 6.5
    tetrahedra = linear_sags(quadratic_tetrahedra, (2, 4), 0.0)
    assert sags[2] == pytest.approx(tetrahedra[1] + (tetrahedra[1] - tetrahedra[0]) / 7, rel=1e-3)


def test_cantilever_converges_at_the_expected_rate():
    """Order 2 for hexahedra and 3 for 10-node tetrahedra (nu = 0 has no singularity at the clamp).

    The limit is the extrapolation of the other element's sags.
    """
    hexahedra = linear_sags(lambda n: box_hexahedra(BEAM, (4 * n, n, n)), (2, 4, 8), 0.0)
    tetrahedra = linear_sags(quadratic_tetrahedra, (1, 2, 4), 0.0)
    limit_of_hexahedra = hexahedra[2] + (hexahedra[2] - hexahedra[1]) / 3
    limit_of_tetrahedra = tetrahedra[2] + (tetrahedra[2] - tetrahedra[1]) / 7
    assert limit_of_hexahedra == pytest.approx(limit_of_tetrahedra, rel=1e-3)
    errors = hexahedra - limit_of_tetrahedra, tetrahedra[:2] - limit_of_hexahedra
    assert (errors[0] > 0).all()  # too stiff
    rates = [np.log2(e[:-1] / e[1:]) for e in errors]
    np.testing.assert_allclose(rates[0], 2.0, atol=0.2)
    np.testing.assert_allclose(rates[1], 3.0, atol=0.3)


@pytest.mark.parametrize("model", ["corotated", "stable_neo_hookean"])
def test_small_strains_are_linear_elasticity(model):
    """A cube that is pulled along x between symmetry planes, by Hooke's law.

    Corotated is a third of lambda.
    """
    youngs_modulus, poissons_ratio, stress = 1e5, 0.4, 1e-3
    mesh = box_hexahedra((0.02, 0.02, 0.02), (1, 1, 1))
    body = Body(
        mesh, symmetry=[SymmetryPlane(axis) for axis in np.eye(3)], volume_integration="full"
    )
    material = MATERIALS[model](youngs_modulus, poissons_ratio, density=1000.0)
    simulator = Simulator(
        body, material, gravity=(0.0, 0.0, 0.0), solver="newton", relative_tolerance=1e-6
    )
    force = torch.zeros(1, 8, 3, dtype=torch.float64)
    force[:, select_vertices(mesh, x=0.02), 0] = stress * 0.02**2 / 4.0
    # Of (1, 1, 1).
    strain = (simulator.static_equilibrium(Inputs(force)).q[0] - simulator.rest_positions)[
        -1
    ] / 0.02
    mu = youngs_modulus / (2 * (1 + poissons_ratio))
    lame_lambda = (
        youngs_modulus * poissons_ratio / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio))
    )
    if model == "corotated":
        lame_lambda /= 3
    hooke = [[2 * mu + lame_lambda, 2 * lame_lambda], [lame_lambda, 2 * (mu + lame_lambda)]]
    along, across = np.linalg.solve(hooke, [stress, 0.0])
    np.testing.assert_allclose(strain, [along, across, across], rtol=1e-4)
