"""Pixels of points before a camera with corrections, and their derivatives."""

import math

import numpy as np
import pytest
import torch

from warp_resphys.data.camera import Lens
from warp_resphys.io.errors import InputError
from warp_resphys.pictures.camera import CORRECTIONS, PlacedCamera
from warp_resphys.stepping.rotations import rotations

MATRIX = torch.tensor([[900.0, 0.0, 320.0], [0.0, 880.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENS = Lens(MATRIX, torch.tensor([-0.12, 0.05, 1e-3, -2e-3], dtype=torch.float64))
POSE = torch.eye(4, dtype=torch.float64)
POSE[:3, :3] = rotations(torch.tensor([2.9, 0.2, -0.1], dtype=torch.float64))
POSE[:3, 3] = torch.tensor([0.02, -0.01, 0.5])
CENTRE = torch.tensor([0.05, 0.0, 0.01], dtype=torch.float64)
CAMERA = PlacedCamera(LENS, POSE, CENTRE)
POINTS = 0.08 * torch.as_tensor(np.random.default_rng(0).normal(size=(7, 3)))
MOVED = {
    "camera_shift_2": 0.01,
    "camera_turn_1": 0.2,
    "camera_turn_3": -0.1,
    "focal_factor": 1.05,
    "principal_point_1": 8.0,
}


def test_derivatives_are_those_of_differences():
    corrections = CAMERA.corrections(MOVED)
    tangents = torch.as_tensor(np.random.default_rng(1).normal(size=(3, 7, 3)))
    slopes = CAMERA.derivative(POINTS, corrections, tangents)
    step = 1e-6
    for number in range(3):
        ends = [CAMERA.pixels(POINTS + by * tangents[number], corrections) for by in (step, -step)]
        assert torch.allclose(slopes[number], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-6, atol=1e-5)
    for number in range(len(CORRECTIONS)):
        by = step * torch.eye(len(CORRECTIONS), dtype=torch.float64)[number]
        ends = [CAMERA.pixels(POINTS, corrections + sign * by) for sign in (1.0, -1.0)]
        assert torch.allclose(slopes[3 + number], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-6, atol=1e-5)


def test_corrections_mean_what_their_names_say():
    """In words of a pinhole camera without distortion that looks along the scene's axes."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 0.5
    camera = PlacedCamera(Lens(MATRIX), pose, CENTRE)
    point = CENTRE + torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    plain = camera.pixels(point, camera.corrections({}))
    assert plain.tolist() == pytest.approx([320.0 + 900.0 * 0.15 / 0.51, 240.0])
    shifted = camera.pixels(point, camera.corrections({"camera_shift_1": 0.01, "camera_shift_3": -0.01}))
    assert shifted.tolist() == pytest.approx([320.0 + 900.0 * 0.16 / 0.5, 240.0])
    # A quarter turn about z takes the point from x to y of the turn's centre.
    turned = camera.pixels(point, camera.corrections({"camera_turn_3": math.pi / 2.0}))
    assert turned.tolist() == pytest.approx([320.0 + 900.0 * 0.05 / 0.51, 240.0 + 880.0 * 0.1 / 0.51])
    lens = camera.pixels(point, camera.corrections({"focal_factor": 1.1, "principal_point_2": 5.0}))
    assert lens.tolist() == pytest.approx([320.0 + 990.0 * 0.15 / 0.51, 245.0])


def test_located_points_are_those_that_are_seen():
    """From pixels and depths through a distorted lens, and from the axes of a scan, with derivatives."""
    corrections = CAMERA.corrections(MOVED)
    depth = CAMERA.seen_from(POINTS, corrections)[:, 2:]
    measured = torch.cat([CAMERA.pixels(POINTS, corrections), depth], 1)
    scanner = PlacedCamera(None, POSE, CENTRE)
    for camera, own in ((CAMERA, measured), (scanner, scanner.seen_from(POINTS, corrections))):
        assert torch.allclose(camera.located(own, corrections), POINTS, atol=1e-9)
        slopes = camera.located_by(own, corrections)
        for number, by in enumerate(1e-6 * torch.eye(len(CORRECTIONS), dtype=torch.float64)):
            ends = [camera.located(own, corrections + sign * by) for sign in (1.0, -1.0)]
            assert torch.allclose(slopes[number], (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=1e-8)


def test_points_behind_the_camera_are_not_seen():
    points = POINTS.clone()
    points[0] = -10.0 * POSE[:3, :3].T[:, 2]
    seen = CAMERA.pixels(points, CAMERA.corrections({}))
    assert torch.isnan(seen[0]).all()
    assert torch.isfinite(seen[1:]).all()


def test_a_pose_is_a_rigid_motion():
    with pytest.raises(InputError, match=r"shape \(3, 4\)"):
        PlacedCamera(LENS, POSE[:3], CENTRE)
    mirrored = POSE.clone()
    mirrored[0] *= -1.0
    with pytest.raises(InputError, match="no rotation with a shift"):
        PlacedCamera(LENS, mirrored, CENTRE)
