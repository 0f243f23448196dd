"""A block on obstacles and on a plate beside theory: inclines, stopping distances, and hundreds of throws."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.contact import BLOCK, SOFT, WEIGHT, D, G, crossings_and_gap, distances, on_obstacles, resting_floor, solves
from warp_resphys import Body, Mesh, Rigid, Scene, Simulator, SolverSettings, State, SurfaceContact, box_hexahedra
from warp_resphys.energies.contact.contact_points import vertex_areas
from warp_resphys.mesh.boxes import box_tetrahedra
from warp_resphys.mesh.selection import select_vertices
from warp_resphys.settings.contact import Box, Capsule, Cylinder, HalfSpace, Sphere

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


@pytest.mark.parametrize(("mu", "kind"), [(0.2, "soft"), (0.5, "soft"), (0.5, "rigid")])
def test_a_cube_on_a_held_plate_slides_beyond_the_angle_of_friction_alone(mu, kind, device):
    """A degree below it gains no speed in 0.15 s, a degree above that of Coulomb's law.

    Its height changes by some micrometres as its vertices pass over edges of the plate.
    """
    plate = box_hexahedra((0.06, 0.06, 0.01), (6, 6, 1))
    raised = replace(BLOCK, vertices=BLOCK.vertices + [0.0203, 0.0197, 0.0109])
    own = Body(raised) if kind == "soft" else Body.rigid_body(raised, Rigid())
    bodies = {"plate": Body(plate, fixed=select_vertices(plate, z=0.0)), "cube": own}
    scene, speed = Scene(bodies, SurfaceContact(2e4, mu, slip_speed=1e-3)), 1e-3
    gains = []
    for beyond in (-1.0, 1.0):
        a = math.atan(mu) + math.radians(beyond)
        s = Simulator(scene, SOFT, 5e-3, (G * math.sin(a), 0.0, -G * math.cos(a)), device=device)
        with torch.no_grad():
            v = s.rollout(s.rest_state(), 60).v[[30, 60], 0, scene.vertex_slice("cube"), 0].mean(1)
        gains.append(float(v[1] - v[0]))
    assert abs(gains[0]) < 0.1 * speed
    assert math.tan(a) - gains[1] / (30 * s.time_step * G * math.cos(a)) == pytest.approx(mu, abs=2e-3)


def turned(mesh, random, place):
    """A mesh turned at random about its middle, with its middle at a place [m]."""
    middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    return replace(mesh, vertices=(mesh.vertices - middle) @ Rotation.random(rng=random).as_matrix().T + place)


@pytest.mark.parametrize(("distance", "dtype"), itertools.product((1e-3, 1e-4), (torch.float64, torch.float32)))
def test_thrown_blocks_never_cross(distance, dtype, device):
    """Throws of two or three blocks of random sizes, the second of which is rigid in every other throw."""
    random, hits, throws = np.random.default_rng(0), 0, 10
    for k in range(throws):
        speed, h = 10.0 ** random.uniform(-0.5, 1.0), 10.0 ** random.uniform(-3.3, -2.0)
        way = random.normal(size=3)
        way /= np.linalg.norm(way)
        bodies, velocities = {}, []
        for number in range(2 + k % 2):
            mesh = box_tetrahedra(random.uniform(0.01, 0.04, 3).tolist(), random.integers(1, 4, 3).tolist())
            # Half of the longest diagonal is 35 mm: none overlap at the start.
            place = way * (0.08 * number - 0.04) + 0.004 * random.normal(size=3)
            block, rigid = turned(mesh, random, place), number == 1 and k // 2 % 2 == 1
            bodies[f"body{number}"] = Body.rigid_body(block) if rigid else Body(block)
            velocities.append(np.tile((0.5 - number) * speed * way, (len(mesh.vertices), 1)))
        scene = Scene(bodies, SurfaceContact(10.0 ** random.uniform(4, 6), random.uniform(0.0, 1.0), distance))
        solver = SolverSettings(relative_tolerance=1e-8 if dtype == torch.float64 else 1e-5, on_failure="count")
        s = Simulator(scene, SOFT, h, (0.0, 0.0, 0.0), solver=solver, dtype=dtype, device=device)
        with torch.no_grad():
            start = s.state(scene.vertices, np.concatenate(velocities))
            path = s.rollout(start, min(60, int(0.12 / speed / h) + 5))
        assert crossings_and_gap(scene.mesh, path.q[:, 0], distance)[0] == solves(path)[0] == 0
        hits += bool((path.v[-1] - path.v[0])[0].norm(dim=-1).max() > 0.1 * speed)
    assert hits > 0.8 * throws
