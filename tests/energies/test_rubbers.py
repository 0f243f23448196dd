"""Rubbers of Gent and of Mooney and Rivlin: closed forms, gradients by every constant, and their ranges."""

import numpy as np
import pytest
import torch

from support.clamped import clamped
from support.slopes import check_rows
from warp_resphys import Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.energies import Gent, MooneyRivlin
from warp_resphys.io.errors import InputError
from warp_resphys.studies.gradient_check import check_gradients

TIGHT = SolverSettings("newton", relative_tolerance=1e-10)
CUBE = box_hexahedra((0.01, 0.01, 0.01), (1, 1, 1))
WEIGHTLESS = (0.0, 0.0, 0.0)
BEAM = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
MU, LIMIT, BULK = 90e3, 8.0, 90e8


def pulled(stretches, material):
    """(T,) nominal stresses of a bar that is free at its sides [Pa], by the force that balances each stretch."""
    s = Simulator(clamped(CUBE), material, gravity=WEIGHTLESS, solver=TIGHT)
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


DAMPED = {"mass_damping": 0.5, "stiffness_damping": 2e-3}


@pytest.mark.parametrize(
    ("material", "start", "names"),
    [
        (Gent(90e3, 3.0, 4e6, **DAMPED), "twisted", ("shear_modulus", "limit, each element")),
        (MooneyRivlin(36e3, 8e3, 4e5, **DAMPED), "rest", ("c10", "c01, each element")),
        (MooneyRivlin(36e3, 8e3, 4e7, **DAMPED), "twisted", ("c10", "c01, each element")),
    ],
    ids=["gent", "mooney_rivlin", "nearly incompressible"],
)
def test_gradients_by_every_constant(material, start, names, device):
    solver = SolverSettings("newton", relative_tolerance=1e-12)
    simulator = Simulator(clamped(BEAM), material, solver=solver, device=device)
    check_rows(check_gradients(simulator, start, steps=2), *names, "bulk_modulus, each environment")


@pytest.mark.parametrize(("name", "value"), [("c10", -1), ("bulk_modulus", 0)])
def test_constants_out_of_range(name, value):
    with pytest.raises(InputError, match=f"{name} is {value}: it must be positive, in Pa"):
        MooneyRivlin(**{name: float(value)})
