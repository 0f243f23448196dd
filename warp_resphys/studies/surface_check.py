"""Contact of bodies with one another beside theory.

==================  ==================================================================================================
slope               a cube on a held plate sticks a degree below the angle of friction, and slides a degree above it
throws              no surface crosses another in any step, and every solve converges
momentum            that of bodies that collide with friction is constant
arch                a semicircular arch of rigid stones on a floor stands with more friction than it needs to be in
                    equilibrium with joints that take no tension (Heyman 1966), and falls with less
==================  ==================================================================================================

J. Heyman: The stone skeleton. International Journal of Solids and Structures 2, 1966.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..dynamics.trajectory import Trajectory
from ..energies.contact import Contact
from ..energies.launcher import Launcher
from ..energies.materials import Corotated
from ..energies.obstacles import HalfSpace
from ..energies.pairs import PairList, Surface
from ..energies.surfaces import SurfaceContact
from ..fem.body import Body
from ..fem.rigid import Rigid
from ..fem.scene import Scene
from ..io.progress import Progress
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices
from ..stepping.state import State
from .device_check import Check

FloatArray = NDArray[np.float64]

G: Final = 9.81
SIDE: Final = 0.02  # of a cube [m]
SOFT: Final = Corotated(youngs_modulus=264e3, poissons_ratio=0.45, density=1070.0, stiffness_damping=2e-3)
DENSITY: Final = 2000.0  # of stones and cards [kg/m^3]
STONE: Final = Corotated(youngs_modulus=2e7, poissons_ratio=0.2, density=DENSITY, stiffness_damping=1e-3)
RADIUS, THICKNESS, WIDTH = 0.5, 0.12, 0.1  # of an arch [m]
MARGIN: Final = 0.05  # of the friction of arches and cards, either way
_THROWN: Final = tuple(itertools.product((1e-3, 1e-4), (torch.float64, torch.float32)))  # D [m] and dtype


def slope_checks(quick: bool, device: torch.device) -> Iterator[Check]:
    """Speed that a cube gains on a held plate in 0.15 s, and the coefficient of friction that follows from it.

    The height of the cube changes by some micrometres as its vertices pass over edges of the plate.
    """
    plate = box_hexahedra((0.06, 0.06, 0.01), (6, 6, 1))
    cube = box_hexahedra((SIDE,) * 3, (2, 2, 2))
    raised = replace(cube, vertices=cube.vertices + [0.0203, 0.0197, 0.0109])
    held = Body(plate, fixed=select_vertices(plate, z=0.0))
    cubes = {"soft": Body(raised), "rigid": Body.rigid_body(raised, Rigid())}
    speed = 1e-3  # v_s [m/s]
    for mu, kind in ((0.5, "rigid"),) if quick else ((0.2, "soft"), (0.5, "soft"), (0.5, "rigid")):
        scene = Scene({"plate": held, "cube": cubes[kind]}, SurfaceContact(2e4, mu, slip_speed=speed))
        for beyond in (-1.0, 1.0):
            a = math.atan(mu) + math.radians(beyond)
            pull = (G * math.sin(a), 0.0, -G * math.cos(a))
            s = Simulator(scene, SOFT, time_step=5e-3, gravity=pull, device=device)
            own = scene.vertex_slice("cube")
            with torch.no_grad():
                v = s.rollout(s.rest_state(), 60).v[[30, 60], 0, own, 0].mean(1)
            gain = float(v[1] - v[0])
            if beyond < 0:
                title = f"{kind}, mu {mu:g}, a degree below arctan mu: speed gained"
                yield Check(title, f"{1e3 * gain:.3f} mm/s", "< 0.1 mm/s", abs(gain) < 0.1 * speed)
            else:
                actual = math.tan(a) - gain / (30 * s.time_step * G * math.cos(a))
                title = f"{kind}, mu {mu:g}, a degree above arctan mu: mu by the acceleration"
                yield Check(title, f"{actual:.4f}", f"{mu:g} within 0.002", abs(actual - mu) < 2e-3)


def turned(mesh: Mesh, random: np.random.Generator, place: Any) -> Mesh:
    """A mesh turned at random about its middle, with its middle at a place [m]."""
    middle = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    turn = Rotation.random(rng=random).as_matrix()
    return replace(mesh, vertices=(mesh.vertices - middle) @ turn.T + place)


def throw_checks(throws: int, seed: int, device: torch.device) -> Iterator[Check]:
    """Two or three blocks of random sizes thrown at one another, of which the second is rigid in every other throw."""
    share = max(throws // len(_THROWN), 1)
    with Progress("throws of bodies", len(_THROWN) * share, "throws") as progress:
        for distance, dtype in _THROWN:
            random = np.random.default_rng(seed)
            crossings = failed = most = hits = 0
            for k in range(share):
                new = _throw(distance, dtype, 2 + k % 2, k // 2 % 2 == 1, random, device)
                crossings, failed, hits = crossings + new[0], failed + new[1], hits + new[3]
                most = max(most, new[2])
                progress.advance()
            title = f"D {1e3 * distance:g} mm, {str(dtype).removeprefix('torch.')}: {share} throws"
            result = f"{hits} hit, {crossings} crossings, {failed} failed, {most} iterations at most"
            yield Check(title, result, "0 crossings, 0 failed", crossings == failed == 0)


def _throw(
    distance: float, dtype: torch.dtype, count: int, rigid: bool, random: np.random.Generator, device: torch.device
) -> tuple[int, int, int, int]:
    """Returns the numbers of crossings in all steps and of failed solves, the most iterations, and the hits."""
    speed, h = 10.0 ** random.uniform(-0.5, 1.0), 10.0 ** random.uniform(-3.3, -2.0)
    way = random.normal(size=3)
    way /= np.linalg.norm(way)
    bodies, velocities = dict[str, Body](), []
    for k in range(count):
        mesh = box_tetrahedra(random.uniform(0.01, 0.04, 3).tolist(), random.integers(1, 4, 3).tolist())
        # Half of the longest diagonal is 35 mm: none overlap at the start.
        place = way * (0.08 * k - 0.04) + 0.004 * random.normal(size=3)
        block = turned(mesh, random, place)
        bodies[f"body{k}"] = Body.rigid_body(block) if rigid and k == 1 else Body(block)
        velocities.append(np.tile((0.5 - k) * speed * way, (mesh.vertices.shape[0], 1)))
    scene = Scene(bodies, SurfaceContact(10.0 ** random.uniform(4, 6), random.uniform(0.0, 1.0), distance))
    solver = SolverSettings(relative_tolerance=1e-8 if dtype == torch.float64 else 1e-5, on_failure="count")
    s = Simulator(scene, SOFT, h, (0.0, 0.0, 0.0), solver=solver, dtype=dtype, device=device)
    with torch.no_grad():
        path = s.rollout(s.state(scene.vertices, np.concatenate(velocities)), min(60, int(0.12 / speed / h) + 5))
    pairs = PairList(Launcher(1, device), Surface.of(scene.mesh), distance)
    crossings = sum(int(pairs.crossings(q)[0]) for q in path.q.double())
    failed = sum(int((~report.converged).sum()) for report in path.reports)
    hit = bool((path.v[-1] - path.v[0])[0].norm(dim=-1).max() > 0.1 * speed)
    return crossings, failed, max(int(report.iterations.max()) for report in path.reports), int(hit)


def momentum_checks(device: torch.device) -> Iterator[Check]:
    """Drift of the momentum of two cubes that collide off centre."""
    random = np.random.default_rng(0)
    cube = box_tetrahedra((SIDE,) * 3, (2, 2, 2))
    bodies = {n: Body(turned(cube, random, place)) for n, place in (("a", (0, 0, 0)), ("b", (0.006, 0.004, 0.037)))}
    solver = SolverSettings(relative_tolerance=1e-13, absolute_tolerance=1e-15)
    for name in ("implicit_euler", "bdf2"):
        scene = Scene(bodies, SurfaceContact(2e4, 0.5))
        s = Simulator(scene, SOFT, 2e-3, (0.0, 0.0, 0.0), name, solver, device=device)
        start = s.rest_state()
        v = torch.zeros_like(start.v)
        v[:, scene.vertex_slice("b")] = s.tensor([0.1, -0.2, -2.0])
        with torch.no_grad():
            path = s.rollout(State(start.q, v), 20)
        momenta = (s.prepare().mass[..., None] * path.v).sum(2)
        drift = float((momenta - momenta[0]).abs().max() / momenta[0].norm())
        yield Check(f"{name}, 20 steps: change of the momentum", f"{drift:.1e}", "< 1e-11", drift < 1e-11)


def arch_checks(stones: int, device: torch.device) -> Iterator[Check]:
    """Speed of the keystone of an arch, half a second after it was put up."""
    need = least_friction(np.ones(stones).tolist(), arch_joints(stones))
    for mu, stands in ((need * (1.0 + MARGIN), True), (need * (1.0 - MARGIN), False)):
        scene, speed = arch(stones, mu), 1e-3
        key = scene.vertex_slice(f"stone{stones // 2}")
        v = built(scene, device).v[-1, 0, key].mean(0).norm()
        # Every joint creeps below its slip speed.
        most = 5.0 * speed if stands else math.inf
        least = 0.0 if stands else 50.0 * speed
        title = f"{stones} stones, mu {mu:.3f} for {need:.3f}: speed of the keystone"
        expected = "< 5 mm/s: it stands" if stands else "> 50 mm/s: it falls"
        yield Check(title, f"{1e3 * float(v):.1f} mm/s", expected, least <= float(v) <= most)


@torch.no_grad()
def built(scene: Scene, device: torch.device) -> Trajectory:
    """Returns the motion of rigid bodies that were put up at rest, for half a second."""
    solver = SolverSettings(relative_tolerance=1e-6)
    s = Simulator(scene, {}, 0.01, (0.0, 0.0, -G), solver=solver, device=device)
    return s.rollout(s.rest_state(), 50)


def arch(stones: int, friction: float) -> Scene:
    """A semicircular arch of rigid stones on a floor, which almost touch."""
    distance, kappa = 1e-3, 1e6
    gap, angle = 0.97 * distance, math.pi / stones
    floor = {"floor": HalfSpace(position=(0.0, 0.0, -0.5 * gap))}
    bodies = dict[str, Body]()
    for k in range(stones):
        brick = box_hexahedra((1.0, 1.0, 1.0), (1, 1, 1))
        u = brick.vertices
        turn, r = math.pi - (k + u[:, 0]) * angle, RADIUS + THICKNESS * (u[:, 2] - 0.5)
        x = np.stack([r * np.cos(turn), WIDTH * (u[:, 1] - 0.5), r * np.sin(turn)], 1)
        middle = math.pi - (k + 0.5) * angle
        along = np.array([-math.sin(middle), 0.0, math.cos(middle)])
        x -= np.outer(x @ along, along) * gap / (angle * RADIUS)
        contact = Contact(floor, kappa, friction, distance)
        bodies[f"stone{k}"] = Body.rigid_body(replace(brick, vertices=x), Rigid(DENSITY), energies=[contact])
    return Scene(bodies, SurfaceContact(kappa, friction, distance))


@dataclass(frozen=True)
class PointContact:
    """A place at which a body pushes another one.

    Attributes:
        place: (2,) relative to the centre of gravity of the first body [m].
        normal: (2,) direction of the normal force on it.
        body: number of the first body.
        other: number and place (2,) of the second one [m]; None for a floor.
    """

    place: FloatArray
    normal: FloatArray
    body: int
    other: tuple[int, FloatArray] | None = None


def arch_joints(stones: int) -> list[PointContact]:
    """Returns the inner and outer ends of the joints of an arch."""
    turn = math.pi * (1.0 - np.arange(stones + 1) / stones)
    half, inner, outer = 0.5 * math.pi / stones, RADIUS - 0.5 * THICKNESS, RADIUS + 0.5 * THICKNESS
    ring = 2.0 / 3.0 * (outer**3 - inner**3) / (outer**2 - inner**2) * math.sin(half) / half
    middle = 0.5 * (turn[1:] + turn[:-1])
    centres, radial = (np.stack([np.cos(a), np.sin(a)], 1) for a in (middle, turn))
    normal, out = np.stack([radial[:, 1], -radial[:, 0]], 1), list[PointContact]()
    for joint, r in itertools.product(range(stones + 1), (inner, outer)):
        places = [r * radial[joint] - ring * centres[k] for k in (min(joint, stones - 1), joint - 1)]
        if joint == stones:
            out.append(PointContact(places[0], -normal[joint], stones - 1))
        else:
            out.append(PointContact(places[0], normal[joint], joint, (joint - 1, places[1]) if joint else None))
    return out


def least_friction(weights: Sequence[float], touches: Sequence[PointContact], most: float = 3.0) -> float:
    """Coefficient of friction below which no forces at the touches carry the weights of bodies.

    At every touch, the normal force N is positive, and friction at most mu N.

    Args:
        weights: of the bodies.
        touches: where they push one another.
        most: the coefficient is sought up to this one.
    """
    balance = np.zeros((3 * len(weights), 2 * len(touches)))
    size = max(float(np.linalg.norm(touch.place)) for touch in touches)
    for k, touch in enumerate(touches):
        sides = [(touch.body, touch.place, 1.0), *((*o, -1.0) for o in [touch.other] if o is not None)]
        across = np.array([-touch.normal[1], touch.normal[0]])
        for (body, place, sign), (number, force) in itertools.product(sides, enumerate((touch.normal, across))):
            moment = (place[0] * force[1] - place[1] * force[0]) / size
            balance[3 * body : 3 * body + 3, 2 * k + number] += sign * np.array([*force, moment])
    carried = np.kron(np.divide(weights, max(weights)), [0.0, 1.0, 0.0])
    shear = np.kron(np.eye(len(touches)), [[0.0, 1.0], [0.0, -1.0]])
    normal = np.kron(np.eye(len(touches)), [[1.0, 0.0], [1.0, 0.0]])

    def carries(friction: float) -> bool:
        limits, bounds = shear - friction * normal, [(0.0, None), (None, None)] * len(touches)
        free: FloatArray = np.zeros(2 * len(touches))
        solution = linprog(free, limits, np.zeros(len(limits)), balance, carried, bounds=bounds)
        return bool(solution.status == 0)

    low, high = 0.0, most
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if carries(middle) else (middle, high)
    return high
