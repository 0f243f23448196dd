"""Weights on strings against closed forms, bodies that they are part of, and differences."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import Corotated, Inputs, PointMass, Simulator, SolverSettings, box_hexahedra, select_vertices
from warp_resphys.energies.strings import Strings
from warp_resphys.io.errors import InputError
from warp_resphys.stepping.integrators import INTEGRATORS
from warp_resphys.studies.gradient_check import POSES, check_gradients

BEAM = box_hexahedra((0.1, 0.03, 0.03), (6, 2, 2))
TIP = select_vertices(BEAM, x=0.1, z=0.03)
SOFT = Corotated(264e3, 0.49, stiffness_damping=0.002)
RIGID = replace(SOFT, youngs_modulus=1e12, stiffness_damping=0.0)
TIGHT = SolverSettings(name="newton", relative_tolerance=1e-10)
G = 9.81


def simulator(length=0.2, compliance=0.0, material=SOFT, tied=TIP, step=0.005, toe=1e-5, integrator="implicit_euler"):
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
    motion = swing(simulator(length, 0.0, RIGID, step=step, integrator="bdf2"), angle, round(2 * quarter / step))
    crossing = int(torch.argmax((motion[:, 0] < 0.0).int()))
    assert crossing * step == pytest.approx(quarter, abs=2 * step)
    torch.testing.assert_close(motion.norm(dim=1), torch.full_like(motion[:, 0], length), rtol=0.0, atol=2e-4)
    assert float(motion[-1, 0]) == pytest.approx(-length * math.sin(angle), rel=0.01)


@pytest.mark.slow
def test_a_compliant_string_bounces():
    """Below what it is tied to the weight oscillates with the period 2 pi sqrt(m c)."""
    mass, compliance, step = 0.05, 0.01, 5e-4
    motion = swing(simulator(0.2, compliance, RIGID, step=step, toe=1e-6, integrator="midpoint"), 0.0, 300)
    bounce, time = motion[:, 2] + 0.2 + mass * G * compliance, step * torch.arange(301, dtype=torch.float64)
    expected = mass * G * compliance * torch.cos(time / math.sqrt(mass * compliance))
    torch.testing.assert_close(bounce, expected, rtol=0.0, atol=0.02 * mass * G * compliance)


def test_a_body_that_falls_faster_than_its_weight_leaves_it_behind():
    """The tip of a beam that is let go straight does: the weight falls freely, and the beam knows nothing of it."""
    sim, steps = simulator(integrator="bdf2"), 4
    loaded, bare = (sim.rollout(sim.rest_state(), steps, weight(mass)) for mass in (0.05, 0.0))
    torch.testing.assert_close(loaded.q, bare.q, rtol=0.0, atol=1e-5)
    fallen = float(sim.rest_positions[TIP, 2].mean()) - 0.2 - float(loaded.final.memory["payload_position"][0, 0, 2])
    assert fallen == pytest.approx(0.5 * G * (steps * sim.time_step) ** 2, rel=0.3)
    assert float(bare.q[-1, 0, TIP, 2].mean()) < 0.03 - 0.5 * G * (steps * sim.time_step) ** 2


@pytest.mark.parametrize(("integrator", "compliance"), [("implicit_euler", 0.01), ("bdf2", 0.0), ("midpoint", 0.01)])
def test_an_equilibrium_stays(integrator, compliance):
    """That of a weight that is part of the body, and steps do not leave it."""
    sim = simulator(compliance=compliance, integrator=integrator)
    start = sim.static_equilibrium(weight(0.05, 0.0))
    glued = replace(sim, body=clamped(BEAM, point_masses=[PointMass(0.05, TIP)])).static_equilibrium()
    torch.testing.assert_close(start.q[0], glued.q[0], rtol=0.0, atol=1e-9)
    after = sim.rollout(start, 20, weight(0.05, 0.0))
    torch.testing.assert_close(after.q[-1], start.q, rtol=0.0, atol=1e-8)
    hangs = (after.final.memory["payload_position"] - after.final.q[:, TIP].mean(1, keepdim=True))[0, 0]
    assert float(-hangs[2]) == pytest.approx(0.2 + 0.05 * G * compliance, abs=1e-5)


@pytest.mark.parametrize(("integrator", "start"), [*zip(INTEGRATORS, POSES, strict=True)])
def test_gradients(integrator, start, device):
    """Of weights, lengths and compliances: taut and slack strings, and on the way between."""
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
        (lambda: simulator(tied=np.array([999])), "string 1 is tied to a vertex that is not among the 63 of the mesh."),
        (lambda: simulator([0.1, 0.2]).prepare(), "string_length has 2 values for 1 strings"),
        (
            lambda: simulator().rollout(simulator().rest_state(), 1, weight(-1.0)),
            "payload is -1: it must be zero or more",
        ),
        (lambda: Simulator(clamped(BEAM)).step(simulator().step(simulator().rest_state())), "'payload_position'"),
    ],
)
def test_what_cannot_hang(make, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        make()
