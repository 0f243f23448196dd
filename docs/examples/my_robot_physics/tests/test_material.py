"""The rubber of eight chains beside its closed form, its limit, and differences."""

import numpy as np
import pytest
import torch
from my_robot_physics.material import ArrudaBoyce

from warp_resphys import (
    Body,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import check_gradients

TIGHT = SolverSettings(name="newton", relative_tolerance=1e-10)
BEAM = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
CUBE = box_hexahedra((0.01, 0.01, 0.01), (1, 1, 1))
MU, LOCKING, BULK = 60e3, 1.6, 6e9


def slope(first, locking):
    """dW/dI [Pa] at the first invariant, for the shear modulus one at rest."""
    c = np.array([1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750])
    n = np.arange(1, 6)

    def terms(i):
        return sum(c * n * i ** (n - 1.0) / locking ** (2.0 * (n - 1.0)))

    return terms(first) / (2.0 * terms(3.0))


@pytest.mark.parametrize("stretch", [0.7, 1.5, 2.2])
def test_uniaxial_tension_is_that_of_the_closed_form(stretch):
    """At constant volume the nominal stress is 2 (l - l^-2) dW/dI."""
    s = Simulator(
        Body(CUBE, fixed=select_vertices(CUBE, x=0.0)),
        ArrudaBoyce(MU, LOCKING, BULK),
        gravity=(0, 0, 0),
    )
    here, across = s.linearise(s.rest_state(), parameters={"density": 1e-9}), stretch**-0.5
    for _ in range(20):  # The sides follow from the small change of volume.
        x = s.rest_positions * torch.tensor([stretch, across, across], dtype=torch.float64)
        force = here.residual(x[None])[0]
        sideways = float(force[select_vertices(CUBE, y=0.01), 1].sum())
        across -= sideways / (BULK * 1e-4 * stretch**2 * across**2)
    stress = float(force[select_vertices(CUBE, x=0.01), 0].sum()) / 1e-4
    expected = 2.0 * MU * (stretch - stretch**-2) * slope(stretch**2 + 2.0 / stretch, LOCKING)
    assert stress == pytest.approx(expected, rel=1e-4)


def test_with_long_chains_it_is_neo_hookean():
    mu, bulk = 1e5, 2e6
    e, nu = 9.0 * bulk * mu / (3.0 * bulk + mu), (3.0 * bulk - 2.0 * mu) / (2.0 * (3.0 * bulk + mu))
    ends = []
    for material in (ArrudaBoyce(mu, 1e5, bulk), StableNeoHookean(e, nu)):
        s = Simulator(Body(BEAM, fixed=select_vertices(BEAM, x=0.0)), material, solver=TIGHT)
        ends.append(s.rollout(s.rest_state(), 3).q[-1])
    torch.testing.assert_close(*ends, rtol=0.0, atol=1e-9)


def test_gradients_by_its_parameters_equal_differences():
    rubber = ArrudaBoyce(60e3, 1.6, 4e6, mass_damping=0.5, stiffness_damping=2e-3)
    tight = SolverSettings(name="newton", relative_tolerance=1e-12)
    s = Simulator(Body(BEAM, fixed=select_vertices(BEAM, x=0.0)), rubber, solver=tight)
    rows = check_gradients(s, "bent", steps=2)
    assert {"shear_modulus", "locking_stretch", "bulk_modulus"} <= {row.parameter for row in rows}
    assert {
        row.parameter: row.relative_error for row in rows if not row.relative_error <= 1e-6
    } == {}
