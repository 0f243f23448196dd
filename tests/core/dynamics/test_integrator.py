"""Time integrators against closed forms and against their own limit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.clamped import clamped
from warp_resphys import (
    Body,
    Corotated,
    PointMass,
    Simulator,
    State,
    box_hexahedra,
    box_tetrahedra,
    select_vertices,
)
from warp_resphys.core.stepping.inputs import Inputs
from warp_resphys.core.stepping.integrators import INTEGRATORS
from warp_resphys.io.errors import InputError

SOFT = Corotated(2e4, 0.3, density=1000.0, mass_damping=1.0, stiffness_damping=3e-3)
MESH = box_hexahedra((0.04, 0.02, 0.02), (2, 1, 1))
CLAMPED = clamped(MESH)
TIGHT = {"solver": "newton", "relative_tolerance": 1e-10}
WEIGHTLESS = (0.0, 0.0, 0.0)


def swing(integrator, steps, material=SOFT, duration=0.04, moving=False):
    """Positions and velocities at the end of a large motion that starts smoothly."""
    simulator = Simulator(CLAMPED, material, duration / steps, integrator=integrator, **TIGHT)
    state = simulator.rest_state()
    x = state.q[..., :1] / 0.04
    v = 1.5 * torch.cat([0 * x, x**2, -0.5 * x**2], dim=-1)
    targets = None
    if moving:
        time = torch.linspace(0, duration, steps + 1, dtype=torch.float64)[1:]
        shift = 5e-3 * torch.sin(time / duration * np.pi / 2) ** 3
        targets = state.q[:, simulator.fixed] + shift[:, None, None, None] * torch.tensor(
            [0.0, 1.0, 0.0]
        )
    trajectory = simulator.rollout(State(state.q, v), steps, Inputs(fixed_positions=targets))
    return trajectory.q[-1], trajectory.v[-1]


@pytest.mark.parametrize(
    ("integrator", "order", "moving", "prony"),
    [
        ("implicit_euler", 1, False, ()),
        *((integrator, 2, True, ()) for integrator in ("bdf2", "midpoint")),
        *((integrator, 2, False, [(0.4, 0.02), (0.2, 0.3)]) for integrator in ("bdf2", "midpoint")),
    ],
)
def test_order_of_convergence(integrator, order, moving, prony):
    """Large rotations and strains, dampings and branches:
    positions and velocities converge at the order.
    """
    material = replace(SOFT, prony=prony)
    results = [swing(integrator, steps, material, moving=moving) for steps in (32, 64, 128)]
    free = torch.as_tensor(np.setdiff1d(np.arange(len(MESH.vertices)), CLAMPED.fixed_vertices))
    for quantity in (0, 1):
        coarse, middle, fine = (r[quantity][:, free] for r in results)
        observed = torch.log2((coarse - middle).abs().max() / (middle - fine).abs().max())
        assert float(observed) == pytest.approx(order, abs=0.25)


GROWTH = {
    # Damping alone, v' = -alpha v: the amplification of a step with a = alpha h.
    "implicit_euler": lambda a, n: (1 + a) ** -n,
    "midpoint": lambda a, n: ((1 - a / 2) / (1 + a / 2)) ** n,
}


def bdf2_decay(a, n):
    v = [1.0, 1.0 / (1 + a)]
    for _ in range(n - 1):
        v.append((4 * v[-1] - v[-2]) / (3 + 2 * a))
    return v[n]


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_mass_damping_of_a_translation_is_exact(integrator, device):
    h, alpha, steps = 0.02, 5.0, 6
    material = Corotated(1e5, 0.4, density=1000.0, mass_damping=alpha)
    simulator = Simulator(Body(MESH), material, h, WEIGHTLESS, integrator, device=device, **TIGHT)
    rest = simulator.rest_state()
    v = simulator.tensor([0.3, -0.2, 0.1]).expand_as(rest.v)
    final = simulator.rollout(State(rest.q, v), steps).final
    factor = (
        bdf2_decay(alpha * h, steps)
        if integrator == "bdf2"
        else GROWTH[integrator](alpha * h, steps)
    )
    torch.testing.assert_close(final.v, factor * v, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_free_fall(integrator):
    h, steps, g, undamped = 0.01, 10, -9.81, replace(SOFT, mass_damping=0.0, stiffness_damping=0.0)
    simulator = Simulator(Body(MESH), undamped, h, (0, 0, g), integrator, **TIGHT)
    final = simulator.rollout(simulator.rest_state(), steps).final
    t = h * steps
    torch.testing.assert_close(
        final.v[..., 2], torch.full_like(final.v[..., 2], g * t), rtol=1e-8, atol=0.0
    )
    fallen = (final.q - simulator.rest_positions)[0, :, 2]
    # Implicit Euler is ahead by g h t / 2; the starting step costs BDF2 a part of g h^2.
    early = {
        "implicit_euler": g * t * h / 2,
        "midpoint": 0.0,
        "bdf2": float(fallen[0]) - g * t**2 / 2,
    }[integrator]
    assert abs(early) <= abs(g * t * h / 2) + 1e-12
    torch.testing.assert_close(
        fallen, torch.full_like(fallen, g * t**2 / 2 + early), rtol=1e-7, atol=0.0
    )


def total_momenta(simulator, state):
    mass = simulator.prepare().mass[0, :, None]
    p = mass * state.v[0]
    return p.sum(0), torch.linalg.cross(state.q[0], p).sum(0)


def test_midpoint_conserves_momenta_and_rigid_rotations_are_not_damped():
    """A spinning free body: viscosity acts on strain rates, not on rotations."""
    h, omega = 2e-3, 8.0
    viscous = replace(SOFT, mass_damping=0.0, stiffness_damping=0.05)
    simulator = Simulator(Body(MESH), viscous, h, WEIGHTLESS, "midpoint", **TIGHT)
    rest = simulator.rest_state()
    centred = rest.q - torch.tensor([0.02, 0.01, 0.01], dtype=torch.float64)
    axis = torch.tensor([0.0, 0.0, omega], dtype=torch.float64)
    state = State(rest.q, torch.linalg.cross(axis.expand_as(centred), centred))
    before = total_momenta(simulator, state)
    after = total_momenta(simulator, simulator.rollout(state, 100).final)
    torch.testing.assert_close(after[0], before[0], rtol=0.0, atol=1e-10)
    torch.testing.assert_close(after[1], before[1], rtol=1e-4, atol=1e-10)


def test_point_mass_weighs_and_slows():
    """A body of no weight of its own with a mass on its tip face is a spring: omega^2 = k / m."""
    mesh = box_tetrahedra((0.04, 0.02, 0.02), (2, 1, 1), 2)
    tip, grams = select_vertices(mesh, x=0.04), 0.05
    body = clamped(mesh, point_masses=[PointMass(grams, tip)])
    light = Corotated(2e4, 0.3, density=1e-3)
    g, h = 1e-2, 1e-3
    simulator = Simulator(body, light, h, (0.0, 0.0, -g), "midpoint", **TIGHT)
    np.testing.assert_allclose(simulator.prepare().mass.sum() - grams, 1e-3 * 1.6e-5, rtol=1e-6)
    sag = -float((simulator.static_equilibrium().q[0] - simulator.rest_positions)[tip, 2].mean())
    bare = Simulator(clamped(mesh), light, h, WEIGHTLESS, **TIGHT)
    force = torch.zeros_like(bare.rest_state().q)
    force[:, tip, 2] = -grams * g / len(tip)
    pulled = -float(
        (bare.static_equilibrium(Inputs(force)).q[0] - bare.rest_positions)[tip, 2].mean()
    )
    assert sag == pytest.approx(pulled, rel=1e-4)
    omega = np.sqrt(g / sag)  # k / m
    quarter = round(np.pi / omega / h)
    q = simulator.rollout(simulator.rest_state(), quarter).q[:, 0, tip, 2].mean(-1)
    drop = float(simulator.rest_positions[tip, 2].mean() - q[-1])
    # Half a period after the release: twice the sag.
    assert drop == pytest.approx(2 * sag, rel=0.02)


def test_unknown_integrator_is_refused():
    with pytest.raises(InputError, match="integrator is"):
        Simulator(CLAMPED, integrator="rk4")
