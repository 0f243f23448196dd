"""Small versions of cases that show whether contact between surfaces ever lets them cross.

========  ==================================================================================
Erleben   pairs of stiff bodies of a few tetrahedra, whose corners and edges meet (after
          Erleben 2018)
mat       both ends of a mat are turned against one another until it touches itself
rollers   two turning cylinders draw a soft block between them
funnel    a soft ball is forced through a funnel narrower than itself
tentacle  a tendon curls a tentacle around a post and onto itself
========  ==================================================================================

In no step does an edge pass through a triangle, every solve converges, and surfaces come within
reach; without contact, they cross.

K. Erleben: Methodology for assessing mesh-based contact point methods. ACM Transactions on
Graphics 37(3), 2018.
M. Li et al.: Incremental potential contact. ACM Transactions on Graphics 39(4), 2020.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.contact import G, crossings_and_gap, solves
from warp_resphys import (
    Contact,
    Corotated,
    Inputs,
    Scene,
    Simulator,
    SolverSettings,
    StableNeoHookean,
    SurfaceContact,
)
from warp_resphys.core.energies.contact.pairs import PairList, Surface
from warp_resphys.core.energies.contact.touching_bodies import Cylinder, HalfSpace
from warp_resphys.core.energies.launcher import Launcher
from warp_resphys.core.energies.tendons import Tendons
from warp_resphys.core.fem.bodies import Body
from warp_resphys.core.mesh.boxes import box_hexahedra, box_tetrahedra
from warp_resphys.core.mesh.rod import rod
from warp_resphys.core.mesh.selection import select_vertices
from warp_resphys.core.mesh.volume_mesh import Mesh
from warp_resphys.environments.grippers import ball_mesh

_SIDE = 0.1  # of Erleben's bodies [m]
_GAP = 0.05  # that the upper one falls [m]
_STONE = Corotated(youngs_modulus=2e7, poissons_ratio=0.2, density=2000.0, stiffness_damping=1e-3)
_RUBBER = StableNeoHookean(
    youngs_modulus=1e5, poissons_ratio=0.4, density=1070.0, stiffness_damping=4e-3
)
_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """Bodies that are thrown, pressed or driven."""

    bodies: dict[str, Body]
    contact: SurfaceContact | None
    distance: float  # below which surfaces count as touching [m]
    steps: int
    time_step: float = 0.01  # s
    material: Corotated | StableNeoHookean = _STONE  # of all bodies
    gravity: tuple = (0.0, 0.0, -G)  # m/s^2
    velocities: dict = field(default_factory=dict)  # at the start, by body [m/s]
    drive: Callable | None = (
        None  # positions (D, 3) of the fixed vertices by those at rest and the share of the time
    )
    pull: dict = field(default_factory=dict)  # largest at two thirds of the time [N], by body

    def inputs(self, simulator):
        """The inputs of all steps."""
        rise = simulator.tensor([min(1.5 * (k + 1) / self.steps, 1.0) for k in range(self.steps)])
        rise = rise[:, None, None]
        pulled = {
            name: Inputs(tendon_tension=rise * simulator.tensor(most))
            for name, most in self.pull.items()
        }
        own = Scene(self.bodies).inputs(pulled)
        if self.drive is None:
            return own
        rest = simulator.rest_positions[simulator.fixed].cpu().numpy()
        places = np.stack([self.drive(rest, (k + 1) / self.steps) for k in range(self.steps)])
        return own.replace(fixed_positions=simulator.tensor(places[:, None]))


@torch.no_grad()
def run(case, device):
    """Simulates a case without a failed solve.

    Returns numbers of steps after which surfaces cross, by program, the least distance [m] and the
    last positions (N, 3) [m].
    """
    solver = SolverSettings(relative_tolerance=1e-6, on_failure="count")
    scene = Scene(case.bodies, case.contact)
    s = Simulator(scene, case.material, case.time_step, case.gravity, solver=solver, device=device)
    start = s.rest_state()
    for name, velocity in case.velocities.items():
        start.v[:, s.body.vertex_slice(name)] = s.tensor(velocity)
    path = s.rollout(start, case.steps, case.inputs(s))
    assert solves(path)[0] == 0
    positions = path.q[1:, 0]
    own, gap = crossings_and_gap(scene.mesh, positions, case.distance)
    crossings = {"own": own}
    if find_spec("ipctk") is not None:
        import ipctk

        surface = Surface.of(scene.mesh)
        peer = ipctk.CollisionMesh(surface.rest, surface.edges, surface.triangles)
        crossings["ipctk"] = sum(ipctk.has_intersections(peer, q) for q in positions.cpu().numpy())
    return crossings, gap, positions[-1].cpu().numpy()


def cone(apex, triangles):
    """Tetrahedra between an apex (3,) and triangles (T, 3, 3) [m],
    of which neighbours share corners.
    """
    tips = np.broadcast_to(apex, (len(triangles), 1, 3))
    return _tetrahedra(np.concatenate([tips, triangles], axis=1))


def prism(outline, length):
    """Tetrahedra of a prism along y, centred there,
    over an outline (x, z) that its first corner sees.
    """
    x, z = np.array(outline).T
    low, high = (
        np.stack([x, np.full_like(x, side * length / 2.0), z], axis=1) for side in (-1.0, 1.0)
    )
    cells = []
    for k in range(1, len(x) - 1):
        a, b = low[[0, k, k + 1]], high[[0, k, k + 1]]
        cells += [[a[0], a[1], a[2], b[2]], [a[0], a[1], b[1], b[2]], [a[0], b[0], b[1], b[2]]]
    return _tetrahedra(np.array(cells))


def _tetrahedra(corners):
    """The mesh of tetrahedra (M, 4, 3) [m], of either orientation."""
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    return merged(np.where(inverted[:, None, None], corners[:, [1, 0, 2, 3]], corners))


def merged(corners):
    """The mesh of cells with corners (M, K, 3) [m],
    of which those at one place become one vertex.
    """
    vertices, cells = np.unique(np.round(corners.reshape(-1, 3), 12), axis=0, return_inverse=True)
    return Mesh(vertices, cells.reshape(corners.shape[:2]))


def placed(mesh, place=_ORIGIN, turn=_ORIGIN):
    """A mesh turned by a rotation vector (3,) [rad] about the origin, then moved by (3,) [m]."""
    return replace(
        mesh, vertices=Rotation.from_rotvec(turn).apply(mesh.vertices) + np.asarray(place)
    )


def erleben_cases():
    """Cases in which a body falls on a held one or slides over it,
    corner on corner and edge on edge.
    """
    a, upside_down = _SIDE, (math.pi, 0.0, 0.0)
    square = a * np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    spike = cone((0.0, 0.0, a), square[[[0, 1, 2], [0, 2, 3]]])
    box = box_tetrahedra((2.0 * a, 2.0 * a, a), (1, 1, 1))
    box = replace(box, vertices=box.vertices - [a, a, a])
    faces = box.vertices[Surface.of(box).triangles]
    pit = cone((0.0, 0.0, -0.6 * a), faces[(faces[..., 2] < 0.0).any(1)])
    wedge = prism(((0.0, a), (-0.4 * a, 0.0), (0.4 * a, 0.0)), a)
    groove = (
        (0.0, -0.6),
        (-0.6, 0.0),
        (-1.0, 0.0),
        (-1.0, -1.0),
        (1.0, -1.0),
        (1.0, 0.0),
        (0.6, 0.0),
    )
    crack = prism([(a * x, a * z) for x, z in groove], 2.0 * a)
    brick = box_tetrahedra((a, a, a), (1, 1, 1))
    plate = box_tetrahedra((4.0 * a, 2.0 * a, 0.5 * a), (4, 2, 1))
    plate = replace(plate, vertices=plate.vertices - [a, a, 0.5 * a])
    down = {"spike": placed(spike, turn=upside_down), "wedge": placed(wedge, turn=upside_down)}
    across = placed(down["wedge"], turn=(0.0, 0.0, math.pi / 2.0))
    near = 2e-3
    top, inside = (0.0, 0.0, 2.0 * a + _GAP), (0.0, 0.0, a + near)
    return {
        "spikes": _falls(spike, placed(down["spike"], top)),
        "spike in hole": _falls(pit, placed(down["spike"], inside)),
        "spike on wedge": _falls(wedge, placed(down["spike"], top)),
        "spike in crack": _falls(crack, placed(down["spike"], inside)),
        "wedges": _falls(wedge, placed(down["wedge"], top)),
        "wedges across": _falls(wedge, placed(across, top)),
        "wedge in crack": _falls(crack, placed(down["wedge"], inside)),
        "sliding spike": _falls(plate, placed(down["spike"], inside), 1.0),
        "sliding wedge": _falls(plate, placed(down["wedge"], inside), 1.0),
        "cliff edges": _falls(placed(brick, (0.0, 0.0, -a)), placed(brick, (0.6 * a, 0.0, near))),
        "internal edges": _falls(plate, placed(brick, (-0.9 * a, -0.5 * a, near)), 1.0),
    }


def _falls(lower, upper, speed=0.0):
    """The case of a stiff body that falls on another one,
    which is held at its base, and on to a floor.
    """
    kappa, friction, distance = 1e5, 0.3, 1e-4
    base = float(lower.vertices[:, 2].min())
    floor = Contact({"floor": HalfSpace(position=(0.0, 0.0, base))}, kappa, friction, distance)
    bodies = {
        "lower": Body(lower, fixed=select_vertices(lower, z=base)),
        "upper": Body(upper, energies=[floor]),
    }
    contact, thrown = SurfaceContact(kappa, friction, distance), {"upper": (speed, 0.0, -1.0)}
    return Case(bodies, contact, distance, 60, velocities=thrown)


def mat():
    """The case of a mat whose ends make one and a half turns against one another and come
    nearer.
    """
    length, angle, nearer, distance = 0.1, 1.5 * math.pi, 0.03, 5e-4
    mesh = box_hexahedra((length, 0.05, 0.002), (16, 8, 1))
    fixed = np.union1d(select_vertices(mesh, x=0.0), select_vertices(mesh, x=length))

    def drive(rest, share):
        side = np.where(rest[:, 0] > 0.5 * length, 1.0, -1.0)
        along = np.outer(share * side, (1.0, 0.0, 0.0))
        middle = np.array([0.5 * length, 0.025, 0.001])
        return (
            Rotation.from_rotvec(angle * along).apply(rest - middle) + middle - 0.5 * nearer * along
        )

    contact = SurfaceContact(1e5, 0.3, distance)
    body = {"mat": Body(mesh, fixed=fixed)}
    return Case(body, contact, distance, 120, 0.02, _RUBBER, (0.0, 0.0, 0.0), drive=drive)


def rollers():
    """The case of a soft block that two rollers draw through a gap narrower than itself.

    Rigid rollers would draw it in where friction exceeds the slope at which its edges meet them,
    here 0.58.
    """
    radius, gap, width, distance = 0.015, 0.012, 0.03, 5e-4
    speed, steps, step = 0.1, 120, 0.005
    roller = rod(width * np.array([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]]), radius, 3, core=4, nodes=8)
    block = box_hexahedra((0.03, 0.016, 0.016), (6, 3, 3))
    # Before the place where its edges meet the rollers.
    block = placed(block, (-0.0415, -0.008, -0.008))
    height = np.array([0.0, 0.0, radius + 0.5 * gap])
    bodies, all_of_it = {"block": Body(block)}, np.arange(len(roller.vertices))
    for name, side in (("upper", 1.0), ("lower", -1.0)):
        bodies[name] = Body(placed(roller, side * height), fixed=all_of_it)

    def drive(rest, share):
        side = np.sign(rest[:, 2:])
        turn = -speed / radius * steps * step * share * side * [0.0, 1.0, 0.0]
        return Rotation.from_rotvec(turn).apply(rest - side * height) + side * height

    contact, still = SurfaceContact(1e5, 0.8, distance, 5e-3), (0.0, 0.0, 0.0)
    start = {"block": (speed, 0.0, 0.0)}
    return Case(bodies, contact, distance, steps, step, _RUBBER, still, start, drive=drive)


def funnel():
    """The case of a soft ball that a load forces through a funnel narrower than itself."""
    radius, neck, distance = 0.012, 0.009, 5e-4
    around, wall = 16, 0.003
    levels = np.array([[-0.02, 0.02], [0.0, neck], [0.015, neck]])  # x and inner radius [m]
    tube = box_hexahedra((2.0, wall, 2.0 * math.pi), (2, 1, around))
    level, depth, turn = tube.vertices.T
    x, r = levels[np.round(level).astype(int)].T
    ring = np.stack([x, (r + depth) * np.cos(turn), (r + depth) * np.sin(turn)], axis=1)
    walls = merged(ring[tube.cells])
    ball = placed(ball_mesh(radius, 4), (-0.02, 0.0, 0.0))
    bodies = {"funnel": Body(walls, fixed=np.arange(len(walls.vertices))), "ball": Body(ball)}
    contact, soft = SurfaceContact(1e5, 0.1, distance), replace(_RUBBER, youngs_modulus=2e4)
    return Case(bodies, contact, distance, 40, 1e-3, soft, (40.0 * G, 0.0, 0.0))


def tentacle():
    """The case of a tentacle that a tendon curls around a post,
    until its end lies on its upper part.
    """
    length, distance, slip_speed = 0.28, 5e-4, 2e-2
    mesh = rod(
        [[0.0, 0.0, 0.0], [0.0, 0.0, -length]], [[0.0, 0.0065], [length, 0.0055]], 12, nodes=20
    )
    curl, side = (
        np.linspace([x, y, 0.0], [end_x, end_y, -length], 21)
        for x, y, end_x, end_y in ((0.006, 0.0, 0.0031, 0.0), (0.0, 8e-4, 0.0, 6e-4))
    )
    post = Cylinder(position=(0.04, 0.0, -0.09), axis=(0.0, 1.0, 0.0), radius=0.016, length=0.12)
    touches = Contact({"post": post}, 2e4, 0.3, 2.0 * distance, slip_speed)
    body = Body(mesh, fixed=select_vertices(mesh, z=0.0), energies=[Tendons([curl, side]), touches])
    contact = SurfaceContact(2e4, 0.3, distance, slip_speed)
    soft = replace(_RUBBER, youngs_modulus=2.3e5)
    return Case(
        {"tentacle": body}, contact, distance, 120, material=soft, pull={"tentacle": (2.7, 1.5)}
    )


CASES = {**erleben_cases(), **{"mat": mat(), "funnel": funnel(), "tentacle": tentacle()}}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.release] * (name == "mat")) for name in CASES]
)
def test_surfaces_touch_and_cross_without_contact_alone(name, device):
    case = CASES[name]
    crossings, gap, end = run(case, device)
    assert not any(crossings.values())
    assert gap < case.distance
    if name == "funnel":
        assert end[Scene(case.bodies).vertex_slice("ball"), 0].mean() > 0.015
    if name == "tentacle":
        check_turn(case, end)
    assert all(run(replace(case, contact=None), device)[0].values())


def check_turn(case, end):
    """A tentacle makes a whole turn around its post,
    and parts that are far from one another at rest touch.
    """
    body = case.bodies["tentacle"]
    post, rest = body.energies[1].obstacles["post"], body.mesh.vertices
    levels = rest[:, 2].round(6)
    axis = np.stack([end[levels == z].mean(0) for z in np.unique(levels)])[:, [0, 2]] - [
        0.04,
        -0.09,
    ]
    assert np.linalg.norm(axis, axis=1).min() > post.radius
    assert np.ptp(np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))) > 2.0 * math.pi
    end = torch.tensor(end[None])
    pairs = PairList(Launcher(1, end.device), Surface.of(body.mesh), case.distance)
    pairs.find(end, torch.zeros_like(end))
    first, second = rest[pairs.nodes[:, 0], 2], rest[pairs.nodes[:, 3], 2]
    assert pairs.distances(end).numpy()[np.abs(first - second) > 0.1].min() < case.distance


def test_rollers_draw_by_friction_alone(device):
    """The block passes where friction exceeds the slope
    at which its edges meet the rollers, and not with less.

    The middles of the rollers are 21 mm from that of the block, which is 16 mm high, and their
    radius is 15 mm.
    """
    case, slope = rollers(), math.tan(math.acos((21.0 - 8.0) / 15.0))
    for friction, draws in ((1.15 * slope, True), (0.85 * slope, False)):
        crossings, gap, end = run(
            replace(case, contact=replace(case.contact, friction=friction)), device
        )
        assert not any(crossings.values())
        assert gap < case.distance
        assert (end[Scene(case.bodies).vertex_slice("block"), 0].mean() > 0.02) == draws
