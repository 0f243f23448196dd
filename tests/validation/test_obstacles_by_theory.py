"""A block on obstacles beside theory: inclines, stopping distances, and hundreds of throws."""

import itertools
import math

import numpy as np
import pytest
import torch

from support.contact import BLOCK, WEIGHT, D, G, distances, on_obstacles, resting_floor, solves
from warp_resphys import Mesh, SolverSettings, State
from warp_resphys.energies.contact.contact_points import vertex_areas
from warp_resphys.energies.contact.obstacles import Box, Capsule, Cylinder, HalfSpace, Sphere

SLIP = 1e-3  # v_s [m/s]
AXIS = (0.3, -0.2, 0.9)
SHAPES = {
    "half-space": HalfSpace(axis=AXIS),
    "sphere": Sphere(radius=0.02),
    "capsule": Capsule(radius=0.012, length=0.03, axis=AXIS),
    "box": Box(edges=(0.02, 0.03, 0.04), axis=AXIS),
    "cylinder": Cylinder(radius=0.015, length=0.03, axis=AXIS),
}
integrators = pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])


def slide(mu, angles, integrator, device):
    """Speeds (B,) [m/s] of blocks on inclines half a second and a second after they are let go, and that half [s]."""
    floor = resting_floor(math.cos(float(angles.mean())) * WEIGHT)
    s = on_obstacles(floor, integrator=integrator, device=device)
    given = {"gravity": s.tensor(G * np.stack([np.sin(angles), 0.0 * angles, -np.cos(angles)], 1))}
    with torch.no_grad():
        held = s.rollout(s.rest_state(len(mu)), 100, None, {**given, "contact_friction": 4.0}).final
        given["contact_friction"] = s.tensor(mu[:, None])
        start, half = State(held.q, torch.zeros_like(held.q)), round(0.5 / s.time_step)
        v = s.rollout(start, 2 * half, None, given).v[..., 0].mean(2).cpu().numpy()
    return v[half], v[-1], half * s.time_step


@integrators
def test_blocks_slide_beyond_the_angle_of_friction_alone(integrator, device):
    """At whole degrees around arctan mu; below it they creep by v_s (1 - sqrt(1 - tan a / mu)).

    Beyond, they are accelerated by g (sin a - mu cos a), which is measured from half a degree on.
    """
    frictions, around = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7), range(-3, 5)
    cases = [(mu, math.floor(math.degrees(math.atan(mu))) + more) for mu in frictions for more in around]
    mu, degrees = np.array([case for case in cases if case[1] > 0]).T
    a, beyond = np.radians(degrees), degrees - np.degrees(np.arctan(mu))
    share, acceleration = np.tan(a) / mu, G * (np.sin(a) - mu * np.cos(a))
    half, v, seconds = slide(mu, a, integrator, device)
    assert np.abs(beyond)[(v > SLIP) != (share > 1.0)].max(initial=0.0) < 1.0
    slides, sticks = beyond > 0.5, share < 1.0
    assert (v - half)[slides] / seconds == pytest.approx(acceleration[slides], rel=2e-4)
    assert v[sticks] == pytest.approx(SLIP * (1.0 - np.sqrt(1.0 - share[sticks])), rel=0.02)


@integrators
def test_a_sliding_block_stops_after_its_way(integrator, device):
    """From 1 m/s after v^2 / (2 mu g): of first order for implicit Euler; BDF2 is better than the block is rigid."""
    mu, errors = np.array([0.2, 0.5]), []
    for h in (4e-3, 2e-3, 1e-3):
        s = on_obstacles(resting_floor(WEIGHT), integrator=integrator, time_step=h, device=device)
        given = {"contact_friction": s.tensor(mu[:, None])}
        with torch.no_grad():
            start = s.rollout(s.rest_state(2), round(0.2 / h), None, given).final.q
            speed = s.tensor([1.0, 0.0, 0.0]).expand_as(start).clone()
            end = s.rollout(State(start, speed), round(1.1 / (mu.min() * G) / h), None, given).q[-1]
        errors.append((end - start)[..., 0].mean(1).cpu().numpy() * 2.0 * mu * G - 1.0)
    assert np.abs(errors[-1]).max() < 0.01
    if integrator == "implicit_euler":
        assert np.log2(np.abs(np.array(errors[:-1]) / errors[1:])).min() > 0.9


@pytest.mark.parametrize(("distance", "dtype"), itertools.product((D, 0.1 * D), (torch.float64, torch.float32)))
@pytest.mark.parametrize("shape", SHAPES)
def test_thrown_blocks_never_penetrate(shape, distance, dtype, device):
    """Twenty throws at up to 10 m/s from random directions, with a spin; every solve converges."""
    obstacle, batch = SHAPES[shape], 20
    random = np.random.default_rng([list(SHAPES).index(shape), dtype == torch.float64, distance == D])
    solver = SolverSettings(relative_tolerance=1e-8 if dtype == torch.float64 else 1e-5, on_failure="count")
    mesh = Mesh(BLOCK.vertices + [0.0, 0.0, 0.1], BLOCK.cells)
    options = {"distance": distance, "solver": solver, "time_step": 2e-3, "dtype": dtype, "device": device}
    s = on_obstacles(obstacle, 0.4, mesh=mesh, **options)
    ways = random.normal(size=(batch, 1, 3))
    ways *= np.where(ways @ obstacle.turn[:, 2:] < 0.0, -1.0, 1.0)  # from above a half-space
    ways += 0.7 * np.linalg.norm(ways, axis=-1, keepdims=True) * obstacle.turn[:, 2] * isinstance(obstacle, HalfSpace)
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    spins, speeds = 20.0 * random.normal(size=(batch, 1, 3)), random.uniform(1.0, 10.0, (batch, 1, 1))
    x = mesh.vertices - mesh.vertices.mean(0)
    with torch.no_grad():
        path = s.rollout(State(s.tensor(x + 0.06 * ways), s.tensor(np.cross(spins, x) - speeds * ways)), 40)
    outer = np.flatnonzero(vertex_areas(BLOCK))
    gaps = distances(obstacle, path.q.double().cpu().numpy()[:, :, outer]).min((0, 2))
    assert gaps.min() > 0.0
    assert (gaps < distance).all()  # they hit
    assert solves(path)[0] == 0
