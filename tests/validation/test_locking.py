"""Deflections of a pneumatic arm at rest, by hexahedra:
quadratic ones do not lock, coarse linear ones do.

The converged tip, extrapolated from 8-node hexahedra of 10 and 3.3 mm, is 31.63 mm aside under
gravity with a base tilted by 20 degrees.
"""

import math
from functools import cache

import numpy as np
import pytest
import torch

from warp_resphys import (
    Body,
    Corotated,
    Fibres,
    Inputs,
    Pressure,
    Simulator,
    SolverSettings,
    quadratic,
)
from warp_resphys.core.mesh.arm import mesh_arm
from warp_resphys.core.mesh.arm_dimensions import ArmMesh
from warp_resphys.mesh import find_chambers

RUBBER = Corotated(264e3, 0.499, density=1070.0)
CONVERGED = 31.63  # mm, under gravity


@cache
def deflection(size, layers, nodes, load, device):
    """Way of the tip of an arm towards +x [mm], of gravity
    with a base tilted by 20 degrees, or of pressure.
    """
    mesh = mesh_arm(ArmMesh(size=1e-3 * size, layers=1e-3 * layers))[0]
    mesh = mesh if nodes == 8 else quadratic(mesh, f"hexahedron{nodes}")
    heights, chambers = mesh.vertices[:, 2], find_chambers(mesh)
    fixed, tip = (
        np.flatnonzero(np.abs(heights - end) < 1e-6) for end in (heights.max(), heights.min())
    )
    pressed = Pressure(chambers)
    fibres = Fibres(chambers, (8.0, -8.0), 2e-3, stiffness=1e4)
    pressures = torch.zeros(1, len(chambers), dtype=torch.float64)
    pressures[0, 0] = 1e4  # Pa
    energies, angle, inputs = {
        "gravity": ([pressed], math.radians(20.0), Inputs()),
        "pressure": ([pressed, fibres], 0.0, Inputs(pressure=pressures)),
    }[load]
    pull = 9.80709 * np.array([math.sin(angle), 0.0, -math.cos(angle)])
    body, solver = Body(mesh, fixed, energies=energies), SolverSettings(relative_tolerance=1e-6)
    simulator = Simulator(body, RUBBER, gravity=pull.tolist(), solver=solver, device=device)
    moved = simulator.static_equilibrium(inputs).q - simulator.rest_positions
    return 1e3 * float(moved[0, tip, 0].mean())


# Sizes of elements and layers [mm], nodes of a cell, and ways of the tip: the table of docs/results
MESHES = {
    "coarse linear hexahedra": (10.0, 24.0, 8, 29.10, -11.95),
    "linear hexahedra of the arm": (6.5, 10.0, 8, 30.80, -13.34),
    "20-node hexahedra": (10.0, 60.0, 20, 31.14, -13.06),
    "27-node hexahedra": (10.0, 60.0, 27, 31.30, -12.92),
}


@pytest.mark.parametrize("name", MESHES)
def test_an_arm_bends_as_far_as_its_elements_allow(name, device):
    """The figures by which elements are recommended.

    Quadratic ones are within 2 % under gravity.
    """
    *mesh, gravity, pressure = MESHES[name]
    aside, bent = (deflection(*mesh, load, device) for load in ("gravity", "pressure"))
    assert aside == pytest.approx(gravity, rel=2e-3)
    assert bent == pytest.approx(pressure, rel=4e-3)
    assert (abs(aside / CONVERGED - 1.0) < 0.02) == (mesh[2] > 8)


def test_linear_hexahedra_converge_at_second_order(device):
    """Richardson's extrapolation of the way of the tip from two meshes,
    one twice as fine, is the converged one.
    """
    coarse, fine = (
        deflection(*sizes, 8, "gravity", device) for sizes in ((10.0, 24.0), (5.0, 12.0))
    )
    assert fine + (fine - coarse) / 3.0 == pytest.approx(CONVERGED, rel=5e-3)
    assert abs(fine - CONVERGED) < 0.35 * abs(coarse - CONVERGED)
