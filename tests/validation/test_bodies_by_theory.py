"""Bodies on one another: a cube on a slope, and hundreds of throws of blocks at one another."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.contact import SIDE, SOFT, G, crossings_and_gap, solves
from warp_resphys import Body, Rigid, Scene, Simulator, SolverSettings, SurfaceContact, box_hexahedra, select_vertices
from warp_resphys.mesh.boxes import box_tetrahedra


@pytest.mark.parametrize(("mu", "kind"), [(0.2, "soft"), (0.5, "soft"), (0.5, "rigid")])
def test_a_cube_on_a_held_plate_slides_beyond_the_angle_of_friction_alone(mu, kind, device):
    """A degree below it gains no speed in 0.15 s, a degree above that of Coulomb's law.

    Its height changes by some micrometres as its vertices pass over edges of the plate.
    """
    plate = box_hexahedra((0.06, 0.06, 0.01), (6, 6, 1))
    cube = box_hexahedra((SIDE,) * 3, (2, 2, 2))
    raised = replace(cube, vertices=cube.vertices + [0.0203, 0.0197, 0.0109])
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
