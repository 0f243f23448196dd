"""Surfaces of rigid obstacles, for pictures of bodies that touch them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Final

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from ..energies.contact import GROWTH, SHIFT, TURN, Contact
from ..energies.obstacles import Box, Capsule, Cylinder, DistanceGrid, HalfSpace, Obstacle, Sphere
from ..fem.body import Body
from .render import FloatArray, IntArray

OBSTACLE: Final = "#b9b2a6"  # Colour of obstacles: a warm grey beside the blue of bodies.
OBSTACLE_LIGHT: Final = (0.62, 0.42)
_CORNERS: Final = 64  # Of a circle.
_NEAR: Final = 0.2  # Width of the space around a body in which its obstacles are shown, over its size.
_PLATE: Final = (1.5, 0.02)  # Edge and thickness of the plate that stands for a half-space, over the body's size.


@dataclass(frozen=True, eq=False)
class ObstacleSurface:
    """Triangles of all obstacles of a body."""

    points: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (P, 3) [m].
    triangles: IntArray = field(default_factory=lambda: np.empty((0, 3), dtype=np.int64))  # (S, 3).

    @classmethod
    def of(cls, body: Body, parameters: Mapping[str, Any] | None = None) -> "ObstacleSurface":
        """Returns the obstacles of a body, none of which moves by inputs.

        Args:
            body: With or without obstacles.
            parameters: Identified values by name, such as `obstacle_x_bar`; others are zero.
        """
        known, points, triangles = parameters or {}, [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)]
        for contact in (energy for energy in body.energies if isinstance(energy, Contact)):
            for name, obstacle in contact.obstacles.items():
                shift, turn = (
                    np.array([_value(known, q.name, name) for q in quantities]) for quantities in (SHIFT, TURN)
                )
                growth, matrix = (
                    _value(known, GROWTH.name, name),
                    Rotation.from_rotvec(turn).as_matrix() @ obstacle.turn,
                )
                if isinstance(obstacle, DistanceGrid):
                    own, faces = _contour(obstacle, growth)
                else:
                    own = _solid(obstacle, body.mesh.vertices, growth)
                    faces = _outwards(ConvexHull(own))
                triangles.append(faces + sum(map(len, points)))
                points.append(own @ matrix.T + obstacle.position + shift)
        return cls(np.concatenate(points), np.concatenate(triangles))

    def near(self, points: FloatArray) -> FloatArray:
        """Returns corners (Q, 3) [m] of the surface within the frame of points (P, 3) of a body and a margin."""
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        margin = _NEAR * (high - low).max()
        return np.clip(self.points, low - margin, high + margin)


def _value(parameters: Mapping[str, Any], name: str, part: str) -> float:
    """Returns the value of a parameter for an obstacle."""
    return float(parameters.get(f"{name}_{part}", parameters.get(name, 0.0)))


def _contour(grid: DistanceGrid, growth: float) -> tuple[FloatArray, IntArray]:
    """Returns the points (P, 3) [m] and triangles (S, 3) at a distance from the surface of a grid."""
    import pyvista

    image = pyvista.ImageData(dimensions=grid.distances.shape, spacing=(grid.spacing,) * 3, origin=grid.low)
    surface = image.contour([growth], scalars=grid.distances.ravel(order="F"))
    return np.asarray(surface.points, dtype=float), np.asarray(surface.faces, dtype=np.int64).reshape(-1, 4)[:, :0:-1]


def _outwards(hull: ConvexHull) -> IntArray:
    """Returns the triangles (S, 3) of a convex hull, with normals that point outwards."""
    triangles = np.array(hull.simplices, dtype=np.int64)
    corners = hull.points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = (normals * hull.equations[:, :3]).sum(axis=1) < 0.0
    triangles[inwards] = triangles[inwards, ::-1]
    return triangles


def _solid(obstacle: Obstacle, vertices: FloatArray, growth: float) -> FloatArray:
    """Returns points (P, 3) in the axes of an obstacle, whose convex hull it is.

    Args:
        obstacle: Its shape.
        vertices: (N, 3) of the body, beside which the plate of a half-space lies [m].
        growth: By which its surface lies further out [m].
    """
    x, y, z = obstacle.size
    match obstacle:
        case HalfSpace():
            edge, thickness = np.multiply(_PLATE, np.ptp(vertices, axis=0).max())
            middle = (vertices.mean(axis=0) - obstacle.position) @ obstacle.turn
            lowest = np.array([middle[0] - 0.5 * edge, middle[1] - 0.5 * edge, growth - thickness])
            return np.array([*product(*zip(lowest, lowest + (edge, edge, thickness), strict=True))])
        case Box():
            half = np.array([x, y, z]) + growth
            return np.array([*product(*zip(-half, half, strict=True))])
        case Sphere() | Capsule():
            angles = np.linspace(0.0, 0.5 * np.pi, _CORNERS // 4 + 1)
            radii = np.tile((x + growth) * np.sin(angles), 2)
            heights = np.outer([1.0, -1.0], z + (x + growth) * np.cos(angles)).ravel()
        case Cylinder():
            radii, heights = np.full(2, x + growth), np.array([-z, z]) + growth * np.array([-1.0, 1.0])
        case _:
            raise TypeError(f"{type(obstacle).__name__} has no surface to draw")
    around = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    circle = np.stack([np.cos(around), np.sin(around)], axis=1)
    rings = [np.column_stack([r * circle, np.full(_CORNERS, h)]) for r, h in zip(radii, heights, strict=True)]
    return np.concatenate(rings)
