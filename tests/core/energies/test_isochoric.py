"""Stress of homogeneous tests in closed form, against the simulator
and against textbook formulas.
"""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Inputs, Simulator, box_hexahedra
from warp_resphys.core.energies.catalogue import make_material
from warp_resphys.core.energies.isochoric import (
    bulk_of,
    path_of,
    shear_modulus,
    stress,
    stress_columns,
)

LAW = {
    "c10": 20e3,
    "c20": 3e3,
    "c30": 0.4e3,
    "c01": 6e3,
    "c02": 0.8e3,
    "ogden_3": 15e3,
    "ogden_m3": 4e3,
}
STRAINS = np.array([0.1, 0.4])
GRADIENTS = {  # of deformation at a strain x, keeping the volume
    "tension": lambda x: np.diag([1 + x, (1 + x) ** -0.5, (1 + x) ** -0.5]),
    "compression": lambda x: np.diag([1 - x, (1 - x) ** -0.5, (1 - x) ** -0.5]),
    "biaxial": lambda x: np.diag([1 + x, 1 + x, (1 + x) ** -2]),
    "planar": lambda x: np.diag([1 + x, 1.0, 1 / (1 + x)]),
    "shear": lambda x: np.array([[1.0, x, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
}


def cube(material, **options):
    """A unit cube whose surface is fixed."""
    mesh = box_hexahedra((1.0, 1.0, 1.0), (2, 2, 2))
    inside = (np.abs(mesh.vertices - 0.5) < 0.1).all(1)
    body = Body(mesh, fixed=np.flatnonzero(~inside))
    return Simulator(body, material, gravity=(0.0, 0.0, 0.0), relative_tolerance=1e-11, **options)


def placed(simulator, f):
    """Places (1, D, 3) of the surface at a homogeneous deformation gradient."""
    return (simulator.rest_positions @ torch.as_tensor(f).T)[simulator.fixed][None]


def work_of(simulator, reaction, slope):
    """Work (...) of reactions at a motion of the surface
    with the rate dF/dx of the deformation gradient: P : dF/dx.
    """
    return (reaction.forces * placed(simulator, slope)[0]).sum((-1, -2)).numpy()


@pytest.mark.parametrize("kind", GRADIENTS)
def test_stress_is_that_of_the_simulator(kind):
    """The stress conjugate to x is P : dF/dx, in which the pressure of the volume does no work."""
    simulator = cube(make_material("law", **LAW, bulk_1=1e7))
    for x in STRAINS:
        balance = simulator.static_equilibrium(
            Inputs(fixed_positions=placed(simulator, GRADIENTS[kind](x)))
        )
        slope = (GRADIENTS[kind](x + 1e-5) - GRADIENTS[kind](x - 1e-5)) / 2e-5
        (work,) = work_of(simulator, simulator.reaction(balance), slope) / (
            2.0 if kind == "biaxial" else 1.0
        )
        assert stress(kind, np.array([x]), LAW)[0] == pytest.approx(work, rel=1e-6)


def test_paths_keep_the_volume_and_have_their_green_strain():
    for kind, gradient in GRADIENTS.items():
        path = path_of(kind, STRAINS)
        np.testing.assert_allclose(path.stretches.prod(1), 1.0, rtol=1e-12)
        for k, x in enumerate(STRAINS):
            f = gradient(x)
            np.testing.assert_allclose(path.green[k], 0.5 * (f.T @ f - np.eye(3)), atol=1e-12)
            values = np.sort(np.linalg.svd(f)[1])
            np.testing.assert_allclose(np.sort(path.stretches[k]), values, rtol=1e-12)
        finer = path_of(kind, STRAINS + 1e-6), path_of(kind, STRAINS - 1e-6)
        np.testing.assert_allclose(
            path.green_slopes, (finer[0].green - finer[1].green) / 2e-6, atol=1e-8
        )
        np.testing.assert_allclose(
            path.stretch_slopes, (finer[0].stretches - finer[1].stretches) / 2e-6, atol=1e-8
        )


def test_textbook_formulas():
    x = np.linspace(0.05, 2.0, 7)
    stretch = 1.0 + x
    np.testing.assert_allclose(
        stress("tension", x, {"c10": 1.0}), 2.0 * (stretch - stretch**-2), rtol=1e-12
    )
    np.testing.assert_allclose(
        stress("tension", x, {"c01": 1.0}), 2.0 * (1.0 - stretch**-3), rtol=1e-12
    )
    np.testing.assert_allclose(stress("shear", x, {"c10": 1.0, "c01": 2.0}), 6.0 * x, rtol=1e-12)
    assert shear_modulus(LAW) == pytest.approx(2.0 * (20e3 + 6e3) + 15e3 + 4e3, rel=1e-5)
    # lambda = mu at a Poisson's ratio of a quarter
    assert bulk_of({"c10": 10e3}, 0.25) == pytest.approx(10e3)


def test_branches_relax_as_in_the_simulator():
    """A cube that is sheared in steps and then held:
    stress of elasticity, a branch and viscosity over time.
    """
    law = {"c10": 20e3, "prony_modulus_1": 30e3, "prony_time_1": 0.05, "shear_viscosity": 200.0}
    step, shear = 1e-3, np.concatenate([np.linspace(0.0, 0.4, 21), np.full(30, 0.4)])
    simulator = cube(make_material("law", density=1e-8, bulk_1=1e7, **law), time_step=step)
    moved = torch.stack([placed(simulator, GRADIENTS["shear"](x)) for x in shear[1:]])
    motion = simulator.rollout(simulator.rest_state(), len(moved), Inputs(fixed_positions=moved))
    rate = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    measured = work_of(simulator, simulator.reaction(motion), rate)[:, 0]
    columns = stress_columns(
        "shear", shear, ("c10", "prony_0.05", "shear_viscosity"), step * np.arange(len(shear))
    )
    expected = (
        20e3 * columns["c10"] + 30e3 * columns["prony_0.05"] + 200.0 * columns["shear_viscosity"]
    )
    np.testing.assert_allclose(measured, expected[1:], rtol=1e-4)
