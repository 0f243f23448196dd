"""A block on obstacles and on a plate beside theory:
inclines, stopping distances, and hundreds of throws.

Rigid spheres and cylinders that are pressed into a block bonded to a rigid base, beside theory.

The sphere's force is Hertz's, 4/3 E* sqrt(R) d^1.5, with the correction for the thickness of the
layer (Dimitriadis et al. 2002). The cylinder's, along a line, has no limit for a thick layer. It
follows from the displacement u of the surface under a pressure p in plane strain, without friction:
for a wave number k and a layer of the thickness t,

    u(k) = 2 (1 - nu^2) / (E k) K(k t) p(k),
    K(x) = (c sinh 2x - 2x) / (c cosh 2x + 2x^2 + 5 - 12 nu + 8 nu^2),     c = 3 - 4 nu

(Carbone and Mangialardi 2008). Pressures within the contact make u follow the cylinder, and the
contact is where they are positive. Depths are below the undeformed surface and include the gap of
the barrier.

E. K. Dimitriadis et al.: Determination of elastic moduli of thin layers of soft material using the
atomic force microscope. Biophysical Journal 82, 2002. G. Carbone, L. Mangialardi: Analysis of the
adhesive contact of confined layers by using a Green's function approach. Journal of the Mechanics
and Physics of Solids 56, 2008.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation

from support import contact as blocks
from support.contact import pressure
from warp_resphys import (
    Body,
    Contact,
    Mesh,
    Scene,
    Simulator,
    StableNeoHookean,
    State,
    SurfaceContact,
    box_hexahedra,
)
from warp_resphys.core.dynamics.solver_settings import SolverSettings
from warp_resphys.core.energies.contact.contact_points import vertex_areas
from warp_resphys.core.energies.contact.touching_bodies import (
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    Sphere,
)
from warp_resphys.core.fem.rigid_region import Rigid
from warp_resphys.core.mesh.boxes import box_tetrahedra
from warp_resphys.core.mesh.selection import select_vertices

SLIP = 1e-3  # v_s [m/s]
AXIS = (0.3, -0.2, 0.9)
SHAPES = {
    "half-space": HalfSpace(axis=AXIS),
    "sphere": Sphere(radius=0.02),
    "capsule": Capsule(radius=0.012, length=0.03, axis=AXIS),
    "box": Box(edges=(0.02, 0.03, 0.04), axis=AXIS),
    "cylinder": Cylinder(radius=0.015, length=0.03, axis=AXIS),
}
# of every shape both distances and both types, and all four pairs of these
THROWS = [
    (
        shape,
        blocks.D if (number + half) % 2 else 0.1 * blocks.D,
        (torch.float64, torch.float32)[half],
    )
    for number, shape in enumerate(SHAPES)
    for half in (0, 1)
]
integrators = pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])


def slide(mu, angles, integrator, device):
    """Speeds (B,) [m/s] of blocks on inclines half a second and a second
    after they are let go, and that half [s].
    """
    floor = blocks.resting_floor(math.cos(float(angles.mean())) * blocks.WEIGHT)
    s = blocks.on_obstacles(floor, integrator=integrator, device=device)
    given = {
        "gravity": s.tensor(blocks.G * np.stack([np.sin(angles), 0.0 * angles, -np.cos(angles)], 1))
    }
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
    frictions, around = (0.1, 0.4, 0.7), range(-2, 4)
    cases = [
        (mu, math.floor(math.degrees(math.atan(mu))) + more) for mu in frictions for more in around
    ]
    mu, degrees = np.array([case for case in cases if case[1] > 0]).T
    a, beyond = np.radians(degrees), degrees - np.degrees(np.arctan(mu))
    share, acceleration = np.tan(a) / mu, blocks.G * (np.sin(a) - mu * np.cos(a))
    half, v, seconds = slide(mu, a, integrator, device)
    assert np.abs(beyond)[(v > SLIP) != (share > 1.0)].max(initial=0.0) < 1.0
    slides, sticks = beyond > 0.5, share < 1.0
    assert (v - half)[slides] / seconds == pytest.approx(acceleration[slides], rel=2e-4)
    assert v[sticks] == pytest.approx(SLIP * (1.0 - np.sqrt(1.0 - share[sticks])), rel=0.02)


@integrators
def test_a_sliding_block_stops_after_its_way(integrator, device):
    """From 1 m/s after v^2 / (2 mu g): of first order for implicit Euler.

    BDF2 is better than the block is rigid.
    """
    mu, errors = np.array([0.2, 0.5]), []
    for h in (4e-3, 2e-3, 1e-3) if integrator == "implicit_euler" else (1e-3,):
        s = blocks.on_obstacles(
            blocks.resting_floor(blocks.WEIGHT), integrator=integrator, time_step=h, device=device
        )
        given = {"contact_friction": s.tensor(mu[:, None])}
        with torch.no_grad():
            start = s.rollout(s.rest_state(2), round(0.2 / h), None, given).final.q
            speed = s.tensor([1.0, 0.0, 0.0]).expand_as(start).clone()
            end = s.rollout(
                State(start, speed), round(1.1 / (mu.min() * blocks.G) / h), None, given
            ).q[-1]
        errors.append((end - start)[..., 0].mean(1).cpu().numpy() * 2.0 * mu * blocks.G - 1.0)
    assert np.abs(errors[-1]).max() < 0.01
    if integrator == "implicit_euler":
        assert np.log2(np.abs(np.array(errors[:-1]) / errors[1:])).min() > 0.9


@pytest.mark.parametrize(("shape", "distance", "dtype"), THROWS)
def test_thrown_blocks_never_penetrate(shape, distance, dtype, device):
    """Twenty throws at up to 10 m/s from random directions, with a spin; every solve converges."""
    obstacle, batch = SHAPES[shape], 20
    random = np.random.default_rng(
        [list(SHAPES).index(shape), dtype == torch.float64, distance == blocks.D]
    )
    solver = SolverSettings(
        relative_tolerance=1e-8 if dtype == torch.float64 else 1e-5, on_failure="count"
    )
    mesh = Mesh(blocks.BLOCK.vertices + [0.0, 0.0, 0.1], blocks.BLOCK.cells)
    options = {
        "distance": distance,
        "solver": solver,
        "time_step": 2e-3,
        "dtype": dtype,
        "device": device,
    }
    s = blocks.on_obstacles(obstacle, 0.4, mesh=mesh, **options)
    ways = random.normal(size=(batch, 1, 3))
    ways *= np.where(ways @ obstacle.turn[:, 2:] < 0.0, -1.0, 1.0)  # from above a half-space
    ways += (
        0.7
        * np.linalg.norm(ways, axis=-1, keepdims=True)
        * obstacle.turn[:, 2]
        * isinstance(obstacle, HalfSpace)
    )
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    spins = 20.0 * random.normal(size=(batch, 1, 3))
    speeds = random.uniform(1.0, 10.0, (batch, 1, 1))
    x = mesh.vertices - mesh.vertices.mean(0)
    with torch.no_grad():
        path = s.rollout(
            State(s.tensor(x + 0.06 * ways), s.tensor(np.cross(spins, x) - speeds * ways)), 40
        )
    outer = np.flatnonzero(vertex_areas(blocks.BLOCK))
    gaps = blocks.distances(obstacle, path.q.double().cpu().numpy()[:, :, outer]).min((0, 2))
    assert gaps.min() > 0.0
    assert (gaps < distance).all()  # they hit
    assert blocks.solves(path)[0] == 0


@pytest.mark.parametrize(("mu", "kind"), [(0.5, "soft"), (0.2, "rigid")])
def test_a_cube_on_a_held_plate_slides_beyond_the_angle_of_friction_alone(mu, kind, device):
    """A degree below it gains no speed in 0.15 s, a degree above that of Coulomb's law.

    Its height changes by some micrometres as its vertices pass over edges of the plate.
    """
    plate = box_hexahedra((0.06, 0.06, 0.01), (6, 6, 1))
    raised = replace(blocks.BLOCK, vertices=blocks.BLOCK.vertices + [0.0203, 0.0197, 0.0109])
    own = Body(raised) if kind == "soft" else Body.rigid_body(raised, Rigid())
    bodies = {"plate": Body(plate, fixed=select_vertices(plate, z=0.0)), "cube": own}
    scene, speed = Scene(bodies, SurfaceContact(2e4, mu, slip_speed=1e-3)), 1e-3
    gains = []
    for beyond in (-1.0, 1.0):
        a = math.atan(mu) + math.radians(beyond)
        s = Simulator(
            scene,
            blocks.SOFT,
            5e-3,
            (blocks.G * math.sin(a), 0.0, -blocks.G * math.cos(a)),
            device=device,
        )
        with torch.no_grad():
            v = s.rollout(s.rest_state(), 60).v[[30, 60], 0, scene.vertex_slice("cube"), 0].mean(1)
        gains.append(float(v[1] - v[0]))
    assert abs(gains[0]) < 0.1 * speed
    assert math.tan(a) - gains[1] / (30 * s.time_step * blocks.G * math.cos(a)) == pytest.approx(
        mu, abs=2e-3
    )


def turned(mesh, random, place):
    """A mesh turned at random about its middle, with its middle at a place [m]."""
    middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    return replace(
        mesh, vertices=(mesh.vertices - middle) @ Rotation.random(rng=random).as_matrix().T + place
    )


@pytest.mark.parametrize(("distance", "dtype"), [(1e-3, torch.float64), (1e-4, torch.float32)])
def test_thrown_blocks_never_cross(distance, dtype, device):
    """Throws of two or three blocks of random sizes,
    the second of which is rigid in every other throw.
    """
    random, hits, throws = np.random.default_rng(0), 0, 4
    for k in range(throws):
        speed, h = 10.0 ** random.uniform(-0.5, 1.0), 10.0 ** random.uniform(-3.3, -2.0)
        way = random.normal(size=3)
        way /= np.linalg.norm(way)
        bodies, velocities = {}, []
        for number in range(2 + k % 2):
            mesh = box_tetrahedra(
                random.uniform(0.01, 0.04, 3).tolist(), random.integers(1, 4, 3).tolist()
            )
            # Half of the longest diagonal is 35 mm: none overlap at the start.
            place = way * (0.08 * number - 0.04) + 0.004 * random.normal(size=3)
            block, rigid = turned(mesh, random, place), number == 1 and k // 2 % 2 == 1
            bodies[f"body{number}"] = Body.rigid_body(block) if rigid else Body(block)
            velocities.append(np.tile((0.5 - number) * speed * way, (len(mesh.vertices), 1)))
        scene = Scene(
            bodies, SurfaceContact(10.0 ** random.uniform(4, 6), random.uniform(0.0, 1.0), distance)
        )
        solver = SolverSettings(
            relative_tolerance=1e-8 if dtype == torch.float64 else 1e-5, on_failure="count"
        )
        s = Simulator(
            scene, blocks.SOFT, h, (0.0, 0.0, 0.0), solver=solver, dtype=dtype, device=device
        )
        with torch.no_grad():
            start = s.state(scene.vertices, np.concatenate(velocities))
            path = s.rollout(start, min(60, int(0.12 / speed / h) + 5))
        assert (
            blocks.crossings_and_gap(scene.mesh, path.q[:, 0], distance)[0]
            == blocks.solves(path)[0]
            == 0
        )
        hits += bool((path.v[-1] - path.v[0])[0].norm(dim=-1).max() > 0.1 * speed)
    assert hits > 0.8 * throws


YOUNG, POISSON = 264e3, 0.45  # Pa, -
GROWTH = 1.4  # of the cells away from the contact, from one to the next
SPHERE_RADIUS, SPHERE_DEPTH = 0.02, 0.5e-3  # m
CYLINDER_RADIUS = 0.2  # m
# Of the cylinder; each contact ends elsewhere between vertices [m].
DEPTHS = np.linspace(2e-5, 5e-5, 8)
_ALONG = (0.0, 1.0, 2.0, 4.0, 6.0)  # vertices along the cylinder, over the thickness of the layer
_POINTS = 2**14  # of the surface of a layer


def sphere_error(cell, device):
    """Relative error of the force on a sphere, for a size of the cells below it [m],
    which grow with the distance.
    """
    lines = _lines(cell, GROWTH, 0.03)
    mesh, ball = _block(lines, lines, lines), Sphere(radius=SPHERE_RADIUS)
    ((force, d),) = press(ball, mesh, [SPHERE_DEPTH], 2e-5, 1e5, device)
    depth = SPHERE_DEPTH + float((force * d).sum() / force.sum())
    return float(force.sum()) / hertz_force(SPHERE_RADIUS, depth, lines[-1]) - 1.0


def cylinder_errors(cell, device):
    """Relative errors of the force on a cylinder at `DEPTHS`, for a size of the cells below it [m].

    The growth of the cells is refined with their size. The force is that on the middle of a block
    twelve times as long as it is thick, which is in plane strain there.
    """
    growth = GROWTH ** (cell / 1e-3)
    layer, wide = _lines(cell, growth, 0.01), _lines(cell, growth, 0.05)
    along = layer[-1] * np.array(_ALONG)
    mesh = _block(wide, along, layer)
    rod = Cylinder(radius=CYLINDER_RADIUS, length=1.0, axis=(0.0, 1.0, 0.0))
    middle, errors = np.abs(mesh.vertices[:, 1]) < 1e-9, []
    for depth, (force, d) in zip(DEPTHS, press(rod, mesh, DEPTHS, 1e-6, 2e5, device), strict=True):
        own = force * middle
        gap = float((own * d).sum() / own.sum())
        expected = layer_force(CYLINDER_RADIUS, depth + gap, layer[-1])
        errors.append(own.sum() / along[1] / expected - 1.0)
    return np.array(errors)


def _lines(cell, growth, extent):
    """Distances from zero to an extent or a little further [m],
    between which cells grow by a factor.
    """
    count = math.ceil(math.log(1.0 + extent * (growth - 1.0) / cell) / math.log(growth))
    return np.concatenate([[0.0], np.cumsum(cell * growth ** np.arange(count))])


def _block(x, y, depth):
    """A block below z = 0, with vertices at distances to both sides of zero along x
    and y, and at depths [m].
    """
    lines = [np.concatenate([-way[:0:-1], way]) for way in (x, y)] + [-depth[::-1]]
    counts = [len(line) - 1 for line in lines]
    box = box_hexahedra((1.0, 1.0, 1.0), (counts[0], counts[1], counts[2]))
    index = np.rint(box.vertices * counts).astype(int)
    return Mesh(
        np.stack([line[own] for line, own in zip(lines, index.T, strict=True)], 1), box.cells
    )


def press(obstacle, mesh, depths, distance, stiffness, device):
    """Presses an obstacle at depths [m] below z = 0 into a block with a fixed base.

    Returns vertical forces [N] and distances [m] of the vertices, (N,), for every depth.
    """
    radius, deep = obstacle.radius, -float(mesh.vertices[:, 2].min())
    obstacle = obstacle.changed(position=(0.0, 0.0, radius + distance))
    contact = Contact({"obstacle": obstacle}, stiffness, distance=distance)
    fixed = np.flatnonzero(mesh.vertices[:, 2] < -deep + 1e-9)
    rubber = StableNeoHookean(youngs_modulus=YOUNG, poissons_ratio=POISSON, density=1070.0)
    body = Body(mesh, fixed=fixed, energies=[contact])
    s = Simulator(body, rubber, gravity=(0.0, 0.0, 0.0), device=device)
    # The start is the surface pushed clear of the obstacle.
    x, down = s.rest_positions, s.tensor(depths)[:, None] + distance
    across = x[:, : 2 if isinstance(obstacle, Sphere) else 1].square().sum(1).clamp_max(radius**2)
    push = (down - radius + (radius**2 - across).sqrt() - 0.4 * distance).clamp_min(0.0)
    start = x.expand(len(down), -1, -1).clone()
    start[..., 2] -= push * (1.0 + x[:, 2] / deep)
    with torch.no_grad():
        q = s.static_equilibrium(None, {"obstacle_z": -down}, after=s.state(start)).q
    q[..., 2] += down
    away = q.cpu().numpy() - obstacle.position
    away[..., 1] *= isinstance(obstacle, Sphere)
    far = np.linalg.norm(away, axis=-1)
    d = far - radius
    forces = (
        -stiffness
        * vertex_areas(mesh)
        * pressure(np.minimum(d / distance, 1.0))
        * away[..., 2]
        / far
    )
    return list(zip(forces, d, strict=True))


def hertz_force(radius, depth, thickness):
    """Force [N] on a rigid sphere that is pressed into a bonded layer (Dimitriadis et al. 2002,
    equation 12).
    """
    nu, chi = POISSON, math.sqrt(radius * depth) / thickness
    a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1.0 - nu)
    b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1.0 - nu)
    p = math.pi
    layer = (
        1.0
        - 2.0 * a / p * chi
        + 4.0 * (a / p * chi) ** 2
        - 8.0 / p**3 * (a**3 + 4.0 * p**2 / 15.0 * b) * chi**3
    )
    layer += 16.0 * a / p**4 * (a**3 + 3.0 * p**2 / 5.0 * b) * chi**4
    return 4.0 / 3.0 * YOUNG / (1.0 - nu**2) * math.sqrt(radius) * depth**1.5 * layer


def layer_response(wave_number, thickness):
    """Displacement over pressure [m/Pa] of the surface of a bonded layer,
    by positive wave numbers [1/m].
    """
    nu, x = POISSON, wave_number * thickness
    c, decay = 3.0 - 4.0 * nu, np.exp(-2.0 * x)
    above = c * (1.0 - decay**2) - 4.0 * x * decay
    below = c * (1.0 + decay**2) + (4.0 * x**2 + 10.0 - 24.0 * nu + 16.0 * nu**2) * decay
    return 2.0 * (1.0 - nu**2) / YOUNG / wave_number * above / below


def layer_force(radius, depth, thickness):
    """Force over length [N/m] on a rigid cylinder that is pressed
    into a bonded layer in plane strain.
    """
    # Half of the width without a rise beside the contact.
    nu, most = POISSON, math.sqrt(2.0 * radius * depth)
    spacing = (12.0 * thickness + 4.0 * most) / _POINTS  # of points in a period that is long enough
    waves = 2.0 * np.pi * np.arange(_POINTS // 2 + 1, dtype=np.float64) / (_POINTS * spacing)
    uniform = thickness * (1.0 + nu) * (1.0 - 2.0 * nu) / ((1.0 - nu) * YOUNG)
    response = np.concatenate([[uniform], layer_response(waves[1:], thickness)])
    green = np.fft.irfft(response, _POINTS)  # displacements under a pressure at one point
    half = int(most / spacing)
    x = spacing * np.arange(-half, half + 1)
    into = depth - radius + np.sqrt(radius**2 - x**2)
    while True:
        own = scipy.linalg.solve_toeplitz(green[: len(into)], into)
        if own.min() >= 0.0:
            return float(own.sum() * spacing)
        into = into[own >= 0.0]


def test_the_force_on_a_sphere_is_that_of_hertz(device):
    """For a sphere of 20 mm, 0.5 mm deep, within 2 % with cells of 0.18 mm."""
    assert abs(sphere_error(1.8e-4, device)) < 0.02


def test_the_force_on_a_cylinder_is_that_of_plane_strain(device):
    """At eight depths within 2 % with cells of 0.5 mm, and of almost second order in their size."""
    cells = (1.4e-3, 1e-3, 7e-4, 5e-4)
    errors = [cylinder_errors(cell, device) for cell in cells]
    assert np.abs(errors[-1]).max() < 0.02
    means = [np.sqrt(np.mean(error**2)) for error in errors]
    assert np.polyfit(np.log(cells), np.log(means), 1)[0] > 1.5
