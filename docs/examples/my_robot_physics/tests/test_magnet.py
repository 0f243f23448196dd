"""A magnetised beam beside beam theory, and its gradients beside differences."""

import pytest
import torch
from my_robot_physics.magnet import Magnet

from warp_resphys import (
    Body,
    Inputs,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    box_hexahedra,
    select_vertices,
)
from warp_resphys.core.dynamics.gradient_check import check_gradients

LENGTH, SIDE, MAGNETISATION = 0.06, 0.006, 50e3
MESH = box_hexahedra((LENGTH, SIDE, SIDE), (12, 1, 1), nodes=27)


def simulator(mesh):
    body = Body(mesh, fixed=select_vertices(mesh, x=0.0), energies=[Magnet(MAGNETISATION)])
    rubber = StableNeoHookean(300e3, 0.3, density=1000.0, mass_damping=0.5, stiffness_damping=2e-3)
    return Simulator(
        body,
        rubber,
        gravity=(0.0, 0.0, 0.0),
        solver=SolverSettings(name="newton", relative_tolerance=1e-12),
    )


def test_a_small_field_bends_a_beam_as_beam_theory_says():
    """The torque M B per volume bends a cantilever by M B A L^3 / (3 E I) at its tip."""
    s, field = simulator(MESH), 1e-4
    moved = s.static_equilibrium(
        Inputs(magnetic_field=torch.full((1, 1), field, dtype=torch.float64))
    ).q[0]
    tip = float((moved - s.rest_positions)[select_vertices(MESH, x=LENGTH), 2].mean())
    expected = MAGNETISATION * field * LENGTH**3 / (3.0 * 300e3 * SIDE**2 / 12.0)
    assert tip == pytest.approx(expected, rel=0.02)


def test_gradients_equal_differences():
    rows = check_gradients(simulator(box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))), "bent", steps=2)
    named = {row.parameter.partition(",")[0] for row in rows}
    assert {"magnetisation", "field_direction", "magnetic_field"} <= named
    assert {
        row.parameter: row.relative_error for row in rows if not row.relative_error <= 1e-6
    } == {}
