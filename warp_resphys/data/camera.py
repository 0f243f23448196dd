"""Pixels of markers in the image of a calibrated camera, as an observation.

A point x of the body's frame is seen at (u, v), where (u w, v w, w) = P (x, 1) and P = K [R | t] is the camera's matrix
(Hartley and Zisserman, Multiple View Geometry, 2nd edition, eq. 6.8). w is the depth in front of the camera. Lens
distortion is removed from the pixels beforehand, for example by OpenCV's `undistortPoints`. Depth along the line of
sight is not measured: with one camera, motion towards it appears only as a change of size.

`tests/data/test_camera.py` compares it with a camera of closed form and identifies Young's modulus from its pixels.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from typing_extensions import override

from ..io.errors import InputError
from .markers import Markers
from .observation import Observation


@dataclass(frozen=True)
class CameraMarkers(Observation):
    """Projections of markers in a pinhole camera, (B, M, 2) [px].

    Raises:
        InputError: a matrix of another shape.
    """

    unit: ClassVar[str] = "px"
    dimension: ClassVar[int] = 2

    markers: Markers
    matrix: torch.Tensor  # (3, 4) P, from the body's frame [m] to homogeneous pixels

    def __post_init__(self) -> None:
        """Checks the matrix."""
        if self.matrix.shape != (3, 4):
            raise InputError(f"matrix has shape {tuple(self.matrix.shape)}: a camera's matrix K [R | t] is (3, 4).")

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns pixels (B, M, 2), NaN for a marker behind the camera."""
        rays = self.markers(positions) @ self.matrix[:, :3].mT + self.matrix[:, 3]
        in_front = rays[..., 2:] > 0.0
        pixels = rays[..., :2] / torch.where(in_front, rays[..., 2:], 1.0)
        return torch.where(in_front, pixels, torch.nan)  # A NaN of its own would spread through the gradient.
