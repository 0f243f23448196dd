"""The point of a body's surface that is closest to a given one, and on which side of it that one lies."""

from dataclasses import dataclass

import numpy as np

from ..io.errors import InputError
from .mesh import FloatArray, IntArray, Mesh, boundary_triangles

_TIE = 1e-9  # Triangles count as equally close up to this distance, over the diagonal of the mesh.


@dataclass(frozen=True)
class ClosestPoints:
    """What the surface has to say of P points."""

    triangles: IntArray  # (P, 3) vertices of the closest triangle, counter-clockwise seen from outside
    points: FloatArray  # (P, 3) [m] the closest point of that triangle
    normals: FloatArray  # (P, 3) the triangle's outer unit normal
    distances: FloatArray  # (P,) [m] from the closest point; negative inside the body


def closest_points(mesh: Mesh, points: FloatArray) -> ClosestPoints:
    """Finds the closest points on the boundary at rest.

    Faces with four nodes count as two triangles, those with six as four, through all of their nodes. A point beside an
    edge is equally close to the triangles that share it; of these the one that it lies most squarely above is taken.

    Raises:
        InputError: A point of (P, 3) [m] is not finite.
    """
    import trimesh

    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise InputError("The closest point of a surface was asked for of a point that is not finite.")
    triangles = boundary_triangles(mesh)
    corners = mesh.vertices[triangles]  # (F, 3, 3) [m]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tie = _TIE * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    chosen = np.empty(len(points), dtype=np.int64)
    nearest = np.empty_like(points)
    for row, point in enumerate(points):
        candidates = trimesh.triangles.closest_point(corners, np.broadcast_to(point, (len(corners), 3)))
        distance = np.linalg.norm(candidates - point, axis=1)
        close = np.flatnonzero(distance <= distance.min() + tie)
        squarely = np.abs(np.sum((point - candidates[close]) * normals[close], axis=1))
        chosen[row] = close[np.argmax(squarely)]
        nearest[row] = candidates[chosen[row]]
    offset = points - nearest
    side = np.where(np.sum(offset * normals[chosen], axis=1) < 0.0, -1.0, 1.0)
    return ClosestPoints(triangles[chosen], nearest, normals[chosen], side * np.linalg.norm(offset, axis=1))
