"""Materials of convex terms in a simulator."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from warp_resphys import Body, Inputs, MooneyRivlin, Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.energies.materials import ConvexMaterial, FibreFamily
from warp_resphys.io.errors import InputError
from warp_resphys.studies.gradient_check import POSES, check_gradients

BEAM = box_hexahedra((0.1, 0.03, 0.03), (5, 2, 2))
BODY = Body(BEAM, fixed=select_vertices(BEAM, x=0.0))
TIGHT = SolverSettings("newton", relative_tolerance=1e-12)
C10, C01, BULK = 36e3, 8e3, 4e6
# A family that resists compression as it does tension has no jump of its modulus, which differences would not see.
FIBRES = [FibreFamily(0.3, 0.2, 40e3, 10e3, 40e3), FibreFamily(-0.4, 0.1, 20e3, 0.0, 20e3)]


def simulator(material, **more):
    return Simulator(BODY, material, solver=TIGHT, integrator="bdf2", **more)


def test_two_coefficients_and_a_bulk_modulus_are_mooney_rivlin():
    convex = ConvexMaterial(C10, c01=C01, bulk_1=0.5 * (BULK - 4.0 / 3.0 * (C10 + C01)), stiffness_damping=1e-3)
    rivlin = MooneyRivlin(C10, C01, BULK, stiffness_damping=1e-3)
    runs = [sim.rollout(sim.rest_state(), 10).q for sim in map(simulator, (convex, rivlin))]
    torch.testing.assert_close(runs[0], runs[1], rtol=0.0, atol=1e-10)
    assert (runs[0][-1] - runs[0][0]).abs().max() > 1e-3


@pytest.mark.parametrize("pose", POSES)
def test_gradients_by_every_coefficient_and_direction(pose):
    terms = {"c20": 20e3, "c30": 10e3, "c01": C01, "c02": 5e3, "dilation": 10e3, "bulk_1": 1e6, "bulk_2": 1e9}
    material = ConvexMaterial(C10, **terms, fibres=FIBRES, mass_damping=0.5, stiffness_damping=1e-3)
    mesh = box_hexahedra((0.06, 0.03, 0.03), (2, 1, 1))
    small = replace(simulator(material), body=Body(mesh, fixed=select_vertices(mesh, x=0.0)))
    rows = {row.parameter: row for row in check_gradients(small, pose)}
    assert {"c02", "bulk_1", "fibre_1_azimuth", "fibre_2_tension, each element"} <= rows.keys()
    # Rounding limits differences of the smaller gradients, and jumps of a fibre's modulus limit those by its constants;
    # `tests/kernels/test_material_laws.py` compares the latter away from the jumps.
    compared = {name: row for name, row in rows.items() if abs(row.adjoint) > 1e-6}
    errors = {name: row.relative_error / (1e-3 if "fibre" in name else 1e-6) for name, row in compared.items()}
    assert {name: error for name, error in errors.items() if not error < 1.0} == {}
    assert {"c10", "c01", "dilation", "bulk_1", "fibre_1_azimuth", "fibre_2_tension"} <= compared.keys()
    assert pose != "twisted" or {"c20", "c02", "bulk_2", "fibre_1_stiffening"} <= compared.keys()


def test_fibres_stiffen_a_beam_along_their_direction_only():
    material = [
        ConvexMaterial(C10, bulk_1=1e6, fibres=[FibreFamily(azimuth, 0.0, 100e3)]) for azimuth in (0.0, math.pi / 2)
    ]
    force = torch.zeros(1, len(BEAM.vertices), 3, dtype=torch.float64)
    force[:, select_vertices(BEAM, x=0.1), 0] = 0.5
    pulled = []
    for own in (*material, ConvexMaterial(C10, bulk_1=1e6)):
        sim = simulator(own, gravity=(0.0, 0.0, 0.0))
        q = sim.static_equilibrium(Inputs(external_force=force)).q
        pulled.append(float((q - sim.rest_positions)[0, :, 0].max()))
    assert pulled[0] < 0.5 * pulled[2]
    assert pulled[1] == pytest.approx(pulled[2], rel=0.05)


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: ConvexMaterial(-1.0), "c10"),
        (lambda: ConvexMaterial(c02=math.inf), "c02"),
        (lambda: ConvexMaterial(fibres=[FibreFamily(tension=-1.0)]), "fibre_1_tension"),
        (lambda: ConvexMaterial(fibres=[(1.0, 0.0, 0.0)]), r"fibres\[0\]"),
        (lambda: simulator(ConvexMaterial(fibres=[FibreFamily(np.zeros(3))])), "3 values for 20 elements"),
    ],
)
def test_invalid_coefficients_are_refused(make, key):
    with pytest.raises(InputError, match=key):
        make().prepare()
