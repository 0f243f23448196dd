"""The linearised equilibrium: a step of Newton's method gives the derivatives of equilibria by parameters."""

from dataclasses import replace

import pytest
import torch

from support.chambered import chambered
from support.clamped import clamped, noise
from warp_resphys import Contact, Corotated, HalfSpace, Inputs, Simulator, Tendons
from warp_resphys.energies.materials import Gent
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.boxes import box_hexahedra
from warp_resphys.studies.gradient_check import central_difference

MESH = box_hexahedra((0.1, 0.02, 0.02), (5, 1, 1))
TENDON = [[0.0, 0.01, 0.02], [0.05, 0.01, 0.02], [0.1, 0.01, 0.02]]
FLOOR = HalfSpace(position=(0.0, 0.0, -0.015))


def beam(material, *energies, **options):
    return Simulator(clamped(MESH, energies=energies), material, **({"relative_tolerance": 1e-12} | options))


CASES = {
    "nearly incompressible": (lambda: beam(Corotated(2e5, 0.499)), Inputs(), "poissons_ratio", 0.499),
    "law": (lambda: beam(Gent(9e3, 3.0, 1e6)), Inputs(), "limit", 3.0),
    "contact": (
        lambda: beam(Corotated(2e4, 0.45), Contact({"floor": FLOOR}, friction=0.3, distance=2e-3)),
        Inputs(),
        "youngs_modulus",
        2e4,
    ),
    "tendon": (
        lambda: beam(Corotated(2e5, 0.45), Tendons([TENDON], stiffness=100.0)),
        Inputs(tendon_tension=3.0),
        "tendon_stiffness",
        100.0,
    ),
    "pressure": (
        lambda: Simulator(chambered("hexahedron"), Corotated(1e5, 0.45), relative_tolerance=1e-12),
        Inputs(pressure=[4e3, 2e3]),
        "youngs_modulus",
        1e5,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_step_of_newtons_method_gives_the_derivative_of_an_equilibrium(case):
    make, inputs, name, value = CASES[case]
    simulator = make()
    weights = noise(simulator.body.n_vertices, 3)
    start = simulator.static_equilibrium(inputs, {name: value}).q

    def function(step):
        q = simulator.static_equilibrium(inputs, {name: value * (1.0 + 1e-3 * step)}, start=start).q
        return float((weights * q).sum())

    wanted, error = central_difference(function)
    here = simulator.linearise_equilibrium(inputs, {name: value})
    here.factorise(start)
    there = replace(simulator).linearise_equilibrium(inputs, {name: value * (1.0 + 1e-6)})
    moved = here.solve((there.residual(start) - here.residual(start)).reshape(1, -1, 1)).view_as(start)
    derivative = -float((weights * moved).sum()) * 1e3
    assert derivative == pytest.approx(wanted, rel=1e-4, abs=10.0 * error + 1e-12)


def test_forces_that_follow_the_pose_are_refused():
    simulator = beam(Corotated(2e5, 0.45), Tendons([TENDON], friction=0.3))
    assert simulator.energies.follow_pose
    with pytest.raises(InputError, match="solve its equilibria"):
        simulator.linearise_equilibrium(Inputs(tendon_tension=3.0))


def test_a_step_near_its_solution_takes_no_iterations_and_has_the_same_result():
    simulator = beam(Corotated(2e5, 0.45), relative_tolerance=1e-9)
    state = simulator.rest_state()
    new = simulator.step(state)
    again = replace(simulator).step(state, near=new.q)
    assert int(again.report.iterations) < int(new.report.iterations)
    torch.testing.assert_close(again.q, new.q, rtol=0.0, atol=1e-9)
    for integrator in ("bdf2", "midpoint"):
        other = replace(simulator, integrator=integrator)
        expected = other.step(state)
        far = expected.q + 1e-3 * torch.rand(expected.q.shape, generator=torch.Generator().manual_seed(0)).double()
        torch.testing.assert_close(replace(other).step(state, near=far).q, expected.q, rtol=0.0, atol=1e-8)
    with pytest.raises(InputError, match="near has shape"):
        simulator.step(state, near=new.q[0])
