"""An arch of stones and houses of cards stand with 5 % more friction than statics asks,
and fall with 5 % less.

A semicircular arch of rigid stones in equilibrium has joints that take no tension (Heyman 1966).

J. Heyman: The stone skeleton. International Journal of Solids and Structures 2, 1966.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from support.contact import G
from warp_resphys import (
    Body,
    Contact,
    HalfSpace,
    Rigid,
    Scene,
    Simulator,
    SurfaceContact,
    box_hexahedra,
)

DENSITY = 2000.0  # kg/m^3
RADIUS, THICKNESS, STONE_WIDTH = 0.5, 0.12, 0.1  # of an arch [m]
LENGTH, CARD, WIDTH = 0.2, 0.01, 0.1  # of a card [m]
GAP = 2e-4  # at which contact of cards begins [m]
REST = 0.97 * GAP  # between them at the start
# Coefficients of friction below which no forces at the ends of joints carry the weights, by a
# linear program: of the arch of 25 stones, and of two storeys of cards at 25 degrees, of which one
# storey needs 0.208.
ARCH, TWO_STOREYS = 0.307689, 0.297236


@torch.no_grad()
def built(scene, device):
    """The motion of rigid bodies that were put up at rest, for half a second."""
    s = Simulator(scene, {}, 0.01, (0.0, 0.0, -G), relative_tolerance=1e-6, device=device)
    return s.rollout(s.rest_state(), 50)


def arch(stones, friction):
    """A semicircular arch of rigid stones on a floor, which almost touch."""
    distance, kappa = 1e-3, 1e6
    gap, angle = 0.97 * distance, math.pi / stones
    floor = {"floor": HalfSpace(position=(0.0, 0.0, -0.5 * gap))}
    bodies, brick = {}, box_hexahedra((1.0, 1.0, 1.0), (1, 1, 1))
    for k in range(stones):
        u = brick.vertices
        turn, r = math.pi - (k + u[:, 0]) * angle, RADIUS + THICKNESS * (u[:, 2] - 0.5)
        x = np.stack([r * np.cos(turn), STONE_WIDTH * (u[:, 1] - 0.5), r * np.sin(turn)], 1)
        middle = math.pi - (k + 0.5) * angle
        along = np.array([-math.sin(middle), 0.0, math.cos(middle)])
        x -= np.outer(x @ along, along) * gap / (angle * RADIUS)
        contact = Contact(floor, kappa, friction, distance)
        bodies[f"stone{k}"] = Body.rigid_body(
            replace(brick, vertices=x), Rigid(density=DENSITY), energies=[contact]
        )
    return Scene(bodies, SurfaceContact(kappa, friction, distance))


def house(degrees, storeys, friction):
    """Storeys of pairs of rigid cards that lean on one another,
    with a flat card on every storey but the last.

    A leaning card, at an angle to the vertical [degrees], touches floor and neighbour with the
    edges of one of its faces. Each storey has one pair fewer than that below.
    """
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    along, thick = LENGTH * np.array([sine, cosine]), CARD * np.array([-cosine, sine])
    foot = np.array([-0.5 * REST - along[0], 0.0])
    left = np.array([foot + thick, foot, foot + along, foot + along + thick])
    right = left[[1, 0, 3, 2]] * [-1.0, 1.0]
    pitch, rise = 2.0 * (along[0] - thick[0]) + CARD, left[3, 1] + REST
    cards = []  # corners (4, 2) [m], lower left first, counter-clockwise
    for storey in range(storeys):
        floor = storey * (rise + CARD + REST)
        feet = [np.array([pitch * (k + 0.5 * storey), floor]) for k in range(storeys - storey)]
        cards += [corners + place for place in feet for corners in (left, right)]
        if storey + 1 < storeys:
            low, high = feet[0][0] + left[3, 0] - CARD, feet[-1][0] + right[2, 0] + CARD
            z = floor + rise
            cards.append(np.array([[low, z], [high, z], [high, z + CARD], [low, z + CARD]]))
    kappa, bodies, brick = 1e6, {}, box_hexahedra((1.0, WIDTH, 1.0), (1, 1, 1))
    ground = Contact({"floor": HalfSpace(position=(0.0, 0.0, -REST))}, kappa, friction, GAP)
    for k, corners in enumerate(cards):
        u, y, v = brick.vertices.T
        x, z = (
            corners[0] + np.outer(u, corners[1] - corners[0]) + np.outer(v, corners[3] - corners[0])
        ).T
        card = replace(brick, vertices=np.stack([x, y, z], 1))
        bodies[f"card{k}"] = Body.rigid_body(card, Rigid(density=DENSITY), energies=[ground])
    return Scene(bodies, SurfaceContact(kappa, friction, GAP))


def card_drop(scene, device):
    """How far the upper edges of a house of cards sink in half a second [m]."""
    top = scene.vertices[:, 2] > scene.vertices[:, 2].max() - 1e-6
    z = built(scene, device).q[:, 0, top, 2].mean(1)
    return float(z[0] - z[-1])


@pytest.mark.release
@pytest.mark.parametrize(("share", "stands"), [(1.05, True), (0.95, False)])
def test_an_arch(share, stands, device):
    """Of 25 stones: the speed of its keystone after half a second.

    Every joint of one that stands creeps.
    """
    stones = 25
    scene = arch(stones, share * ARCH)
    speed = float(
        built(scene, device).v[-1, 0, scene.vertex_slice(f"stone{stones // 2}")].mean(0).norm()
    )
    assert speed < 5e-3 if stands else speed > 0.05


@pytest.mark.parametrize("degrees", [15.0, 35.0])
def test_two_cards(degrees, device):
    """Moments about the edge on which a card stands,
    of its weight and of the other card's force, give the friction.
    """
    scene = house(degrees, 1, 0.3)
    x = scene.vertices[scene.vertex_slice("card0")]
    foot, top, middle = x[x[:, 2].argmin()], x[x[:, 0].argmax()], x.mean(0)
    assert top[0] < 0.0  # The other card begins at the plane x = 0.
    need = (middle[0] - foot[0]) / (top[2] - foot[2])
    stands, falls = (card_drop(house(degrees, 1, share * need), device) for share in (1.05, 0.95))
    assert stands < 1e-3 < 1e-2 < falls


def test_a_second_storey_needs_more_friction(device):
    stands, falls = (
        card_drop(house(25.0, 2, share * TWO_STOREYS), device) for share in (1.05, 0.95)
    )
    assert stands < 1e-3 < 1e-2 < falls
