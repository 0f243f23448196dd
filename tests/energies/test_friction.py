"""Bristle friction against the closed forms of Dahl's model, and its gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid

from warp_resphys import Body, Corotated, Inputs, Simulator, SolverSettings, State, box_hexahedra, select_vertices
from warp_resphys.energies.friction import BristleFriction
from warp_resphys.io.errors import InputError
from warp_resphys.studies.gradient_check import check_gradients

SIZE = (0.06, 0.02, 0.02)
MESH = box_hexahedra(SIZE, (3, 1, 1))
LEFT, RIGHT = select_vertices(MESH, x=0.0), select_vertices(MESH, x=SIZE[0])
FORCE, LENGTH = 2.0, 1e-3
MATERIAL = Corotated(1e5, 0.4, mass_damping=0.5, stiffness_damping=2e-3)
TIGHT = SolverSettings("newton", relative_tolerance=1e-12)


def simulator(pairs, fixed=LEFT, **options):
    body = Body(MESH, fixed=fixed, energies=[BristleFriction(pairs, FORCE, LENGTH)])
    return Simulator(body, MATERIAL, solver=TIGHT, gravity=(0.0, 0.0, 0.0), **options)


def pulled(slides):
    """(T,) deflections while one clamp is pulled away from the other, (T,) slides [m]."""
    fixed = np.union1d(LEFT, RIGHT)
    s = simulator([[LEFT[0], RIGHT[0]]], fixed)
    rest = s.rest_positions[s.fixed]
    moves = torch.as_tensor(slides)[:, None, None] * torch.as_tensor(np.isin(s.fixed.numpy(), RIGHT))[:, None]
    targets = rest + moves * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    state, deflections = s.rest_state(), []
    for target in targets:
        state, _ = s.step(state, Inputs(fixed_positions=target[None]))
        deflections.append(float(state.memory["bristle_deflection"]))
    return np.array(deflections)


def test_the_force_approaches_the_friction_force_as_an_exponential():
    slides = np.linspace(0.0, 5.0 * LENGTH, 11)[1:]
    np.testing.assert_allclose(pulled(slides), LENGTH * (1.0 - np.exp(-slides / LENGTH)), rtol=1e-9)


def test_a_cycle_takes_the_work_of_the_closed_form():
    amplitude, steps = 1.5 * LENGTH, 60
    slides = amplitude * np.sin(2.0 * math.pi * np.arange(3 * steps + 1) / steps)
    force = FORCE * pulled(slides) / LENGTH
    work = trapezoid(force[-steps - 1 :], slides[-steps - 1 :])
    assert work == pytest.approx(4.0 * FORCE * (amplitude - LENGTH * math.tanh(amplitude / LENGTH)), rel=2e-3)


@pytest.mark.parametrize("slide", [3e-4, -7e-4])
def test_the_force_on_a_vertex_is_that_of_the_bristles(slide):
    """A vertex is moved along its line from a deflection of half the bristle length."""
    s = simulator([[LEFT[0], RIGHT[0]]])
    state = s.rest_state()
    state = State(state.q, state.v, memory={"bristle_deflection": torch.full((1, 1), 0.5 * LENGTH).double()})
    x = state.q.clone()
    x[0, RIGHT[0], 0] += slide
    acting, absent = (
        s.linearise(state, parameters={"friction_force": force}).residual(x)[0, RIGHT[0]] for force in (FORCE, 0.0)
    )
    most = math.copysign(LENGTH, slide)
    expected = FORCE * (most + (0.5 * LENGTH - most) * math.exp(-abs(slide) / LENGTH)) / LENGTH
    np.testing.assert_allclose(acting - absent, [expected, 0.0, 0.0], atol=1e-9)


def test_a_pose_stays_where_friction_holds_it():
    """A static equilibrium is a step: none without loads, and one after another pose keeps a deflection."""
    s = simulator([[LEFT[0], RIGHT[0]], [LEFT[3], RIGHT[3]]])
    torch.testing.assert_close(s.static_equilibrium().q[0], s.rest_positions, rtol=0.0, atol=1e-12)
    force = torch.zeros(1, len(MESH.vertices), 3, dtype=torch.float64)
    force[:, RIGHT, 0] = 1.0
    pulled_out = s.static_equilibrium(Inputs(force))
    left = s.static_equilibrium(after=pulled_out)
    slides = [float((state.q[0, RIGHT] - s.rest_positions[RIGHT])[:, 0].mean()) for state in (pulled_out, left)]
    assert 0.01 * slides[0] < slides[1] < slides[0]
    assert left.memory["bristle_deflection"].shape == (1, 2)


@pytest.mark.parametrize(
    ("integrator", "pairs"),
    [("implicit_euler", [[LEFT[0], RIGHT[0]]]), ("midpoint", [[LEFT[0], RIGHT[0]], [LEFT[1], RIGHT[2]]])],
)
def test_gradients_of_a_rollout_equal_differences(integrator, pairs):
    s = simulator(pairs, integrator=integrator)
    rows = check_gradients(s, "bent", steps=3)
    assert {"friction_force, each line", "bristle_length, each line"} <= {row.parameter for row in rows}
    assert {row.parameter: row.relative_error for row in rows if not row.relative_error <= 1e-6} == {}


@pytest.mark.parametrize(
    ("arguments", "name"), [(([[1, 1]], 1.0, 1e-3), "lines"), (([[0, 1]], 1.0, 0.0), "bristle_length")]
)
def test_what_cannot_be_simulated_is_named(arguments, name):
    with pytest.raises(InputError, match=name):
        BristleFriction(*arguments)
