"""The pose of a camera from a drawn tag."""

import numpy as np
import pytest
import torch

from support.refusals import refuses
from support.tags import draw_tag
from warp_resphys.core.stepping.rotations import rotations
from warp_resphys.data.camera import Lens
from warp_resphys.io.errors import InputError
from warp_resphys.pictures.tags import tag_poses
from warp_resphys.settings.pictures import TagSettings

MATRIX = np.array([[900.0, 0.0, 330.0], [0.0, 900.0, 250.0], [0.0, 0.0, 1.0]])
LENS = Lens(torch.as_tensor(MATRIX))
SIZE, PLACE = 0.06, np.array([0.02, -0.01, 0.005])  # m
RIGHT, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])  # the tag looks along x


def pose(turn):
    """world_to_camera that sees the tag from the front, turned by (3,) rad."""
    axes = np.stack([RIGHT, -UP, np.cross(RIGHT, -UP)])
    camera = np.eye(4)
    camera[:3, :3] = rotations(torch.tensor(turn, dtype=torch.float64)).numpy() @ axes
    camera[:3, 3] = np.array([0.01, -0.02, 0.6]) - camera[:3, :3] @ PLACE
    return camera


def picture(camera):
    """The tag, seen by a camera."""
    return draw_tag(
        np.full((500, 660, 3), 60, dtype=np.uint8), camera, MATRIX, PLACE, RIGHT, UP, SIZE, 7
    )


def tag(number=7, dictionary="4x4_50", up=UP):
    return TagSettings(
        dictionary=dictionary, number=number, size=SIZE, centre=[*PLACE], right=[*RIGHT], up=[*up]
    )


@pytest.mark.parametrize("turn", [(0.0, 0.6, 0.0), (0.5, -0.2, 0.1)])
def test_one_of_the_poses_of_a_tag_is_that_of_the_camera(turn):
    camera = pose(turn)
    poses = tag_poses(tag(), picture(camera), LENS)
    away = [np.abs(own - camera).max(0) for own in poses]
    best = min(away, key=lambda own: own[:3].max())
    assert best[:3].max() < 0.03
    assert best[3] < 0.01
    for own in poses:
        assert own[:3, :3] @ own[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(own[:3, :3]) > 0.0


def test_a_tag_that_is_not_seen_has_no_pose_and_it_is_one_of_opencvs_with_two_edges():
    assert tag_poses(tag(3), picture(pose((0.0, 0.3, 0.0))), LENS) == []
    refuses(
        InputError,
        "OpenCV has no tags '9x9_1'",
        tag_poses,
        tag(dictionary="9x9_1"),
        np.zeros((9, 9, 3)),
        LENS,
    )
    refuses(
        InputError, "must be perpendicular", tag_poses, tag(up=RIGHT), np.zeros((9, 9, 3)), LENS
    )
