"""Small versions of cases that show whether contact between surfaces ever lets them cross, and a house of cards.

==================  ==================================================================================================
Erleben             pairs of stiff bodies of a few tetrahedra, whose corners and edges meet (after Erleben 2018)
mat                 both ends of a mat are turned against one another until it touches itself
rollers             two turning cylinders draw a soft block between them
funnel              a soft ball is forced through a funnel narrower than itself
clip                the ends of a U are pressed on one another
tentacle            a tendon curls a tentacle around a post and onto itself
cards               houses of cards stand with more friction than statics asks, and fall with less
==================  ==================================================================================================

A case passes if in no step an edge passes through a triangle, every solve converges, and surfaces come within reach.

K. Erleben: Methodology for assessing mesh-based contact point methods. ACM Transactions on Graphics 37(3), 2018.
M. Li et al.: Incremental potential contact. ACM Transactions on Graphics 39(4), 2020.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Final

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..dynamics.nonlinear_solver import SolverSettings
from ..dynamics.simulator import Simulator
from ..energies.contact import Contact
from ..energies.launcher import Launcher
from ..energies.materials import Material, StableNeoHookean
from ..energies.obstacles import Cylinder, HalfSpace
from ..energies.pairs import PairList, Surface
from ..energies.surfaces import SurfaceContact
from ..energies.tendons import Tendons
from ..fem.body import Body
from ..fem.rigid import Rigid
from ..fem.scene import Scene
from ..io.errors import ResphysError
from ..mesh.boxes import boxes_hexahedra
from ..mesh.mesh import Mesh, box_hexahedra, box_tetrahedra, select_vertices
from ..mesh.rod import rod
from ..robot.gripper import thing_mesh
from ..stepping.inputs import Inputs
from .device_check import Check
from .surface_check import DENSITY, MARGIN, SOFT, STONE, G, PointContact, built, least_friction

FloatArray = NDArray[np.float64]

_SIDE: Final = 0.1  # of Erleben's bodies [m]
_GAP: Final = 0.05  # that the upper one falls [m]
_RUBBER: Final = StableNeoHookean(youngs_modulus=1e5, poissons_ratio=0.4, density=1070.0, stiffness_damping=4e-3)
_QUICK: Final = ("spikes", "wedge in crack", "cliff edges", "funnel", "clip")
_LENGTH, _THICKNESS, _WIDTH = 0.2, 0.01, 0.1  # of a card [m]
_CARD_GAP: Final = 2e-4  # at which contact of cards begins [m]
_CARD_REST: Final = 0.97 * _CARD_GAP  # between them at the start
_ORIGIN: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """Bodies that are thrown, pressed or driven.

    Attributes:
        bodies: bodies by name.
        contact: contact of their surfaces, or None.
        distance: distance below which surfaces count as touching [m].
        steps: number of steps T.
        time_step: [s].
        material: material of all bodies.
        gravity: (3,) [m/s^2].
        velocities: velocities (3,) at the start, by body [m/s].
        force: (N, 3) external force on the vertices of all bodies, or None [N].
        drive: returns the positions (D, 3) of the fixed vertices [m] from those at rest and the share of the time.
        pull: largest tensions of the tendons of a body, by its name, which are reached at two thirds of the time [N].
        passes: a body, and the coordinate x that its middle passes until the end [m]; or None.
    """

    bodies: Mapping[str, Body]
    contact: SurfaceContact | None
    distance: float
    steps: int
    time_step: float = 0.01
    material: Material = STONE
    gravity: Sequence[float] = (0.0, 0.0, -G)
    velocities: Mapping[str, Sequence[float]] = field(default_factory=dict)
    force: FloatArray | None = None
    drive: Callable[[FloatArray, float], FloatArray] | None = None
    pull: Mapping[str, Sequence[float]] = field(default_factory=dict)
    passes: tuple[str, float] | None = None

    def simulator(self, device: torch.device) -> Simulator:
        """Returns the simulator, which counts failed solves."""
        solver = SolverSettings(relative_tolerance=1e-6, on_failure="count")
        scene = Scene(self.bodies, self.contact)
        return Simulator(scene, self.material, self.time_step, self.gravity, solver=solver, device=device)

    def inputs(self, simulator: Simulator) -> Inputs:
        """Returns the inputs of all steps."""
        force = None if self.force is None else simulator.tensor(self.force)
        rise = simulator.tensor([min(1.5 * (k + 1) / self.steps, 1.0) for k in range(self.steps)])[:, None, None]
        pulled = {name: Inputs(tendon_tension=rise * simulator.tensor(most)) for name, most in self.pull.items()}
        own = Scene(self.bodies).inputs(pulled)
        if self.drive is None:
            return own.replace(external_force=force)
        rest = simulator.rest_positions[simulator.fixed].cpu().numpy()
        places = np.stack([self.drive(rest, (k + 1) / self.steps) for k in range(self.steps)])
        return own.replace(external_force=force, fixed_positions=simulator.tensor(places[:, None]))


@dataclass(frozen=True)
class CaseOutcome:
    """Outcome of a case.

    Attributes:
        crossings: number of steps after which surfaces cross.
        checked_by: name of the program that says so.
        failed: number of failed solves.
        iterations: most iterations of a step.
        gap: least distance of surfaces [m]; infinite without pairs nearby.
        end: (N, 3) positions at the end [m].
    """

    crossings: int
    checked_by: str
    failed: int
    iterations: int
    gap: float
    end: FloatArray


def run_case(case: Case, device: torch.device) -> CaseOutcome:
    """Simulates a case and checks every step for crossings."""
    s = case.simulator(device)
    start = s.rest_state()
    assert isinstance(s.body, Scene)
    for name, velocity in case.velocities.items():
        start.v[:, s.body.vertex_slice(name)] = s.tensor(velocity)
    with torch.no_grad():
        path = s.rollout(start, case.steps, case.inputs(s))
    surface = Surface.of(s.body.mesh)
    pairs = PairList(Launcher(1, device), surface, case.distance)
    crossed, checked_by = crossing_steps(surface, path.q[1:, 0].double(), pairs)
    gap = math.inf
    for q in path.q[1:].double():
        pairs.find(q, torch.zeros_like(q))
        gap = min(gap, float(pairs.distances(q).min())) if pairs.count else gap
    failed = sum(int((~report.converged).sum()) for report in path.reports)
    most = max(int(report.iterations.max()) for report in path.reports)
    return CaseOutcome(crossed, checked_by, failed, most, gap, path.q[-1, 0].cpu().numpy())


def crossing_steps(surface: Surface, positions: torch.Tensor, pairs: PairList) -> tuple[int, str]:
    """Returns the number of positions (T, N, 3) [m] at which surfaces cross, and the program that checked it.

    That is ipctk where it is installed, and the project's own search otherwise.
    """
    if find_spec("ipctk") is None:
        return sum(bool(pairs.crossings(q[None])[0]) for q in positions), "own check"
    import ipctk

    mesh = ipctk.CollisionMesh(surface.rest, surface.edges, surface.triangles)
    return sum(bool(ipctk.has_intersections(mesh, q.cpu().numpy())) for q in positions), "ipctk"


def case_checks(quick: bool, device: torch.device) -> Iterator[Check]:
    """Runs all cases, or some of them."""
    for name, case in cases().items():
        if not quick or name in _QUICK:
            yield check_case(name, case, device)


def check_case(name: str, case: Case, device: torch.device) -> Check:
    """Runs a case; an error is a failure."""
    expected = "0 crossings, 0 failed, touches"
    try:
        out = run_case(case, device)
    except ResphysError as error:
        return Check(name, str(error), expected, False)
    result = f"{case.steps} steps, {out.crossings} crossings ({out.checked_by}), {out.failed} failed, "
    result += f"{out.iterations} iterations at most, gap {1e6 * out.gap:.3g} um"
    passed = out.crossings == out.failed == 0 and out.gap < case.distance
    if case.passes is not None:
        body, least = case.passes
        x = float(out.end[Scene(case.bodies).vertex_slice(body), 0].mean())
        result, expected = f"{result}, {body} at {1e3 * x:.0f} mm", f"{expected}, {body} beyond {1e3 * least:.0f} mm"
        passed = passed and x > least
    return Check(name, result, expected, passed)


def cases() -> dict[str, Case]:
    """Returns all cases by name."""
    driven = {"mat": mat(), "rollers": rollers(), "funnel": funnel(), "clip": clip(), "tentacle": tentacle()}
    return {**erleben_cases(), **driven}


def cone(apex: ArrayLike, triangles: ArrayLike) -> Mesh:
    """Returns tetrahedra between an apex (3,) and triangles (T, 3, 3) [m], of which neighbours share corners."""
    corners = np.asarray(triangles, dtype=np.float64)
    tips = np.broadcast_to(np.asarray(apex, dtype=np.float64), (len(corners), 1, 3))
    return _tetrahedra(np.concatenate([tips, corners], axis=1))


def prism(outline: Sequence[Sequence[float]], length: float) -> Mesh:
    """Returns the tetrahedra of a prism along y, centred there, over an outline (x, z) that its first corner sees."""
    x, z = np.asarray(outline, dtype=np.float64).T
    low, high = (np.stack([x, np.full_like(x, side * length / 2.0), z], axis=1) for side in (-1.0, 1.0))
    cells = []
    for k in range(1, len(x) - 1):
        a, b = low[[0, k, k + 1]], high[[0, k, k + 1]]
        cells += [[a[0], a[1], a[2], b[2]], [a[0], a[1], b[1], b[2]], [a[0], b[0], b[1], b[2]]]
    return _tetrahedra(np.array(cells))


def _tetrahedra(corners: FloatArray) -> Mesh:
    """Returns the mesh of tetrahedra (M, 4, 3) [m], of either orientation."""
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    return merged(np.where(inverted[:, None, None], corners[:, [1, 0, 2, 3]], corners))


def merged(corners: FloatArray) -> Mesh:
    """Returns the mesh of cells with corners (M, K, 3) [m], of which those at one place become one vertex."""
    vertices, cells = np.unique(np.round(corners.reshape(-1, 3), 12), axis=0, return_inverse=True)
    return Mesh(vertices, cells.reshape(corners.shape[:2]))


def placed(mesh: Mesh, place: ArrayLike = _ORIGIN, turn: ArrayLike = _ORIGIN) -> Mesh:
    """Returns a mesh turned by a rotation vector (3,) [rad] about the origin, then moved by (3,) [m]."""
    return replace(mesh, vertices=Rotation.from_rotvec(turn).apply(mesh.vertices) + np.asarray(place))


def erleben_cases() -> dict[str, Case]:
    """Returns cases in which a body falls on a held one or slides over it, corner on corner and edge on edge."""
    a, upside_down = _SIDE, (math.pi, 0.0, 0.0)
    square = a * np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    spike = cone((0.0, 0.0, a), square[[[0, 1, 2], [0, 2, 3]]])
    box = box_tetrahedra((2.0 * a, 2.0 * a, a), (1, 1, 1))
    box = replace(box, vertices=box.vertices - [a, a, a])
    faces = box.vertices[Surface.of(box).triangles]
    pit = cone((0.0, 0.0, -0.6 * a), faces[(faces[..., 2] < 0.0).any(1)])
    wedge = prism(((0.0, a), (-0.4 * a, 0.0), (0.4 * a, 0.0)), a)
    groove = ((0.0, -0.6), (-0.6, 0.0), (-1.0, 0.0), (-1.0, -1.0), (1.0, -1.0), (1.0, 0.0), (0.6, 0.0))
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


def _falls(lower: Mesh, upper: Mesh, speed: float = 0.0) -> Case:
    """Returns the case of a stiff body that falls on another one, which is held at its base, and on to a floor."""
    kappa, friction, distance = 1e5, 0.3, 1e-4
    base = float(lower.vertices[:, 2].min())
    floor = Contact({"floor": HalfSpace(position=(0.0, 0.0, base))}, kappa, friction, distance)
    bodies = {"lower": Body(lower, fixed=select_vertices(lower, z=base)), "upper": Body(upper, energies=[floor])}
    contact, thrown = SurfaceContact(kappa, friction, distance), {"upper": (speed, 0.0, -1.0)}
    return Case(bodies, contact, distance, 100, velocities=thrown)


def mat() -> Case:
    """Returns the case of a mat whose ends make one and a half turns against one another and come nearer."""
    length, angle, nearer, distance = 0.1, 1.5 * math.pi, 0.03, 5e-4
    mesh = box_hexahedra((length, 0.05, 0.002), (16, 8, 1))
    fixed = np.union1d(select_vertices(mesh, x=0.0), select_vertices(mesh, x=length))

    def drive(rest: FloatArray, share: float) -> FloatArray:
        side = np.where(rest[:, 0] > 0.5 * length, 1.0, -1.0)
        along, middle = np.outer(share * side, (1.0, 0.0, 0.0)), np.array([0.5 * length, 0.025, 0.001])
        return Rotation.from_rotvec(angle * along).apply(rest - middle) + middle - 0.5 * nearer * along

    contact = SurfaceContact(1e5, 0.3, distance)
    body = {"mat": Body(mesh, fixed=fixed)}
    return Case(body, contact, distance, 120, 0.02, _RUBBER, (0.0, 0.0, 0.0), drive=drive)


def rollers() -> Case:
    """Returns the case of a soft block that two rollers draw through a gap narrower than itself.

    Rigid rollers would draw it in where friction exceeds the slope at which its edges meet them, here 0.58.
    """
    radius, gap, width, distance = 0.015, 0.012, 0.03, 5e-4
    speed, steps, step = 0.1, 120, 0.005
    roller = rod(width * np.array([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]]), radius, 3, core=4, nodes=8)
    block = box_hexahedra((0.03, 0.016, 0.016), (6, 3, 3))
    block = placed(block, (-0.0415, -0.008, -0.008))  # before the place where its edges meet the rollers
    height = np.array([0.0, 0.0, radius + 0.5 * gap])
    bodies, all_of_it = {"block": Body(block)}, np.arange(len(roller.vertices))
    for name, side in (("upper", 1.0), ("lower", -1.0)):
        bodies[name] = Body(placed(roller, side * height), fixed=all_of_it)

    def drive(rest: FloatArray, share: float) -> FloatArray:
        side = np.sign(rest[:, 2:])
        turn = -speed / radius * steps * step * share * side * [0.0, 1.0, 0.0]
        return Rotation.from_rotvec(turn).apply(rest - side * height) + side * height

    contact, still = SurfaceContact(1e5, 0.8, distance, 5e-3), (0.0, 0.0, 0.0)
    start = {"block": (speed, 0.0, 0.0)}
    return Case(bodies, contact, distance, steps, step, _RUBBER, still, start, drive=drive, passes=("block", 0.02))


def funnel() -> Case:
    """Returns the case of a soft ball that a load forces through a funnel narrower than itself."""
    radius, neck, distance = 0.012, 0.009, 5e-4
    around, wall = 16, 0.003
    levels = np.array([[-0.02, 0.02], [0.0, neck], [0.015, neck]])  # x and inner radius [m]
    tube = box_hexahedra((2.0, wall, 2.0 * math.pi), (2, 1, around))
    level, depth, turn = tube.vertices.T
    x, r = levels[np.round(level).astype(int)].T
    ring = np.stack([x, (r + depth) * np.cos(turn), (r + depth) * np.sin(turn)], axis=1)
    walls = merged(ring[tube.cells])
    ball = placed(thing_mesh("ball", radius, 4), (-0.02, 0.0, 0.0))
    bodies = {"funnel": Body(walls, fixed=np.arange(len(walls.vertices))), "ball": Body(ball)}
    contact, soft = SurfaceContact(1e5, 0.1, distance), replace(_RUBBER, youngs_modulus=2e4)
    return Case(bodies, contact, distance, 40, 1e-3, soft, (40.0 * G, 0.0, 0.0), passes=("ball", 0.015))


def clip() -> Case:
    """Returns the case of a U with legs of two lengths, whose ends are pressed on one another."""
    bar, height, distance, press = 0.006, 0.028, 1e-3, 0.3
    legs = {1.0: ((0.0, 0.0, 0.0), (0.03, bar, bar)), -1.0: ((0.0, 0.0, height - bar), (0.026, bar, height))}
    mesh = boxes_hexahedra([*legs.values(), ((0.0, 0.0, 0.0), (bar, bar, height))], 0.003)
    force = np.zeros_like(mesh.vertices)
    for side, (low, high) in legs.items():
        end = select_vertices(mesh, x=high[0], z=(low[2], high[2]))
        force[end, 2] = side * press / len(end)
    body = {"clip": Body(mesh, fixed=select_vertices(mesh, x=0.0))}
    contact = SurfaceContact(1e5, 0.3, distance)
    return Case(body, contact, distance, 40, 0.004, SOFT, (0.0, 0.0, 0.0), force=force)


def tentacle() -> Case:
    """Returns the case of a tentacle that a tendon curls around a post, until its end lies on its upper part."""
    length, distance, slip_speed = 0.28, 5e-4, 2e-2
    mesh = rod([[0.0, 0.0, 0.0], [0.0, 0.0, -length]], [[0.0, 0.0065], [length, 0.0055]], 12, nodes=20)
    curl, side = (
        np.linspace([x, y, 0.0], [end_x, end_y, -length], 21)
        for x, y, end_x, end_y in ((0.006, 0.0, 0.0031, 0.0), (0.0, 8e-4, 0.0, 6e-4))
    )
    post = Cylinder(position=(0.04, 0.0, -0.09), axis=(0.0, 1.0, 0.0), radius=0.016, length=0.12)
    touches = Contact({"post": post}, 2e4, 0.3, 2.0 * distance, slip_speed)
    body = Body(mesh, fixed=select_vertices(mesh, z=0.0), energies=[Tendons([curl, side]), touches])
    contact, soft = SurfaceContact(2e4, 0.3, distance, slip_speed), replace(_RUBBER, youngs_modulus=2.3e5)
    return Case({"tentacle": body}, contact, distance, 120, material=soft, pull={"tentacle": (2.7, 1.5)})


@dataclass
class CardHouse:
    """Storeys of pairs of rigid cards that lean on one another, with a flat card on every storey but the last.

    A leaning card of length L and thickness t touches floor and neighbour with the edges of one of its faces.

    Args:
        angle: of the leaning cards to the vertical [rad].
        storeys: number of storeys; each has one pair fewer than that below.
    """

    angle: float
    storeys: int
    cards: list[FloatArray] = field(default_factory=list)  # corners (4, 2) [m], lower left first, counter-clockwise
    touches: list[PointContact] = field(default_factory=list)  # places where they push one another

    def __post_init__(self) -> None:
        """Puts up the storeys."""
        sine, cosine = math.sin(self.angle), math.cos(self.angle)
        along, thick = _LENGTH * np.array([sine, cosine]), _THICKNESS * np.array([-cosine, sine])
        foot = np.array([-0.5 * _CARD_REST - along[0], 0.0])
        left = np.array([foot + thick, foot, foot + along, foot + along + thick])
        right = left[[1, 0, 3, 2]] * [-1.0, 1.0]
        pitch, up = 2.0 * (along[0] - thick[0]) + _THICKNESS, np.array([0.0, 1.0])
        floor, below = 0.0, None  # height, and the flat card, of a storey
        for storey in range(self.storeys):
            tops = list[tuple[int, FloatArray]]()
            for k in range(self.storeys - storey):
                place = np.array([pitch * (k + 0.5 * storey), floor])
                a, b = (self._put(corners + place) for corners in (left, right))
                for card, at in ((a, left[1] + place), (b, right[0] + place)):
                    self._touch(card, at, up, below)
                self._touch(a, left[2] + place, np.array([-1.0, 0.0]), b)
                tops += [(a, left[3] + place), (b, right[2] + place)]
            floor += left[3, 1] + _CARD_REST
            if storey + 1 < self.storeys:
                ends = np.array([tops[0][1][0] - _THICKNESS, tops[-1][1][0] + _THICKNESS])
                x, z = ends[[0, 1, 1, 0]], floor + _THICKNESS * np.array([0.0, 0.0, 1.0, 1.0])
                below = self._put(np.stack([x, z], 1))
                for other, at in tops:
                    self._touch(below, at, up, other)
                floor += _THICKNESS + _CARD_REST

    def _put(self, corners: FloatArray) -> int:
        """Adds a card, and returns its number."""
        self.cards.append(corners)
        return len(self.cards) - 1

    def _touch(self, card: int, at: FloatArray, normal: FloatArray, other: int | None) -> None:
        own, by = (at - self.cards[card].mean(0), None if other is None else (other, at - self.cards[other].mean(0)))
        self.touches.append(PointContact(own, normal, card, by))

    @property
    def least_friction(self) -> float:
        """Coefficient of friction below which no forces carry the cards."""
        sizes = [float(np.linalg.norm(card[1] - card[0]) * np.linalg.norm(card[3] - card[0])) for card in self.cards]
        return least_friction(sizes, self.touches)

    def scene(self, friction: float) -> Scene:
        """Returns the cards on a floor, which almost touch."""
        kappa, bodies = 1e6, dict[str, Body]()
        floor = Contact({"floor": HalfSpace(position=(0.0, 0.0, -_CARD_REST))}, kappa, friction, _CARD_GAP)
        for k, corners in enumerate(self.cards):
            brick = box_hexahedra((1.0, _WIDTH, 1.0), (1, 1, 1))
            u, y, v = brick.vertices.T
            x, z = (corners[0] + np.outer(u, corners[1] - corners[0]) + np.outer(v, corners[3] - corners[0])).T
            card = replace(brick, vertices=np.stack([x, y, z], 1))
            bodies[f"card{k}"] = Body.rigid_body(card, Rigid(DENSITY), energies=[floor])
        return Scene(bodies, SurfaceContact(kappa, friction, _CARD_GAP))


def card_checks(quick: bool, device: torch.device) -> Iterator[Check]:
    """Houses of cards that were put up: the way by which their upper edges sink in half a second."""
    for degrees, storeys in ((25.0, 2),) if quick else ((15.0, 1), (25.0, 1), (35.0, 1), (25.0, 2)):
        house = CardHouse(math.radians(degrees), storeys)
        need = house.least_friction
        for mu, stands in ((need * (1.0 + MARGIN), True), (need * (1.0 - MARGIN), False)):
            way = card_drop(house.scene(mu), device)
            title = f"{len(house.cards)} cards, {degrees:g} degrees, mu {mu:.3f} for {need:.3f}: by how much they sink"
            expected = "< 1 mm: they stand" if stands else "> 10 mm: they fall"
            yield Check(title, f"{1e3 * way:.1f} mm", expected, way < 1e-3 if stands else way > 1e-2)


def card_drop(scene: Scene, device: torch.device) -> float:
    """Returns by how much the upper edges of a house of cards sink in half a second [m]."""
    top = scene.vertices[:, 2] > scene.vertices[:, 2].max() - 1e-6
    z = built(scene, device).q[:, 0, top, 2].mean(1)
    return float(z[0] - z[-1])
