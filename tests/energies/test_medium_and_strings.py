"""A medium around a body and weights on strings against closed forms of what moves in and under them."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from support.refusals import refuses
from warp_resphys import Body, Corotated, Inputs, PointMass, Simulator, SolverSettings, State, select_vertices
from warp_resphys.energies.medium import Medium
from warp_resphys.energies.strings import Strings
from warp_resphys.io.errors import InputError
from warp_resphys.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.mesh.volume_mesh import boundary_faces
from warp_resphys.stepping.integrators import INTEGRATORS
from warp_resphys.studies.gradient_check import POSES, check_gradients

SIZE = (0.04, 0.03, 0.02)
BOX = box_hexahedra(SIZE, (2, 2, 2))
MESHES = {"hexahedra": BOX, "tetrahedra10": box_tetrahedra(SIZE, (2, 2, 2), order=2)}
STIFF = Corotated(1e6, 0.3, density=1000.0)
MASS = 1000.0 * math.prod(SIZE)
ACROSS = 2 * SIZE[0] * SIZE[1]  # the two faces across z
ALONG = 2 * (SIZE[0] + SIZE[1]) * SIZE[2]


def simulator(medium, mesh=BOX, gravity=0.0, fixed=(), step=0.01, material=STIFF, **more):
    body, more = Body(mesh, fixed=fixed, energies=(medium,)), {"relative_tolerance": 1e-9, **more}
    return Simulator(body, material, time_step=step, gravity=(0.0, 0.0, -gravity), solver="newton", **more)


def coasting(sim, speed):
    rest = sim.rest_state()
    v = torch.zeros_like(rest.q)
    v[..., 2] = speed
    return State(rest.q, v)


@pytest.mark.parametrize("mesh", MESHES)
def test_a_body_that_sinks_reaches_its_terminal_velocity(mesh):
    """Weight less buoyancy is rho / 2 v^2 times the drag coefficients and areas of the body."""
    normal, tangential, density = 1.1, 0.3, 800.0
    sim = simulator(Medium(density, normal=normal, tangential=tangential), MESHES[mesh], gravity=9.81)
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
    torch.testing.assert_close(floats.static_equilibrium().q[0], floats.rest_positions, rtol=0.0, atol=1e-9)
    hangs = simulator(Medium(1000.0, normal=1.0, buoyancy=False), gravity=9.81, fixed=fixed, material=soft)
    bare = replace(hangs, body=Body(BOX, fixed=fixed))
    torch.testing.assert_close(hangs.static_equilibrium().q, bare.static_equilibrium().q, rtol=0.0, atol=1e-12)
    assert float((bare.static_equilibrium().q[0] - bare.rest_positions).abs().max()) > 5e-4


def test_drag_takes_energy_and_never_adds_any():
    """Over steps that are far too long for it."""
    sim = simulator(Medium(1000.0, linear=1e5, normal=100.0, tangential=10.0), step=0.1, integrator="implicit_euler")
    speeds = sim.rollout(coasting(sim, 5.0), 20).v[:, 0].norm(dim=-1).mean(-1)
    assert bool((speeds[1:] <= speeds[:-1] + 1e-9).all())
    assert float(speeds[-1]) < 0.01 * 5.0


@pytest.mark.parametrize(("integrator", "start"), [*zip(INTEGRATORS, POSES, strict=True)])
def test_gradients(integrator, start, device):
    mesh = box_hexahedra((0.06, 0.02, 0.02), (3, 1, 1))
    medium = Medium(900.0, linear=30.0, normal=1.2, tangential=0.2, layer=4e-3)
    material = Corotated(1e5, 0.45, mass_damping=0.5, stiffness_damping=2e-3)
    more = {"material": material, "integrator": integrator, "device": device, "relative_tolerance": 1e-12}
    sim = simulator(medium, mesh, 9.8, select_vertices(mesh, x=0.0), **more)
    rows = {row.parameter: row for row in check_gradients(sim, start, steps=3, together=False)}
    assert {"medium_density", "drag_linear", "drag_normal", "drag_tangential", "added_layer"} <= {
        name.partition(",")[0] for name in rows
    }
    wrong = {name: row for name, row in rows.items() if abs(row.adjoint - row.difference) > 3.0 * row.uncertainty}
    # Differences across a velocity of zero, where the cube of its size has no third derivative, are off by more.
    assert {name: row.relative_error for name, row in wrong.items() if not row.relative_error < 1e-5} == {}


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Medium(-1.0), "medium_density is"),
        (lambda: Medium(1000.0, normal=-2.0), "drag_normal is"),
        (lambda: simulator(Medium(1.0, faces=np.array([[0, 1, 2]]))), "the faces that a medium acts on must belong"),
        # Vertices of the surface, but no face of it.
        (lambda: simulator(Medium(1.0, faces=boundary_faces(BOX)[:2].reshape(4, 2).repeat(2, 1))), "the faces that a"),
    ],
)
def test_what_surrounds_nothing(make, sentence):
    refuses(InputError, "^" + re.escape(sentence), make)


BEAM = box_hexahedra((0.1, 0.03, 0.03), (6, 2, 2))
TIP = select_vertices(BEAM, x=0.1, z=0.03)
SOFT = Corotated(264e3, 0.49, stiffness_damping=0.002)
RIGID = replace(SOFT, youngs_modulus=1e12, stiffness_damping=0.0)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-10)
G = 9.81


def hanging(length=0.2, compliance=0.0, material=SOFT, tied=TIP, step=0.005, toe=1e-5, integrator="implicit_euler"):
    body = clamped(BEAM, energies=(Strings([tied], length, compliance, toe=toe),))
    return Simulator(body, material, step, (0.0, 0.0, -G), integrator, TIGHT)


def weight(*kilograms):
    return Inputs(payload=np.array(kilograms)[:, None])


def swing(sim, angle, steps, mass=0.05, length=0.2):
    """(T + 1, 3) from the tip to a weight that begins still, at an angle from below."""
    rest = sim.rest_state()
    tied = rest.q[:, TIP].mean(1, keepdim=True)
    offset = length * torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], dtype=torch.float64)
    state = replace(rest, memory={"payload_position": tied + offset, "payload_velocity": torch.zeros_like(tied)})
    offsets = [offset]
    for _ in range(steps):
        state = sim.step(state, weight(mass))
        offsets.append((state.memory["payload_position"] - state.q[:, TIP].mean(1, keepdim=True))[0, 0])
    return torch.stack(offsets)


@pytest.mark.slow
def test_a_weight_on_a_rigid_body_is_a_pendulum():
    """A quarter of the period 2 pi sqrt(L / g) (1 + a^2 / 16) after it is let go, it is below, on a taut string."""
    length, angle, step = 0.2, 0.4, 0.001
    quarter = 0.5 * math.pi * math.sqrt(length / G) * (1.0 + angle**2 / 16.0)
    motion = swing(hanging(length, 0.0, RIGID, step=step, integrator="bdf2"), angle, round(2 * quarter / step))
    crossing = int(torch.argmax((motion[:, 0] < 0.0).int()))
    assert crossing * step == pytest.approx(quarter, abs=2 * step)
    torch.testing.assert_close(motion.norm(dim=1), torch.full_like(motion[:, 0], length), rtol=0.0, atol=2e-4)
    assert float(motion[-1, 0]) == pytest.approx(-length * math.sin(angle), rel=0.01)


@pytest.mark.slow
def test_a_compliant_string_bounces():
    """Below what it is tied to the weight oscillates with the period 2 pi sqrt(m c)."""
    mass, compliance, step = 0.05, 0.01, 5e-4
    motion = swing(hanging(0.2, compliance, RIGID, step=step, toe=1e-6, integrator="midpoint"), 0.0, 300)
    bounce, time = motion[:, 2] + 0.2 + mass * G * compliance, step * torch.arange(301, dtype=torch.float64)
    expected = mass * G * compliance * torch.cos(time / math.sqrt(mass * compliance))
    torch.testing.assert_close(bounce, expected, rtol=0.0, atol=0.02 * mass * G * compliance)


def test_a_body_that_falls_faster_than_its_weight_leaves_it_behind():
    """The tip of a beam that is let go straight does: the weight falls freely, and the beam knows nothing of it."""
    sim, steps = hanging(integrator="bdf2"), 4
    loaded, bare = (sim.rollout(sim.rest_state(), steps, weight(mass)) for mass in (0.05, 0.0))
    torch.testing.assert_close(loaded.q, bare.q, rtol=0.0, atol=1e-5)
    fallen = float(sim.rest_positions[TIP, 2].mean()) - 0.2 - float(loaded.final.memory["payload_position"][0, 0, 2])
    assert fallen == pytest.approx(0.5 * G * (steps * sim.time_step) ** 2, rel=0.3)
    assert float(bare.q[-1, 0, TIP, 2].mean()) < 0.03 - 0.5 * G * (steps * sim.time_step) ** 2


@pytest.mark.parametrize(("integrator", "compliance"), [("implicit_euler", 0.01), ("bdf2", 0.0), ("midpoint", 0.01)])
def test_an_equilibrium_stays(integrator, compliance):
    """That of a weight that is part of the body, and steps do not leave it."""
    sim = hanging(compliance=compliance, integrator=integrator)
    start = sim.static_equilibrium(weight(0.05, 0.0))
    glued = replace(sim, body=clamped(BEAM, point_masses=[PointMass(0.05, TIP)])).static_equilibrium()
    torch.testing.assert_close(start.q[0], glued.q[0], rtol=0.0, atol=1e-9)
    after = sim.rollout(start, 20, weight(0.05, 0.0))
    torch.testing.assert_close(after.q[-1], start.q, rtol=0.0, atol=1e-8)
    hangs = (after.final.memory["payload_position"] - after.final.q[:, TIP].mean(1, keepdim=True))[0, 0]
    assert float(-hangs[2]) == pytest.approx(0.2 + 0.05 * G * compliance, abs=1e-5)


@pytest.mark.parametrize(("integrator", "start"), [*zip(INTEGRATORS, POSES, strict=True)])
def test_gradients_of_strings(integrator, start, device):
    """Gradients by weights, lengths and compliances: taut and slack strings, and on the way between."""
    strings = Strings([TIP, select_vertices(BEAM, x=0.05, z=0.0)[:1]], [0.2, 0.1], 1e-2, toe=2e-2)
    body = clamped(BEAM, energies=(strings,))
    material = replace(SOFT, mass_damping=0.5)
    solver = TIGHT.changed(relative_tolerance=1e-12)
    sim = Simulator(body, material, time_step=0.01, integrator=integrator, solver=solver, device=device)
    rows = check_gradients(sim, start, steps=5)
    own = {row.parameter: row for row in rows if row.parameter.startswith(("payload", "string"))}
    kinds = ("", ", each string", ", each environment")
    assert [*own] == ["payload", *(f"string_{name}{kind}" for name in ("length", "compliance") for kind in kinds)]
    # A difference across a string that tightens tells less than the adjoint.
    wrong = {
        row.parameter: row.relative_error
        for row in rows
        if not (row.relative_error <= 1e-5 or abs(row.adjoint - row.difference) <= 3.0 * row.uncertainty)
    }
    assert wrong == {}
    assert own["payload"].relative_error < 1e-5


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: Strings([], 0.1), "there is no string: say what each is tied to, or leave the strings out."),
        (lambda: Strings([np.array([], int)], 0.1), "string 1 is tied to no vertex"),
        (lambda: Strings([TIP], 0.0), "string_length is"),
        (lambda: Strings([TIP], 0.1, -1.0), "string_compliance is"),
        (lambda: Strings([TIP], 0.1, toe=0.0), "the toe of strings is 0"),
        (lambda: hanging(tied=np.array([999])), "string 1 is tied to a vertex that is not among the 63 of the mesh."),
        (lambda: hanging([0.1, 0.2]).prepare(), "string_length has 2 values for 1 strings"),
        (lambda: hanging().rollout(hanging().rest_state(), 1, weight(-1.0)), "payload is -1: it must be zero or more"),
        (lambda: Simulator(clamped(BEAM)).step(hanging().step(hanging().rest_state())), "'payload_position'"),
    ],
)
def test_what_cannot_hang(make, sentence):
    refuses(InputError, re.escape(sentence), make)
