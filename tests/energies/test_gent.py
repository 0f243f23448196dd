"""Gent's rubber against its closed form in uniaxial tension, its small strains, and differences."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Gent, Inputs, Simulator, SolverSettings, StableNeoHookean, box_hexahedra, select_vertices
from warp_resphys.studies.gradient_check import check_gradients

TIGHT = SolverSettings("newton", relative_tolerance=1e-10)
CUBE = box_hexahedra((0.01, 0.01, 0.01), (1, 1, 1))
WEIGHTLESS = (0.0, 0.0, 0.0)
BEAM = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
MU, LIMIT, BULK = 90e3, 8.0, 90e8


def pulled(stretches, material):
    """(T,) nominal stresses of a bar that is free at its sides [Pa], by the force that balances each stretch."""
    s = Simulator(Body(CUBE, fixed=select_vertices(CUBE, x=0.0)), material, gravity=WEIGHTLESS, solver=TIGHT)
    here, stresses = s.linearise(s.rest_state(), parameters={"density": 1e-9}), []
    for stretch in stretches:
        # Nearly incompressible: the sides follow from what little the volume changes, by J - 1 = p / lambda.
        across = stretch**-0.5
        for _ in range(20):
            x = s.rest_positions * torch.tensor([stretch, across, across], dtype=torch.float64)
            residual = here.residual(x[None])[0]
            sideways = float(residual[select_vertices(CUBE, y=0.01), 1].sum())
            force = float(residual[select_vertices(CUBE, x=0.01), 0].sum())
            across -= sideways / (BULK * 1e-4 * stretch**2 * across**2)
        stresses.append(force / 1e-4)
    return np.array(stresses)


def test_uniaxial_tension_is_that_of_the_closed_form():
    """At constant volume mu J_m (l - l^-2) / (J_m - I1 + 3) at the stretch l (Gent 1996)."""
    stretch = np.array([0.7, 1.0, 1.5, 2.0, 2.8])
    first = stretch**2 + 2.0 / stretch
    expected = MU * LIMIT * (stretch - stretch**-2) / (LIMIT - first + 3.0)
    np.testing.assert_allclose(pulled(stretch, Gent(MU, LIMIT, BULK)), expected, rtol=1e-4, atol=1.0)


def test_with_a_far_limit_it_is_neo_hookean():
    ends = []
    mu, bulk = 1e5, 2e6
    e, nu = 9.0 * bulk * mu / (3.0 * bulk + mu), (3.0 * bulk - 2.0 * mu) / (2.0 * (3.0 * bulk + mu))
    for material in (Gent(mu, 1e9, bulk), StableNeoHookean(e, nu)):
        s = Simulator(Body(BEAM, fixed=select_vertices(BEAM, x=0.0)), material, solver=TIGHT)
        ends.append(s.rollout(s.rest_state(), 3).q[-1])
    torch.testing.assert_close(*ends, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("start", ["bent", "twisted"])
def test_gradients_by_its_constants_equal_differences(start):
    rubber = Gent(90e3, 3.0, 4e6, mass_damping=0.5, stiffness_damping=2e-3)
    s = Simulator(Body(BEAM, fixed=select_vertices(BEAM, x=0.0)), rubber, solver=SolverSettings("newton", 1e-12))
    rows = check_gradients(s, start, steps=2)
    assert {"shear_modulus", "limit, each element", "bulk_modulus, each environment"} <= {row.parameter for row in rows}
    assert {row.parameter: row.relative_error for row in rows if not row.relative_error <= 1e-6} == {}


def test_the_limit_is_found_from_a_static_pull():
    """A cube under a force: Newton's method on its measured length gives the limit back."""
    body = Body(CUBE, fixed=select_vertices(CUBE, x=0.0))
    s = Simulator(body, Gent(30e3, 5.0, 3e6), gravity=WEIGHTLESS, solver=TIGHT)
    force = torch.zeros(1, body.n_vertices, 3, dtype=torch.float64)
    force[0, select_vertices(CUBE, x=0.01), 0] = 1.0

    def length(limit):
        return s.static_equilibrium(Inputs(force), {"limit": limit}).q[0, :, 0].max()

    target, limit = length(torch.tensor(5.0)).detach(), torch.tensor(6.0, dtype=torch.float64, requires_grad=True)
    for _ in range(5):
        miss = length(limit) - target
        (slope,) = torch.autograd.grad(miss, limit)
        limit = (limit - miss.detach() / slope).detach().requires_grad_()
    assert limit.item() == pytest.approx(5.0, rel=1e-6)
