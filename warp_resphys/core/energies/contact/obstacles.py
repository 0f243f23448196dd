"""Obstacles by distances on a grid, and surfaces of obstacles as triangles."""

import itertools
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
import scipy.ndimage
import warp as wp
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, model_validator
from typing_extensions import override

from ....io.arrays import FloatArray, IntArray
from ....io.errors import InputError
from ....io.kernel_cache import start_quietly
from ....io.settings import Positive, Vector, setting
from ....kernels.contact import signed_distances as kernels
from ....kernels.modules import shareable
from ...mesh.readers import METRES
from ...mesh.tetrahedra import read_shells
from .touching_bodies import Box, Capsule, Cylinder, HalfSpace, Obstacle, Sphere, SurfaceFile

# Bezier points of a cubic B-spline, and of its slope raised to the same degree, a third of a
# spacing below a node, at it, and a third above, from the coefficients of the node before, itself
# and the one behind.
_VALUES = np.array([[2.0, 4.0, 0.0], [1.0, 4.0, 1.0], [0.0, 4.0, 2.0]]) / 6.0
_SLOPES = np.array([[-5.0, 4.0, 1.0], [-3.0, 0.0, 3.0], [-1.0, -4.0, 5.0]]) / 6.0
_CORNERS: Final = 64  # of a circle
# Edge and thickness of the plate that stands for a half-space, over the body's size.
_PLATE: Final = (1.5, 0.02)


def _float64(values: Any) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


class DistanceGrid(Obstacle):
    """Any shape, by its signed distances at the nodes of a grid, interpolated by cubic B-splines.

    Edges are rounded over about a spacing. Around the grid, the distance is that from it and
    ``margin``.

    Raises:
        InputError: fewer than eight nodes along an axis, values that are not finite, or distances
            at the boundary that are not positive.
    """

    distances: Annotated[Any, BeforeValidator(_float64)]  # (I, J, K) [m]
    spacing: Positive = setting(description="of the nodes", unit="m")
    low: Vector = setting(
        description="place of the first node in the axes of the obstacle", unit="m"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        shape = self.distances.shape
        if len(shape) != 3 or min(shape) < 8 or not np.isfinite(self.distances).all():
            raise ValueError(
                f"distances has shape {shape}: give finite distances at 8 nodes or more by 3 axes."
            )
        if not self.margin > 0.0:
            raise ValueError(
                "distances reach zero at the boundary of the grid: let it end outside of the shape."
            )
        return self

    @override
    def __eq__(self, other: object) -> bool:
        return self is other

    @override
    def __hash__(self) -> int:
        return id(self)

    @cached_property
    def margin(self) -> float:
        """Least distance one node within the boundary, where the interpolation ends [m]."""
        inner = np.ones(np.shape(self.distances), dtype=bool)
        inner[2:-2, 2:-2, 2:-2] = False
        return float(self.distances[inner].min())

    @cached_property
    def coefficients(self) -> FloatArray:
        """(I, J, K) coefficients of the B-splines [m]."""
        return np.asarray(
            scipy.ndimage.spline_filter(self.distances, 3, output=np.float64, mode="mirror")
        )

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
    def size(self) -> tuple[float, float, float]:
        return (self.spacing, self.largest_slope, self.margin)

    @classmethod
    def of_surface(
        cls,
        vertices: ArrayLike,
        triangles: ArrayLike,
        spacing: float,
        margin: float | None = None,
        **pose: Any,
    ) -> "DistanceGrid":
        """Returns the grid of a closed surface.

        Args:
            vertices: (N, 3) in the axes of the obstacle [m].
            triangles: (T, 3) counter-clockwise seen from outside.
            spacing: of the nodes [m]: half of the smallest radius, or less.
            margin: by which the grid is larger than the surface; ten spacings if omitted, as the
                boundary disturbs the interpolation over some spacings [m].
            pose: position, axis and ``moves``.

        Raises:
            InputError: a surface that is not closed, or whose triangles are seen from inside.
        """
        import trimesh

        surface = trimesh.Trimesh(np.asarray(vertices), np.asarray(triangles))
        if not surface.is_watertight:
            raise InputError(
                "the surface of the obstacle is not closed, so that it has no inside: repair it."
            )
        if not (surface.is_winding_consistent and surface.volume > 0.0):
            raise InputError(
                "the triangles of the obstacle are not all counter-clockwise seen from outside: "
                "reverse those that are not."
            )
        width = (10.0 * spacing if margin is None else margin) + 2.0 * spacing
        low, high = surface.bounds + np.array([[-width], [width]])
        shape = np.ceil((high - low) / spacing).astype(int) + 1
        nodes = low + spacing * np.moveaxis(np.indices(shape), 0, -1)
        distances = signed_distances(surface.vertices, surface.faces, nodes.reshape(-1, 3)).reshape(
            nodes.shape[:3]
        )
        return cls(distances=distances, spacing=spacing, low=(low[0], low[1], low[2]), **pose)

    @classmethod
    def of_file(cls, file: SurfaceFile, margin: float | None = None) -> "DistanceGrid":
        """Returns the grid of a closed surface in a file; ``margin`` as for `of_surface`.

        Raises:
            MeshError: a file that is missing or damaged, or whose surface is not closed.
        """
        vertices, shells = read_shells(Path(file.path).expanduser())
        pose = {"position": file.position, "axis": file.axis, "moves": file.moves}
        return cls.of_surface(
            METRES[file.units] * vertices, np.concatenate(shells), file.spacing, margin, **pose
        )


# Kinds of the kernels.
KINDS: Final[Mapping[type[Obstacle], int]] = {
    HalfSpace: int(kernels.HALF_SPACE),
    Sphere: int(kernels.SPHERE),
    Capsule: int(kernels.CAPSULE),
    Box: int(kernels.BOX),
    Cylinder: int(kernels.CYLINDER),
    DistanceGrid: int(kernels.GRID),
}


def signed_distances(vertices: ArrayLike, triangles: ArrayLike, places: ArrayLike) -> FloatArray:
    """Returns the distances (P,) of places (P, 3) from a closed surface,
    negative inside of it, in float32 [m].

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


def surface_of(
    obstacle: Obstacle, growth: float, beside: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Returns points (P, 3) [m] and triangles (S, 3) of an obstacle in its axes,
    with normals that point outwards.

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
            solid = trimesh.creation.box((edge, edge, thickness))
            place = np.append(middle[:2], growth - 0.5 * thickness)
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
    return np.asarray(solid.vertices - solid.bounds.mean(axis=0) + place), np.asarray(
        solid.faces, dtype=np.int64
    )


def _contour(grid: DistanceGrid, growth: float) -> tuple[FloatArray, IntArray]:
    """The points (P, 3) [m] and triangles (S, 3) at a distance from the surface of a grid."""
    import pyvista

    image = pyvista.ImageData(
        dimensions=grid.distances.shape, spacing=(grid.spacing,) * 3, origin=grid.low
    )
    surface = image.contour([growth], scalars=grid.distances.ravel(order="F"))
    return np.asarray(surface.points, dtype=float), np.asarray(
        surface.faces, dtype=np.int64
    ).reshape(-1, 4)[:, :0:-1]
