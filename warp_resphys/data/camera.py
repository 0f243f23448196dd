r"""Pixels of markers in the image of a calibrated camera, as an observation.

A point x of the body's frame is seen at (u, v), where (u w, v w, w) = P (x, 1) and P = K [R | t] is the camera's matrix
(Hartley and Zisserman, Multiple View Geometry, 2nd edition, eq. 6.8). w is the depth in front of the camera. Depth
along the line of sight is not measured: with one camera, motion towards it appears only as a change of size.

A `Lens` moves the point (x, y) = (X / Z, Y / Z) of the image at distance one, with r^2 = x^2 + y^2, to

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),
    y' = y (same) + p1 (r^2 + 2 y^2) + 2 p2 x y

(Brown 1966, with OpenCV's names), which K takes to pixels.

`tests/data/test_camera.py` compares it with a camera of closed form and identifies Young's modulus from its pixels.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import yaml
from typing_extensions import override

from ..io.errors import DataFileError, InputError
from .markers import Markers
from .observation import Observation

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D", "d")
_COUNTS = (0, 4, 5, 8)  # of the coefficients of a lens
_UNDISTORTING = 30  # steps of Newton's method
_UNDISTORTED = 0.01  # px: error of a ray


@dataclass(frozen=True)
class Lens:
    """Focal lengths, principal point and distortion of a camera (equations in the module's docstring).

    Raises:
        InputError: a matrix of another shape, or another number of coefficients.
    """

    matrix: torch.Tensor  # (3, 3) K [px]
    distortion: torch.Tensor | None = None  # k1, k2, p1, p2 and, where there are more, k3, or k3 to k6

    def __post_init__(self) -> None:
        """Checks the shapes."""
        if self.matrix.shape != (3, 3):
            raise InputError(f"the matrix of a lens has shape {tuple(self.matrix.shape)}: K is (3, 3).")
        if self.distortion is not None and self.distortion.shape not in [(count,) for count in _COUNTS]:
            raise InputError(
                f"the distortion of a lens has shape {tuple(self.distortion.shape)}: give k1, k2, p1, p2, or k3 after "
                "them, or k3 to k6."
            )

    @classmethod
    def read(cls, path: str | Path) -> "Lens":
        """Reads a calibration by OpenCV (YAML), or a ``camera_info`` file of ROS.

        Args:
            path: the file.

        Raises:
            DataFileError: it cannot be read, or has no camera matrix of nine numbers.
            InputError: a number of coefficients that is not known.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise DataFileError(f"Cannot read {path} ({error}); give the calibration of a camera as YAML.") from error
        # OpenCV writes a directive that is not YAML's, and a tag of its own.
        lines = [line.replace("!!opencv-matrix", "") for line in text.splitlines() if not line.startswith("%YAML")]
        try:
            content = yaml.safe_load("\n".join(lines))
        except yaml.YAMLError as error:
            raise DataFileError(
                f"{path} is no YAML ({str(error).splitlines()[0]}); export the calibration again."
            ) from error
        matrix, distortion = (_numbers(content, names, path) for names in (_MATRIX, _DISTORTION))
        if matrix is None or len(matrix) != 9:
            raise DataFileError(f"{path} has no camera_matrix of nine numbers: give a calibration by OpenCV or ROS.")
        coefficients = None if distortion is None else torch.as_tensor(distortion)
        return cls(torch.as_tensor(matrix).reshape(3, 3), coefficients)

    def pixels(self, points: torch.Tensor) -> torch.Tensor:
        """Returns pixels (..., 2) of points (..., 3) in the axes of the camera: x right, y down, z forward [m]."""
        flat = points[..., :2] / points[..., 2:]
        if self.distortion is not None and len(self.distortion):
            k = torch.nn.functional.pad(self.distortion.to(points), (0, 8 - len(self.distortion)))
            (x, y), square = flat.unbind(-1), flat.square().sum(-1)
            up, down = (1.0 + square * (a + square * (b + square * c)) for a, b, c in (k[[0, 1, 4]], k[[5, 6, 7]]))
            radial, twice = up / down, 2.0 * x * y
            flat = torch.stack(
                [
                    radial * x + k[2] * twice + k[3] * (square + 2.0 * x.square()),
                    radial * y + k[2] * (square + 2.0 * y.square()) + k[3] * twice,
                ],
                -1,
            )
        intrinsic = self.matrix.to(points)
        return flat @ intrinsic[:2, :2].mT + intrinsic[:2, 2]

    def rays(self, pixels: torch.Tensor) -> torch.Tensor:
        """Returns the points (..., 3) of depth one in the axes of the camera that are seen at pixels (..., 2).

        Of a distorted image they are sought by Newton's method with the derivative of the undistorted one, which
        converges where the distortion is well below the distance from the principal point; NaN elsewhere.
        """
        inverse = torch.linalg.inv(self.matrix[:2, :2].to(pixels)).mT
        flat = (pixels - self.matrix[:2, 2].to(pixels)) @ inverse
        for _ in range(0 if self.distortion is None else _UNDISTORTING):
            flat = flat - (self.pixels(_at_one(flat)) - pixels) @ inverse
        off = (self.pixels(_at_one(flat)) - pixels).abs().amax(-1, keepdim=True)
        return _at_one(flat.where(off < _UNDISTORTED, torch.nan))


def _at_one(flat: torch.Tensor) -> torch.Tensor:
    """Points (..., 3) of depth one, from their first two coordinates."""
    return torch.cat([flat, torch.ones_like(flat[..., :1])], -1)


def _numbers(content: Any, names: tuple[str, ...], path: str | Path) -> "np.ndarray[Any, np.dtype[np.float64]] | None":
    """The first of some entries of a calibration, as a flat array; None without any."""
    if not isinstance(content, Mapping):
        return None
    value = next((content[name] for name in names if name in content), None)
    value = value.get("data") if isinstance(value, Mapping) else value
    if value is None:
        return None
    try:
        return np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise DataFileError(f"{path}: {names[0]} is {value!r}: give its numbers.") from None


@dataclass(frozen=True)
class CameraMarkers(Observation):
    """Projections of markers in a pinhole camera, (B, M, 2) [px].

    Raises:
        InputError: a matrix of another shape.
    """

    unit: ClassVar[str] = "px"
    dimension: ClassVar[int] = 2

    markers: Markers
    matrix: torch.Tensor  # (3, 4) P, from the body's frame [m] to homogeneous pixels; with a lens, to the camera's axes
    lens: Lens | None = None  # then the matrix is the pose [R | t] of the body's frame [-, m]

    def __post_init__(self) -> None:
        """Checks the matrix."""
        if self.matrix.shape != (3, 4):
            raise InputError(f"matrix has shape {tuple(self.matrix.shape)}: a camera's matrix K [R | t] is (3, 4).")

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns pixels (B, M, 2), NaN for a marker behind the camera."""
        rays = self.markers(positions) @ self.matrix[:, :3].mT + self.matrix[:, 3]
        return projected(rays, self.lens)


def projected(rays: torch.Tensor, lens: Lens | None) -> torch.Tensor:
    """Returns pixels (..., 2), NaN behind the camera.

    Args:
        rays: (..., 3) homogeneous pixels; with a lens, points in the axes of the camera [m].
        lens: of the camera.
    """
    in_front = rays[..., 2:] > 0.0
    rays = torch.cat([rays[..., :2], torch.where(in_front, rays[..., 2:], 1.0)], -1)
    pixels = rays[..., :2] / rays[..., 2:] if lens is None else lens.pixels(rays)
    return torch.where(in_front, pixels, torch.nan)  # A NaN of its own would spread through the gradient.
