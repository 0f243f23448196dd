r"""Cameras: lens, place up to corrections, the pixels of markers
as an observation, and views of drawings.

A body's point X [m] is seen at the pixel p = lens(M (R (X - c) + c + t)): M is the given pose of
the camera, from the axes of the scene to its own (x right, y down, z forward), R = exp([w]x) a
small turn about a point c of the body's clamp, and t a shift, by which the body stands elsewhere
before the camera than assumed. A turn of the camera by w about c, and a shift, are the same as
those of the body, so that R and t stand for errors of both. The same equation, solved for X, takes
pixels with a depth back to the scene, and without a lens the points of a scan, of whose axes M is
the pose. Depth along the line of sight is not measured: with one camera, motion towards it appears
as a change of size.

A `Lens` moves the point (x, y) = (X / Z, Y / Z) of the image at distance one, with r^2 = x^2 + y^2,
to

    x' = x q + 2 p1 x y + p2 (r^2 + 2 x^2),
    y' = y q + p1 (r^2 + 2 y^2) + 2 p2 x y,
    q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)

(Brown 1966, with OpenCV's names), which the matrix K takes to pixels (Hartley and Zisserman,
Multiple View Geometry, 2nd edition, eq. 6.8). Its focal lengths are corrected by a factor, its
principal point by a shift.

Drawings of bodies have cameras without perspective: orthonormal axes (3, 3) with rows to the right,
up and towards the viewer (`view_axes` and the functions after it), and a frame in the first two of
them (`frame_of`).

`tests/data/test_camera.py` compares with a camera of closed form and with differences, and
identifies Young's modulus.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import numpy as np
import torch
import yaml
from numpy.typing import ArrayLike
from typing_extensions import override

from ..core.stepping.rotations import rotations
from ..io.arrays import FloatArray
from ..io.errors import DataFileError, InputError
from ..io.text import read_text
from .markers import Markers, Observation

SHIFTS: Final = ("camera_shift_1", "camera_shift_2", "camera_shift_3")  # m
TURNS: Final = ("camera_turn_1", "camera_turn_2", "camera_turn_3")  # rad
FOCAL: Final = "focal_factor"
PRINCIPAL: Final = ("principal_point_1", "principal_point_2")  # px
PLACES: Final = (*SHIFTS, *TURNS)
CORRECTIONS: Final = (*PLACES, FOCAL, *PRINCIPAL)
_NEUTRAL: Final = (0.0,) * 6 + (1.0, 0.0, 0.0)
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k")
_DISTORTION = (
    "distortion_coefficients",
    "Distortion_Coefficients",
    "distCoeffs",
    "dist_coeffs",
    "D",
    "d",
)
_COUNTS = (0, 4, 5, 8)  # of the coefficients of a lens
_UNDISTORTING = 30  # steps of Newton's method
_UNDISTORTED = 0.01  # px: error of a ray
_FRAME: Final = 0.06  # margin around the points in a drawing, over their longer side
_TILT: Final = (0.30, 0.30)  # of the view of a motion, to the right and upwards
_LEVEL: Final = 1.2  # tilt of the view of a path in a level plane, towards its near side
_UPRIGHT: Final = 0.3  # tilt of the view of a path in an upright plane, upwards


@dataclass(frozen=True)
class Lens:
    """Focal lengths, principal point and distortion
    of a camera (equations in the module's docstring).

    Raises:
        InputError: a matrix of another shape, or another number of coefficients.
    """

    matrix: torch.Tensor  # (3, 3) K [px]
    distortion: torch.Tensor | None = (
        None  # k1, k2, p1, p2 and, where there are more, k3, or k3 to k6
    )

    def __post_init__(self) -> None:
        """Checks the shapes."""
        if self.matrix.shape != (3, 3):
            raise InputError(
                f"the matrix of a lens has shape {tuple(self.matrix.shape)}: K is (3, 3)."
            )
        if self.distortion is not None and self.distortion.shape not in [
            (count,) for count in _COUNTS
        ]:
            raise InputError(
                f"the distortion of a lens has shape {tuple(self.distortion.shape)}: give k1, "
                "k2, p1, p2, or k3 after them, or k3 to k6."
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
        # OpenCV writes a directive that is not YAML's, and a tag of its own.
        lines = [
            line.replace("!!opencv-matrix", "")
            for line in read_text(path).split("\n")
            if line[:5] != "%YAML"
        ]
        try:
            content = yaml.safe_load("\n".join(lines))
            matrix, distortion = (_numbers(content, names) for names in (_MATRIX, _DISTORTION))
        except (yaml.YAMLError, TypeError, ValueError) as error:
            raise DataFileError(
                f"{path} is no YAML with numbers ({str(error).splitlines()[0]}); export the "
                "calibration again."
            ) from error
        if matrix is None or len(matrix) != 9:
            raise DataFileError(
                f"{path} has no camera_matrix of nine numbers: give a calibration by OpenCV or ROS."
            )
        return cls(matrix.reshape(3, 3), distortion)

    def pixels(self, points: torch.Tensor) -> torch.Tensor:
        """Returns pixels (..., 2) of points (..., 3) in the axes of the camera [m],
        NaN behind the camera.
        """
        in_front = points[..., 2:] > 0.0
        flat = points[..., :2] / torch.where(in_front, points[..., 2:], 1.0)
        if self.distortion is not None and len(self.distortion):
            k = torch.nn.functional.pad(self.distortion.to(points), (0, 8 - len(self.distortion)))
            (x, y), square = flat.unbind(-1), flat.square().sum(-1)
            up, down = (
                1.0 + square * (a + square * (b + square * c))
                for a, b, c in (k[[0, 1, 4]], k[[5, 6, 7]])
            )
            radial, twice = up / down, 2.0 * x * y
            moved_x = radial * x + k[2] * twice + k[3] * (square + 2.0 * x.square())
            moved_y = radial * y + k[2] * (square + 2.0 * y.square()) + k[3] * twice
            flat = torch.stack([moved_x, moved_y], -1)
        intrinsic = self.matrix.to(points)
        pixels = flat @ intrinsic[:2, :2].mT + intrinsic[:2, 2]
        # A NaN of its own would spread through the gradient.
        return torch.where(in_front, pixels, torch.nan)

    def rays(self, pixels: torch.Tensor) -> torch.Tensor:
        """Returns the points (..., 3) of depth one in the axes of the camera
        that are seen at pixels (..., 2).

        Of a distorted image they are sought by Newton's method with the derivative of the
        undistorted one, which converges where the distortion is well below the distance from the
        principal point; NaN elsewhere.
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


def _numbers(content: Any, names: tuple[str, ...]) -> torch.Tensor | None:
    """The first of some entries of a calibration, as a flat tensor; None without any."""
    known = content if isinstance(content, Mapping) else {}
    value = next((known[name] for name in names if name in known), None)
    value = value.get("data") if isinstance(value, Mapping) else value
    return None if value is None else torch.as_tensor(np.array(value, dtype=np.float64).ravel())


@dataclass(frozen=True)
class PlacedCamera:
    """A lens, its pose, and the point about which the body may be turned (equations in the module's
    docstring).

    Raises:
        InputError: a pose of another shape, or one that is no rigid motion.
    """

    lens: Lens | None  # None for the axes of a scan, which has no pictures
    pose: torch.Tensor  # (4, 4) M, from the scene's axes to those of the camera or scan [-, m]
    centre: torch.Tensor = field(default_factory=lambda: torch.zeros(3))  # (3,) c [m]

    def __post_init__(self) -> None:
        """Converts arrays, and checks the pose."""
        for name in ("pose", "centre"):
            object.__setattr__(
                self, name, torch.as_tensor(getattr(self, name), dtype=torch.float64)
            )
        if self.pose.shape != (4, 4):
            raise InputError(
                f"the pose of a camera has shape {tuple(self.pose.shape)}: "
                "world_to_camera is (4, 4)."
            )
        turn = self.pose[:3, :3]
        if (
            not torch.allclose(turn @ turn.mT, torch.eye(3).to(turn), atol=1e-3)
            or torch.det(turn) < 0.0
        ):
            raise InputError(
                "the pose of a camera is no rotation with a shift (world_to_camera, row-major, "
                "right-handed): check its rows."
            )

    def to(self, like: torch.Tensor) -> Self:
        """Returns the camera on the device of a tensor."""
        return replace(self, pose=self.pose.to(like.device), centre=self.centre.to(like.device))

    @staticmethod
    def corrections(values: Mapping[str, float]) -> torch.Tensor:
        """(9,) corrections in the order of `CORRECTIONS`, from their values by name.

        None for those left out.
        """
        pairs = zip(CORRECTIONS, _NEUTRAL, strict=True)
        return torch.tensor(
            [values.get(name, neutral) for name, neutral in pairs], dtype=torch.float64
        )

    def seen_from(self, points: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns points (..., 3) of the scene in the axes of the camera,
        with corrections (9,) or (..., 9) [m].
        """
        away = (rotations(corrections[..., 3:6]) @ (points - self.centre)[..., None])[..., 0]
        return (away + self.centre + corrections[..., :3]) @ self.pose[:3, :3].mT + self.pose[:3, 3]

    def _seen_through(self) -> tuple[Lens, torch.Tensor]:
        """The lens, and its principal point (2,) [px]."""
        assert self.lens is not None
        return self.lens, self.lens.matrix[:2, 2].to(self.pose)

    def pixels(self, points: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns pixels (..., 2) of points (..., 3) [m], with corrections (9,) or (..., 9).

        NaN behind the camera.
        """
        lens, middle = self._seen_through()
        seen = lens.pixels(self.seen_from(points, corrections))
        return middle + corrections[..., 7:] + corrections[..., 6:7] * (seen - middle)

    def located(self, measured: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns points (..., 3) in the axes of the scene [m], with corrections (9,) or (..., 9).

        Args:
            measured: (..., 3) pixels and depths along the axis of the lens [px, px, m]; without a
                lens, points in the axes of the scan [m].
            corrections: see above.
        """
        away = measured
        if self.lens is not None:
            lens, middle = self._seen_through()
            rays = lens.rays(
                middle + (measured[..., :2] - middle - corrections[..., 7:]) / corrections[..., 6:7]
            )
            away = rays * measured[..., 2:]
        away = (away - self.pose[:3, 3]) @ self.pose[:3, :3] - self.centre - corrections[..., :3]
        return (rotations(corrections[..., 3:6]).mT @ away[..., None])[..., 0] + self.centre

    def millimetres(self, corrections: torch.Tensor) -> float:
        """Length that a pixel shows at a depth of 1 m, with corrections (9,) [mm]."""
        return 1e3 / float(
            corrections[6] * self._seen_through()[0].matrix[:2, :2].diagonal().mean()
        )

    def derivative(
        self, points: torch.Tensor, corrections: torch.Tensor, tangents: torch.Tensor
    ) -> torch.Tensor:
        """Returns derivatives (K + 9, P, 2) of the pixels of points (P, 3),
        by K motions and by the corrections [px].

        Args:
            points: (P, 3) [m].
            corrections: (9,).
            tangents: (K, P, 3) motions of the points by K parameters [m].
        """
        turn = rotations(corrections[3:6])
        lens, middle = self._seen_through()
        seen = self.seen_from(points, corrections)
        by_place = corrections[6] * jacobians(lens.pixels, seen)[0] @ self.pose[:3, :3]
        turned = torch.autograd.functional.jacobian(rotations, corrections[3:6])  # (3, 3, 3)
        by_turn = by_place @ torch.einsum("ijk,pj->pik", turned, points - self.centre)
        by_scale = (lens.pixels(seen) - middle)[..., None]
        by_shift = torch.eye(2).to(points).expand(len(points), 2, 2)
        by_corrections = torch.cat([by_place, by_turn, by_scale, by_shift], -1)
        return torch.cat(
            [
                torch.einsum("pij,kpj->kpi", by_place @ turn, tangents),
                by_corrections.permute(2, 0, 1),
            ]
        )

    def located_by(self, measured: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        """Returns derivatives (9, P, 3) of located points (P, 3) by the corrections (9,) [m]."""
        return jacobians(self.located, measured, corrections.expand(len(measured), -1))[1].permute(
            2, 0, 1
        )


def jacobians(function: Callable[..., torch.Tensor], *inputs: torch.Tensor) -> list[torch.Tensor]:
    """Jacobians (P, D, C) of a function (P, D) of P rows by each of its inputs (P, C)."""
    with torch.enable_grad():
        variables = [values.detach().clone().requires_grad_() for values in inputs]
        result = function(*variables)
        rows = [
            torch.autograd.grad(column.sum(), variables, retain_graph=True)
            for column in result.unbind(-1)
        ]
    return [torch.stack(parts, 1) for parts in zip(*rows, strict=True)]


@dataclass(frozen=True)
class CameraMarkers(Observation):
    """Projections of markers in a camera, (B, M, 2) [px]."""

    unit: ClassVar[str] = "px"
    dimension: ClassVar[int] = 2

    markers: Markers
    camera: PlacedCamera  # in the body's frame

    @override
    def __call__(self, positions: torch.Tensor) -> torch.Tensor:
        """Returns pixels (B, M, 2), NaN for a marker behind the camera."""
        corrections = self.camera.corrections({}).to(positions.device)
        return self.camera.pixels(self.markers(positions).double(), corrections).to(positions)


def view_axes(towards_viewer: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> FloatArray:
    """Returns orthonormal rows (3, 3): to the right, up, towards the viewer."""
    towards = np.array(towards_viewer, dtype=np.float64)
    right = np.cross(np.array(up, dtype=np.float64), towards)
    rows = np.stack([right, np.cross(towards, right), towards])
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


def upwards(gravity: FloatArray) -> FloatArray:
    """Returns the direction (3,) against gravity; z where there is no gravity."""
    length = float(np.linalg.norm(gravity))
    return -gravity / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def side_axes(up: FloatArray, azimuth: float, elevation: float) -> FloatArray:
    """Returns axes (3, 3) of a view from the side, turned about the upward direction (3,) and
    raised [rad].
    """
    up = up / np.linalg.norm(up)
    side = np.cross(up, np.eye(3)[int(np.abs(up).argmin())])
    side /= np.linalg.norm(side)
    level = np.cos(azimuth) * np.cross(side, up) + np.sin(azimuth) * side
    return view_axes(np.cos(elevation) * level + np.sin(elevation) * up, up)


def motion_axes(gravity: FloatArray, positions: FloatArray) -> FloatArray:
    """Returns axes (3, 3) whose right is the direction of largest extent or motion across gravity.

    Args:
        gravity: (3,) direction of gravity; -z is taken for zero.
        positions: (T, N, 3) [m], the first frame at rest; NaN is left out.
    """
    up = upwards(gravity)
    points = positions[np.isfinite(positions).all(axis=2)]
    flat = points - np.outer(points @ up, up)
    directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False).Vh
    right = directions[0] - (directions[0] @ up) * up
    right /= np.linalg.norm(right)
    moved = np.nanmax(np.linalg.norm(positions - positions[0], axis=2), axis=0)  # (N,)
    towards_end = moved @ (positions[0] - positions[0].mean(axis=0))
    right = -right if towards_end @ right < 0.0 else right
    return view_axes(np.cross(right, up) + _TILT[0] * right + _TILT[1] * up, up)


def axes_from_below(axes: FloatArray, gravity: FloatArray) -> FloatArray:
    """Returns axes (3, 3) of a view against gravity (3,)
    that has the right of another view (3, 3).
    """
    towards = -upwards(gravity)
    return np.stack([axes[0], np.cross(towards, axes[0]), towards])


def path_axes(plane: FloatArray, gravity: FloatArray) -> FloatArray:
    """Returns axes (3, 3) in which letters in a plane are readable.

    Args:
        plane: (2, 3) directions to the right and upwards in the plane.
        gravity: (3,) direction of gravity.
    """
    up, normal = upwards(gravity), np.cross(*plane)
    normal /= np.linalg.norm(normal)
    level = float(normal @ up)
    near = plane[1] / np.linalg.norm(plane[1])
    return view_axes(normal - _LEVEL * level * near + _UPRIGHT * (1.0 - level**2) * up, up)


def frame_of(
    points: FloatArray, axes: FloatArray, margin: float = _FRAME
) -> tuple[FloatArray, FloatArray]:
    """Returns the middle (3,) of points (P, 3), and half the width
    and height (2,) of a view that contains them [m].

    Args:
        points: [m]; those that are not finite are left out.
        axes: (3, 3) of the view.
        margin: on each side, over the longer side of the points.
    """
    turned = points[np.isfinite(points).all(axis=1)] @ axes.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    extent = (high - low)[:2] + 2.0 * margin * (high - low)[:2].max()
    return 0.5 * (low + high) @ axes, 0.5 * extent


def height_of(half: FloatArray, size: tuple[int, int]) -> float:
    """Returns half the height of a view of a size [px]
    that contains half a width and height (2,).
    """
    return float(max(half[1], half[0] * size[1] / size[0]))
