"""Surfaces of obstacles in pictures: where contact has them, and in all scenes."""

import numpy as np
import pytest
import torch

from warp_resphys import Body, Contact, Cylinder, HalfSpace, Scene, box_hexahedra
from warp_resphys.core.energies.contact.obstacle_poses import ObstacleSet, Pose
from warp_resphys.core.energies.contact.obstacle_surface import ObstacleSurface
from warp_resphys.core.stepping.rotations import rotations
from warp_resphys.energies import Box, Capsule, Sphere

MESH = box_hexahedra((0.1, 0.02, 0.02), (4, 1, 1))
SHAPES = {
    "sphere": Sphere(position=(0.0, 0.0, -0.1), radius=0.03),
    "capsule": Capsule(position=(0.0, 0.0, -0.1), axis=(1.0, 1.0, 0.0), radius=0.02, length=0.05),
    "cylinder": Cylinder(position=(0.0, 0.0, -0.1), axis=(0.0, 1.0, 0.3), radius=0.02, length=0.05),
    "box": Box(position=(0.0, 0.0, -0.1), edges=(0.02, 0.04, 0.06)),
}
MOVED = {"obstacle_x": 0.01, "obstacle_z": -0.02, "obstacle_turn_y": 0.4}


@pytest.mark.parametrize("name", SHAPES)
def test_the_surface_is_where_the_distance_is_zero(name):
    """Corners of the triangles lie on the obstacle.

    Volumes by the divergence theorem are its own, normals outwards.
    """
    body = Body(MESH, energies=[Contact({name: SHAPES[name]})])
    surface = ObstacleSurface.of(body, MOVED)
    place = torch.tensor([[[0.01, 0.0, -0.12]]], dtype=torch.float64)
    turn = rotations(torch.tensor([0.0, 0.4, 0.0], dtype=torch.float64)) @ torch.from_numpy(
        SHAPES[name].turn
    )
    shapes = ObstacleSet((SHAPES[name],), 1e-3, torch.device("cpu"))
    points = torch.from_numpy(surface.points)[None]
    d, _ = shapes.distances(points, Pose(place, turn[None, None], place.new_zeros(1, 1)))
    assert d.abs().max() < 1e-12
    corners = surface.points[surface.triangles] - surface.points.mean(axis=0)
    ball = 4.0 / 3.0 * np.pi
    volume = {
        "sphere": ball * 0.03**3,
        "capsule": ball * 0.02**3 + np.pi * 0.02**2 * 0.05,
        "cylinder": np.pi * 0.02**2 * 0.05,
        "box": 0.02 * 0.04 * 0.06,
    }[name]
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(volume, rel=6e-3)


def test_a_half_space_is_a_plate_below_the_body_and_no_obstacle_has_none():
    floor = HalfSpace(position=(5.0, 5.0, -0.01))
    surface = ObstacleSurface.of(
        Body(MESH, energies=[Contact({"floor": floor})]), {"obstacle_growth": 2e-3}
    )
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    assert high[2] == pytest.approx(-0.008)
    np.testing.assert_allclose(0.5 * (low + high)[:2], MESH.vertices.mean(axis=0)[:2], atol=1e-12)
    assert (high - low)[:2] == pytest.approx([0.15, 0.15])
    surface = ObstacleSurface.of(Body(MESH))
    assert len(surface.points) == len(surface.triangles) == 0


def test_parameters_move_the_obstacle_that_they_name():
    two = {"one": SHAPES["sphere"], "two": Sphere(position=(0.0, 0.0, 0.2), radius=0.03)}
    body = Body(MESH, energies=[Contact(two)])
    moved, still = (
        ObstacleSurface.of(body, parameters).points for parameters in ({"obstacle_y_two": 0.01}, {})
    )
    half = len(still) // 2
    np.testing.assert_array_equal(moved[:half], still[:half])
    np.testing.assert_allclose(
        moved[half:] - still[half:], np.tile([0.0, 0.01, 0.0], (half, 1)), atol=1e-15
    )


def test_obstacles_of_a_scene_have_the_names_and_parameters_of_their_bodies():
    ball = Contact({"ball": SHAPES["sphere"]})
    scene = Scene({"left": Body(MESH, energies=[ball]), "right": Body(MESH, energies=[ball])})
    moved = ObstacleSurface.of(
        scene, {"left_obstacle_y": 0.01, "right_obstacle_growth": 0.01}
    ).solids
    one, triangles = ObstacleSurface.of(Body(MESH, energies=[ball])).solids["ball"]
    assert [*moved] == ["left_ball", "right_ball"]
    np.testing.assert_allclose(moved["left_ball"][0], one + [0.0, 0.01, 0.0], atol=1e-15)
    assert np.ptp(moved["right_ball"][0], axis=0) == pytest.approx(
        np.ptp(one, axis=0) * 0.04 / 0.03
    )
    assert all(np.array_equal(faces, triangles) for _, faces in moved.values())
