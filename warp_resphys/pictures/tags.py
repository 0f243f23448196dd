"""World-to-camera poses from the picture of one small square tag (ArUco or AprilTag), by OpenCV.

Two poses fit the picture of a small square nearly as well (Collins and Bartoli 2014): both are
returned, the better one first. `tests/pictures/test_tags.py` compares with tags drawn at known
poses.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..data.camera import Lens
from ..io.arrays import FloatArray
from ..io.errors import InputError, needs_extra
from ..settings.pictures import TagSettings

# Corners of a tag in the order of OpenCV, over half its edge.
_CORNERS: Final = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def tag_poses(tag: TagSettings, image: NDArray[np.uint8], lens: Lens) -> list[FloatArray]:
    """Returns the one or two world_to_camera (4, 4) that a picture (H, W, 3) allows.

    None without the tag.

    Raises:
        InputError: OpenCV is not installed, or has no such dictionary; or the edges are not
            perpendicular.
    """
    with needs_extra("tags", "data.tag needs"):
        import cv2
    constant = getattr(cv2.aruco, f"DICT_{tag.dictionary.upper()}", None)
    if constant is None:
        raise InputError(
            f"OpenCV has no tags {tag.dictionary!r}: choose one such as 6x6_250 or apriltag_36h11."
        )
    right, up = np.array(tag.right), np.array(tag.up)
    if not abs(right @ up) <= 1e-3 * np.linalg.norm(right) * np.linalg.norm(up) or not (
        right.any() and up.any()
    ):
        raise InputError(
            "right and up of a tag are directions of two of its edges: they must be perpendicular."
        )
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(constant)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(
        np.ascontiguousarray(image[..., ::-1])
    )
    seen = [] if numbers is None else zip(corners, numbers.ravel(), strict=True)
    found = [seen_corners[0] for seen_corners, number in seen if number == tag.number]
    if not found:
        return []
    distortion = None if lens.distortion is None else lens.distortion.numpy()
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        0.5 * tag.size * _CORNERS,
        found[0].astype(np.float64),
        lens.matrix.numpy(),
        distortion,
        flags=cv2.SOLVEPNP_IPPE_SQUARE,
    )
    right, up = (edge / np.linalg.norm(edge) for edge in (right, up))
    axes = np.stack([right, up, np.cross(right, up)])  # from the scene to the tag
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        rotation = cv2.Rodrigues(turn)[0] @ axes
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, shift.ravel() - rotation @ np.array(tag.centre)
        poses.append(pose)
    return poses
