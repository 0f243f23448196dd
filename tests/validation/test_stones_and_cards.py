"""An arch of stones and houses of cards stand with 5 % more friction than statics asks, and fall with 5 % less.

A semicircular arch of rigid stones in equilibrium has joints that take no tension (Heyman 1966).

J. Heyman: The stone skeleton. International Journal of Solids and Structures 2, 1966.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import linprog

from support.contact import G
from warp_resphys import (
    Body,
    Contact,
    HalfSpace,
    Rigid,
    Scene,
    Simulator,
    SolverSettings,
    SurfaceContact,
    box_hexahedra,
)

FloatArray = NDArray[np.float64]
DENSITY = 2000.0  # kg/m^3
RADIUS, THICKNESS, WIDTH = 0.5, 0.12, 0.1  # of an arch [m]
_LENGTH, _THICKNESS, _WIDTH = 0.2, 0.01, 0.1  # of a card [m]
_CARD_GAP = 2e-4  # at which contact of cards begins [m]
_CARD_REST = 0.97 * _CARD_GAP  # between them at the start


@torch.no_grad()
def built(scene: Scene, device: str):
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


def card_drop(scene: Scene, device: str) -> float:
    """Returns by how much the upper edges of a house of cards sink in half a second [m]."""
    top = scene.vertices[:, 2] > scene.vertices[:, 2].max() - 1e-6
    z = built(scene, device).q[:, 0, top, 2].mean(1)
    return float(z[0] - z[-1])


@pytest.mark.parametrize(("share", "stands"), [(1.05, True), (0.95, False)])
def test_an_arch(share, stands, device):
    """Of 25 stones: the speed of its keystone after half a second; every joint of one that stands creeps."""
    stones = 25
    scene = arch(stones, share * least_friction(np.ones(stones).tolist(), arch_joints(stones)))
    speed = float(built(scene, device).v[-1, 0, scene.vertex_slice(f"stone{stones // 2}")].mean(0).norm())
    assert speed < 5e-3 if stands else speed > 0.05


@pytest.mark.parametrize("degrees", [15.0, 25.0, 35.0])
def test_two_cards(degrees, device):
    """Moments about the edge on which a card stands, of its weight and of the other card's force, give the friction."""
    house = CardHouse(math.radians(degrees), 1)
    scene = house.scene(0.3)
    x = scene.vertices[scene.vertex_slice("card0")]
    foot, top, middle = x[x[:, 2].argmin()], x[x[:, 0].argmax()], x.mean(0)
    assert top[0] < 0.0  # The other card begins at the plane x = 0.
    need = (middle[0] - foot[0]) / (top[2] - foot[2])
    assert house.least_friction == pytest.approx(need, rel=1e-6)
    stands, falls = (card_drop(house.scene(share * need), device) for share in (1.05, 0.95))
    assert stands < 1e-3 < 1e-2 < falls


def test_a_second_storey_needs_more_friction(device):
    one, two = (CardHouse(math.radians(25.0), storeys) for storeys in (1, 2))
    assert len(two.cards) == 7
    need = two.least_friction
    assert need > 1.2 * one.least_friction
    stands, falls = (card_drop(two.scene(share * need), device) for share in (1.05, 0.95))
    assert stands < 1e-3 < 1e-2 < falls
