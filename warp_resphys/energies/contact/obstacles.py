"""Shapes of rigid obstacles, and their surfaces as triangles."""

import itertools
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import scipy.ndimage
import warp as wp
from numpy.typing import ArrayLike
from typing_extensions import override

from ...io.arrays import FloatArray, IntArray
from ...io.errors import InputError, MeshError
from ...io.kernel_cache import start_quietly
from ...kernels.contact import signed_distances as kernels
from ...kernels.modules import shareable
from ...mesh.readers import METRES
from ...mesh.tetrahedra import read_shells

Vector = tuple[float, float, float]
# Bezier points of a cubic B-spline, and of its slope raised to the same degree, a third of a spacing below a node, at
# it, and a third above, from the coefficients of the node before, itself and the one behind.
_VALUES = np.array([[2.0, 4.0, 0.0], [1.0, 4.0, 1.0], [0.0, 4.0, 2.0]]) / 6.0
_SLOPES = np.array([[-5.0, 4.0, 1.0], [-3.0, 0.0, 3.0], [-1.0, -4.0, 5.0]]) / 6.0
_CORNERS: Final = 64  # of a circle
_PLATE: Final = (1.5, 0.02)  # edge and thickness of the plate that stands for a half-space, over the body's size


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """A rigid body.

    Args:
        position: of its centre; of a half-space, of any point of its plane [m].
        axis: direction of its z axis: the normal of a half-space, or the axis of a capsule or cylinder.
        moves: whether it has the inputs `contact.MOTION`.

    Raises:
        InputError: a size that is not positive, or an axis of no length.
    """

    kind: ClassVar[int]
    vectors: ClassVar[tuple[str, ...]] = ("position", "axis")  # fields that are three numbers
    lengths: ClassVar[tuple[str, ...]] = ()  # fields that are lengths

    position: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    moves: bool = False

    def __post_init__(self) -> None:
        """Checks the numbers."""
        name = type(self).__name__
        for key in self.vectors:
            value = getattr(self, key)
            if np.shape(value) != (3,) or not np.isfinite(np.asarray(value, dtype=float)).all():
                raise InputError(f"{name}.{key} is {value}: it must be three finite numbers.")
        if not np.linalg.norm(self.axis) > 0.0:
            raise InputError(f"{name}.axis is {self.axis}: it must have a length.")
        for key in self.lengths:
            value = getattr(self, key)
            if not (np.isfinite(value) & (np.asarray(value) > 0.0)).all():
                raise InputError(f"{name}.{key} is {value}: it must be positive, in metres.")

    @property
    def size(self) -> Vector:
        """Sizes as in `kernels.contact.signed_distances` [m]."""
        return (0.0, 0.0, 0.0)

    @property
    def turn(self) -> FloatArray:
        """(3, 3) rotation from its axes to those of the world."""
        z = np.asarray(self.axis, dtype=float) / np.linalg.norm(self.axis)
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)


@dataclass(frozen=True, kw_only=True)
class HalfSpace(Obstacle):
    """All points below a plane with the normal ``axis``, such as a floor."""

    kind: ClassVar[int] = int(kernels.HALF_SPACE)


