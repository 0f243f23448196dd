"""Linearised steps and equilibria: the Hessian is the derivative of the residual.

Steps of Newton's method.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.chambered import chambered
from support.clamped import clamped, noise
from support.refusals import refuses
from warp_resphys import (
    Contact,
    Corotated,
    HalfSpace,
    InputError,
    Inputs,
    Mesh,
    Rigid,
    Simulator,
    Tendons,
)
from warp_resphys.core.dynamics.energy_set import EnergySet, place_energies
from warp_resphys.core.dynamics.gradient_check import central_difference
from warp_resphys.core.dynamics.linearisation import Linearisation
from warp_resphys.core.energies.route import Route
from warp_resphys.core.fem.coordinates import DeviceCoordinates
from warp_resphys.core.mesh.boxes import box_hexahedra
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.energies import Gent

BOX = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
MESH = Mesh(BOX.vertices, BOX.cells, {"beam": np.array([0, 1]), "cap": np.array([2])})
GUIDES = [[x, 0.01, 0.02] for x in (0.0, 0.01, 0.03, 0.04)]
TENDON = Tendons([Route(guides=GUIDES, offsets=[[0.0, 0.0, 1.0]])], 400.0)


def linearised(rigid):
    """A step of two bent bodies, positions at which to take it, and a direction of coordinates."""
    mesh = MESH if rigid else BOX
    body = clamped(mesh, energies=[TENDON], rigid={"cap": Rigid()} if rigid else {})
    s = Simulator(body, {"beam": Corotated(2e5)} if rigid else Corotated(2e5))
    state = s.rest_state(2)
    bend = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    state = s.state(state.q + 20.0 * state.q[..., :1] ** 2 * bend, 0.1 * state.q)
    inputs = Inputs(tendon_tension=torch.tensor([[1.0], [2.0]]).double(), tendon_contraction=1e-3)
    step: Linearisation = s.linearise(state, inputs, {"tendon_offset_1": 2e-3})
    x, zero = (step.hold(q) for q in (state.q, torch.zeros_like(state.q)))
    direction = step.hold(noise(*state.q.shape)) - zero
    return step, x, direction


@pytest.mark.parametrize("rigid", [False, True])
def test_product_matrix_and_solution_belong_to_the_derivative_of_the_residual(rigid):
    step, x, direction = linearised(rigid)
    h = 1e-7
    difference = (step.residual(x + h * direction) - step.residual(x - h * direction)) / (2 * h)
    scale = float(difference.abs().max())
    step.update(x)
    on_controls = difference[:, step.free]
    torch.testing.assert_close(
        step.product(direction)[:, step.free], on_controls, rtol=0.0, atol=1e-6 * scale
    )
    matrix, inertia = step.matrix(x)
    flat = direction[0, step.free].flatten().numpy()
    np.testing.assert_allclose(matrix @ flat, on_controls[0].flatten(), atol=1e-6 * scale)
    mass = step.inertia_matrix(x)
    if not rigid:
        np.testing.assert_allclose(mass.diagonal(), inertia)
    along = np.tile([1.0, 0.0, 0.0], len(step.free))
    whole = np.tile([1.0, 2.0, 3.0], len(step.free))
    # The same mass in every direction.
    assert whole @ mass @ whole == pytest.approx(14.0 * (along @ mass @ along))
    step.factorise(x)
    solved = step.solve(difference.flatten(1)[..., None])[..., 0].view_as(x)
    torch.testing.assert_close(solved, direction, rtol=1e-4, atol=1e-6)


def test_a_shifted_factor():
    step, x, direction = linearised(False)
    step.update(x)
    right = (direction + 1e-6 * step.product(direction))[:, step.free].reshape(2, -1, 1)
    solved = step.shifted(1e-6).solve(right).view(2, -1, 3)
    torch.testing.assert_close(solved, direction[:, step.free], rtol=0.0, atol=1e-9)


def test_an_energy_set_names_parameters_by_region_and_knows_its_memory():
    mesh = Mesh(BOX.vertices, BOX.cells, {"root": np.array([0]), "tip": np.array([1, 2])})
    body = clamped(mesh, energies=[replace(TENDON, friction=0.2)])
    materials = {"root": Corotated(1e5, density=1000.0), "tip": Corotated(2e5, density=500.0)}
    rest = torch.as_tensor(mesh.vertices)
    where = (body, DeviceCoordinates(body.coordinates, rest), rest, INTEGRATORS["bdf2"], 0.01)
    energies = EnergySet(place_energies(body, materials), *where)
    assert energies.defaults["tip_youngs_modulus"] == 2e5
    assert {"root_density", "tip_density", "tendon_friction"} <= set(energies.parameters)
    given = {
        name: energies.parameters[name].shaped(torch.as_tensor(v).double())
        for name, v in energies.defaults.items()
    }
    values, mass = energies.prepare(
        {**given, "tip_density": torch.tensor([[500.0], [700.0]]).double()}
    )
    volume = 0.02**3
    np.testing.assert_allclose(
        mass.inertia.sum(1), [volume * (1000.0 + 2 * density) for density in (500.0, 700.0)]
    )
    assert "tendon_friction" in values[-1]
    energies.check_memory({"tendon_segment_tension": rest.new_zeros(2, 3)}, 2, rest)
    for wrong in (
        {"tension": rest.new_zeros(2, 1)},
        {"tendon_segment_tension": rest.new_zeros(2, 1)},
    ):
        refuses(InputError, next(iter(wrong)), energies.check_memory, wrong, 2, rest)
    twice = 2 * place_energies(body, materials)
    refuses(InputError, "two energies depend on", EnergySet, twice, *where)


BEAM = box_hexahedra((0.1, 0.02, 0.02), (5, 1, 1))
ROUTE = [[0.0, 0.01, 0.02], [0.05, 0.01, 0.02], [0.1, 0.01, 0.02]]
FLOOR = HalfSpace(position=(0.0, 0.0, -0.015))


def beam(material, *energies, **options):
    return Simulator(
        clamped(BEAM, energies=energies), material, **({"relative_tolerance": 1e-12} | options)
    )


CASES = {
    "nearly incompressible": (
        lambda: beam(Corotated(2e5, 0.499)),
        Inputs(),
        "poissons_ratio",
        0.499,
    ),
    "law": (lambda: beam(Gent(9e3, 3.0, 1e6)), Inputs(), "limit", 3.0),
    "contact": (
        lambda: beam(Corotated(2e4, 0.45), Contact({"floor": FLOOR}, friction=0.3, distance=2e-3)),
        Inputs(),
        "youngs_modulus",
        2e4,
    ),
    "tendon": (
        lambda: beam(Corotated(2e5, 0.45), Tendons([ROUTE], stiffness=100.0)),
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
    moved = here.solve((there.residual(start) - here.residual(start)).reshape(1, -1, 1)).view_as(
        start
    )
    derivative = -float((weights * moved).sum()) * 1e3
    assert derivative == pytest.approx(wanted, rel=1e-4, abs=10.0 * error + 1e-12)


def test_forces_that_follow_the_pose_are_refused():
    simulator = beam(Corotated(2e5, 0.45), Tendons([ROUTE], friction=0.3))
    assert simulator.energies.follow_pose
    refuses(
        InputError,
        "solve its equilibria",
        simulator.linearise_equilibrium,
        Inputs(tendon_tension=3.0),
    )


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
        far = (
            expected.q
            + 1e-3
            * torch.rand(expected.q.shape, generator=torch.Generator().manual_seed(0)).double()
        )
        torch.testing.assert_close(
            replace(other).step(state, near=far).q, expected.q, rtol=0.0, atol=1e-8
        )
    refuses(InputError, "near has shape", simulator.step, state, near=new.q[0])
