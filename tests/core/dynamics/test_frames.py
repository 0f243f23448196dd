"""Rotations around the vertices of a body, forces that turn with them,
and the frame of a base that moves.
"""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from support.chambered import KINDS, chambered
from warp_resphys import Body, Scene, box_hexahedra, select_vertices
from warp_resphys.core.dynamics.frames import BaseFrame, VertexFrames, base_movement, carried_rest


def deformed(body, stretch):
    """(1, N, 3) rest positions under an affine map."""
    return torch.as_tensor(body.mesh.vertices @ np.asarray(stretch).T)[None]


@pytest.mark.parametrize("kind", KINDS)
def test_an_affine_map_has_the_rotation_of_its_polar_decomposition_everywhere(kind):
    body = chambered(kind)
    turn = Rotation.from_euler("xyz", [170.0, 50.0, -80.0], degrees=True).as_matrix()
    stretch = np.array([[1.4, 0.2, 0.0], [0.2, 0.6, 0.1], [0.0, 0.1, 0.9]])
    q = deformed(body, turn @ stretch)
    frames = VertexFrames(body, 0.01, q)
    rotations = frames.rotations(q)
    np.testing.assert_allclose(rotations[0], np.broadcast_to(turn, rotations[0].shape), atol=1e-12)
    force = torch.randn(q.shape, dtype=q.dtype, generator=torch.Generator().manual_seed(0))
    v = 0.0 * q
    np.testing.assert_allclose(
        frames.to_world(q, v, force)[0].numpy(), force[0].numpy() @ turn.T, atol=1e-12
    )
    np.testing.assert_allclose(
        frames.to_rest(q, v, frames.to_world(q, v, force)), force, atol=1e-12
    )
    rest = deformed(body, np.eye(3))
    np.testing.assert_allclose(
        frames.to_world(rest, (q - rest) / 0.01, force), frames.to_world(q, v, force), atol=1e-9
    )


STEP = 0.01
SWINGS = np.array([[0.02, 0.0, 0.01, 0.3, 0.0, 1.0], [0.0, 0.05, 0.0, 0.0, -0.5, 0.2]])  # m, rad


def poses_of_two(steps=20):
    """(K + 1, 2, 6) of two bases that swing, the second one from 0.05 s on."""
    since = np.maximum(STEP * np.arange(steps + 1)[:, None] - [0.0, 0.05], 0.0)
    return torch.from_numpy(np.sin(2.0 * np.pi * since * [1.0, 0.5])[..., None] * SWINGS)


def placed(points, poses):
    """(B, N, 3) points of a body at poses (B, 6)."""
    turned = Rotation.from_rotvec(poses[:, 3:].numpy()).as_matrix() @ points.T
    return np.swapaxes(turned, 1, 2) + poses[:, None, :3].numpy()


def test_a_body_that_goes_with_its_base_is_at_rest_in_its_frame_from_which_states_come_back():
    poses = poses_of_two()
    points = Body(box_hexahedra(divisions=(2, 1, 1))).mesh.vertices
    world = torch.from_numpy(np.stack([placed(points, both) for both in poses]))
    base = BaseFrame(poses, STEP)
    for k in range(1, 21):
        q, v = base.enter(world[k], (world[k] - world[k - 1]) / STEP, k)
        np.testing.assert_allclose(q, np.stack([points, points]), atol=1e-14)
        np.testing.assert_allclose(v, np.zeros_like(q), atol=1e-12)
    base, random = BaseFrame(poses_of_two(), STEP), torch.Generator().manual_seed(2)
    q, v, force = (torch.randn(2, 7, 3, dtype=torch.float64, generator=random) for _ in range(3))
    for k in (0, 1, 7, 20, 25):
        for actual, expected in zip(base.leave(*base.enter(q, v, k), k), (q, v), strict=True):
            torch.testing.assert_close(actual, expected, rtol=0.0, atol=1e-11)
        torch.testing.assert_close(
            base.force_outside(base.force_inside(force, k), k), force, rtol=0.0, atol=1e-14
        )


def test_what_networks_are_told_of_a_base_are_its_velocities_and_gravity():
    times = STEP * np.arange(21)
    velocity, rate = np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.0, 2.0])
    poses = torch.from_numpy(np.concatenate([times[:, None] * velocity, times[:, None] * rate], 1))
    poses = poses[:, None]
    movement = base_movement(poses, STEP, torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64))[
        :, 0
    ].numpy()
    turned = Rotation.from_rotvec(times[:, None] * rate)
    np.testing.assert_allclose(movement[:, :3], turned[:-1].inv().apply(velocity), atol=1e-12)
    np.testing.assert_allclose(movement[:, 3:6], np.tile(rate, (20, 1)), rtol=1e-4)
    np.testing.assert_allclose(movement[1:, 6:12], movement[:-1, :6], atol=1e-15)
    np.testing.assert_allclose(
        movement[:, 12:], turned[1:].inv().apply([0.0, -1.0, 0.0]), atol=1e-12
    )


@pytest.mark.parametrize(
    ("place", "turns"),
    [({"x": 0.0}, True), ({"x": 0.0, "y": 0.0}, False), ({"x": 0.0, "y": 0.0, "z": 0.0}, False)],
    ids=["face", "edge", "corner"],
)
def test_rest_shapes_are_carried_by_their_bases(place, turns):
    """Exactly by a face.

    By an edge or a corner, which leave a turn open, without more of it than they make.
    """
    mesh = box_hexahedra((0.1, 0.03, 0.02), (4, 2, 1))
    body, free = Body(mesh, fixed=select_vertices(mesh, **place)), Body(mesh)
    angles = [[20.0, 130.0, -75.0], [0.0, 0.0, 0.0]]
    turned = torch.from_numpy(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    rest = torch.from_numpy(mesh.vertices)
    away = torch.tensor([[[3.0, -2.0, 1.5]], [[0.0, 7.0, 0.0]]]).double()
    wanted = rest @ turned.mT + away
    carried = carried_rest(Scene({"free": free, "held": body}), wanted[:, body.fixed_vertices])
    np.testing.assert_array_equal(carried[:, : len(rest)], rest.expand(2, -1, -1))
    held = carried[:, len(rest) :]
    np.testing.assert_allclose(
        held[:, body.fixed_vertices], wanted[:, body.fixed_vertices], atol=1e-9
    )
    lengths, wanted_lengths = (
        (x[..., None, :] - x[..., None, :, :]).norm(dim=-1) for x in (held, rest[None])
    )
    np.testing.assert_allclose(lengths, wanted_lengths.expand(2, -1, -1), atol=1e-9)
    np.testing.assert_allclose(held[1], wanted[1], atol=1e-9)
    if turns:
        np.testing.assert_allclose(held[0], wanted[0], atol=1e-9)