@dataclass(frozen=True, kw_only=True)
class Sphere(Obstacle):
    """A sphere."""

    kind: ClassVar[int] = int(kernels.SPHERE)
    lengths: ClassVar[tuple[str, ...]] = ("radius",)
    radius: float  # [m]

    @property
    @override
    def size(self) -> Vector:
        return (self.radius, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class _Rod(Obstacle):
    """A shape of revolution."""

    lengths: ClassVar[tuple[str, ...]] = ("radius", "length")
    radius: float  # [m]
    length: float  # along its axis, of a capsule without its half-spheres [m]

    @property
    @override
    def size(self) -> Vector:
        return (self.radius, self.radius, 0.5 * self.length)


@dataclass(frozen=True, kw_only=True)
class Capsule(_Rod):
    """All points within a radius of a segment."""

    kind: ClassVar[int] = int(kernels.CAPSULE)


@dataclass(frozen=True, kw_only=True)
class Cylinder(_Rod):
    """A cylinder with flat ends."""

    kind: ClassVar[int] = int(kernels.CYLINDER)


@dataclass(frozen=True, kw_only=True)
class Box(Obstacle):
    """A cuboid; its edges are along the axes of the world unless ``axis`` or inputs turn it."""

    kind: ClassVar[int] = int(kernels.BOX)
    lengths: ClassVar[tuple[str, ...]] = ("edges",)
    edges: Vector  # [m]

    @property
    @override
    def size(self) -> Vector:
        x, y, z = self.edges
        return (0.5 * x, 0.5 * y, 0.5 * z)


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceGrid(Obstacle):
    """Any shape, by its signed distances at the nodes of a grid, interpolated by cubic B-splines.

    Edges are rounded over about a spacing. Around the grid, the distance is that from it and ``margin``.

    Raises:
        InputError: fewer than eight nodes along an axis, values that are not finite, or distances at the boundary that
            are not positive.
    """

    kind: ClassVar[int] = int(kernels.GRID)
    vectors: ClassVar[tuple[str, ...]] = (*Obstacle.vectors, "low")
    lengths: ClassVar[tuple[str, ...]] = ("spacing",)
    distances: FloatArray  # (I, J, K) [m]
    spacing: float  # of the nodes [m]
    low: Vector  # place of the first node in the axes of the obstacle [m]

    def __post_init__(self) -> None:
        """Checks the grid."""
        super().__post_init__()
        object.__setattr__(self, "distances", np.asarray(self.distances, dtype=np.float64))
        shape = self.distances.shape
        if len(shape) != 3 or min(shape) < 8 or not np.isfinite(self.distances).all():
            raise InputError(
                f"DistanceGrid.distances has shape {shape}: give finite distances at 8 nodes or more by 3 axes."
            )
        if not self.margin > 0.0:
            raise InputError(
                "DistanceGrid.distances reach zero at the boundary of the grid: let it end outside of the shape."
            )

    @cached_property
    def margin(self) -> float:
        """Least distance one node within the boundary, where the interpolation ends [m]."""
        inner = np.ones(np.shape(self.distances), dtype=bool)
        inner[2:-2, 2:-2, 2:-2] = False
        return float(self.distances[inner].min())

    @cached_property
    def coefficients(self) -> FloatArray:
        """(I, J, K) coefficients of the B-splines [m]."""
        return np.asarray(scipy.ndimage.spline_filter(self.distances, 3, output=np.float64, mode="mirror"))

    @cached_property
    def largest_slope(self) -> float:
        """Upper bound of the slope, by the convex hull of the Bezier points of the gradient."""
        largest = self.spacing  # outside of the grid
        for points in itertools.product(range(3), repeat=3):
            gradient = []
            for along in range(3):
                values = self.coefficients
                for axis, point in enumerate(points):
                    weights = (_SLOPES if axis == along else _VALUES)[point]
                    values = scipy.ndimage.correlate1d(values, weights, axis)
                gradient.append(values[1:-1, 1:-1, 1:-1])
            largest = max(largest, float(np.linalg.norm(gradient, axis=0).max()))
        return largest / self.spacing

    @property
    @override
    def size(self) -> Vector:
        return (self.spacing, self.largest_slope, self.margin)

    @classmethod
    def of_surface(
        cls, vertices: ArrayLike, triangles: ArrayLike, spacing: float, margin: float | None = None, **pose: Any
    ) -> "DistanceGrid":
        """Returns the grid of a closed surface.

        Args:
            vertices: (N, 3) in the axes of the obstacle [m].
            triangles: (T, 3) counter-clockwise seen from outside.
            spacing: of the nodes [m]: half of the smallest radius, or less.
            margin: by which the grid is larger than the surface; ten spacings if omitted, as the boundary disturbs the
                interpolation over some spacings [m].
            pose: position, axis and ``moves``.

        Raises:
            InputError: a surface that is not closed, or whose triangles are seen from inside.
        """
        import trimesh

        surface = trimesh.Trimesh(np.asarray(vertices), np.asarray(triangles))
        if not surface.is_watertight:
            raise InputError("the surface of the obstacle is not closed, so that it has no inside: repair it.")
        if not (surface.is_winding_consistent and surface.volume > 0.0):
            raise InputError(
                "the triangles of the obstacle are not all counter-clockwise seen from outside: reverse those that are "
                "not."
            )
        width = (10.0 * spacing if margin is None else margin) + 2.0 * spacing
        low, high = surface.bounds + np.array([[-width], [width]])
        shape = np.ceil((high - low) / spacing).astype(int) + 1
        nodes = low + spacing * np.moveaxis(np.indices(shape), 0, -1)
        distances = signed_distances(surface.vertices, surface.faces, nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
        return cls(distances=distances, spacing=spacing, low=(low[0], low[1], low[2]), **pose)

    @classmethod
    def from_file(
        cls, path: str | os.PathLike[str], spacing: float, units: str = "mm", margin: float | None = None, **pose: Any
    ) -> "DistanceGrid":
        """Returns the grid of a closed surface in a file.

        Args:
            path: an STL, OBJ or PLY file.
            spacing: as for `of_surface` [m].
            units: of the file: ``m``, ``cm`` or ``mm``.
            margin: as for `of_surface` [m].
            pose: position, axis and ``moves``.

        Raises:
            MeshError: other units, or a file that is missing or damaged, or whose surface is not closed.
        """
        if units not in METRES:
            raise MeshError(f"the units of an obstacle's surface must be one of {', '.join(METRES)}, not {units}")
        vertices, shells = read_shells(Path(path).expanduser())
        return cls.of_surface(METRES[units] * vertices, np.concatenate(shells), spacing, margin, **pose)


def signed_distances(vertices: ArrayLike, triangles: ArrayLike, places: ArrayLike) -> FloatArray:
    """Returns the distances (P,) of places (P, 3) from a closed surface, negative inside of it, in float32 [m].

    Args:
        vertices: (N, 3) [m].
        triangles: (T, 3) vertices of its triangles, counter-clockwise seen from outside.
        places: (P, 3) [m].
    """
    arrays = [np.asarray(vertices), np.asarray(places)]
    start_quietly()
    with shareable():
        corners: Any = wp.array(arrays[0], dtype=wp.vec3, device="cpu")
        points: Any = wp.array(arrays[1], dtype=wp.vec3, device="cpu")
        indices: Any = wp.array(np.asarray(triangles).ravel(), dtype=int, device="cpu")
        surface = wp.Mesh(corners, indices, support_winding_number=True)
        out = wp.zeros(len(arrays[1]), dtype=float, device="cpu")
        wp.launch(kernels.from_surface, out.size, [surface.id, points], [out], device="cpu")
    return np.asarray(out.numpy(), dtype=np.float64)


def surface_of(obstacle: Obstacle, growth: float, beside: FloatArray) -> tuple[FloatArray, IntArray]:
    """Returns points (P, 3) [m] and triangles (S, 3) of an obstacle in its axes, with normals that point outwards.

    Args:
        obstacle: its shape.
        growth: by which its surface lies further out [m].
        beside: (N, 3) vertices of the body, beside which the plate of a half-space lies [m].
    """
    import trimesh

    x, y, z = obstacle.size
    place = np.zeros(3)
    match obstacle:
        case DistanceGrid():
            return _contour(obstacle, growth)
        case HalfSpace():
            edge, thickness = np.multiply(_PLATE, np.ptp(beside, axis=0).max())
            middle = (beside.mean(axis=0) - obstacle.position) @ obstacle.turn
            solid, place = (
                trimesh.creation.box((edge, edge, thickness)),
                np.append(middle[:2], growth - 0.5 * thickness),
            )
        case Box():
            solid = trimesh.creation.box(2.0 * (np.array([x, y, z]) + growth))
        case Sphere():
            solid = trimesh.creation.uv_sphere(radius=x + growth, count=(_CORNERS // 2, _CORNERS))
        case Capsule():
            solid = trimesh.creation.capsule(2.0 * z, x + growth, count=(_CORNERS // 2, _CORNERS))
        case Cylinder():
            solid = trimesh.creation.cylinder(x + growth, 2.0 * (z + growth), sections=_CORNERS)
        case _:
            raise TypeError(f"{type(obstacle).__name__} has no surface to draw")
    return np.asarray(solid.vertices - solid.bounds.mean(axis=0) + place), np.asarray(solid.faces, dtype=np.int64)


def _contour(grid: DistanceGrid, growth: float) -> tuple[FloatArray, IntArray]:
    """Returns the points (P, 3) [m] and triangles (S, 3) at a distance from the surface of a grid."""
    import pyvista

    image = pyvista.ImageData(dimensions=grid.distances.shape, spacing=(grid.spacing,) * 3, origin=grid.low)
    surface = image.contour([growth], scalars=grid.distances.ravel(order="F"))
    return np.asarray(surface.points, dtype=float), np.asarray(surface.faces, dtype=np.int64).reshape(-1, 4)[:, :0:-1]
