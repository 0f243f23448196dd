"""A medium around a body against closed forms of what moves in it."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.refusals import refuses
from warp_resphys import Body, Corotated, Inputs, Simulator, State, select_vertices
from warp_resphys.core.dynamics.gradient_check import POSES, check_gradients
from warp_resphys.core.energies.medium import Medium
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.core.mesh.volume_mesh import boundary_faces
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.io.errors import InputError

SIZE = (0.04, 0.03, 0.02)
BOX = box_hexahedra(SIZE, (2, 2, 2))
MESHES = {"hexahedra": BOX, "tetrahedra10": box_tetrahedra(SIZE, (2, 2, 2), order=2)}
STIFF = Corotated(1e6, 0.3, density=1000.0)
MASS = 1000.0 * math.prod(SIZE)
ACROSS = 2 * SIZE[0] * SIZE[1]  # the two faces across z
ALONG = 2 * (SIZE[0] + SIZE[1]) * SIZE[2]


def simulator(medium, mesh=BOX, gravity=0.0, fixed=(), step=0.01, material=STIFF, **more):
    body, more = Body(mesh, fixed=fixed, energies=(medium,)), {"relative_tolerance": 1e-9, **more}
    return Simulator(
        body, material, time_step=step, gravity=(0.0, 0.0, -gravity), solver="newton", **more
    )


def coasting(sim, speed):
    rest = sim.rest_state()
    v = torch.zeros_like(rest.q)
    v[..., 2] = speed
    return State(rest.q, v)


@pytest.mark.parametrize("mesh", MESHES)
def test_a_body_that_sinks_reaches_its_terminal_velocity(mesh):
    """Weight less buoyancy is rho / 2 v^2 times the drag coefficients and areas of the body."""
    normal, tangential, density = 1.1, 0.3, 800.0
    sim = simulator(
        Medium(density, normal=normal, tangential=tangential), MESHES[mesh], gravity=9.81
    )
    speeds = sim.rollout(sim.rest_state(), 200).v[-1, 0, :, 2]
    resistance = 0.5 * density * (normal * ACROSS + tangential * ALONG)
    expected = math.sqrt((1.0 - density / 1000.0) * MASS * 9.81 / resistance)
    assert float(speeds.mean()) == pytest.approx(-expected, rel=2e-3)


@pytest.mark.parametrize("integrator", ["implicit_euler", "midpoint"])
def test_linear_drag_slows_a_body_down_exponentially(integrator):
    linear, steps, step = 40.0, 50, 0.002
    sim = simulator(Medium(1000.0, linear=linear), step=step, integrator=integrator)
    after = sim.rollout(coasting(sim, 0.3), steps).v[-1, 0, :, 2].mean()
    rate = linear * (ACROSS + ALONG) / MASS
    assert float(after) == pytest.approx(0.3 * math.exp(-rate * steps * step), rel=0.02)
    assert rate * steps * step > 0.8


def test_added_mass_shares_a_push():
    layer, force, steps = 0.01, 0.05, 20
    sim = simulator(Medium(1000.0, layer=layer), integrator="bdf2")
    push = torch.zeros_like(sim.rest_positions)[None]
    masses = sim.prepare().mass
    push[..., 2] = force * masses / masses.sum()
    speed = sim.rollout(sim.rest_state(), steps, Inputs(external_force=push)).v[-1, 0, :, 2] @ (
        masses[0] / masses.sum()
    )
    expected = force / (MASS + 1000.0 * layer * ACROSS) * steps * sim.time_step
    assert float(speed) == pytest.approx(expected, rel=0.01)


def test_what_is_as_heavy_as_the_medium_floats():
    fixed = select_vertices(BOX, x=0.0)
    soft = replace(STIFF, youngs_modulus=1e4)
    floats = simulator(Medium(1000.0, normal=1.0), gravity=9.81, fixed=fixed, material=soft)
    torch.testing.assert_close(
        floats.static_equilibrium().q[0], floats.rest_positions, rtol=0.0, atol=1e-9
    )
    hangs = simulator(
        Medium(1000.0, normal=1.0, buoyancy=False), gravity=9.81, fixed=fixed, material=soft
    )
    bare = replace(hangs, body=Body(BOX, fixed=fixed))
    torch.testing.assert_close(
        hangs.static_equilibrium().q, bare.static_equilibrium().q, rtol=0.0, atol=1e-12
    )
    assert float((bare.static_equilibrium().q[0] - bare.rest_positions).abs().max()) > 5e-4


def test_drag_takes_energy_and_never_adds_any():
    """Over steps that are far too long for it."""
    sim = simulator(
        Medium(1000.0, linear=1e5, normal=100.0, tangential=10.0),
        step=0.1,
        integrator="implicit_euler",
    )
    speeds = sim.rollout(coasting(sim, 5.0), 20).v[:, 0].norm(dim=-1).mean(-1)
    assert bool((speeds[1:] <= speeds[:-1] + 1e-9).all())
    assert float(speeds[-1]) < 0.01 * 5.0


@pytest.mark.parametrize(("integrator", "start"), [*zip(INTEGRATORS, POSES, strict=True)])
def test_gradients(integrator, start, device):
    mesh = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
    medium = Medium(900.0, linear=30.0, normal=1.2, tangential=0.2, layer=4e-3)
    material = Corotated(1e5, 0.45, mass_damping=0.5, stiffness_damping=2e-3)
    more = {
        "material": material,
        "integrator": integrator,
        "device": device,
        "relative_tolerance": 1e-12,
    }
    sim = simulator(medium, mesh, 9.8, select_vertices(mesh, x=0.0), **more)
    rows = {row.parameter: row for row in check_gradients(sim, start, steps=3, together=False)}
    assert {"medium_density", "drag_linear", "drag_normal", "drag_tangential", "added_layer"} <= {
        name.partition(",")[0] for name in rows
    }
    wrong = {
        name: row
        for name, row in rows.items()
        if abs(row.adjoint - row.difference) > 3.0 * row.uncertainty
    }
    # Differences across a velocity of zero, where the cube of its size has no third derivative, are
    # off by more.
    assert {
        name: row.relative_error for name, row in wrong.items() if not row.relative_error < 1e-5
    } == {}


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Medium(-1.0), "medium_density is"),
        (lambda: Medium(1000.0, normal=-2.0), "drag_normal is"),
        (
            lambda: simulator(Medium(1.0, faces=np.array([[0, 1, 2]]))),
            "the faces that a medium acts on must belong",
        ),
        # Vertices of the surface, but no face of it.
        (
            lambda: simulator(
                Medium(1.0, faces=boundary_faces(BOX)[:2].reshape(4, 2).repeat(2, 1))
            ),
            "the faces that a",
        ),
    ],
)
def test_what_surrounds_nothing(make, sentence):
    refuses(InputError, "^" + re.escape(sentence), make)
